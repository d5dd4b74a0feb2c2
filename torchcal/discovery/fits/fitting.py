"""Least squares on the trajectories: Levenberg–Marquardt from several starts at once, within physical bounds."""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem, Whitening
from torchcal.discovery.fits.rhythm import rhythms
from torchcal.simulators import Solution

__all__ = ["Fitted", "finished", "fit", "refit", "weighed"]

#: Relative change of χ² below which a fit has converged.
TOLERANCE = 1e-7
MAX_STEPS = 60
#: Change of χ², in the residual's variance but at most in that of the noise, below which so many steps lead nowhere, of
#: which so many at least were not taken back.
CREEPING, STEPS, TAKEN = 0.02, 20, 5
#: Share of χ² that so many steps take off at least, unless at so many times their pace the fit comes to where it is
#: wanted.
PACE, FASTER = 0.05, 3.0
#: Part of a step after which its bend is looked at, and how long beside the step a turn may be that is taken.
AHEAD, TURN = 0.1, 0.75
#: More steps of the best alone, where it has not converged in those: along a bent valley they are short.
FINISH = 240
#: How far below the smallest start of a parameter on a logarithmic scale one begins that would not be positive.
BELOW = 0.05


@dataclass(frozen=True, eq=False)
class Fitted:
    """The best of several fits.

    Attributes:
        problem: What was fitted.
        whitening: Of its residuals.
        values: Parameters ``(P,)``, physical units.
        free: Places of those that were fitted.
        y: Fitted outputs at the used data, ``(n,)``.
        jacobian: ∂y/∂λ of the free ones there, ``(n, free)``.
        chi2: ‖W (y − f)‖².
        at_bound: Which of the free ones lie on a bound that they want to cross, bool ``(free,)``.
        warm: Warm start.
        agreeing: Share of the starts that came to this χ².
        ends: Where every start ended, ``(H, P)``.
        ends_chi2: With which χ², ``(H,)``.
        falling: By how much its χ² fell in its last steps; 0 where it came to an end.
    """

    problem: Problem
    whitening: Whitening
    values: Tensor
    free: list[int]
    y: Tensor
    jacobian: Tensor
    chi2: float
    at_bound: Tensor
    warm: Solution | None
    agreeing: float = 1.0
    ends: Tensor | None = None
    ends_chi2: Tensor | None = None
    falling: float = 0.0

    @property
    def residual(self) -> Tensor:
        """``y − f`` at the used data."""
        return self.problem.y - self.y

    @cached_property
    def rhythms(self) -> list[float]:
        """Periods of the strongest waves in what it leaves."""
        return rhythms(self.problem, self.whitening.vector(self.residual))

    @property
    def met(self) -> Tensor:
        """Which data it meets to a millionth of their spread, bool ``(n,)``: what it leaves of them is rounding."""
        return self.residual.abs() <= 1e-6 * self.problem.recording.spread[self.problem.index]

    def covariance(self) -> Tensor:
        """Of the free parameters, ``(free, free)``; directions without information get a huge variance."""
        j = self.whitening(self.jacobian)
        scale = j.square().sum(0).sqrt()
        scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        values, vectors = torch.linalg.eigh((j / scale).T @ (j / scale))
        inverse = 1.0 / values.clamp_min(max([1e-300, *(1e-13 * values).tolist()]))
        return (vectors * inverse) @ vectors.T / (scale[:, None] * scale)

    @property
    def by_name(self) -> dict[str, float]:
        """Values of all parameters, free or not."""
        return dict(zip([q.name for q in self.problem.parameters], self.values.tolist(), strict=True))

    @property
    def stuck(self) -> list[str]:
        """Names of the free parameters on a bound that they want to cross."""
        parameters = self.problem.parameters
        return [parameters[i].name for i, at in zip(self.free, self.at_bound.tolist(), strict=True) if at]

    def chi2_at(self, values: Tensor) -> Tensor:
        """χ² of the same model at other parameters ``(H, P)``, ``(H,)``; infinite where its outputs are not finite."""
        left = self.whitening.vector(self.problem.y - self.problem.evaluate(values, [])[0])
        return left.square().sum(-1).nan_to_num(nan=torch.inf)

    def leads_to(self, aim: float, steps: int = FINISH) -> bool:
        """Whether it has steps to go that may lead to a χ² of ``aim`` at a multiple of their pace."""
        return self.falling > 0 and not self.chi2 - FASTER * steps / STEPS * self.falling > aim

    def sd(self) -> Tensor:
        """Standard deviations ``(P,)``; 0 for those held."""
        found = torch.zeros_like(self.values)
        found[self.free] = self.covariance().diagonal().clamp_min(0).sqrt()
        return found


