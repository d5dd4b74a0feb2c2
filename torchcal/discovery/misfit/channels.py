"""Channels: the places where a change of the model can act, and what a change there does to the data.

A change of one equation at one moment moves everything that is observed later. Those linear responses, along the fitted
trajectory, say what any rate, known or unknown, in any window of time or state, does to the recording.
"""

import dataclasses
import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.local import is_window
from torchcal.discovery.fits.problem import Problem
from torchcal.display import ITSELF, rate_unit
from torchcal.simulators import Trajectories

__all__ = ["RUN", "Channel", "channels", "responses"]

#: Moments that a trajectory is cut into, over all runs.
BINS = 150

#: The driver of what differs from run to run.
RUN = "run"


@dataclass(frozen=True, eq=False)
class Channel:
    """A place where a change can act.

    Attributes:
        kind: ``"equation"``, ``"parameter"`` or ``"output"``.
        target: Which one.
        unit: Of a change there.
        drivers: What the change may vary with: values at the K points where it can act, ``(K,)`` each.
        time: Time, or condition, of the points ``(K,)``.
        matrix: Response of the n used data to a unit change at each point, ``(n, K)``; or its diagonal ``(n,)`` where
            each point is a datum. Sparse where points are some of the data.
        rates: Of a parameter of differential equations, by equation what a unit change does to its rate, ``(K,)``.
        usual: Of an equation, the r.m.s. along the trajectory of its rate, or of what one parameter adds to that.
    """

    kind: str
    target: str
    unit: str | None
    drivers: dict[str, Tensor]
    time: Tensor
    matrix: Tensor
    rates: dict[str, Tensor] = field(default_factory=dict)
    usual: float = math.inf

    def response(self, profile: Tensor) -> Tensor:
        """Change of the data by a change ``profile`` (K, m) along the points, ``(n, m)``."""
        return self.matrix[:, None] * profile if self.matrix.ndim == 1 else self.matrix @ profile

    def where(self, there: Tensor) -> "Channel":
        """The same with some of its points alone, bool ``(K,)``."""
        rows = there.nonzero()[:, 0]
        if self.matrix.ndim == 1:  # sparse: of thousands of data it has millions of zeros
            at = torch.stack([rows, torch.arange(len(rows))])
            size = (len(there), len(rows))
            matrix = torch.sparse_coo_tensor(at, self.matrix[rows], size, check_invariants=True)
        else:
            matrix = self.matrix[:, rows]
        drivers, rates = ({name: each[rows] for name, each in table.items()} for table in (self.drivers, self.rates))
        return dataclasses.replace(self, drivers=drivers, time=self.time[rows], matrix=matrix, rates=rates)


