"""Which new condition would tell tied hypotheses apart: where their predictions differ most after refitting."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchcal.data import Recording, Run
from torchcal.discovery.fitting import Fitted
from torchcal.discovery.model import Model
from torchcal.discovery.noise import Noise
from torchcal.discovery.problem import Problem, Whitening
from torchcal.discovery.records import Experiment
from torchcal.display import between, placed
from torchcal.errors import TorchcalError
from torchcal.simulators import Trajectories

__all__ = ["propose"]

#: Distance in noise sd below which more samples are asked for, how many times as many at first, and at last, and the
#: number of samples up to which these are more than at first.
ENOUGH, DENSER, DENSEST, MANY = 6.0, 4, 16, 1000
#: Distance beyond which a milder experiment is as good: models are not right far from what was recorded.
PLENTY = 12.0
#: Models that are told apart at most.
MOST = 8
#: Distance below which an experiment tells nothing apart.
LEAST = 2.0
#: How much larger the distance must be for a less simple experiment.
WORTH = 1.01
#: Below which no temperature goes, by unit.
ABSOLUTE_ZERO = {"degC": -273.15, "°C": -273.15, "degF": -459.67, "°F": -459.67}
#: Solver error, in noise sd, up to which a model bears an experiment, with steps halved so often at most.
SETTLED, HALVINGS = 0.1, 3
#: How many times the largest reading no experiment shall make an output.
FAR = 100.0

Pair = tuple[Model, Model]
Option = tuple[str, Recording, dict[str, Any]]


@dataclass(frozen=True, eq=False)
class Tried:
    """An experiment in thought, and the predicted distance of each pair of models."""

    option: Option
    distances: list[float]

    def nearest(self, told: Sequence[bool]) -> float:
        """The smallest distance of the pairs that any experiment tells apart."""
        return min(distance for distance, clear in zip(self.distances, told, strict=True) if clear)

    def worth(self, told: Sequence[bool]) -> float:
        """The same, but that more than `PLENTY` is worth no more."""
        return min(self.nearest(told), PLENTY)


def propose(models: Sequence[Model], noise: Noise) -> Experiment | None:
    """The experiment, among a few that anyone can do, that separates the two nearest of the models most, those aside
    that none of them tells apart; the first, and mildest, of those that separate them by `PLENTY`.

    Runs are repeated with other initial states, stronger or weaker inputs, or for longer; static conditions are moved
    beyond their range or gathered in a third of it. Where none separates the models well, the best is asked for with
    more samples. The predicted distance is what is left after every model's parameters have been fitted to old and new
    data together (linearised). None where no experiment separates them by `LEAST` noise sd. What one of the models does
    not bear (an orbit that falls into its star) is no experiment.
    """
    models = models[:MOST]
    # One with a term more than another predicts what that one does, and is told from it by its cost alone.
    pairs = [(a, b) for a, b in itertools.combinations(models, 2) if not (_holds(a, b) or _holds(b, a))]
    if not pairs:
        return None
    problem = models[0].found.problem
    options = _in_time(models[0].found) if problem.in_time else _static(problem.recording)
    borne: dict[Tried, bool] = {}

    def bears(one: Tried) -> bool:
        if one not in borne:
            borne[one] = _bearable(models, one.option[1], noise)
        return borne[one]

    tried: list[Tried] = []
    for option in options:
        if (found := _separations(pairs, option[1], noise)) is None:
            continue
        tried.append(Tried(option, found))
        if min(found) >= PLENTY and bears(tried[-1]):
            break
    hopeless: set[int] = set()
    while tried:
        told = [
            k not in hopeless and max(one.distances[k] * _times(one.option[1])[-1] ** 0.5 for one in tried) >= LEAST
            for k in range(len(pairs))
        ]
        best = _best(tried, told)
        if best is None:
            break
        if not bears(best):
            tried = [one for one in tried if one is not best]
            continue
        plain = best.option
        for times in _times(plain[1]):
            if best.nearest(told) >= ENOUGH:
                break
            option = _denser(plain, problem.recording, times)
            denser = _separations(pairs, option[1], noise)
            best = best if denser is None else _best([best, Tried(option, denser)], told) or best
        if best.nearest(told) < LEAST:
            hopeless.add(min((k for k, clear in enumerate(told) if clear), key=best.distances.__getitem__))
            continue
        description, _, conditions = best.option
        untold = [(_called(a), _called(b)) for (a, b), clear in zip(pairs, told, strict=True) if not clear]
        return Experiment(description, best.nearest(told), conditions, untold)
    return None


def _times(recording: Recording) -> list[int]:
    """How many times as many samples are asked for, in turn."""
    return sorted({DENSER, max(DENSER, min(DENSEST, MANY // recording.n))})


def _called(model: Model) -> str:
    """A model's terms, and where they act."""
    return " with ".join(model.names) + (f" where {model.where}" if model.where else "")


