"""Recording and bound simulator as one least-squares problem, and the whitening of its residuals."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.errors import SimulatorError
from torchcal.simulators import Parameter, Simulator, Solution, Trajectories, Values, check_slopes, limits

__all__ = ["SWEEP", "Problem", "Whitening", "breaks", "remembered"]

#: Combinations of all levels of all conditions, in the number of rows, up to which these are a grid; the levels of a
#: condition up to which it switches between sweeps of another one; and the rows of a sweep, on average, at least.
GRID, SWITCH, SWEEP = 2.0, 2, 6
#: Distances of samples, in sampling intervals, over which noise forgets: at least and at most; and how far from 1 they
#: are where sampling is uneven.
SHORTEST, LONGEST, UNEVEN = 1e-3, 1e3, 0.05
#: Correlation of noise in neighbouring samples at most, however close they are.
CLOSEST = 0.999


@dataclass(frozen=True, eq=False)
class Whitening:
    """Turns residuals into independent ones of unit variance.

    Every output of every run is a sequence. With an AR(1) coefficient φ and a distance of d sampling intervals between
    neighbours their correlation is φ^d.

    Attributes:
        sd: Noise sd, ``(n,)``.
        correlation: φ^d with the sample before, ``(n,)``; 0 for the first. Of several memories ``(m, n)``.
        before: Place of the sample before, ``(n,)``.
    """

    sd: Tensor
    correlation: Tensor
    before: Tensor

    @cached_property
    def white(self) -> bool:
        """Whether no datum is correlated with another, where one memory was asked for."""
        return self.correlation.ndim == 1 and not bool((self.correlation != 0).any())

    @cached_property
    def news(self) -> Tensor:
        """Share of the noise sd that is not remembered, like `correlation`."""
        return (1 - self.correlation.square()).sqrt()

    def __call__(self, values: Tensor) -> Tensor:
        """Whitened ``(*batch, n, columns)``; ``(m, n, columns)`` of ``(n, columns)`` in noise of m memories."""
        scaled = values / self.sd[:, None]
        if self.white:
            return scaled
        return (scaled - self.correlation[..., None] * scaled[..., self.before, :]) / self.news[..., None]

    def vector(self, values: Tensor) -> Tensor:
        """Whitened ``(*batch, n)``."""
        return self(values.unsqueeze(-1)).squeeze(-1)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is compared with what.

    Attributes:
        simulator: Bound to the recording.
        recording: All data.
        keep: Which of the n_total outputs are used, bool ``(n_total,)``.
        by_sample: Whether noise forgets with every sample, as that of an instrument that filters its readings does,
            and not with time.
    """

    simulator: Simulator
    recording: Recording
    keep: Tensor
    by_sample: bool = False

    @classmethod
    def of(cls, simulator: Simulator, recording: Recording) -> "Problem":
        """The problem of all observed data."""
        return cls(simulator.bind(recording), recording, recording.observed.clone())

    def with_simulator(self, simulator: Simulator) -> "Problem":
        """Another simulator of the same data."""
        return dataclasses.replace(self, simulator=simulator)

    def keeping(self, keep: Tensor) -> "Problem":
        """The same with fewer data."""
        return dataclasses.replace(self, keep=self.keep & keep)

    @cached_property
    def index(self) -> Tensor:
        """Places of the used data in ``recording.y``, ``(n,)``."""
        return self.keep.nonzero()[:, 0]

    @property
    def n(self) -> int:
        """Number of used data."""
        return len(self.index)

    @cached_property
    def y(self) -> Tensor:
        """Used data, ``(n,)``."""
        return self.recording.y[self.index]

    @cached_property
    def output_of(self) -> Tensor:
        """Number of the output of each used datum, ``(n,)``."""
        return self.index // self.recording.n

    @cached_property
    def condition_of(self) -> Tensor:
        """Number of the condition of each used datum, ``(n,)``."""
        return self.index % self.recording.n

    @cached_property
    def before(self) -> Tensor:
        """Place of the datum that was recorded before each one, ``(n,)``; of the first its own."""
        found = torch.arange(self.n)
        for places in self.recorded:
            found[places[1:]] = places[:-1]
        return found

    def by_run(self, values: Tensor) -> Tensor:
        """Sums of values of the used data ``(*batch, n)`` over those of each run, ``(*batch, R)``."""
        run_of = self.recording.x["run"][self.condition_of].long()  # type: ignore[index]
        found = values.new_zeros(*values.shape[:-1], len(self.recording.runs or ()))
        return found.index_add(-1, run_of, values)

    @property
    def dear(self) -> bool:
        """Whether the simulator's evaluations cost what nobody can tell, as those of a program of its own do."""
        return self.simulator.dear and not isinstance(self.simulator, Trajectories)

    @property
    def in_time(self) -> bool:
        """Whether the recording is one in time."""
        return self.recording.runs is not None

    @cached_property
    def order(self) -> Tensor | None:
        """What neighbouring data follow each other in: time, or the only condition; None where nothing does."""
        several = len(self.recording.columns.T) > 1 and not self.in_time
        return None if several or self.clock is None else self.clock[1]

    @cached_property
    def clock(self) -> tuple[str, Tensor] | None:
        """Name and values of what the data were recorded along: what they follow each other in, or of several
        conditions one that rises, or falls, from every row to the next."""
        x = self.recording.x
        if not isinstance(x, dict):
            return "x", x
        if self.in_time:
            return "t", x["time"]
        steps = {name: values.diff() for name, values in x.items()}
        along = [name for name, step in steps.items() if bool((step > 0).all()) or bool((step < 0).all())]
        names = list(x) if len(x) == 1 else along
        return (names[0], x[names[0]]) if len(names) == 1 else None

    @cached_property
    def levels(self) -> tuple[Tensor, Tensor]:
        """Different conditions ``(m, C)``, and which of them every row is at, ``(rows,)``."""
        return self.recording.columns.unique(dim=0, return_inverse=True)  # type: ignore[no-any-return]

    @cached_property
    def sweeps(self) -> Tensor | None:
        """Number of the sweep that every row belongs to, ``(rows,)``; None where rows do not follow one another.

        Noise may be correlated along the rows of one sweep, as they were recorded. A grid is recorded sweep by sweep,
        or in an order of its own: a smooth effect of one of its conditions is steps along all rows, as slow noise may
        be.
        """
        one = torch.zeros(self.recording.n, dtype=torch.long)
        if self.order is not None:
            return one
        columns = self.recording.columns
        levels = [len(column.unique()) for column in columns.T]
        if sum(count > SWITCH for count in levels) == 1 or math.prod(levels) > GRID * len(one):
            return one
        one[1:] = breaks(columns).cumsum(0)
        return one if len(one) >= SWEEP * (int(one[-1]) + 1) else None

    @cached_property
    def sequences(self) -> list[Tensor]:
        """Places (among the used data) of each output of each run, in order."""
        run = self.recording.x["run"] if self.in_time else torch.zeros(self.recording.n)  # type: ignore[index]
        found = []
        for output in range(len(self.recording.outputs)):
            for r in run.unique():
                places = ((self.output_of == output) & (run[self.condition_of] == r)).nonzero()[:, 0]
                if self.order is not None:
                    places = places[self.order[self.condition_of[places]].argsort(stable=True)]
                if len(places):
                    found.append(places)
        return found

    @cached_property
    def recorded(self) -> list[Tensor]:
        """The same in the order in which they were recorded, in which noise is correlated."""
        return [places.sort().values for places in self.sequences] if not self.in_time else self.sequences

    def recorded_of(self, output: int) -> list[Tensor]:
        """Those of one output, by its number."""
        return [places for places in self.recorded if int(self.output_of[places[0]]) == output]

    def gaps(self, places: Tensor) -> Tensor:
        """Distances of successive data of one of the `recorded` sequences in sampling intervals, ``(m - 1,)``: the
        usual one of their output in all runs.

        Noise forgets over them: they are infinite between sweeps.
        """
        found = self.condition_of[places].diff().double()  # what is not used was recorded all the same
        if not len(found):
            return found
        if self.in_time and not self.by_sample:
            found = self.steps(places) / self.usual[int(self.output_of[places[0]])]
        found = found.clamp(SHORTEST, LONGEST)
        if self.sweeps is None:
            return torch.full_like(found, math.inf)
        return torch.where(self.sweeps[self.condition_of[places]].diff() == 0, found, math.inf)

    def steps(self, places: Tensor) -> Tensor:
        """Times between successive data of one of the `recorded` sequences, ``(m - 1,)``."""
        return self.order[self.condition_of[places]].diff()  # type: ignore[index]

    @cached_property
    def usual(self) -> list[float]:
        """Usual time between successive data of a run, by output; 1 where none follow each other."""
        found = []
        for output in range(len(self.recording.outputs)):
            each = [self.steps(places) for places in self.recorded_of(output)]
            every = torch.cat(each) if each else torch.zeros(0)
            found.append(max(float(every.median()), 1e-300) if len(every) else 1.0)
        return found

    @cached_property
    def uneven(self) -> bool:
        """Whether it matters if noise forgets with time or with every sample."""
        timed = dataclasses.replace(self, by_sample=False)
        each = [timed.gaps(places) for places in self.recorded if len(places) > 2] if self.in_time else []
        return any(bool((gaps - 1).abs().amax() > UNEVEN) for gaps in each)

    @cached_property
    def _gaps(self) -> list[Tensor]:
        """`gaps` of all `recorded` sequences."""
        return [self.gaps(places) for places in self.recorded]

    def whitening(self, sd: Tensor, correlation: Tensor) -> Whitening:
        """Of noise with sd ``(n_total,)`` and an AR(1) coefficient for each output, ``(outputs,)``; or of m memories,
        ``(m, outputs)``."""
        rho = torch.zeros(*correlation.shape[:-1], self.n, dtype=torch.float64)
        if bool((correlation != 0).any()):
            for places, gaps in zip(self.recorded, self._gaps, strict=True):
                each = remembered(correlation[..., int(self.output_of[places[0]])], gaps)
                rho[..., places[1:]] = each.movedim(0, -1)
        return Whitening(sd[self.index], rho, self.before)

    # --- parameters ---------------------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The simulator's, unknown initial states among them."""
        return self.simulator.parameters

    def limits(self) -> tuple[Tensor, Tensor]:
        """Physical bounds, ``(P,)`` twice."""
        return limits(self.parameters)

    def evaluate(
        self, values: Tensor, columns: list[int], warm: Solution | None = None, *, march: bool = True
    ) -> tuple[Tensor, Tensor, Solution | None]:
        """Outputs at the used data ``(H, n)``, their derivatives ``(H, n, columns)``, and a warm start."""
        found = self.simulator.linearise(self.recording.x, values, self.recording.outputs, columns, warm, march=march)
        if found.y.shape[-1] != len(self.recording.y):
            raise SimulatorError(
                f"Expected {len(self.recording.y)} output values, as in the recording. Got {found.y.shape[-1]}."
            )
        return found.y[:, self.index], found.jacobian[:, self.index], found.warm

    def check_slopes(
        self, values: Tensor, columns: Sequence[int], what: str = "the simulator", near: Solution | None = None
    ) -> None:
        """Raise if the outputs at the used data change otherwise with some parameters, at values ``(P,)``, than their
        derivatives say; ``near`` is another problem's only solution, near there.

        Raises:
            SimulatorError: If they do.
        """
        x, outputs = self.recording.x, self.recording.outputs
        near = self.guess(near, values[None])
        check_slopes(
            self.simulator, x, values[None], columns, outputs, kept=self.keep, whole=True, what=what, near=near
        )

    def guess(self, found: Solution | None, values: Tensor) -> Solution | None:
        """Another problem's only solution as a warm start at ``values`` (H, P); None where it is none.

        States that are added, behind the others, stay as they begin.
        """
        bound = self.simulator
        if found is None or not isinstance(bound, Trajectories):
            return None
        known, nodes = found.states.shape[-1], found.states.shape[-2]
        added = len(bound.ode.states) - known
        if nodes != bound.grid.nodes.shape[1] or added < 0:  # other steps, or other states
            return None
        guess = found.repeated(len(values))
        if not added:
            return guess
        begin = bound.layout.start(values)[..., known:].unsqueeze(2)
        return Solution(torch.cat([guess.states, begin.expand(*guess.states.shape[:-1], -1)], dim=-1))

    def drivers(self, values: Tensor, warm: Solution | None) -> dict[str, Tensor]:
        """What a change may vary with at every datum, ``(n_total conditions,)`` each: conditions, or time, states and
        inputs."""
        if not self.in_time:
            x = self.recording.x
            return dict(x) if isinstance(x, dict) else {"x": x}
        bound = self.simulator
        if not isinstance(bound, Trajectories):
            return {"t": self.recording.x["time"]}  # type: ignore[index]
        found = bound.along(bound.solve(values, warm))
        return {name: table[bound.grid.run_of, bound.grid.node_of] for name, table in found.items()}

    def is_time(self, driver: str) -> bool:
        """Whether a driver is the time of differential equations, and no condition that somebody calls t."""
        return self.in_time and driver == "t"

    def drivers_at_data(self, values: Tensor, warm: Solution | None) -> dict[str, Tensor]:
        """The same at the data in use, ``(n,)`` each."""
        return {name: along[self.condition_of] for name, along in self.drivers(values, warm).items()}

    def parameters_at_data(self, values: Tensor) -> Values:
        """Parameters ``(P,)`` by the names that the functions of a model get: a number each, or where they differ from
        run to run ``(n,)``."""
        bound = self.simulator
        if not isinstance(bound, Trajectories):
            return Values({q.name: value for q, value in zip(self.parameters, values, strict=True)}, 0.0, 0.0)
        found = bound.layout.by_name(values[None], bound.grid.run_of[self.condition_of])
        return found | {name: each[0] if each.shape[-1] > 1 else each[0, 0] for name, each in found.items()}

    def arguments(self, drivers: Mapping[str, Tensor], own: Mapping[str, Any], *shown: Tensor) -> tuple[Any, ...]:
        """What a function of a term is asked with on rows of data: drivers by name, the parameters that it gets, and
        for that of an output what is shown without it."""
        if self.in_time:
            return drivers["t"], drivers, own, drivers, *shown
        return drivers if isinstance(self.recording.x, dict) else next(iter(drivers.values())), own, *shown

    @property
    def kinds(self) -> tuple[str, str]:
        """Kinds of channels that something unknown is sought in."""
        return ("equation", "output") if self.in_time else ("parameter", "output")


def breaks(columns: Tensor) -> Tensor:
    """Where successive rows of conditions ``(m, k)`` belong to two sweeps, bool ``(m - 1,)``: others change there than
    the one that most often changes alone."""
    change = columns.diff(dim=0) != 0
    swept = int((change & (change.sum(1, keepdim=True) == 1)).sum(0).argmax())
    others = [k for k in range(columns.shape[1]) if k != swept]
    return change[:, others].any(1)


def remembered(phi: Tensor, gaps: Tensor) -> Tensor:
    """Correlation of noise over distances ``(m,)``, for each AR(1) coefficient, ``(m, *phi.shape)``."""
    return (phi ** gaps.reshape(-1, *[1] * phi.ndim)).clamp_max(CLOSEST)