def _binning(bound: Trajectories) -> tuple[Tensor, int]:
    """Bin of every step ``(R, K)`` (−1 for padding), and how many there are."""
    runs = len(bound.runs)
    each = max(30, BINS // runs)
    bins = torch.full_like(bound.grid.h, -1, dtype=torch.long)
    first = 0
    for r in range(runs):
        real = int((bound.grid.h[r] > 0).sum())
        count = min(each, real)
        bins[r, :real] = first + (torch.arange(real) * count) // real
        first += count
    return bins, first


def responses(problem: Problem, found: Fitted, forcing: Tensor) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """Responses of the used data to forcings within each bin of the trajectory, by the adjoint recursion.

    Args:
        problem: With a simulator in time.
        found: Its fit.
        forcing: Change of the state by the end of each step, ``(R, K, S, m)``.

    Returns:
        ``(n, bins, m)``, the drivers ``(bins,)`` by name, and the bins' times.
    """
    bound = problem.simulator
    if not isinstance(bound, Trajectories):
        raise TypeError("responses need a simulator in time")
    values = found.values[None]
    states = bound.solve(values, found.warm)
    flow = bound.flow(values, states)[0]  # (R, K, S, S)
    size = flow.shape[-1]
    rows = bound.observation_slopes(values, states, problem.recording.outputs)[0][problem.index]  # (n, S)
    run_of, node_of = bound.grid.run_of[problem.condition_of], bound.grid.node_of[problem.condition_of]
    bins, count = _binning(bound)
    result = torch.zeros(problem.n, count, forcing.shape[-1], dtype=torch.float64)
    for r in range(len(bound.runs)):
        mine = (run_of == r).nonzero()[:, 0]
        order = node_of[mine].argsort(descending=True, stable=True)
        mine = mine[order]
        nodes = node_of[mine].tolist()
        adjoint = torch.zeros(len(mine), size, dtype=torch.float64)
        filled = 0
        last = int((bound.grid.h[r] > 0).sum())
        block = torch.zeros(len(mine), count, forcing.shape[-1], dtype=torch.float64)
        where = bins[r].tolist()
        for k in range(last - 1, -1, -1):
            while filled < len(nodes) and nodes[filled] >= k + 1:
                adjoint[filled] = rows[mine[filled]]
                filled += 1
            if filled == 0:
                continue
            active = adjoint[:filled]
            block[:filled, where[k]] += active @ forcing[r, k]
            adjoint[:filled] = active @ flow[r, k]
        result[mine] = block
    along = bound.along(states)
    drivers = {name: _bin_means(bins, count, 0.5 * (table[:, :-1] + table[:, 1:])) for name, table in along.items()}
    return result, drivers, drivers["t"]


def _by_run(problem: Problem, drivers: dict[str, Tensor], runs: Tensor) -> dict[str, Tensor]:
    """With the number of the run among the drivers, where there are several: what differs between runs alone."""
    if not isinstance(problem.recording.x, dict) or RUN in drivers or not problem.in_time:
        return drivers
    if len(problem.recording.x[RUN][problem.condition_of].unique()) < 2:
        return drivers
    return {**drivers, RUN: runs.to(torch.float64)}


def _bin_means(bins: Tensor, count: int, steps: Tensor) -> Tensor:
    """Means over the steps ``(R, K, ...)`` of each bin, ``(bins, ...)``."""
    real = bins >= 0
    ones = torch.ones(int(real.sum()), dtype=torch.float64)
    weight = torch.zeros(count, dtype=torch.float64).index_add_(0, bins[real], ones)
    total = torch.zeros(count, *steps.shape[2:], dtype=torch.float64).index_add_(0, bins[real], steps[real])
    return total / weight.reshape(-1, *(1 for _ in steps.shape[2:]))


def _time(problem: Problem) -> Tensor:
    """Time, or the condition's number, of every datum ``(n,)``."""
    at = problem.condition_of
    return problem.order[at] if problem.in_time and problem.order is not None else at.double()


def definitions(bound: Trajectories, values: Tensor, states: Tensor) -> set[str]:
    """States whose equation only says what another state is, as dx/dt = v does: there is no physics to leave out.

    Args:
        bound: The simulator.
        values: Its parameters ``(d,)``.
        states: A trajectory, ``(1, R, nodes, S)``.
    """
    generator = torch.Generator().manual_seed(0)

    def moved(tensor: Tensor) -> Tensor:
        size = tensor.abs().max().clamp_min(1e-3)
        return tensor + 0.1 * size * torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)

    rates, there = [], []
    for node in torch.linspace(0, bound.grid.t.shape[1] - 1, 4).round().long().tolist():
        here = torch.stack([moved(column) for column in states[0, :, node].unbind(-1)], dim=-1)[None]  # (1, R, S)
        others = torch.stack([moved(value[None])[0] for value in values])  # each by its own size, and none stays 0
        u = {name: moved(table[0, :, node]) for name, table in bound.grid.u.items()}
        rates.append(bound.steps.rates(bound.grid.t[:, node], here, bound.layout.by_name(others[None]), u))
        there.append(here)
    slopes, here = torch.cat(rates), torch.cat(there)
    names = list(bound.ode.states)
    same = [
        name
        for i, name in enumerate(names)
        if any(j != i and torch.equal(slopes[..., i], here[..., j]) for j in range(len(names)))
    ]
    return set(same) if len(same) < len(names) else set()