def _positive(values: Tensor, log: Tensor) -> Tensor:
    """Starting values ``(H, free)``, those that a logarithmic scale does not have well below the others' smallest."""
    if not bool((log & (values <= 0)).any()):
        return values
    smallest = torch.where(values > 0, values, torch.full_like(values, torch.inf)).amin(0)
    small = torch.where(smallest.isfinite(), BELOW * smallest, torch.full_like(smallest, BELOW))
    return torch.where(log & (values <= 0), small, values)


def fit(
    problem: Problem,
    whitening: Whitening,
    begin: Tensor,
    free: list[int],
    *,
    warm: Solution | None = None,
    data: Tensor | None = None,
    max_steps: int = MAX_STEPS,
    finish: int = FINISH,
    aim: float = torch.inf,
    later: int = 0,
    bend: bool = False,
) -> Fitted | None:
    """Minimise χ² over the free parameters from every row of ``begin`` (H, P); None where no start works.

    Marquardt's scaling makes it independent of units. A parameter on a bound that the gradient pushes outward is held
    for the step. Parameters with ``transform="log"`` are stepped in their logarithm. With ``data`` (H, n) every start
    is fitted to data of its own, and ``ends_chi2`` tells how well. A start ends where it has converged, or creeps.
    Where the best has done neither after ``max_steps`` it goes on alone for at most ``finish`` more. A start that falls
    so slowly that its χ² will be above ``aim`` in the end, with ``later`` steps of `finished` too, has no need to get
    there, and ends too. With ``bend``, as in those last steps, every step follows the valley's curvature (geodesic
    acceleration; Transtrum & Sethna 2012, arXiv:1201.5885), which costs a look ahead and makes bent valleys several
    times shorter.
    """
    low, high = problem.limits()
    low, high = low[free], high[free]
    log = torch.tensor([problem.parameters[i].transform == "log" for i in free], dtype=torch.bool)
    target = whitening.vector(problem.y if data is None else data)
    values = begin.clone()
    values[:, free] = _positive(values[:, free].clamp(low, high), log)

    def evaluate(
        points: Tensor, target: Tensor, warm: Solution | None, march: bool = True
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Solution | None]:
        y, jacobian, warm = problem.evaluate(points, free, warm, march=march)
        residual = target - whitening.vector(y)
        chi2 = residual.square().sum(-1)
        bad = ~torch.isfinite(chi2) | ~torch.isfinite(jacobian).flatten(1).all(-1)
        return y, jacobian, residual, torch.where(bad, torch.full_like(chi2, torch.inf), chi2), warm

    y, jacobian, residual, chi2, warm = evaluate(values, target, warm)
    alive = torch.isfinite(chi2)
    if not bool(alive.any()):
        return None
    if not bool(alive.all()):  # infinite trajectories would poison the batch
        values, y, jacobian, residual, chi2 = (t[alive] for t in (values, y, jacobian, residual, chi2))
        warm = None if warm is None else warm.rows(alive)
        if data is not None:
            target, data = target[alive], data[alive]
    damping = torch.full_like(chi2, 1e-3)
    size = torch.zeros(len(values), len(free), dtype=torch.float64)
    done = torch.zeros(len(values), dtype=torch.bool)
    lost = torch.zeros(len(values), dtype=torch.long)
    eager = torch.full_like(chi2, 0.2)
    passed, taken = [chi2.clone()], [torch.zeros_like(chi2)]
    for _ in range(max_steps):
        if not free:
            break
        slope = whitening(jacobian)
        if bool(log.any()):
            slope = torch.where(log, slope * values[:, None, free], slope)
        gradient = (slope.transpose(-1, -2) @ residual.unsqueeze(-1))[..., 0]
        diagonal = slope.square().sum(-2)
        size = torch.maximum(size * 0.9, diagonal)
        now = values[:, free]
        stuck = ((now <= low) & (gradient < 0)) | ((now >= high) & (gradient > 0)) | (size <= 0)
        held = torch.zeros_like(now)
        for _ in range(len(free)):
            unit = torch.where(stuck, torch.ones_like(size), size).sqrt()
            left = residual - (slope @ held.unsqueeze(-1))[..., 0]
            u, s, v = torch.linalg.svd(
                torch.where(stuck[:, None], torch.zeros_like(slope), slope / unit[:, None]), full_matrices=False
            )
            along = (u.transpose(-1, -2) @ left.unsqueeze(-1))[..., 0]
            shrink = s / (s.square() + damping[:, None] + 1e-14)
            change = (v.transpose(-1, -2) @ (shrink * along).unsqueeze(-1))[..., 0] / unit
            change = torch.where(stuck, held, change)
            free_move = torch.where(log, now * change.clamp(-2, 2).exp(), now + change)
            over = ~stuck & ((free_move < low) | (free_move > high))
            if not bool(over.any()):
                break
            wall = free_move.clamp(low, high)
            held = torch.where(over, torch.where(log, (wall / now).log(), wall - now), held)
            stuck = stuck | over
        if bend:
            change = torch.where(log, change.clamp(-2, 2), change)
            ahead = values.clone()
            ahead[:, free] = torch.where(log, now * (AHEAD * change).exp(), now + AHEAD * change).clamp(low, high)
            rise = whitening.vector(problem.evaluate(ahead, [], warm, march=False)[0] - y) / AHEAD
            second = 2.0 / AHEAD * (rise - (slope @ change.unsqueeze(-1))[..., 0])
            along = (u.transpose(-1, -2) @ second.unsqueeze(-1))[..., 0]
            turn = -(v.transpose(-1, -2) @ (shrink * along).unsqueeze(-1))[..., 0] / unit
            short = (turn * unit).norm(dim=-1) <= TURN * (change * unit).norm(dim=-1)  # not where it is NaN
            change = torch.where(short[:, None] & ~stuck, change + 0.5 * turn, change)
            free_move = torch.where(log, now * change.clamp(-2, 2).exp(), now + change)
        moved = free_move.clamp(low, high)
        trial = values.clone()
        trial[:, free] = torch.where(done[:, None], now, moved)
        step = torch.where(log, (trial[:, free] / now).log(), trial[:, free] - now)
        reach = (slope @ step.unsqueeze(-1))[..., 0]
        predicted = 2 * (step * gradient).sum(-1) - reach.square().sum(-1)
        # A step from which the trajectory cannot be mended at once is too long; only if that goes on is it marched.
        rows = (~done).nonzero()[:, 0]  # the others are not evaluated again
        part = None if warm is None else warm.rows(rows)
        *found, warm_part = evaluate(
            trial[rows], target[rows] if target.ndim == 2 else target, part, bool((lost[rows] >= 3).any())
        )
        y_new, jacobian_new, residual_new, chi2_new = (
            old.index_copy(0, rows, new) for old, new in zip((y, jacobian, residual, chi2), found, strict=True)
        )
        lost = torch.where(torch.isfinite(chi2_new) | (lost >= 3), torch.zeros_like(lost), lost + 1)
        gain = (chi2 - chi2_new) / predicted.clamp_min(1e-300)
        better = (chi2_new < chi2) & ~done
        small = predicted.abs() <= TOLERANCE * (chi2 + 1e-3 * problem.n)
        done = done | (small & ~(chi2_new < chi2 * (1 - TOLERANCE))) | (~better & (damping > 1e10))
        for old, new in (
            (values, trial),
            (y, y_new),
            (jacobian, jacobian_new),
            (residual, residual_new),
            (chi2, chi2_new),
        ):
            old[better] = new[better]
        if warm is not None and warm_part is not None:
            warm = warm.updated(better, warm_part.rows(better[rows]))
        # A step that had to be taken back teaches caution: along a bent valley the damping would swing otherwise.
        eager = torch.where(better, (eager * 0.9).clamp_min(0.2), (eager * 2.0).clamp_max(0.8))
        ease = torch.where(
            gain > 0.75, eager, torch.where(gain > 0.25, torch.full_like(gain, 0.9), torch.full_like(gain, 2.0))
        )
        damping = torch.where(better, damping * ease, damping * 4.0)
        damping = damping.clamp(1e-9, 1e12)
        passed.append(chi2.clone())
        taken.append(taken[-1] + better)
        if len(passed) > STEPS:  # along a valley that is nearly flat
            creeping = passed[-1 - STEPS] - chi2 < CREEPING * (chi2 / problem.n).clamp_max(1.0)
            done = done | (creeping & (taken[-1] - taken[-1 - STEPS] >= TAKEN))
            fall, left_over = passed[-1 - STEPS] - chi2, (max_steps + finish + later - len(passed) + 1) / STEPS
            done = done | ((fall < PACE * chi2) & (chi2 - FASTER * left_over * fall > aim))
        if bool(done.all()):
            break
    best = int(chi2.argmin())
    agreeing = float((chi2 <= chi2[best] * (1 + 1e-3) + 0.1).double().mean())
    gradient = (whitening(jacobian[best]).T @ residual[best]) if free else residual[best, :0]
    now = values[best, free]
    width = torch.where(torch.isfinite(high - low), high - low, now.abs().clamp_min(1e-300))
    near = 1e-6 * width
    spread = torch.ones_like(now)
    if free:
        tangents = whitening(jacobian[best])
        edge = (now <= low + near) | (now >= high - near)
        others = tangents[:, ~edge]
        sizes = others.norm(dim=0).clamp_min(1e-300)
        uu, ss, _ = torch.linalg.svd(others / sizes, full_matrices=False)
        basis = uu[:, ss > 1e-7 * ss.max()] if others.shape[1] else tangents[:, :0]
        spread = (tangents - basis @ (basis.T @ tangents)).norm(dim=0).clamp_min(1e-300)
    pushed = gradient / spread
    at_bound = ((now <= low + near) & (pushed < -2.0)) | ((now >= high - near) & (pushed > 2.0))
    ended = Fitted(
        problem=problem,
        whitening=whitening,
        values=values[best],
        free=list(free),
        y=y[best],
        jacobian=jacobian[best],
        chi2=float(chi2[best]),
        at_bound=at_bound,
        warm=None if warm is None else Solution(warm.states[best : best + 1]),  # tangents would only take memory
        ends=values,
        ends_chi2=chi2,
        agreeing=agreeing,
        falling=0.0 if not free or bool(done[best]) else max(float(passed[-1 - STEPS :][0][best] - chi2[best]), 1e-300),
    )
    return finished(ended, aim, finish, None if data is None else data[best : best + 1])


