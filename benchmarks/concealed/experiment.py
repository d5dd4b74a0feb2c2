"""The truth of a case under new conditions, so that a proposed experiment can be done."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.concealed.families import FAMILIES
from benchmarks.concealed.families.base import Array, Gate, Planted, RunSetting, Setting, simulate, truth_vector

__all__ = ["planted", "repeat", "setting_of"]


def planted(answer: Mapping[str, Any]) -> list[Planted]:
    """The effects of a case from its answer."""
    family = FAMILIES[answer["family"]]
    found = []
    for row in answer["effects"]:
        gate = None
        if row["gate"] is not None:
            ends = {end: row["gate"][end] for end in ("low", "high")}
            gate = Gate(
                row["gate"]["driver"],
                -np.inf if ends["low"] is None else ends["low"],
                np.inf if ends["high"] is None else ends["high"],
                row["gate"]["width"],
            )
        found.append(Planted(family.effect(row["name"]), row["amplitude"], row["shapes"], gate))
    return found


def setting_of(case: Mapping[str, Any], answer: Mapping[str, Any]) -> Setting:
    """Its conditions, and where every state begins."""
    if "runs" not in case:
        return Setting(x={k: np.asarray(v, dtype=float) for k, v in case["x"].items()}, observed=tuple(case["y"]))
    runs = tuple(
        RunSetting(
            np.asarray(run["time"]),
            {k: np.asarray(v, dtype=float) for k, v in run["inputs"].items()},
            start,
            tuple(run["initial"]),
        )
        for run, start in zip(case["runs"], answer["initial"], strict=True)
    )
    return Setting(runs, observed=tuple(case["runs"][0]["outputs"]))


def repeat(
    case: Mapping[str, Any], answer: Mapping[str, Any], conditions: Mapping[str, Any], *, seed: int = 0
) -> dict[str, Any]:
    """The case with one more run (or more conditions, for a static family) as the experiment asks for.

    Args:
        case: The recording, as JSON holds it.
        answer: Its answer.
        conditions: ``time``, ``inputs`` and ``initial`` of the new run, or ``x`` of a static one. What is not given is
            as in the first run; initial states that are not given are the first run's true ones.
        seed: Of the noise, which is white of the case's own size.

    Returns:
        A case like the given one with the new data behind the old.
    """
    family, rng = FAMILIES[answer["family"]], np.random.default_rng([seed, 77])
    observed = tuple(case["y"] if "y" in case else case["runs"][0]["outputs"])

    def noisy(values: Array, name: str) -> list[float]:
        return [float(v) for v in values + answer["noise"]["sd"][name] * rng.standard_normal(len(values))]

    if family.static:
        given = conditions["x"]
        fresh = given if isinstance(given, Mapping) else {next(iter(case["x"])): given}
        x = {name: np.asarray(fresh[name], dtype=float) for name in case["x"]}
        setting = Setting(x=x, observed=observed)
        theta = truth_vector(family, setting, answer["parameters"])
        trace = simulate(family, setting, theta, planted(answer))[0]
        y = {name: [*case["y"][name], *noisy(trace.outputs[name][:, 0], name)] for name in observed}
        return {**case, "x": {name: [*case["x"][name], *x[name].tolist()] for name in x}, "y": y}
    first = case["runs"][0]
    time = np.asarray(conditions.get("time", first["time"]), dtype=float)
    inputs = {
        name: np.asarray((conditions.get("inputs") or {}).get(name, values), dtype=float)
        for name, values in first["inputs"].items()
    }
    initial = dict(answer["initial"][0])
    given_initial = {name: float(v) for name, v in (conditions.get("initial") or {}).items() if name in family.states}
    initial.update(given_initial)
    setting = Setting((RunSetting(time, inputs, initial, tuple(family.states)),), observed=observed)
    trace = simulate(family, setting, truth_vector(family, setting, answer["parameters"]), planted(answer))[0]
    run = {
        "time": time.tolist(),
        "outputs": {name: noisy(trace.outputs[name][:, 0], name) for name in observed},
        "inputs": {name: values.tolist() for name, values in inputs.items()},
        "initial": given_initial,
    }
    return {**case, "runs": [*case["runs"], run]}
