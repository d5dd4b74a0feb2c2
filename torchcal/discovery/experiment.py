"""Which new condition would tell tied hypotheses apart: where their predictions differ most after refitting."""

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcal.data import Recording, Run
from torchcal.discovery.fitting import Fitted
from torchcal.discovery.noise import Noise
from torchcal.discovery.records import Experiment
from torchcal.discovery.search import Model
from torchcal.errors import TorchcalError
from torchcal.simulators import Trajectories

__all__ = ["propose"]


def propose(models: Sequence[Model], noise: Noise) -> Experiment | None:
    """The experiment, among a few that anyone can do, that separates the two nearest of the models most.

    Runs are repeated with other initial states, stronger or weaker inputs, or for longer; static conditions are moved
    beyond their range. The predicted distance is what is left after every model's parameters have been fitted to old
    and new data together (linearised).
    """
    if len(models) < 2:
        return None
    problem = models[0].found.problem
    options = _in_time(models[0].found) if problem.in_time else _static(problem.recording)
    best: Experiment | None = None
    for description, recording, conditions in options:
        distance = _separation(models, recording, noise)
        if distance is not None and (best is None or distance > best.separation):
            best = Experiment(description, distance, conditions)
    return best


def _separation(models: Sequence[Model], recording: Recording, noise: Noise) -> float | None:
    """Smallest distance of two of the models at new conditions, in noise sd."""
    predictions, slopes = [], []
    for model in models:
        try:
            y, jacobian = _predict(model.found, recording)
        except TorchcalError:
            return None
        if not bool(torch.isfinite(y).all() and torch.isfinite(jacobian).all()):
            return None
        predictions.append(y)
        slopes.append(jacobian)
    outputs = len(recording.outputs)
    per_output = torch.stack([part[torch.isfinite(part)].median() for part in noise.sd.chunk(outputs)])
    sd = per_output.repeat_interleave(recording.n)
    least = None
    for a, b in itertools.combinations(range(len(models)), 2):
        gap = (predictions[a] - predictions[b]) / sd
        # Either model may move its parameters, as far as the old data allow.
        rows, targets = [], []
        width = slopes[a].shape[1] + slopes[b].shape[1]
        rows.append(torch.cat([slopes[a] / sd[:, None], -slopes[b] / sd[:, None]], dim=1))
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
        left = float((design / size @ solution + target).norm())
        least = left if least is None else min(least, left)
    return least


def _predict(found: Fitted, recording: Recording) -> tuple[Tensor, Tensor]:
    simulator = found.problem.simulator
    if isinstance(simulator, Trajectories):
        # Initial states are the experimenter's now: known, given in the runs.
        bound = simulator.bind(recording)
        shared = {name: i for i, name in enumerate(simulator.names)}
        values = torch.tensor([[_value(found, shared, name) for name in bound.names]], dtype=torch.float64)
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


def _in_time(model: Fitted) -> list[tuple[str, Recording, dict[str, Any]]]:
    found: list[tuple[str, Recording, dict[str, Any]]] = []
    recording, bound = model.problem.recording, model.problem.simulator
    if not isinstance(bound, Trajectories) or recording.runs is None:
        return found
    first = recording.runs[0]
    states = bound.solve(model.values[None]) if model.warm is None else model.warm
    known = {
        name: float(states[0, 0, 0, i]) for i, name in enumerate(bound.ode.states) if name not in bound.ode.initial
    }
    options: list[tuple[str, dict[str, float], float, float]] = []
    for factor in (2.0, 0.5, 3.0, -1.0):
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
            options.append((f"a run with {factor:g} times the inputs of the first", known, factor, 1.0))
    options.append(("a run three times as long as the first", known, 1.0, 3.0))
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
        blank = {name: torch.zeros(len(time), dtype=torch.float64) for name in recording.outputs}
        run = Run(time=time, outputs=blank, inputs=inputs or None, initial=initial, hold=first.hold)
        conditions = {"time": time, "initial": initial, "inputs": inputs}
        found.append((text, Recording(runs=[run]), conditions))
    return found


def _static(recording: Recording) -> list[tuple[str, Recording, dict[str, Any]]]:
    found = []
    x = recording.x if isinstance(recording.x, dict) else {"x": recording.x}
    zeros = {name: torch.zeros(recording.n, dtype=torch.float64) for name in recording.outputs}
    for name, values in x.items():
        low, high = float(values.min()), float(values.max())
        width = high - low
        for end, target in (("above", high + 0.5 * width), ("below", low - 0.5 * width)):
            if low >= 0 > target:
                continue
            moved = {k: v.clone() for k, v in x.items()}
            moved[name] = torch.linspace(
                *((high, target) if end == "above" else (target, low)), recording.n, dtype=torch.float64
            )
            given: Any = moved if isinstance(recording.x, dict) else moved["x"]
            where = Recording(x=given, y=zeros)
            found.append((f"conditions with {name} {end} the recorded range, to {target:.4g}", where, {"x": moved}))
    return found