def _bearable(models: Sequence[Model], recording: Recording, noise: Noise) -> bool:
    """Whether the models' solutions in time settle there when steps are halved a few times, and do not blow up."""
    for model in models:
        simulator = model.found.problem.simulator
        if isinstance(simulator, Trajectories):
            bound, values = _there(model.found, simulator, recording)
            try:
                settled = bound.settled(values, SETTLED * _sd(recording, noise), halvings=HALVINGS)
            except TorchcalError:
                return False
            if not bool(torch.isfinite(settled.outputs_of(values, settled.solve(values))).all()):
                return False
    return True


def _holds(model: Model, other: Model) -> bool:
    """Whether a model has all that another one has, and more."""
    return set(other.names) < set(model.names) and other.window is None and model.window is None


def _best(tried: Sequence[Tried], told: Sequence[bool]) -> Tried | None:
    """The experiment that tells the nearest of the pairs that can be told best; an earlier one where they are alike."""
    best: Tried | None = None
    for one in tried if any(told) else ():
        if best is None or one.worth(told) >= WORTH * best.worth(told):
            best = one
    return best


def _separations(pairs: Sequence[Pair], recording: Recording, noise: Noise) -> list[float] | None:
    """Distance of the models of each pair at new conditions, in noise sd; None where a model cannot predict them."""
    models = list(dict.fromkeys(model for pair in pairs for model in pair))
    predictions, slopes = [], []
    for model in models:
        try:
            y, jacobian = _predict(model.found, recording)
        except TorchcalError:
            return None
        if not bool(torch.isfinite(y).all() and torch.isfinite(jacobian).all()) or _explodes(model, y, noise):
            return None
        predictions.append(y)
        slopes.append(jacobian)
    white = _whitening(models[0].found.problem, recording, noise)
    predictions, slopes = [white.vector(y) for y in predictions], [white(jacobian) for jacobian in slopes]
    distances = []
    for a, b in ((models.index(one), models.index(other)) for one, other in pairs):
        gap = predictions[a] - predictions[b]
        # Either model may move its parameters, as far as the old data allow.
        rows, targets = [], []
        width = slopes[a].shape[1] + slopes[b].shape[1]
        rows.append(torch.cat([slopes[a], -slopes[b]], dim=1))
        targets.append(gap)
        first = 0
        for k in (a, b):
            old = models[k].found.whitening(models[k].found.jacobian)
            block = torch.zeros(len(old), width, dtype=torch.float64)
            block[:, first : first + old.shape[1]] = old
            first += old.shape[1]
            rows.append(block)
            targets.append(torch.zeros(len(old), dtype=torch.float64))
        design, target = torch.cat(rows), torch.cat(targets)
        size = design.norm(dim=0).clamp_min(1e-300)
        solution = torch.linalg.lstsq(design / size, -target, driver="gelsd").solution
        distances.append(float((design / size @ solution + target).norm()))
    return distances


