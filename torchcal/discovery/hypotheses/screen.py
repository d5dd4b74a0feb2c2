"""Screening in the tangent space: a score statistic, a detection limit and the ties of every candidate.

.. math:: z_i = s_i^\\perp \\cdot r / \\lVert s_i^\\perp \\rVert

with the whitened residual r of the calibrated base and the whitened tangent s of a candidate's amplitude at its neutral
value, projected off the tangents of everything that was calibrated. Linear: it screens and does not decide.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate
from torchcal.discovery.fits.local import SHORT, Span
from torchcal.discovery.fits.readings import are_instruments
from torchcal.discovery.misfit.channels import responses
from torchcal.discovery.misfit.residual import Residual
from torchcal.simulators import Trajectories

__all__ = ["Screening", "Window", "contributions", "screen", "twins", "windows", "windows_of"]

#: A tangent whose projection keeps less than this share of it says nothing new.
VANISHED = 1e-5
#: Correlation from which on an effect is that of a parameter of the base that comes off its bound, up to this.
SAME = 1e-9
#: Correlation of projected tangents above which two candidates are one.
ONE = 0.9999
#: Places at which windows may begin or end, both ends of the driver among them.
CUTS = 13


@dataclass(frozen=True, eq=False)
class Screening:
    """All candidates in the tangent space.

    Attributes:
        columns: Unit tangents ``(n, m)``: every candidate's amplitudes at every shape.
        owner: Number of the candidate of each column, ``(m,)``.
        shape: Number of its shape, ``(m,)``.
        amplitude: Number of its amplitude, ``(m,)``.
        norm: ‖s⊥‖, ``(m,)``.
        z: Score statistics, one-sided where physics is, ``(m,)``.
        best: Best column of every candidate; −1 where its tangent vanishes, or the base has it already.
        acting: The same, and where the base has all of it already some column that it acts by: in a range of something
            it may be new.
        null: Largest score in each simulated residual, ``(draws,)``.
    """

    columns: Tensor
    owner: Tensor
    shape: Tensor
    amplitude: Tensor
    norm: Tensor
    z: Tensor
    best: list[int]
    acting: list[int]
    null: Tensor

    def score(self, i: int) -> float:
        """Largest score of a candidate."""
        return 0.0 if self.best[i] < 0 else float(self.z[self.best[i]])

    def usable(self, i: int) -> Tensor:
        """Columns of a candidate that say something new."""
        return ((self.owner == i) & (self.norm > 0)).nonzero()[:, 0]

    def correlation(self, i: int, j: int) -> float:
        """Of the best tangents of two candidates."""
        if self.best[i] < 0 or self.best[j] < 0:
            return 0.0
        return float(self.columns[:, self.best[i]] @ self.columns[:, self.best[j]])


def screen(residual: Residual, candidates: Sequence[Candidate], before: Screening | None = None) -> Screening:
    """Score every candidate against the residual of a fit.

    What said nothing new ``before``, at the fit that the tangents were taken at, says nothing new at one close to it.
    """
    blocks, owner, shape, amplitude, sign = [], [], [], [], []
    for i, candidate in enumerate(candidates):
        for g in range(len(candidate.shapes)):
            for a, place in enumerate(candidate.amplitudes):
                blocks.append(candidate.tangents[g, :, a])
                owner.append(i)
                shape.append(g)
                amplitude.append(a)
                sign.append(candidate.one_sided(place))
    raw = torch.stack(blocks, dim=-1) if blocks else residual.e.new_zeros(len(residual.e), 0)
    whole = residual.found.whitening(raw)
    columns = residual.project(whole)
    norm = columns.norm(dim=0)
    good = norm > VANISHED * whole.norm(dim=0).clamp_min(1e-300)
    good &= ~_inward(residual, columns, torch.tensor(sign))
    if before is not None:
        good &= before.norm > 0
    norm = torch.where(good, norm, torch.zeros_like(norm))
    columns = torch.where(good, columns / norm.clamp_min(1e-300), torch.zeros_like(columns))
    direction = torch.tensor(sign, dtype=torch.float64)

    def scores(values: Tensor) -> Tensor:
        z = columns.T @ values
        sided = (direction[:, None] * z).clamp_min(0.0)
        return torch.where(direction[:, None] == 0, z.abs(), sided)

    z = scores(residual.e[:, None])[:, 0]
    owners = torch.tensor(owner, dtype=torch.long)
    best, acting = [], []
    for i in range(len(candidates)):
        mine = (owners == i).nonzero()[:, 0]
        usable, moving = mine[good[mine]], mine[whole[:, mine].norm(dim=0) > 0]
        best.append(int(usable[z[usable].argmax()]) if len(usable) else -1)
        acting.append(best[-1] if len(usable) or not len(moving) else int(moving[0]))
    null = scores(residual.null).amax(0) if columns.shape[1] else torch.zeros(residual.null.shape[1])
    return Screening(columns, owners, torch.tensor(shape), torch.tensor(amplitude), norm, z, best, acting, null)


def _inward(residual: Residual, columns: Tensor, sides: Tensor) -> Tensor:
    """Which effects, to the one side that they may act to, are those of a base's parameter that comes off its bound.

    A bound that the base wants to cross leaves its tangent out of what is projected off, but holds it back to one side
    only.
    """
    found = residual.found
    stuck = [i for i, at in zip(found.free, found.at_bound.tolist(), strict=True) if at]
    low, high = (end[stuck] - found.values[stuck] for end in found.problem.limits())
    away = torch.where(low.abs() <= high.abs(), 1.0, -1.0)
    moved = residual.tangent(found.jacobian[:, found.at_bound]) * away
    along = columns.T @ moved / (columns.norm(dim=0)[:, None] * moved.norm(dim=0)).clamp_min(1e-300)
    return (sides[:, None] * along > 1 - SAME).any(1)


def twins(candidates: Sequence[Candidate], screening: Screening) -> dict[int, int]:
    """Candidates that have the same projected tangent as an earlier one, and may have the same sign, and which."""
    side = {i: c.one_sided(c.amplitudes[0]) for i, c in enumerate(candidates)
            if len(c.shapes) == 1 and len(c.amplitudes) == 1}  # fmt: skip
    found: dict[int, int] = {}
    for k, i in itertools.combinations(side, 2):
        alike = screening.correlation(i, k) * (side[i] * side[k] or 1)
        if i not in found and k not in found and (alike > ONE or (alike < -ONE and not side[i] * side[k])):
            found[i] = k
    return found


@dataclass(frozen=True)
class Window:
    """A candidate that acts in a range of one driver only.

    Attributes:
        candidate: Its number.
        driver: The driver.
        low: Lower end, −inf where open.
        high: Upper end.
        z: Score statistic.
        amplitude: Linear estimate of the amplitude.
        span: Scale on which its edges are laid out, once it is fitted.
        at: The levels of another condition at which it acts alone, in words.
    """

    candidate: int
    driver: str
    low: float
    high: float
    z: float
    amplitude: float
    span: Span | None = None
    at: str = ""


def contributions(
    residual: Residual, candidates: Sequence[Candidate], screening: Screening
) -> dict[int, tuple[Tensor, dict[str, Tensor]]]:
    """What a candidate's amplitude does to the data from each part of the trajectory (or each condition) alone.

    Returns by candidate responses ``(n, K)``, or their diagonals ``(n,)`` where each part is a datum, and the drivers
    ``(K,)``. Terms with hidden states, which remember, terms that free a parameter, and instruments of a recording in
    time are left out.
    """
    found = residual.found
    bound = found.problem.simulator
    states = bound.solve(found.values[None], found.warm) if isinstance(bound, Trajectories) else None
    at_data = found.problem.drivers_at_data(found.values[None], found.warm if states is not None else None)
    parts: dict[int, tuple[Tensor, dict[str, Tensor]]] = {}
    moving, forcing = [], []
    for i, candidate in enumerate(candidates):
        column = screening.acting[i]
        if column < 0 or any(term.states or term.frees for term in candidate.terms):
            continue
        values = candidate.begin.clone()
        values[candidate.own] = candidate.shapes[int(screening.shape[column])]
        place = candidate.amplitudes[int(screening.amplitude[column])]
        extended = candidate.problem.simulator
        moves = any(term.rates or term.shifts for term in candidate.terms)
        if (
            states is None
            or not isinstance(extended, Trajectories)
            or not (moves or _is_instrument(candidate, at_data))
        ):
            tangent = candidate.tangents[int(screening.shape[column]), :, int(screening.amplitude[column])]
            parts[i] = tangent, at_data
        elif not any(term.outputs for term in candidate.terms):
            moving.append(i)
            with torch.no_grad():
                forcing.append(extended.steps.derivatives(values[None], states, [place])[2][0])
    if moving:
        response, drivers, _ = responses(found.problem, found, torch.cat(forcing, dim=-1))
        parts |= {i: (response[:, :, k], drivers) for k, i in enumerate(moving)}
    return dict(sorted(parts.items()))


def _is_instrument(candidate: Candidate, drivers: dict[str, Tensor]) -> bool:
    """Whether what changes outputs alone shows a true value otherwise, and reads nothing else."""
    low, high = candidate.problem.limits()
    values = candidate.begin.clone()
    for a, place in enumerate(candidate.amplitudes):  # at neutral it does nothing, whatever it reads
        size = 1.0 / float(candidate.tangents[:, :, a].abs().max().clamp_min(1e-300))
        up, down = float(high[place] - values[place]), float(values[place] - low[place])
        values[place] += min(size, up) if up >= min(size, down) else -min(size, down)
    return any(are_instruments(candidate.problem, candidate.terms, values, drivers))


def windows(residual: Residual, candidates: Sequence[Candidate], screening: Screening) -> tuple[list[Window], Tensor]:
    """Score candidates that act only in a range of time, a state, an input or a condition.

    Returns the best window of every candidate and driver, and the largest score in each simulated residual.
    """
    found: list[Window] = []
    null = torch.zeros(residual.null.shape[1], dtype=torch.float64)
    for i, (response, drivers) in contributions(residual, candidates, screening).items():
        column = screening.acting[i]
        sign = candidates[i].one_sided(candidates[i].amplitudes[int(screening.amplitude[column])])
        mine, largest = windows_of(i, residual, response, drivers, sign)
        found += mine
        null = torch.maximum(null, largest)
    return found, null


def windows_of(
    number: int, residual: Residual, response: Tensor, drivers: dict[str, Tensor], sign: int
) -> tuple[list[Window], Tensor]:
    """The best window of one change, and the best with an open end, in every driver.

    Args:
        number: Of the candidate.
        residual: What is to be explained.
        response: Of the data to the change at each point, ``(n, K)``; or its diagonal ``(n,)`` where each is a datum.
        drivers: At the points, ``(K,)`` each.
        sign: Which the change must have; 0 for either.

    Returns:
        Windows, and the largest score in each simulated residual.
    """
    found: list[Window] = []
    null = torch.zeros(residual.null.shape[1], dtype=torch.float64)
    for name, driver in drivers.items():
        order = driver.argsort(stable=True)
        if not float(driver[order[-1]]) > float(driver[order[0]]):
            continue
        ordered, span = driver[order], Span.of(driver, time=residual.found.problem.is_time(name))
        cuts = _cuts(ordered, span)
        pieces = residual.tangent(_pieces(response, order, cuts))
        running = torch.cat([pieces.new_zeros(len(pieces), 1), pieces.cumsum(1)], dim=1)
        ends = {
            (a, b): _ends(ordered, a, b) for a, b in itertools.combinations(cuts, 2) if (a, b) != (0, len(order))
        }
        edges = [one for one, (low, high) in ends.items() if span.share(low, high) >= SHORT]
        if not edges:
            continue
        at = {place: k for k, place in enumerate(cuts)}
        columns = torch.stack([running[:, at[b]] - running[:, at[a]] for a, b in edges], dim=-1)
        norm = columns.norm(dim=0)
        keep = norm > max(VANISHED * float(running[:, -1].norm()), 1e-300)
        if not bool(keep.any()):
            continue
        unit = torch.where(keep, columns / norm.clamp_min(1e-300), torch.zeros_like(columns))
        z = unit.T @ residual.e
        simulated = unit.T @ residual.null
        if sign:
            z, simulated = (sign * z).clamp_min(0), (sign * simulated).clamp_min(0)
        null = torch.maximum(null, simulated.abs().amax(0))
        chosen = int(z.abs().argmax())
        open_ended = torch.tensor([a == 0 or b == len(order) for a, b in edges])
        simple = int(torch.where(open_ended, z.abs(), torch.zeros_like(z)).argmax())
        for k in dict.fromkeys((chosen, simple)):
            low, high = ends[edges[k]]
            size = float((unit[:, k] @ residual.e) / norm[k].clamp_min(1e-300))
            found.append(Window(number, name, low, high, float(z[k].abs()), size))
    return found, null


def _pieces(response: Tensor, order: Tensor, cuts: list[int]) -> Tensor:
    """Of a response (see `windows_of`) to the points in their order, the sums from each cut to the next one."""
    number = torch.empty_like(order)
    number[order] = torch.arange(len(cuts) - 1).repeat_interleave(torch.tensor(cuts).diff())
    pieces = response.new_zeros(len(response), len(cuts) - 1)
    if response.ndim == 1:
        pieces[torch.arange(len(response)), number] = response
        return pieces
    return pieces.index_add_(1, number, response)


def _cuts(ordered: Tensor, span: Span) -> list[int]:
    """Places in an ordered driver at which windows may end: as even in its range as in its points.

    A driver that rests somewhere has most of its points there, where no window is long enough.
    """
    along = ordered.log() if span.log else ordered
    measure = torch.linspace(0, 1, len(ordered) + 1, dtype=torch.float64)
    between = torch.cat([along[:1], 0.5 * (along[1:] + along[:-1]), along[-1:]])
    measure = 0.5 * (measure + (between - along[0]) / (along[-1] - along[0]))
    apart = torch.cat([torch.ones(1), ordered.diff(), torch.ones(1)]) > 0  # equal values are on one side
    wanted = torch.linspace(0, 1, CUTS, dtype=torch.float64)
    return sorted({int((measure - share).abs().masked_fill(~apart, math.inf).argmin()) for share in wanted})


def _ends(ordered: Tensor, a: int, b: int) -> tuple[float, float]:
    """Where a window of the points from a to b, exclusive, begins and ends."""
    low = -math.inf if a == 0 else float(0.5 * (ordered[a - 1] + ordered[a]))
    high = math.inf if b == len(ordered) else float(0.5 * (ordered[b - 1] + ordered[b]))
    return low, high
