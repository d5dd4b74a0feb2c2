"""Which new condition would tell tied hypotheses apart: where their predictions differ most after refitting."""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.discovery.findings.conditions import ANYWHERE, Option, bolder, denser, simple
from torchcal.discovery.findings.feasible import Feasible
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.local import Span
from torchcal.discovery.fits.problem import Problem, Whitening
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.misfit.noise import Noise
from torchcal.discovery.records import Experiment
from torchcal.errors import TorchcalError
from torchcal.simulators import Trajectories, settled

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
#: Solver error, in noise sd, up to which a model bears an experiment, with steps of its kind halved so often at most.
SETTLED, HALVINGS = 0.1, 3
#: New data whose nearest recorded ones are sought at once; how many of these count in time, as several runs may have
#: noise of several sizes at one value; and up to how much farther away others are as near.
PIECE, ALIKE, AS_NEAR = 1024, 8, 1e-9
#: How many times the largest reading no experiment shall make an output.
FAR = 100.0

Pair = tuple[Model, Model]


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


def propose(models: Sequence[Model], noise: Noise, feasible: Feasible = ANYWHERE) -> Experiment | None:
    """The experiment, of those tried in thought, that separates the two nearest of the models most, those aside that
    none of them tells apart; the first, and mildest, of those that separate them by `PLENTY`.

    Simple experiments come first (`conditions.simple`). Where none of these would separate the models well, with more
    samples either, `conditions.bolder` ones are tried too. The best is asked for with more samples where it takes them.
    The predicted distance is what is left after every model's parameters have been fitted to old and new data together
    (linearised). None where no experiment separates them by `LEAST` noise sd. What one of the models does not bear (an
    orbit that falls into its star) is no experiment, nor is what is not feasible.
    """
    models = models[:MOST]
    # One with a term more than another predicts what that one does, and is told from it by its cost alone.
    pairs = [(a, b) for a, b in itertools.combinations(models, 2) if not (_holds(a, b) or _holds(b, a))]
    if not pairs:
        return None
    thought = _Thought(models, pairs, noise)
    thought.consider(simple(models[0].found, feasible))
    found = thought.best()
    if found is None or found.separation < ENOUGH:
        thought.consider(bolder(models[0].found, feasible))
        found = thought.best()
    return found


class _Thought:
    """Experiments in thought that are to tell pairs of models apart."""

    def __init__(self, models: Sequence[Model], pairs: Sequence[Pair], noise: Noise) -> None:
        self.models, self.pairs, self.noise = models, pairs, noise
        self.recording = models[0].found.problem.recording
        self.tried: list[Tried] = []
        self._borne: dict[Tried, bool] = {}

    def consider(self, options: Sequence[Option]) -> None:
        """Work out what each would tell, until one tells plenty."""
        for option in options:
            if (found := _separations(self.pairs, option[1], self.noise)) is None:
                continue
            self.tried.append(Tried(option, found))
            if min(found) >= PLENTY and self._bears(self.tried[-1]):
                break

    def best(self) -> Experiment | None:
        """The best of those considered, with as many samples as it takes."""
        tried, hopeless = list(self.tried), set[int]()
        while tried:
            told = [
                k not in hopeless and max(one.distances[k] * _times(one.option[1])[-1] ** 0.5 for one in tried) >= LEAST
                for k in range(len(self.pairs))
            ]
            best = _best(tried, told)
            if best is None:
                break
            if not self._bears(best):
                tried = [one for one in tried if one is not best]
                continue
            best = self._sampled(best, told)
            if best.nearest(told) < LEAST:
                hopeless.add(min((k for k, clear in enumerate(told) if clear), key=best.distances.__getitem__))
                continue
            description, _, conditions = best.option
            untold = [(_called(a), _called(b)) for (a, b), clear in zip(self.pairs, told, strict=True) if not clear]
            return Experiment(description, best.nearest(told), conditions, untold)
        return None

    def _sampled(self, best: Tried, told: Sequence[bool]) -> Tried:
        """With more samples, as far as it takes them."""
        plain = best.option
        for times in _times(plain[1]):
            if best.nearest(told) >= ENOUGH:
                break
            option = denser(plain, self.recording, times)
            found = _separations(self.pairs, option[1], self.noise)
            best = best if found is None else _best([best, Tried(option, found)], told) or best
        return best

    def _bears(self, one: Tried) -> bool:
        if one not in self._borne:
            self._borne[one] = _bearable(self.models, one.option[1], self.noise)
        return self._borne[one]


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
                there = settled(bound, values, SETTLED * _usual_sd(recording, noise), halvings=HALVINGS, switch=False)
            except TorchcalError:
                return False
            if not bool(torch.isfinite(there.outputs_of(values, there.solve(values))).all()):
                return False
    return True


