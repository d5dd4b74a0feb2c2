"""Results from netCDF files that `storage` wrote, held against the simulator that they are read with."""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchcal import embeddings, likelihoods, polychaos
from torchcal.data import Recording, Run
from torchcal.errors import DomainError, EmbeddingError, RecordingError, SimulatorError, TorchcalError
from torchcal.prediction import AdditivePrediction, Moments, Prediction, output_moments
from torchcal.propagation import NISP, PropagationCheck, RuleChoice
from torchcal.results.diagnostics import Diagnostics, Mode, Quality
from torchcal.results.estimate import MapEstimate
from torchcal.results.storage import CHECKSUM, FORMAT, NAME, checksum, netcdf_modules
from torchcal.simulators import ExternalSimulator, ODESimulator, Scaling, Simulator, Trajectories

if TYPE_CHECKING:
    from torchcal.results.additive import AdditiveCalibration
    from torchcal.results.calibration import Calibration

__all__ = ["check_simulator", "read_additive", "read_calibration", "scaling_of"]

SAME, SOLVED = 1e-6, 1e-2
"""Relative difference of predictions that are still taken for the same simulator's, and that of solutions in time,
which may be made of other steps now."""


def read_calibration(
    cls: type["Calibration"], path: str | os.PathLike[str], simulator: Simulator | None
) -> "Calibration":
    """Read an embedded calibration."""
    _check_kind(simulator)
    groups, meta = _read(path, "embedded")
    with _readable(path):
        embedding = _rebuild(embeddings, meta["embedding"])
        parts = _common_parts(groups, meta)
        options = _options(meta)
        p = groups["prediction"]
        posterior = Moments(p["mean"], p["sd"]) if "sd_posterior" in p else None
        parts["likelihood"] = _rebuild(likelihoods, meta["likelihood"])
        parts["stored"] = Prediction(
            x=parts["recording"].x,
            mean=p["mean"],
            sd=p["sd"],
            sd_model_error=p["sd_model_error"],
            sd_posterior=p.get("sd_posterior"),
            map=Moments(p["map_mean"], p["map_sd"]),
            posterior=posterior,
            mean_predictive=(
                Moments(p["mean_predictive_mean"], p["mean_predictive_sd"]) if "mean_predictive_mean" in p else None
            ),
        )
    propagate = _propagation(simulator, embedding, parts["recording"], meta, options)
    result = cls(embedding=embedding, propagate=propagate, **parts)
    if not isinstance(simulator, ExternalSimulator):  # which may take hours
        check_simulator(result)
    return result


def check_simulator(result: "Calibration") -> None:
    """Predict once more what is stored.

    Raises:
        DomainError: If the simulator predicts something else at the MAP.
    """
    if result.propagate is None or result.stored is None:
        return
    with torch.no_grad(), _of_its_kind(result.recording, result.propagate.simulator):
        mean, variance = output_moments(result.propagate, result.map.alpha)
    stored = result.stored.map
    _hold_against(result, stored.mean, (mean, stored.mean), (variance.clamp_min(0).sqrt(), stored.sd))


@contextlib.contextmanager
def _of_its_kind(recording: Recording, simulator: Simulator) -> Iterator[None]:
    """Say what is wrong where a static simulator cannot predict a recording in time; one that reads times can."""
    try:
        yield
    except SimulatorError as error:
        if recording.runs is None or isinstance(simulator, Trajectories):
            raise
        raise SimulatorError(
            "Expected the simulator that was calibrated, with a recording in time. Got a static "
            f"{type(simulator).__name__}, which cannot predict it: {error} Give the ODESimulator where it was one."
        ) from error


