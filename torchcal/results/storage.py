"""Results as xarray trees and netCDF files. No pickle: what cannot be written as data or text is left out."""

import hashlib
import importlib
import io
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchcal.data import Recording, Run
from torchcal.errors import DomainError, MissingDependencyError
from torchcal.files import replacing
from torchcal.propagation import RuleChoice

if TYPE_CHECKING:
    from torchcal.results.additive import AdditiveCalibration
    from torchcal.results.calibration import Calibration

__all__ = [
    "CHECKSUM",
    "FORMAT",
    "NAME",
    "additive_tree",
    "calibration_tree",
    "checksum",
    "netcdf_modules",
    "to_arviz",
    "write",
]

FORMAT = 1

NAME = "torchcal_name"
"""Attribute of a variable that could not be stored under its own name."""

CHECKSUM = "torchcal_sha256"
"""Attribute of a file that its contents are held against."""


def netcdf_modules() -> tuple[Any, Any, Any]:
    """xarray, h5netcdf and h5py, or an error that says how to get what is missing of them."""
    return _optional("xarray"), _optional("h5netcdf"), _optional("h5py")


def _optional(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(
            f"Expected {name} for trees and netCDF files. It is not installed: pip install 'torchcal[arviz]'."
        ) from error


def calibration_tree(result: "Calibration") -> Any:
    """The tree of an embedded calibration."""
    prediction = result.predict()
    groups = _common_groups(result)
    values = {
        "mean": prediction.mean,
        "sd": prediction.sd,
        "sd_model_error": prediction.sd_model_error,
        "sd_posterior": prediction.sd_posterior,
        "map_mean": prediction.map.mean,
        "map_sd": prediction.map.sd,
    }
    if prediction.mean_predictive is not None:
        values["mean_predictive_mean"] = prediction.mean_predictive.mean
        values["mean_predictive_sd"] = prediction.mean_predictive.sd
    groups["prediction"] = _dataset({k: ("datum", v) for k, v in values.items() if v is not None})
    groups["map"]["covariance"] = (("parameter", "parameter_"), result.map.covariance.numpy())
    embedding = {"kind": type(result.embedding).__name__, **_plain_fields(result.embedding)}
    likelihood = {"kind": type(result.likelihood).__name__, **_plain_fields(result.likelihood)}
    return _tree(groups, result, {"kind": "embedded", "embedding": embedding, "likelihood": likelihood})


def additive_tree(result: "AdditiveCalibration") -> Any:
    """The tree of a conventional calibration."""
    prediction = result.predict()
    groups = _common_groups(result)
    values = {
        f"{kind}_{moment}": getattr(getattr(prediction, kind), moment)
        for kind in ("push_forward", "posterior", "map")
        for moment in ("mean", "sd")
    }
    groups["prediction"] = _dataset({k: ("datum", v) for k, v in values.items()})
    return _tree(groups, result, {"kind": "additive"})


def to_arviz(tree: Any) -> Any:
    """A tree as ``arviz.InferenceData`` where ArviZ still has it."""
    try:
        import arviz
    except ImportError as error:
        raise MissingDependencyError(
            "Expected ArviZ. It is not installed: pip install 'torchcal[arviz]'."
        ) from error
    kind = getattr(arviz, "InferenceData", None)
    if kind is None:
        return tree
    return kind(**{name: node.to_dataset() for name, node in tree.children.items()})


def write(tree: Any, path: str | os.PathLike[str]) -> None:
    """Write a tree to a netCDF file, whole or not at all.

    Raises:
        DomainError: If the folder does not exist.
        MissingDependencyError: If a package for netCDF files is not installed.
        OSError: If the disk is full, say.
    """
    netcdf_modules()
    with replacing(path) as temporary:
        temporary.write_bytes(_netcdf(tree))


def _netcdf(tree: Any) -> memoryview:
    """A tree as the bytes of a netCDF file: HDF5 itself ends Python with a crash where a disk is full."""
    xarray, h5netcdf, _ = netcdf_modules()
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        for node in tree.subtree:
            group = file if node.path == "/" else file.create_group(node.path)
            node.to_dataset().dump_to_store(xarray.backends.H5NetCDFStore(group))
        file.attrs[CHECKSUM] = checksum(tree)
    return buffer.getbuffer()


def checksum(tree: Any) -> str:
    """SHA-256 of a tree's variables and attributes, the same before it is written and after it is read."""
    found = hashlib.sha256()
    for node in sorted(tree.subtree, key=lambda node: node.path):
        dataset = node.to_dataset()
        parts: list[Any] = [node.path, _texts(dataset.attrs)]
        for name, variable in sorted(dataset.variables.items()):
            values = np.asarray(variable.values)
            if values.dtype.kind in "biuf":
                numbers = np.array(values, dtype="<f8")
                numbers[np.isnan(numbers)] = np.nan  # of one kind
                held: Any = hashlib.sha256(numbers.tobytes()).hexdigest()
            else:
                held = [str(value) for value in values.ravel()]
            parts.append([name, list(variable.dims), list(values.shape), held, _texts(variable.attrs)])
        found.update(json.dumps(parts).encode())
    return found.hexdigest()


def _texts(attributes: Mapping[str, Any]) -> list[tuple[str, str]]:
    return sorted((name, str(value)) for name, value in attributes.items() if name != CHECKSUM)


def _dataset(values: Mapping[str, tuple[Any, Tensor]]) -> Any:
    return _optional("xarray").Dataset({name: (dims, value.numpy()) for name, (dims, value) in values.items()})


def _named_dataset(dimension: str, values: Mapping[str, Tensor]) -> Any:
    """A dataset of variables with a user's names, changed where a file cannot have them."""
    variables: dict[str, Any] = {}
    for name, value in values.items():
        key = "|" if name == "." else name.replace("/", "|")  # "." is HDF5's name of the group itself
        while key == dimension or key in variables or (key != name and key in values):
            key += "_"
        variables[key] = (dimension, value.numpy(), {} if key == name else {NAME: name})
    return _optional("xarray").Dataset(variables)


def _common_groups(result: Any) -> dict[str, Any]:
    xarray = _optional("xarray")
    estimate = result.map
    groups: dict[str, Any] = {}
    if result.samples is not None:
        chains, draws, _ = result.samples.shape
        groups["posterior"] = xarray.Dataset(
            {"alpha": (("chain", "draw", "coefficient"), result.samples.numpy())},
            coords={
                "chain": np.arange(chains),
                "draw": np.arange(draws),
                "coefficient": list(estimate.alpha_names),
            },
        )
    groups["map"] = xarray.Dataset(
        {
            "alpha": ("coefficient", estimate.alpha.numpy()),
            "mean": ("parameter", estimate.mean.numpy()),
            "objective": ((), estimate.objective),
        },
        coords={"coefficient": list(estimate.alpha_names), "parameter": list(estimate.parameters)},
    )
    recording = result.recording
    count = recording.n
    outputs = recording.split(recording.y)
    groups["observed_data"] = _named_dataset("condition", outputs)
    x = recording.x if isinstance(recording.x, Mapping) else {"x": recording.x}
    groups["constant_data"] = _named_dataset("condition", x)
    if recording.runs is not None and recording.runs[0].inputs:
        inputs = {name: torch.cat([run.inputs[name] for run in recording.runs]) for name in recording.runs[0].inputs}
        groups["inputs"] = _named_dataset("condition", inputs)
    if isinstance(recording.noise, Tensor):
        groups["noise"] = _dataset({"sd": ("datum", recording.noise)})
    if len(result.diagnostics.null_directions):
        groups["null_directions"] = _dataset(
            {"direction": (("number", "coefficient"), result.diagnostics.null_directions)}
        )
    if count != len(next(iter(x.values()))):
        raise DomainError("Expected conditions and recording of one length.")
    return groups


def _tree(groups: dict[str, Any], result: Any, extra: Mapping[str, Any]) -> Any:
    diagnostics = asdict(result.diagnostics)
    del diagnostics["null_directions"]
    recording = result.recording
    settings = dict(result.settings)
    choice = None if result.propagate is None else result.propagate.rule_choice
    if choice is not None and (choice.kind != "tensor" or choice.asked):
        settings["rule"] = _rule_fields(choice)
    meta = {
        **extra,
        "format": FORMAT,
        "settings": settings,
        "diagnostics": diagnostics,
        "recording": {
            "named": isinstance(recording.x, Mapping),
            "outputs": list(recording.outputs),
            "noise": "none" if isinstance(recording.noise, str) else None,
            "missing": recording.missing,
            "held_out": _held_out(recording),
            "units": dict(recording.units),
            "runs": None if recording.runs is None else [_run_fields(run) for run in recording.runs],
        },
    }
    tree = _optional("xarray").DataTree.from_dict({f"/{name}": group for name, group in groups.items()})
    tree.attrs["torchcal"] = json.dumps(meta)
    return tree


def _held_out(recording: Recording) -> dict[str, float]:
    """Spread of the outputs that are held out whole, whose data do not tell it."""
    observed, spread = recording.split(recording.observed), recording.split(recording.spread)
    return {name: float(spread[name][0]) for name, seen in observed.items() if not bool(seen.any())}


def _run_fields(run: Run) -> dict[str, Any]:
    """What of a run is not an array."""
    return {
        "samples": len(run.time),
        "outputs": list(run.outputs),
        "inputs": list(run.inputs),
        "initial": dict(run.initial),
        "hold": run.hold,
        "units": dict(run.units),
    }


def _rule_fields(choice: RuleChoice) -> dict[str, Any]:
    spec: dict[str, Any] = {"kind": choice.kind, "size": choice.size, "seed": choice.seed, "asked": choice.asked}
    if choice.given is not None:
        spec |= {"nodes": choice.given.nodes.tolist(), "weights": choice.given.weights.tolist()}
    return spec


def _plain_fields(item: Any) -> dict[str, Any]:
    values = {}
    for entry in fields(item):
        value = getattr(item, entry.name)
        if isinstance(value, Tensor | np.generic | np.ndarray):
            value = value.tolist()
        values[entry.name] = list(value) if isinstance(value, tuple) else value
    return values