def _holds(model: Model, other: Model) -> bool:
    """Whether a model has all that another one has, and more."""
    return other.content < model.content and other.window is None and model.window is None


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
    white = _whitening(models[0].found, recording, predictions[0], noise)
    predictions, slopes = [white.vector(y) for y in predictions], [white(jacobian) for jacobian in slopes]
    distances = []
    for a, b in ((models.index(one), models.index(other)) for one, other in pairs):
        gap = predictions[a] - predictions[b]
        # Either model may move its parameters, as far as the old data allow, which know nothing of a new run's own.
        rows, targets = [], []
        width = slopes[a].shape[1] + slopes[b].shape[1]
        rows.append(torch.cat([slopes[a], -slopes[b]], dim=1))
        targets.append(gap)
        first = 0
        for k in (a, b):
            old = models[k].found.whitening(models[k].found.jacobian)
            block = torch.zeros(len(old), width, dtype=torch.float64)
            block[:, first : first + old.shape[1]] = old
            first += slopes[k].shape[1]
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


def _whitening(found: Fitted, recording: Recording, y: Tensor, noise: Noise) -> Whitening:
    """Of noise at new conditions, where a fit shows ``y``; it has the memory of that of the recording, however close
    samples are."""
    correlation, problem = noise.correlation, found.problem
    if problem.recording.runs and recording.runs and not problem.by_sample:
        usual = [float(runs[0].time.diff().median()) for runs in (recording.runs, problem.recording.runs)]
        correlation = correlation ** (usual[0] / usual[1])
    new = dataclasses.replace(Problem.of(problem.simulator, recording), by_sample=problem.by_sample)
    return new.whitening(_sd_there(found, recording, y, noise), correlation)


def _usual_sd(recording: Recording, noise: Noise) -> Tensor:
    """Of each new datum, as of the median datum of its output, ``(n_total,)``."""
    outputs = len(recording.outputs)
    per_output = torch.stack([part[torch.isfinite(part)].median() for part in noise.sd.chunk(outputs)])
    return per_output.repeat_interleave(recording.n)


def _sd_there(found: Fitted, recording: Recording, y: Tensor, noise: Noise) -> Tensor:
    """Of each new datum, where a fit shows ``y`` ``(n_total,)``: that of the data of its output at the nearest
    conditions, or in time of the nearest values."""
    problem, sd = found.problem, _usual_sd(recording, noise)
    for output in problem.output_of.unique().tolist():
        mine = problem.output_of == output
        known = noise.sd[problem.index[mine]]
        here = slice(output * recording.n, (output + 1) * recording.n)
        if bool((known == known[0]).all()):
            sd[here] = known[0]
        elif problem.in_time:
            sd[here] = _beside(found.y[mine][:, None], y[here, None], known, min(ALIKE, len(known)))
        else:
            at = problem.recording.columns[problem.condition_of[mine]]
            scales = [Span.of(column, time=False) for column in at.T]
            old, new = (
                torch.stack([
                    scale.distance(column.clamp(scale.low, scale.high), scale.low) / (scale.size or 1.0)
                    for scale, column in zip(scales, columns.T, strict=True)
                ], dim=1) for columns in (at, recording.columns)
            )  # fmt: skip
            sd[here] = _beside(old, new, known, 1)
    return sd


def _beside(old: Tensor, new: Tensor, sd: Tensor, count: int) -> Tensor:
    """Root mean square of the sd at so many of some points ``(n, C)``, and all as near, beside others ``(m, C)``."""
    found = []
    for piece in new.split(PIECE):
        away = torch.cdist(piece, old, compute_mode="donot_use_mm_for_euclid_dist")
        near = away <= away.kthvalue(count, dim=1, keepdim=True).values * (1 + AS_NEAR)
        found.append((near * sd.square()).sum(1) / near.sum(1))
    return torch.cat(found).sqrt()


def _there(found: Fitted, simulator: Trajectories, recording: Recording) -> tuple[Trajectories, Tensor]:
    """A model at a new run, and its values; initial states are the experimenter's now: known, given in the run."""
    bound = simulator.bind(recording)
    values = [float(found.values[columns].mean()) for columns in _sources(simulator)]
    return bound, torch.tensor([values], dtype=torch.float64)


def _sources(simulator: Trajectories) -> list[list[int]]:
    """A model's columns behind each of its simulator's parameters: every run's, of what each has for itself."""
    origins = simulator.layout.origins
    return [[i for i, (name, _) in enumerate(origins) if name == p.name] for p in simulator.ode.parameters]


def _predict(found: Fitted, recording: Recording) -> tuple[Tensor, Tensor]:
    """A model's data at new conditions, and their slopes by what it fits, then by what a new run has for itself."""
    simulator = found.problem.simulator
    if isinstance(simulator, Trajectories):
        bound, values = _there(found, simulator, recording)
        sources = _sources(simulator)
        fitted = [i for i, columns in enumerate(sources) if set(columns) & set(found.free)]
        result = bound.linearise(bound.x, values, recording.outputs, fitted)
        known = torch.zeros(result.y.shape[-1], len(found.free), dtype=torch.float64)
        anew = []
        for slope, i in zip(result.jacobian[0].unbind(-1), fitted, strict=True):
            if simulator.ode.parameters[i].per_run:
                anew.append(slope)
            else:
                known[:, found.free.index(sources[i][0])] = slope
        return result.y[0], torch.column_stack([known, *anew])
    result = simulator.linearise(recording.x, found.values[None], recording.outputs, found.free)
    return result.y[0], result.jacobian[0]
