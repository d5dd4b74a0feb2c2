"""A calibration in time at other times, or for other runs."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchcal.data import Recording, Run
from torchcal.data.arrays import to_tensor
from torchcal.data.run import change, convert
from torchcal.errors import DomainError, PropagationWarning, warn
from torchcal.propagation import NISP, PropagationCheck
from torchcal.results.base import conditions
from torchcal.simulators import Conditions, Simulator, Trajectories, settled

__all__ = ["NODE_TOLERANCE", "check_nodes_in_time", "propagation_in_time"]

NODE_TOLERANCE = 1e-5
"""Change of the moments of trajectories, relative to the output's scale, with which enough nodes are found. Long
oscillations take many nodes for less, and the default tolerance ε is a hundred times as large."""


def check_nodes_in_time(propagate: NISP, alpha: Tensor) -> PropagationCheck:
    """Hold the moments at α against a finer rule, as `NISP.check` does, with a tolerance that trajectories can meet.

    Warns:
        PropagationWarning: If they have not converged, or if trajectories blow up at nodes of the finer rule.
    """
    result = propagate.check(alpha, warn=False)
    if math.isfinite(result.mean_change) and math.isfinite(result.sd_change):
        return propagate.check(alpha, tolerance=10 * NODE_TOLERANCE)
    warn(
        f"The solution blows up at the outermost of {result.finer_nodes} quadrature nodes: the density of the "
        f"parameters reaches values with which the model has no solution. The moments are those of {result.nodes} "
        "nodes, which do not reach as far. Embed such a parameter as embeddings.Uniform or with transform='log', or "
        "name others: embedding=Gaussian(parameters=(...)).",
        PropagationWarning,
    )
    return result


class _Elsewhere(Simulator):
    """Trajectories of other runs as a function of the calibrated parameters, at some of their samples."""

    dear = True

    def __init__(self, bound: Trajectories, other: Trajectories, columns: list[int], picks: Tensor) -> None:
        self.parameters = bound.parameters
        self.degree = None
        self.other, self.columns, self.picks = other, columns, picks

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        """The outputs at the chosen samples."""
        evaluate = self.other.at(self.other.x, outputs)
        count = self.other.recording.n

        def chosen(values: Tensor) -> Tensor:
            y = evaluate(values[..., self.columns])
            return y.unflatten(-1, (-1, count))[..., self.picks].flatten(-2)

        return chosen


def propagation_in_time(propagate: NISP, recording: Recording, x: Any, alpha: Tensor) -> NISP:
    """The calibrated propagation at other times of the recording's runs, or for other runs.

    Args:
        propagate: Of the calibration.
        recording: The data.
        x: Times ``{"time": (n,), "run": (n,)}`` of the recording's runs (``run`` may be left out where there is one);
            or a recording in time, a `Run`, or a list of them, on the same clock. One with the times, inputs, known
            initial states and data of a run of the recording is that run, and what was calibrated of it is known.
        alpha: Coefficients at which steps must be short enough, ``(P,)``.

    Raises:
        DomainError: If times lie outside a run, or runs leave something open that was calibrated run by run.
    """
    bound = propagate.simulator
    if not isinstance(bound, Trajectories):
        raise DomainError("Expected a calibration in time. Got a static one (predict at conditions x).")
    if isinstance(x, Run):
        x = [x]
    listed = isinstance(x, Sequence) and len(x) > 0 and all(isinstance(run, Run) for run in x)
    if isinstance(x, Recording) or listed:
        runs = x.runs if isinstance(x, Recording) else tuple(x)
        if runs is None:
            raise DomainError(
                "Expected a recording in time, a Run, or times. Got a static recording (make one with runs=[Run(...)])."
            )
        alike = _alike(runs, recording)
        other = bound.elsewhere(_blank(alike, recording), first=bound.layout.first)
        where, picks = other.x, torch.arange(other.recording.n)
        columns = _columns(bound, other, _twins(alike, recording))
    else:
        where = _times(x, recording)
        extended, picks = _with_times(recording, where)
        other = bound.elsewhere(extended, first=bound.layout.first)
        columns = list(range(len(bound.names)))
    with torch.no_grad():
        xi = propagate.nodes
        values = propagate.with_held(propagate.parameters_at(alpha.to(xi), xi)).to(device="cpu", dtype=torch.float64)
        spread = recording.spread[:: recording.n]
        other = settled(other, values[:, columns], 1e-3 * spread.cpu().repeat_interleave(other.recording.n))
    return propagate.copy(x=where, simulator=_Elsewhere(bound, other, columns, picks))


def _alike(runs: Sequence[Run], recording: Recording) -> list[Run]:
    """Runs in the recording's units, with its inputs."""
    needed = set(recording.runs[0].inputs) if recording.runs else set()
    for i, run in enumerate(runs):
        if set(run.inputs) != needed:
            raise DomainError(
                f"Expected inputs {sorted(needed)} in every run, as in the recording. Got {sorted(run.inputs)} in run "
                f"{i}."
            )
    units = {**recording.units, **(recording.runs[0].units if recording.runs else {})}
    return [convert(run, units, f"run {i}") for i, run in enumerate(runs)]