def finished(found: Fitted, aim: float = torch.inf, steps: int = FINISH, data: Tensor | None = None) -> Fitted:
    """A fit brought to its end in so many steps more, where they may lead to a χ² of ``aim``."""
    if not steps or not found.leads_to(aim, steps):
        return found
    last = fit(
        found.problem,
        found.whitening,
        found.values[None],
        found.free,
        warm=found.warm,
        data=data,
        max_steps=steps,
        finish=0,
        aim=aim,
        bend=True,
    )
    return found if last is None else dataclasses.replace(
        last, ends=found.ends, ends_chi2=found.ends_chi2, agreeing=found.agreeing
    )


def refit(found: Fitted, whitening: Whitening, problem: Problem | None = None, aim: float = torch.inf) -> Fitted:
    """The same model fitted again with other noise, or to other data, from where it stood.

    Where its way is long and does not lead to a χ² of ``aim`` it does not go to its end.
    """
    problem = found.problem if problem is None else problem
    again = fit(problem, whitening, found.values[None], found.free, warm=found.warm, aim=aim)
    if again is None:
        return dataclasses.replace(found, problem=problem, whitening=whitening)
    return dataclasses.replace(again, agreeing=found.agreeing)


def weighed(found: Fitted, whitening: Whitening) -> Fitted:
    """The same values under other noise, not fitted again."""
    chi2 = float(whitening.vector(found.residual).square().sum())
    return dataclasses.replace(found, whitening=whitening, chi2=chi2)
