"""Unknown initial states, read back from the first readings of outputs that are functions of them."""

import itertools
from collections.abc import Set
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.errors import SimulatorError
from torchcal.simulators import Trajectories

__all__ = ["read_back", "slopes_by"]

#: Sizes of initial states, in powers of ten, that are tried; Gauss-Newton steps from there, and the part of a step that
#: is tried after one that led nowhere.
MAGNITUDES, STEPS, SHORTER = range(-3, 5), 8, 0.25
#: Share of its squared error that a run's readings must leave for its states to be moved.
NEARER = 0.5
#: Relative size of a singular value of the slopes that is none.
NONE = 1e-6


def read_back(problem: Problem, begin: Tensor, held: Set[int]) -> Tensor:
    """Starting values ``(H, P)`` with unknown initial states at which outputs that are functions of them begin as
    recorded.

    Of several sizes the one that comes nearest is followed by Gauss-Newton steps, run by run. Where that leaves more
    than `NEARER` of the squared error, or the functions raise, a run's states stay as they were.

    Args:
        problem: The used data.
        begin: Starting values.
        held: Places of parameters that are not calibrated.
    """
    bound = problem.simulator
    if not isinstance(bound, Trajectories):
        return begin
    places = [
        i for i, q in enumerate(problem.parameters)
        if q.name in bound.initial_names and q.initial is None and i not in held
    ]  # fmt: skip
    first = _first(problem, bound)
    if not places or not first:
        return begin
    readings = _Readings(problem, bound, torch.tensor(first), torch.tensor(places))
    with torch.no_grad():
        return readings.met(begin)


def _first(problem: Problem, bound: Trajectories) -> list[int]:
    """Places in ``recording.y`` of the first used reading of every run by every output that is no state."""
    recording, found = problem.recording, []
    for k, name in enumerate(recording.outputs):
        if name in bound.ode.reads:
            continue
        seen = problem.keep[k * recording.n : (k + 1) * recording.n].nonzero()[:, 0]
        run = bound.grid.run_of[seen]
        found += [k * recording.n + int(seen[run == r][0]) for r in run.unique()]
    return found


@dataclass(frozen=True, eq=False)
class _Readings:
    """First readings that initial states are to meet.

    Attributes:
        problem: The used data.
        bound: Its simulator.
        first: Places of the readings in ``recording.y``, ``(T,)``.
        places: Of the initial states among the parameters, ``(S,)``.
    """

    problem: Problem
    bound: Trajectories
    first: Tensor
    places: Tensor

    def met(self, begin: Tensor) -> Tensor:
        """Starting values with these states moved, run by run, where that leads nearer."""
        places = self.places[self._acting(begin)]
        if not len(places):
            return begin
        low, high = self.problem.limits()
        run_of = torch.tensor([self.bound.layout.origins[i][1] for i in places.tolist()])
        own, best = self._errors(begin), begin
        error, share = own, torch.ones_like(own)
        for size, sign in itertools.product(MAGNITUDES, (1.0, -1.0)):
            tried = begin.index_fill(1, places, sign * 10.0**size).clamp(low, high)
            best, error = _nearer(best, error, tried, self._errors(tried), places, run_of)
        for _ in range(STEPS):
            step = share[:, run_of] * self._step(best, places)
            tried = best.index_copy(1, places, best[:, places] - step).clamp(low, high)
            before = error
            best, error = _nearer(best, error, tried, self._errors(tried), places, run_of)
            share = torch.where(error < before, torch.ones_like(share), SHORTER * share)
        enough = NEARER * own.nan_to_num(posinf=torch.finfo(own.dtype).max)
        return _nearer(begin, enough, best, error, places, run_of)[0]

    def _left(self, values: Tensor) -> Tensor:
        """By how much the readings are missed, in the spread of their outputs, ``(H, T)``."""
        recording = self.problem.recording
        shown = self.bound.readings(values, self.bound.layout.start(values))
        return (shown[:, self.first] - recording.y[self.first]) / recording.spread[self.first]

    def _errors(self, values: Tensor) -> Tensor:
        """Squared, by run, ``(H, R)``; infinite where a function raises."""
        run_of = self.bound.grid.run_of[self.first % self.problem.recording.n]
        found = torch.zeros(len(values), len(self.bound.runs), dtype=torch.float64)
        try:
            square = self._left(values).square().nan_to_num(nan=torch.inf)
        except SimulatorError:
            return torch.full_like(found, torch.inf)
        return found.index_add(1, run_of, square)

    def _slopes(self, values: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """What is left, ``(H, T)``, and its slopes by initial states, ``(H, T, S)``; 0 where a function raises, or is
        not finite."""
        with torch.enable_grad():
            leaf = values[:, places].clone().requires_grad_(True)
            try:
                left = self._left(values.index_copy(1, places, leaf))
            except SimulatorError:
                shape = len(values), len(self.first)
                return values.new_zeros(shape), values.new_zeros(*shape, len(places))
            jacobian = slopes_by(leaf, left)
        sound = torch.isfinite(left.detach()) & torch.isfinite(jacobian).all(-1)
        return left.detach().where(sound, 0.0), jacobian.where(sound[..., None], 0.0)

    def _acting(self, begin: Tensor) -> Tensor:
        """Which of the states the readings depend on, bool ``(S,)``, where they begin or at one."""
        rows = torch.cat([begin, begin.index_fill(1, self.places, 1.0)])
        return (self._slopes(rows, self.places)[1] != 0).any(1).any(0)

    def _step(self, values: Tensor, places: Tensor) -> Tensor:
        left, jacobian = self._slopes(values, places)
        return (torch.linalg.pinv(jacobian, rtol=NONE) @ left.unsqueeze(-1))[..., 0]


def slopes_by(leaf: Tensor, left: Tensor) -> Tensor:
    """Slopes of ``left`` ``(H, T)`` by a leaf ``(H, S)`` of its graph, row by row, ``(H, T, S)``; 0 where it has none.
    """
    rows = [
        torch.autograd.grad(left[:, k].sum(), leaf, retain_graph=True, allow_unused=True)[0]
        if left.requires_grad else None
        for k in range(left.shape[1])
    ]  # fmt: skip
    return torch.stack([torch.zeros_like(leaf) if row is None else row for row in rows], dim=1)


def _nearer(
    values: Tensor, error: Tensor, other: Tensor, its: Tensor, places: Tensor, run_of: Tensor
) -> tuple[Tensor, Tensor]:
    """Of two rows of values ``(H, P)`` the one with the smaller error, run by run ``(H, R)``, and that error."""
    less = its < error
    moved = torch.where(less[:, run_of], other[:, places], values[:, places])
    return values.index_copy(1, places, moved), torch.where(less, its, error)