def _explodes(model: Model, y: Tensor, noise: Noise) -> bool:
    """Whether any output goes far beyond all that was recorded: no model is right there."""
    recording = model.found.problem.recording
    largest = torch.stack([recording.y.abs(), recording.spread, noise.sd]).nan_to_num(nan=0.0).amax(0)
    outputs = len(recording.outputs)
    pairs = zip(largest.chunk(outputs), y.chunk(outputs), strict=True)
    return any(float(new.abs().max()) > FAR * float(old.max()) for old, new in pairs)


def _whitening(problem: Problem, recording: Recording, noise: Noise) -> Whitening:
    """Of noise at new conditions, which has the memory of that of the recording, however close samples are."""
    correlation = noise.correlation
    if problem.recording.runs and recording.runs:
        usual = [float(runs[0].time.diff().median()) for runs in (recording.runs, problem.recording.runs)]
        correlation = correlation ** (usual[0] / usual[1])
    return Problem.of(problem.simulator, recording).whitening(_sd(recording, noise), correlation)


def _sd(recording: Recording, noise: Noise) -> Tensor:
    """Of each new datum, as of the median datum of its output, ``(n_total,)``."""
    outputs = len(recording.outputs)
    per_output = torch.stack([part[torch.isfinite(part)].median() for part in noise.sd.chunk(outputs)])
    return per_output.repeat_interleave(recording.n)


def _there(found: Fitted, simulator: Trajectories, recording: Recording) -> tuple[Trajectories, Tensor]:
    """A model at new runs, and its values; initial states are the experimenter's now: known, given in the runs."""
    bound = simulator.bind(recording)
    shared = {name: i for i, name in enumerate(simulator.names)}
    return bound, torch.tensor([[_value(found, shared, name) for name in bound.names]], dtype=torch.float64)


def _predict(found: Fitted, recording: Recording) -> tuple[Tensor, Tensor]:
    simulator = found.problem.simulator
    if isinstance(simulator, Trajectories):
        bound, values = _there(found, simulator, recording)
        shared = {name: i for i, name in enumerate(simulator.names)}
        columns = [i for i, name in enumerate(bound.names) if name in shared and shared[name] in found.free]
        result = bound.linearise(bound.x, values, recording.outputs, columns)
        jacobian = torch.zeros(result.y.shape[-1], len(found.free), dtype=torch.float64)
        for k, i in enumerate(columns):
            jacobian[:, found.free.index(shared[bound.names[i]])] = result.jacobian[0, :, k]
        return result.y[0], jacobian
    result = simulator.linearise(recording.x, found.values[None], recording.outputs, found.free)
    return result.y[0], result.jacobian[0]


def _value(found: Fitted, shared: dict[str, int], name: str) -> float:
    if name in shared:
        return float(found.values[shared[name]])
    plain = name.split("[")[0]
    alike = [i for other, i in shared.items() if other.split("[")[0] == plain]
    return float(torch.stack([found.values[i] for i in alike]).mean()) if alike else 0.0


def _in_time(model: Fitted) -> list[Option]:
    found: list[Option] = []
    recording, bound = model.problem.recording, model.problem.simulator
    if not isinstance(bound, Trajectories) or recording.runs is None:
        return found
    first = recording.runs[0]
    states = bound.solve(model.values[None], model.warm)
    known = {
        name: float(states[0, 0, 0, i]) for i, name in enumerate(bound.ode.states) if name not in bound.ode.initial
    }
    unsaid = [name for name in known if name not in first.initial]
    ask = f", with initial {', '.join(unsaid)} known from elsewhere" if unsaid else ""
    options: list[tuple[str, dict[str, float], float, float]] = [("the first run again" + ask, known, 1.0, 1.0)]
    # Only what has had either sign is mirrored: an absolute temperature or an amount cannot be.
    mirrored = bool(known) and all(bool((states[..., i] < 0).any() and (states[..., i] > 0).any())
                   for i, name in enumerate(bound.ode.states) if name in known)  # fmt: skip
    for factor in (2.0, 0.5, 3.0, -1.0) if mirrored else (2.0, 0.5, 3.0):
        options.append(
            (
                f"a run that starts from {factor:g} times the initial states of the first",
                {k: factor * v for k, v in known.items()},
                1.0,
                1.0,
            )
        )
    if first.inputs:
        for factor in (2.0, 0.5, 3.0):
            options.append((f"a run with {factor:g} times the inputs of the first{ask}", known, factor, 1.0))
    options.append((f"a run three times as long as the first{ask}", known, 1.0, 3.0))
    options.append(
        (
            "a run that starts from 2 times the initial states and is twice as long",
            {k: 2 * v for k, v in known.items()},
            1.0,
            2.0,
        )
    )
    for text, initial, strength, longer in options:
        copies = int(longer)
        span = first.time[-1] - first.time[0]
        step = span / (len(first.time) - 1)
        time = torch.cat([first.time + k * (span + step) for k in range(copies)])
        inputs = {name: strength * values.repeat(copies) for name, values in first.inputs.items()}
        conditions = {"time": time, "initial": initial, "inputs": inputs}
        found.append((text, Recording(runs=[_run(recording, conditions)]), conditions))
    return found