def _hold_against(
    result: "Calibration | AdditiveCalibration", size: Tensor, *pairs: tuple[Tensor, Tensor]
) -> None:
    """Raise where what is predicted is not what was stored."""
    recording, simulator = result.recording, None if result.propagate is None else result.propagate.simulator
    stored = result.settings.get("implicit")
    if isinstance(simulator, Trajectories) and stored not in (None, simulator.implicit):
        return  # steps of another kind, and nobody knows how far they are off
    allowed = (SAME if recording.runs is None else SOLVED) * (recording.spread + size.abs())
    if not all(bool(((predicted - stored).abs() <= allowed).all()) for predicted, stored in pairs):
        raise DomainError(
            "Expected the simulator that was calibrated. Got one that predicts something else with the same parameters "
            "(load with the function that was calibrated, and its constants, or calibrate again)."
        )


def read_additive(
    cls: type["AdditiveCalibration"], path: str | os.PathLike[str], simulator: Simulator | None
) -> "AdditiveCalibration":
    """Read a conventional calibration."""
    _check_kind(simulator)
    groups, meta = _read(path, "additive")
    with _readable(path):
        parts = _common_parts(groups, meta)
        options = _options(meta)
        recording = parts["recording"]
        p = groups["prediction"]
        kinds = {k: Moments(p[f"{k}_mean"], p[f"{k}_sd"]) for k in ("push_forward", "posterior", "map")}
        parts["stored"] = AdditivePrediction(x=recording.x, **kinds)
    propagate = _propagation(simulator, embeddings.PolynomialChaos(order=0), recording, meta, options)
    result = cls(propagate=propagate, **parts)
    if propagate is not None and not isinstance(simulator, ExternalSimulator):
        with torch.no_grad(), _of_its_kind(recording, propagate.simulator):
            mean = propagate.mean(result.map.alpha[:-1])
        stored = kinds["map"].mean
        _hold_against(result, stored, (mean, stored))
    return result


def _check_kind(simulator: Any) -> None:
    if simulator is not None and not isinstance(simulator, Simulator):
        raise DomainError(
            f"Expected simulator as a torchcal.Simulator or None. Got {type(simulator).__name__} (give the one that "
            "was calibrated, or leave it out)."
        )


@contextlib.contextmanager
def _readable(path: str | os.PathLike[str]) -> Iterator[None]:
    """Whatever goes wrong within is told of the file: damage shows in many ways."""
    try:
        yield
    except Warning:  # where warnings are errors
        raise
    except Exception as error:
        told = f"{type(error).__name__}: {error}"
        raise _damaged(path, f"one that cannot be read, damaged or incomplete: {told}") from error


def _damaged(path: str | os.PathLike[str], got: str) -> TorchcalError:
    return TorchcalError(
        f"Expected a netCDF file that torchcal wrote at {os.fspath(path)}. Got {got} (take a whole copy of it, or "
        "remove it and calibrate again)."
    )


def _read(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, dict[str, Tensor]], dict[str, Any]]:
    if not isinstance(path, str | os.PathLike):
        raise DomainError(f"Expected path: the name of a netCDF file. Got {type(path).__name__} (give its name).")
    if not os.path.exists(path):
        raise TorchcalError(f"Expected a netCDF file that torchcal wrote at {path}. Got none: there is no such file.")
    xarray, _, h5py = netcdf_modules()
    with _readable(path):
        with h5py.File(path, "r") as file:
            dict(file.attrs)  # where these are damaged, h5netcdf cannot even close the file
        tree = xarray.open_datatree(os.fspath(path), engine="h5netcdf")
    with tree:
        if "torchcal" not in tree.attrs:
            raise TorchcalError(f"Expected a netCDF file that torchcal wrote. {path} is none.")
        with _readable(path):
            meta = json.loads(tree.attrs["torchcal"])
            found, version = meta["kind"], meta["format"]
        if version != FORMAT:
            raise TorchcalError(f"Expected format {FORMAT} in {path}. Got {version}.")
        with _readable(path):
            groups = {
                name: {
                    str(value.attrs.get(NAME, key)): torch.from_numpy(np.array(value.values, dtype=np.float64))
                    for key, value in node.data_vars.items()
                }
                for name, node in tree.children.items()
            }
            meta["alpha_names"] = [str(v) for v in tree["map"]["coefficient"].values]
            meta["parameter_names"] = [str(v) for v in tree["map"]["parameter"].values]
            whole = tree.attrs.get(CHECKSUM) in (None, checksum(tree))  # files of earlier versions have none
    if not whole:
        raise _damaged(path, "one that was damaged or changed since: its checksum differs")
    if found != kind:
        raise TorchcalError(
            f"Expected an {kind} calibration in {path}. Got an {found} one. Load it with the other class."
        )
    return groups, meta


