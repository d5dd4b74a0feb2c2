"""The posteriors that are sampled, and their log-densities as plain arrays for samplers that know no PyTorch."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchcal as tc
from benchmarks.sampling import density
from benchmarks.sampling.density import FUNCTIONS, Arrays
from torchcal import polychaos
from torchcal.inference.modes import laplace
from torchcal.models import Problem
from torchcal.results import Calibration

CHECKED = 20
"""Points at which every log-density has to agree."""


@dataclass(frozen=True)
class Posterior:
    """One calibration problem.

    Attributes:
        name: As in tables and file names.
        title: In words.
        simulator: The model.
        recording: The data.
        epsilon: Tolerance of the ABC likelihood.
        options: Further options of `torchcal.calibrate`.
        function: Name of the model in `density.FUNCTIONS`; None for a polynomial.
    """

    name: str
    title: str
    simulator: tc.Simulator
    recording: tc.Recording
    epsilon: float
    options: dict[str, Any] = field(default_factory=dict)
    function: str | None = None

    def calibrate(self, **options: Any) -> Calibration:
        """`torchcal.calibrate` on this problem."""
        return tc.calibrate(
            self.simulator,
            self.recording,
            likelihood=tc.likelihoods.ABC(epsilon=self.epsilon),
            **{"seed": 0, **self.options, **options},
        )


# --- the six of the main table ---------------------------------------------------------------------------------


def cubic(model: str, epsilon: float, n: int, folder: Path) -> Posterior:
    from examples import cubic as study

    title = f"cubic truth, {model} model, N = {n}, ε = {epsilon:g}"
    return Posterior("", title, study.simulator(model), study.recording(n), epsilon)


def ignition(key: str, epsilon: float, folder: Path) -> Posterior:
    """Needs Cantera the first time; data and surrogate are then kept in the folder."""
    kept, data = folder / f"ignition_{key}.npz", folder / f"ignition_{key}_data.npz"
    if not (kept.exists() and data.exists()):
        from examples.ignition import study

        prepared = study.prepare(key, folder)
        x = {name: np.asarray(value) for name, value in prepared.recording.x.items()}
        np.savez(data, y=prepared.recording.y.numpy(), **x)
        prepared.surrogate.save(kept)
    with np.load(data) as arrays:
        x = {name: arrays[name] for name in arrays.files if name != "y"}
        recording = tc.Recording(x=x, y={"ln_tau": arrays["y"]}, noise="none")
    title = f"ignition case {key[0]}, N = {recording.n}, ε = {epsilon:g}"
    return Posterior("", title, tc.PolynomialSurrogate.load(kept), recording, epsilon, {"order": 1})


def response(epsilon: float, folder: Path) -> Posterior:
    """Four parameters in an output of third order, and the variance of its third-order expansion."""
    x = torch.linspace(-1, 1, 20, dtype=torch.float64)
    # The truth is of every order, and its load has a term that the model's lacks.
    y = torch.exp(0.2 + 0.5 * x - 0.4 * torch.sin(2 * x) + 0.2 * torch.cos(3 * x) + 0.3 * torch.sin(6 * x) * x**2)
    simulator = _simulator("response", [tc.Parameter(name, low=-1.5, high=1.5) for name in "abcd"], degree=3)
    title = f"d = 4, third-order output, N = {len(x)}, ε = {epsilon:g}"
    return Posterior("", title, simulator, tc.Recording(x=x, y=y), epsilon, {"order": 3}, "response")


# --- families that grow ----------------------------------------------------------------------------------------


def legendre(d: int, folder: Path) -> Posterior:
    """A polynomial of d coefficients against a truth that is none."""
    from examples.cubic import legendre as polynomials

    names = [f"l{k}" for k in range(d)]
    x = torch.linspace(-1, 1, 21, dtype=torch.float64)

    def polynomial(x: Tensor, p: dict[str, Tensor]) -> Tensor:
        terms = polynomials(x, max(1, d - 1))[:d]
        return sum(p[name] * value for name, value in zip(names, terms, strict=True))

    simulator = tc.Simulator(polynomial, parameters=[tc.Parameter(name) for name in names], degree=1)
    recording = tc.Recording(x=x, y=torch.exp(x) * torch.sin(5 * x))
    return Posterior("", f"{d} coefficients, N = 21, ε = 0.05", simulator, recording, 0.05)


def decay(order: int, folder: Path) -> Posterior:
    """Two parameters of a decay, and the variance of an expansion of growing order."""
    x = torch.linspace(0, 3, 15, dtype=torch.float64)
    parameters = [tc.Parameter("a", low=0.5, high=2.0), tc.Parameter("b", low=0.1, high=2.5)]
    recording = tc.Recording(x=x, y=1 / (1 + x) ** 1.5)
    title = f"d = 2, output of order {order}, N = 15, ε = 0.01"
    options = {"order": order, "rule": 10}
    return Posterior("", title, _simulator("decay", parameters), recording, 0.01, options, "decay")


def _simulator(function: str, parameters: list[tc.Parameter], degree: int | None = None) -> tc.Simulator:
    return tc.Simulator(lambda x, p: FUNCTIONS[function](torch, x, *p.values()), parameters=parameters, degree=degree)


MAIN: dict[str, Callable[[Path], Posterior]] = {
    "cubic-linear-0.1": partial(cubic, "linear", 0.1, 11),
    "cubic-linear-0.01": partial(cubic, "linear", 0.01, 11),
    "cubic-linear-0.001": partial(cubic, "linear", 0.001, 11),
    "cubic-quadratic-0.01": partial(cubic, "quadratic", 0.01, 11),
    "ignition-1": partial(ignition, "1a", 0.001),
    "ignition-2": partial(ignition, "2", 0.001),
    "d4-order3": partial(response, 0.05),
}
GROWTH: dict[str, dict[int, Callable[[Path], Posterior]]] = {
    "N": {n: partial(cubic, "linear", 0.1, n) for n in (11, 31, 101, 316, 1000)},
    "d": {d: partial(legendre, d) for d in (1, 2, 3, 4, 5)},
    "order": {order: partial(decay, order) for order in (1, 2, 3, 4, 5)},
}


def make(name: str, folder: Path) -> Posterior:
    """A posterior by name: one of `MAIN`, or ``grow-N-101`` for one of `GROWTH`."""
    if name in MAIN:
        return replace(MAIN[name](folder), name=name)
    _, axis, size = name.split("-")
    return replace(GROWTH[axis][int(size)](folder), name=name)


# --- as arrays -------------------------------------------------------------------------------------------------


def problem_of(calibration: Calibration) -> Problem:
    """The problem behind a calibration under a flat prior."""
    return Problem(
        y=calibration.recording.y,
        propagate=calibration.propagate,
        likelihood=calibration.likelihood,
        prior=tc.priors.Flat(calibration.propagate),
    )


def normal_approximation(calibration: Calibration) -> tuple[Problem, Tensor, Tensor]:
    """The problem, and the Laplace approximation in unbounded coordinates: centre and factor."""
    problem = problem_of(calibration)
    found, _ = laplace(problem, calibration.map.alpha)
    return problem, found.loc, found.scale_tril


def export(posterior: Posterior) -> tuple[Arrays, float]:
    """The log-density as arrays, and the seconds that the maximum and its curvature took."""
    began = time.perf_counter()
    calibration = posterior.calibrate(num_samples=0)
    problem, loc, scale_tril = normal_approximation(calibration)
    seconds = time.perf_counter() - began
    propagate = problem.propagate
    pattern = propagate.pattern
    # The nodes that torchcal's own moments take: for a polynomial fewer than those of a quadrature rule.
    psi = propagate._carriers
    projection = propagate._projection
    model = _polynomial(propagate) if posterior.function is None else _function(propagate)
    points = _points(problem, calibration.map.alpha, loc, scale_tril)
    with torch.no_grad():
        values = problem.log_prob(points)
    arrays = Arrays(
        y=problem.y.numpy(),
        epsilon=float(posterior.epsilon),
        gamma=float(calibration.likelihood.gamma),
        floor=float(propagate.sd_floor),
        psi=psi.numpy(),
        weights=propagate.weights.numpy(),
        projection=None if projection is None else projection.numpy(),
        rows=pattern.rows.numpy(),
        columns=pattern.columns.numpy(),
        odd=(pattern.indices[pattern.columns] % 2).numpy(),
        low=problem.prior.low.numpy(),
        high=problem.prior.high.numpy(),
        map=calibration.map.alpha.numpy(),
        loc=loc.detach().numpy(),
        scale_tril=scale_tril.detach().numpy(),
        function=posterior.function or "",
        check_points=points.numpy(),
        check_values=values.numpy(),
        mirror=_mirror(posterior, problem, points),
        **model,
    )
    return arrays, seconds


def _mirror(posterior: Posterior, problem: Problem, points: Tensor) -> np.ndarray | None:
    """x → −x turns what the parabola misses of the cubic into its negative: even coefficients change their sign."""
    if not posterior.name.startswith("cubic-quadratic"):
        return None
    signs = 1.0 - 2.0 * (problem.propagate.pattern.rows % 2 == 0).to(points)
    with torch.no_grad():
        here, there = problem.log_prob(points), problem.log_prob(points * signs)
    if not torch.allclose(here, there, rtol=1e-6):
        raise RuntimeError(f"Expected a posterior that is its own mirror image. Got {here} and {there}.")
    return signs.numpy()


def _polynomial(propagate: tc.NISP) -> dict[str, np.ndarray]:
    """Legendre coefficients of the outputs in scaled parameters: exact, since the simulator is a polynomial."""
    # The cubic study's models do not say that they are linear in their parameters; the comparison of values would tell.
    degree, d = propagate.simulator.degree or 1, len(propagate.pattern.names)
    terms = polychaos.multi_indices(d, degree)
    rule = polychaos.tensor_rule(polychaos.LEGENDRE, d, degree + 1)
    basis = polychaos.evaluate(polychaos.LEGENDRE, terms, rule.nodes)
    project = basis * rule.weights[:, None] / polychaos.norms(polychaos.LEGENDRE, terms)
    values = propagate.simulator.at(propagate.x, propagate.outputs)(propagate.scaling.physical(rule.nodes))
    return {"terms": terms.numpy(), "table": (project.T @ values).numpy()}


def _function(propagate: tc.NISP) -> dict[str, np.ndarray]:
    scaling = propagate.scaling
    return {"x": propagate.x.numpy(), "center": scaling.center.numpy(), "scale": scaling.scale.numpy()}


def _points(problem: Problem, alpha: Tensor, loc: Tensor, scale_tril: Tensor) -> Tensor:
    """The maximum, draws of the normal approximation, and far points."""
    generator = torch.Generator().manual_seed(1)
    z = torch.randn(CHECKED - 1, len(loc), generator=generator, dtype=torch.float64)
    z = z * torch.logspace(-1, 2, CHECKED - 1, dtype=torch.float64)[:, None]
    points = problem.prior.transform.bound((loc + z @ scale_tril.T).clamp(-3, 3))
    return torch.cat([alpha[None], points]).detach()


def disagreement(arrays: Arrays, xp: Any) -> float:
    """Largest relative difference between torchcal's log-density and that of the arrays, in one array library."""
    with np.errstate(all="ignore"):
        values = np.asarray(density.log_density(arrays, xp)(xp.asarray(arrays.check_points)))
    return float((np.abs(values - arrays.check_values) / np.maximum(1, np.abs(arrays.check_values))).max())