def _blank(runs: Sequence[Run], recording: Recording) -> Recording:
    """Runs without data: what is predicted are the recording's outputs."""
    blank = [{name: torch.zeros_like(run.time) for name in recording.outputs} for run in runs]
    return Recording(runs=[change(run, outputs=y) for run, y in zip(runs, blank, strict=True)])


def _twins(runs: Sequence[Run], recording: Recording) -> list[int | None]:
    """Which of the recording's runs each is, in the same units.

    All of them in turn, where there are as many and none contradicts its own; else the only one that a run shares
    data with and does not contradict.
    """
    known = recording.runs or ()
    if len(runs) == len(known) and all(_may_be(run, own) for run, own in zip(runs, known, strict=True)):
        return list(range(len(known)))
    found: list[int | None] = []
    for run in runs:
        mine = [r for r, own in enumerate(known) if _may_be(run, own) and _shares_data(run, own)]
        found.append(mine[0] if len(mine) == 1 else None)
    return found


def _may_be(run: Run, own: Run) -> bool:
    """Whether two runs are of the same times, inputs and known initial states, and differ in no datum of both."""

    def agree(given: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> bool:
        return set(given) <= set(other) and all(
            bool(((values == other[name]) | values.isnan() | other[name].isnan()).all())
            for name, values in given.items()
        )

    alike = all(own.holds.get(name) == hold for name, hold in run.holds.items())
    same = run.initial == own.initial and alike and torch.equal(run.time, own.time)
    return same and agree(run.inputs, own.inputs) and agree(run.outputs, own.outputs)


def _shares_data(run: Run, own: Run) -> bool:
    return any(bool((values == own.outputs[name]).any()) for name, values in run.outputs.items())


def _columns(bound: Trajectories, other: Trajectories, twins: Sequence[int | None]) -> list[int]:
    """The place of each of the other runs' parameters among the calibrated ones.

    What each run has for itself is known for the recording's runs alone, ``twins`` of the others.
    """
    places = {origin: i for i, origin in enumerate(bound.layout.origins)}
    found: list[int] = []
    unknown: list[str] = []
    for name, (origin, run) in zip(other.names, other.layout.origins, strict=True):
        twin = None if run is None else twins[run]
        if (run is None or twin is not None) and (origin, twin) in places:
            found.append(places[origin, twin])
        else:
            unknown.append(name)
    if unknown:
        raise DomainError(
            f"Expected runs of which everything is known but the calibrated parameters. Got {unknown} open (give a "
            "Run its initial= for every state; a per-run parameter is known for the calibrated runs alone: predict at "
            "{'time': ..., 'run': ...} of those)."
        )
    return found


def _times(x: Any, recording: Recording) -> dict[str, Tensor]:
    runs = recording.runs or ()
    if len(runs) == 1 and not (isinstance(x, Mapping) and "run" in x):
        time = x["time"] if isinstance(x, Mapping) and set(x) == {"time"} else x
        if not isinstance(time, Mapping):
            time = to_tensor(time, "time", recording.units.get("time"))[0]
            x = {"time": time, "run": torch.zeros_like(time)}
    where = conditions(x, recording)
    if not isinstance(where, Mapping):
        raise DomainError("Expected times as a dict with 'time' and 'run'. Got one array.")
    wrong = [float(r) for r in where["run"] if not (float(r).is_integer() and 0 <= r < len(runs))]
    if wrong:
        raise DomainError(f"Expected runs as whole numbers from 0 to {len(runs) - 1}. Got {wrong[0]:g}.")
    return dict(where)


def _with_times(recording: Recording, where: Mapping[str, Tensor]) -> tuple[Recording, Tensor]:
    """The recording's runs with more samples, without data, and the places of the wanted ones."""
    runs, offset = [], 0
    picks = torch.zeros(len(where["time"]), dtype=torch.long)
    for r, run in enumerate(recording.runs or ()):
        chosen = (where["run"] == r).nonzero()[:, 0]
        wanted = where["time"][chosen].to(run.time)
        if bool((wanted < run.time[0]).any()):
            raise DomainError(
                f"Expected times from {float(run.time[0]):.6g} on in run {r}, where it begins. Got "
                f"{float(wanted.min()):.6g}."
            )
        after = torch.searchsorted(run.time, wanted).clamp(1, len(run.time) - 1)
        below, above = run.time[after - 1], run.time[after]
        nearest = torch.where(wanted - below < above - wanted, below, above)  # not a rounding beside a sample
        few = 8 * torch.finfo(torch.float64).eps * run.time.abs().max()
        wanted = torch.where((nearest - wanted).abs() <= few, nearest, wanted)
        time = torch.unique(torch.cat([run.time, wanted]))
        inputs = run.inputs_at(time) if run.inputs else {}
        picks[chosen] = offset + torch.searchsorted(time, wanted)
        offset += len(time)
        outputs = {name: torch.zeros_like(time) for name in recording.outputs}
        runs.append(Run(time=time, outputs=outputs, inputs=inputs, initial=run.initial, hold=run.hold))
    return Recording(runs=runs), picks