def _common_parts(groups: Mapping[str, Any], meta: Mapping[str, Any]) -> dict[str, Any]:
    """What results of both kinds have."""
    return {
        "map": _map(groups, meta),
        "samples": _samples(groups),
        "diagnostics": _diagnostics(groups, meta),
        "recording": _recording(groups, meta),
        "settings": meta["settings"],
    }


def _rebuild(module: Any, spec: Mapping[str, Any]) -> Any:
    values = {k: (tuple(v) if isinstance(v, list) else v) for k, v in spec.items() if k != "kind"}
    for key in ("epsilon", "floor"):
        if isinstance(values.get(key), tuple):
            values[key] = torch.tensor(values[key], dtype=torch.float64)
    return getattr(module, spec["kind"])(**values)


def _recording(groups: Mapping[str, Any], meta: Mapping[str, Any]) -> Recording:
    info = meta["recording"]
    x: Any = dict(groups["constant_data"]) if info["named"] else groups["constant_data"]["x"]
    held_out = info.get("held_out", {})
    y = {name: _filled(groups["observed_data"][name], name in held_out) for name in info["outputs"]}
    noise: Any = info["noise"]
    if "noise" in groups:
        noise = groups["noise"]["sd"]
    missing = info.get("missing", any(bool(value.isnan().any()) for value in y.values()))
    if info.get("runs"):
        recording = Recording(runs=_runs(groups, y, info["runs"]), noise=noise, missing=missing, units=_units(info))
    else:
        recording = Recording(x=x, y=y, noise=noise, missing=missing, units=info["units"])
    if held_out:
        recording = recording.masked(torch.tensor([name not in held_out for name in y]).repeat_interleave(recording.n))
        spread = recording.split(recording.spread)
        known = [torch.full_like(old, held_out.get(name, float(old[0]))) for name, old in spread.items()]
        object.__setattr__(recording, "spread", torch.cat(known))
    return recording


def _filled(values: Tensor, held_out: bool) -> Tensor:
    """Something for data that are held out whole, until they are."""
    return torch.zeros_like(values) if held_out else values


def _runs(groups: Mapping[str, Any], y: Mapping[str, Tensor], specs: list[dict[str, Any]]) -> list[Run]:
    lengths = [spec["samples"] for spec in specs]
    time = groups["constant_data"]["time"].split(lengths)
    outputs = {name: values.split(lengths) for name, values in y.items()}
    inputs = {name: values.split(lengths) for name, values in groups.get("inputs", {}).items()}
    return [
        Run(
            time=time[i],
            outputs={name: outputs[name][i] for name in spec["outputs"]},
            inputs={name: inputs[name][i] for name in spec["inputs"]},
            initial=spec["initial"],
            hold=spec["hold"],
        )
        for i, spec in enumerate(specs)
    ]


def _units(info: Mapping[str, Any]) -> dict[str, str]:
    """Units of a recording in time; its runs know those of the inputs."""
    units = dict(info["units"])
    for spec in info["runs"]:
        units |= spec["units"]
    return units


def _options(meta: Mapping[str, Any]) -> dict[str, Any]:
    """How the outputs were propagated."""
    settings = meta["settings"]
    for name in ("embedding", "units"):  # which a result needs to print itself
        settings[name]
    return {
        "fixed": settings["fixed"],
        "scaling": scaling_of(settings),
        "order": settings["order"],
        "sd_floor": settings["sd_floor"],
        "rule": _rule(settings["rule"]) if "rule" in settings else RuleChoice("tensor", settings["gauss_nodes"]),
    }