def _static(recording: Recording) -> list[Option]:
    x = recording.x if isinstance(recording.x, dict) else {"x": recording.x}
    found: list[Option] = [("the same conditions again", _blank(recording, x), {"x": x})]
    spans: list[tuple[str, str, float, float]] = []
    for name, values in x.items():
        cuts = values.quantile(torch.tensor([0.0, 1 / 3, 2 / 3, 1.0], dtype=values.dtype)).tolist()
        thirds = [(a, b) for a, b in itertools.pairwise(cuts) if b > a]
        spans += [(name, f"between {text}", *ends) for text, ends in zip(between(thirds, "and"), thirds, strict=True)]
    for name, values in x.items():
        low, high = float(values.min()), float(values.max())
        width = high - low
        above = high + 0.5 * width
        spans.append((name, f"above the recorded range, to {placed(above, width)}", high, above))
        below = low / 3 if 0 < low < 0.5 * width else low - 0.5 * width
        below = max(below, ABSOLUTE_ZERO.get(recording.units.get(name, ""), -math.inf))
        if (below >= 0 or low < 0) and below < low:
            spans.append((name, f"below the recorded range, to {placed(below, width)}", below, low))
    for name, text, first, last in spans:
        moved = {k: v.clone() for k, v in x.items()}
        moved[name] = torch.linspace(first, last, recording.n, dtype=torch.float64)
        found.append((f"conditions with {name} {text}", _blank(recording, moved), {"x": moved}))
    return found


def _blank(recording: Recording, x: dict[str, Tensor]) -> Recording:
    n = len(next(iter(x.values())))
    zeros = {name: torch.zeros(n, dtype=torch.float64) for name in recording.outputs}
    return Recording(x=x if isinstance(recording.x, dict) else x["x"], y=zeros)


def _denser(option: Option, recording: Recording, times: int) -> Option:
    """The same with more samples: in time between the others, else of the same conditions."""
    description, _, conditions = option
    if "x" in conditions:
        x = {name: values.repeat_interleave(times) for name, values in conditions["x"].items()}
        return f"{description}, each {times} times", _blank(recording, x), {"x": x}
    run = _run(recording, conditions)
    place = torch.arange((len(run.time) - 1) * times + 1, dtype=torch.float64) / times
    left = place.long().clamp(max=len(run.time) - 2)
    time = run.time[left] + (place - left) * run.time.diff()[left]
    dense = {"time": time, "initial": conditions["initial"], "inputs": run.inputs_at(time)}
    text = f"{description}, sampled {times} times as densely"
    return text, Recording(runs=[_run(recording, dense)]), dense


def _run(recording: Recording, conditions: Mapping[str, Any]) -> Run:
    blank = {name: torch.zeros(len(conditions["time"]), dtype=torch.float64) for name in recording.outputs}
    hold = recording.runs[0].hold if recording.runs else "linear"
    return Run(outputs=blank, hold=hold, **{**conditions, "inputs": conditions["inputs"] or None})