def channels(problem: Problem, found: Fitted) -> list[Channel]:
    """Every equation that is no definition, every free parameter but those of windows, and every output."""
    list_: list[Channel] = []
    bound = problem.simulator
    names = [q.name for q in problem.parameters]
    if isinstance(bound, Trajectories):
        states = bound.solve(found.values[None], found.warm)
        own = [i for i in found.free if names[i] not in bound.initial_names and not is_window(names[i])]
        size = len(bound.ode.states)
        _, _, by_parameter = bound.steps.derivatives(found.values[None], states, own)
        kicks = bound.steps.kicks(found.values[None], states)[0]
        forcing = torch.cat([kicks, by_parameter[0]], dim=-1)
        response, drivers, time = responses(problem, found, forcing)
        bins, count = _binning(bound)
        _, seen = bound.observation_slopes(found.values[None], states, problem.recording.outputs, own)
        # A datum at the end of a step sees a parameter of the instrument as it is then.
        step = (bound.grid.node_of - 1).clamp_min(0)
        at = bins[bound.grid.run_of, step][problem.condition_of]
        response[torch.arange(problem.n), at, size:] += seen[problem.index]
        run = torch.arange(len(bins), dtype=torch.float64)[:, None].expand(bins.shape)
        drivers = _by_run(problem, drivers, _bin_means(bins, count, run))
        labels = [
            ("equation", state, rate_unit(unit, problem.recording.units.get("time", "[time]")))
            for state, unit in bound.ode.states.items()
        ]
        labels += [("parameter", names[i], problem.parameters[i].unit) for i in own]
        given = definitions(bound, found.values, states)
        rates = _bin_means(bins, count, bound.rates_by(found.values[None], states, own)[0])
        real = bound.grid.h > 0
        net = (states[0].diff(dim=1)[real] / bound.grid.h[real][:, None]).square().mean(0).sqrt()
        parts = (rates * found.values[own]).square().mean(0).sqrt()  # which may balance
        usual = torch.cat([net[:, None], parts], dim=1).amax(1).tolist()
        for m, (kind, target, unit) in enumerate(labels):
            if kind == "equation" and target in given:
                continue
            moved: dict[str, Tensor] = {}
            if kind == "parameter":
                changes = zip(bound.ode.states, rates[:, :, m - size].unbind(-1), strict=True)
                moved = {name: rate for name, rate in changes if name not in given and bool((rate != 0).any())}
            own_rate = usual[m] if kind == "equation" else math.inf
            list_.append(Channel(kind, target, unit, drivers, time, response[:, :, m], moved, own_rate))
        at_data = problem.drivers_at_data(found.values[None], found.warm)
        at_data = _by_run(problem, at_data, bound.grid.run_of[problem.condition_of])
    else:
        at_data = problem.drivers_at_data(found.values[None], None)
        time = _time(problem)
        for j, i in enumerate(found.free):
            if is_window(names[i]):
                continue
            list_.append(
                Channel("parameter", names[i], problem.parameters[i].unit, at_data, time, found.jacobian[:, j])
            )
    time = _time(problem)
    for number, name in enumerate(problem.recording.outputs):
        mine = (problem.output_of == number).double()
        own_drivers = {**at_data, f"{name}{ITSELF}": found.y}
        if name in at_data or (not problem.in_time and problem.order is not None):  # it is seen along another
            own_drivers.pop(f"{name}{ITSELF}")
        list_.append(Channel("output", name, problem.recording.units.get(name), own_drivers, time, mine))
    return [c for c in list_ if math.isfinite(float(c.matrix.abs().sum()))]