def _propagation(
    simulator: Simulator | None,
    embedding: embeddings.Embedding,
    recording: Recording,
    meta: Mapping[str, Any],
    options: Mapping[str, Any],
) -> NISP | None:
    if simulator is None:
        return None
    if recording.runs is None and isinstance(simulator, ODESimulator | Trajectories):
        raise RecordingError("Expected a static simulator for a static recording. Got one in time (give the other).")
    simulator = simulator.bind(recording)
    if isinstance(simulator, Trajectories):
        simulator = _with_steps(simulator, meta["settings"])
    propagate = NISP(simulator, embedding, recording.x, outputs=recording.outputs, **options)
    if propagate.pattern.names != tuple(meta["parameter_names"]):
        raise EmbeddingError(
            f"Expected the simulator of this calibration, with the free parameters {meta['parameter_names']}. Got "
            f"{list(propagate.pattern.names)}."
        )
    return propagate


def _with_steps(simulator: Trajectories, settings: Mapping[str, Any]) -> Trajectories:
    """With the time steps that were stored; where the simulator says now how stiff it is, with its own."""
    implicit = settings.get("implicit", simulator.implicit)
    if simulator.ode.stiff not in (None, implicit):
        return simulator
    subdivide = max(settings.get("subdivide", 1), simulator.subdivide)
    denser = settings.get("denser")
    known = None if denser is None else tuple(torch.tensor(factor) for factor in denser)
    return Trajectories(simulator.ode, simulator.recording, subdivide=subdivide, denser=known, implicit=implicit)


def scaling_of(settings: Mapping[str, Any]) -> Scaling:
    """The coordinates that a result's settings name."""
    return Scaling(
        torch.tensor(settings["center"], dtype=torch.float64),
        torch.tensor(settings["scale"], dtype=torch.float64),
        torch.tensor(settings["log"]),
    )


def _rule(spec: Mapping[str, Any]) -> RuleChoice:
    given = None
    if "nodes" in spec:
        nodes, weights = (torch.tensor(spec[key], dtype=torch.float64) for key in ("nodes", "weights"))
        given = polychaos.Rule(nodes, weights, bool((weights > 0).all()))
    return RuleChoice(spec["kind"], spec["size"], spec["seed"], given, asked=spec.get("asked", False))


def _map(groups: Mapping[str, Any], meta: Mapping[str, Any]) -> MapEstimate:
    values = groups["map"]
    size = len(values["mean"])
    return MapEstimate(
        alpha=values["alpha"],
        mean=values["mean"],
        covariance=values.get("covariance", torch.zeros(size, size, dtype=torch.float64)),
        objective=float(values["objective"]),
        alpha_names=tuple(meta["alpha_names"]),
        parameters=tuple(meta["parameter_names"]),
    )


def _samples(groups: Mapping[str, Any]) -> Tensor | None:
    return groups["posterior"]["alpha"] if "posterior" in groups else None


def _diagnostics(groups: Mapping[str, Any], meta: Mapping[str, Any]) -> Diagnostics:
    values = dict(meta["diagnostics"])
    for key in ("alpha", "parameters"):
        values[key] = {name: Quality(**quality) for name, quality in values[key].items()}
    if values["propagation"] is not None:
        values["propagation"] = PropagationCheck(**values["propagation"])
    values["problems"] = tuple(values["problems"])
    values["modes"] = tuple(
        Mode(**{**mode, "alpha": tuple(mode["alpha"])}) for mode in values.get("modes", ())
    )
    if "null_directions" in groups:
        null = groups["null_directions"]["direction"]
    else:
        null = torch.zeros(0, len(meta["alpha_names"]), dtype=torch.float64)
    return Diagnostics(null_directions=null, **values)
