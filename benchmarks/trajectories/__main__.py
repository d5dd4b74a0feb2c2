"""How long a trajectory and its derivatives take, beside SciPy: ``python -m benchmarks.trajectories``.

What a least-squares fit needs at every step: the states at all samples and their derivatives by the parameters.
torchcal has them from the same passes, exact for its steps, from nothing or from a solution of nearby parameters, as in
a fit. SciPy has them by forward differences, one more solution for each parameter, at the loosest tolerance that gives
as small an error (1e-10 at least). Errors are those of the states against a much tighter solution, relative to the
largest value of each.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp

import torchcal as tc
from torchcal.simulators import workable

REPEATS, NEARBY, DIFFERENCE = 5, 1.01, 1e-4
Rates = Callable[[float, Sequence[float], Sequence[float]], list[float]]


@dataclass(frozen=True)
class Case:
    """A model, written once for each of the two, with its parameters, initial states and sample times."""

    name: str
    rates: Callable[..., dict[str, Any]]
    plain: Rates
    states: dict[str, float]
    values: dict[str, float]
    t: np.ndarray


def cases() -> list[Case]:
    """A swing that is not stiff, a chain with a fast intermediate, and Robertson's problem."""

    def robertson(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        made, back, on = p["k1"] * s["a"], p["k2"] * s["b"] * s["c"], p["k3"] * s["b"] ** 2
        return {"a": back - made, "b": made - back - on, "c": on}

    def swing(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        return {"x": s["v"], "v": -p["k"] * torch.sin(s["x"]) - p["c"] * s["v"]}

    def chain(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        return {"A": -p["k1"] * s["A"], "B": p["k1"] * s["A"] - p["k2"] * s["B"], "C": p["k2"] * s["B"]}

    return [
        Case(
            "pendulum, 2 states, 200 samples", swing,
            lambda t, s, p: [s[1], -p[0] * np.sin(s[0]) - p[1] * s[1]],
            {"x": 1.0, "v": 0.0}, {"k": 4.0, "c": 0.1}, np.linspace(0, 20, 200),
        ),
        Case(
            "chain, k2 / k1 = 1e5, 3 states, 60 samples", chain,
            lambda t, s, p: [-p[0] * s[0], p[0] * s[0] - p[1] * s[1], p[1] * s[1]],
            {"A": 1.0, "B": 0.0, "C": 0.0}, {"k1": 0.3, "k2": 3e4}, np.linspace(0, 10, 60),
        ),
        Case(
            "Robertson, 3 states, 41 samples", robertson,
            lambda t, s, p: [-p[0] * s[0] + p[1] * s[1] * s[2], p[0] * s[0] - p[1] * s[1] * s[2] - p[2] * s[1] ** 2,
                             p[2] * s[1] ** 2],
            {"a": 1.0, "b": 0.0, "c": 0.0}, {"k1": 0.04, "k2": 1e4, "k3": 3e7},
            np.concatenate([[0.0], np.logspace(-4, 4, 40)]),
        ),
    ]  # fmt: skip


def _seconds(work: Callable[[], Any]) -> float:
    work()
    found = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        found.append(time.perf_counter() - begin)
    return statistics.median(found)


def _scipy(case: Case, method: str, values: Sequence[float], rtol: float) -> np.ndarray:
    ends = (case.t[0], case.t[-1])
    scale = 1e-4 if case.name.startswith("Robertson") else 1.0  # of its smallest state
    return solve_ivp(case.plain, ends, list(case.states.values()), method, case.t, args=(values,), rtol=rtol,
                     atol=1e-3 * scale * rtol).y  # fmt: skip


def measure(case: Case) -> list[str]:
    """Rows of the table."""
    values = list(case.values.values())
    exact = _scipy(case, "Radau", values, 1e-11)
    largest = np.abs(exact).max(1, keepdims=True)

    def error(y: np.ndarray) -> float:
        return float((np.abs(y - exact) / largest).max())

    model = tc.ODESimulator(case.rates, list(case.states), [tc.Parameter(name) for name in case.values])
    runs = [tc.Run(case.t, {name: y for name, y in zip(case.states, exact, strict=True)}, initial=case.states)]
    recording = tc.Recording(runs=runs)
    point = torch.tensor([values], dtype=torch.float64)
    spread = torch.as_tensor(largest).expand(-1, len(case.t)).flatten()
    bound = workable(model.bind(recording), point, 1e-5 * spread)
    near = bound.linearise(bound.x, NEARBY * point).warm
    mine = error(bound.linearise(bound.x, point).y.reshape(len(case.states), -1).numpy())
    rows = [
        ("torchcal, from nothing", mine, _seconds(lambda: bound.linearise(bound.x, point))),
        ("torchcal, from parameters 1 % off", mine, _seconds(lambda: bound.linearise(bound.x, point, warm=near))),
    ]
    for method in ("Radau", "LSODA"):
        rtol = 1e-2
        while rtol > 1e-10 and error(_scipy(case, method, values, rtol)) > mine:
            rtol /= 2

        def solutions(method: str = method, rtol: float = rtol) -> None:
            _scipy(case, method, values, rtol)
            for k in range(len(values)):
                moved = [v * (1 + DIFFERENCE * (i == k)) for i, v in enumerate(values)]
                _scipy(case, method, moved, rtol)

        rows.append((f"SciPy {method}, differences", error(_scipy(case, method, values, rtol)), _seconds(solutions)))
    kind = f"{'implicit' if bound.implicit else 'explicit'}, {bound.num_steps} steps"
    return [
        f"| {case.name} | {name}{f' ({kind})' if name.startswith('torchcal, from n') else ''} | {e:.1g} | "
        f"{1e3 * seconds:.1f} |"
        for name, e, seconds in rows
    ]


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    print("| model | solver | error of the states | milliseconds, with derivatives |\n|---|---|---|---|")
    for case in cases():
        print("\n".join(measure(case)), flush=True)


if __name__ == "__main__":
    main()
