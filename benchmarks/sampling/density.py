"""One log-density in NumPy or JAX: the ABC posterior with torchcal's quadrature nodes, weights and floor.

Nothing here imports PyTorch, so that a peer's process holds only what that peer needs.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SMOOTHING = 1e-3
"""As in `torchcal.likelihoods`: the kink of the residual is rounded at this share of ε."""


def _third_order(load: Any) -> Any:
    return 1 + load + load**2 / 2 + load**3 / 6


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "response": lambda xp, x, a, b, c, d: _third_order(a + b * x + c * xp.sin(2 * x) + d * xp.cos(3 * x)),
    "decay": lambda xp, x, a, b: a * xp.exp(-b * x),
}
"""Models that are written as functions; the first argument is the array library."""


@dataclass(frozen=True)
class Arrays:
    """What the log-density is made of. Shapes: N data, P coefficients α, Q nodes, K terms of the embedding.

    Attributes:
        y: Data, ``(N,)``.
        epsilon: Tolerance.
        gamma: Ratio of sd to residual.
        floor: δ in √(σ² + δ²).
        psi: Embedding's polynomials at the nodes, ``(Q, K)``.
        weights: Of the nodes, ``(Q,)``.
        projection: Onto the output's expansion, constant first, ``(Q, J)``; None for the full variance.
        rows: Parameter of each α, ``(P,)``.
        columns: Term of each α, ``(P,)``.
        odd: Whether each α changes its sign with a germ, ``(P, germs)``.
        low: Bounds, ``(P,)``, −inf where there is none.
        high: Likewise.
        map: The maximum, ``(P,)``.
        loc: Centre of the normal approximation in unbounded coordinates, ``(P,)``.
        scale_tril: Its factor, ``(P, P)``.
        function: Name in `FUNCTIONS`, or empty for a polynomial.
        check_points: Where densities are compared, ``(20, P)``.
        check_values: torchcal's values there.
        terms: Multi-indices of the polynomial model, ``(M, d)``.
        table: Its Legendre coefficients for each datum, ``(M, N)``.
        x: Conditions of the function.
        center: Of the parameters' scaling, ``(d,)``.
        scale: Likewise.
        mirror: Signs of α that leave the posterior as it is, germs apart, ``(P,)``; None where there are none.
    """

    y: np.ndarray
    epsilon: float
    gamma: float
    floor: float
    psi: np.ndarray
    weights: np.ndarray
    projection: np.ndarray | None
    rows: np.ndarray
    columns: np.ndarray
    odd: np.ndarray
    low: np.ndarray
    high: np.ndarray
    map: np.ndarray
    loc: np.ndarray
    scale_tril: np.ndarray
    function: str
    check_points: np.ndarray
    check_values: np.ndarray
    terms: np.ndarray | None = None
    table: np.ndarray | None = None
    x: np.ndarray | None = None
    center: np.ndarray | None = None
    scale: np.ndarray | None = None
    mirror: np.ndarray | None = None

    def save(self, path: Path) -> None:
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        np.savez(path, **{name: value for name, value in fields.items() if value is not None})

    @classmethod
    def load(cls, path: Path) -> "Arrays":
        with np.load(path) as file:
            found = {name: file[name] for name in file.files}
        for name in ("epsilon", "gamma", "floor"):
            found[name] = float(found[name])
        return cls(**{"projection": None, **found, "function": str(found["function"])})


# --- the density -----------------------------------------------------------------------------------------------


def log_density(arrays: Arrays, xp: Any = np) -> Callable[[Any], Any]:
    """α ``(*batch, P)`` to the log-posterior ``(*batch,)`` within the bounds."""
    moments = _moments(arrays, xp)
    y = xp.asarray(arrays.y)
    precision = 1 / arrays.epsilon**2
    rounding, floor = (SMOOTHING * arrays.epsilon) ** 2, arrays.floor**2

    def value(alpha: Any) -> Any:
        mean, variance = moments(alpha)
        squared = (mean - y) ** 2
        sd = xp.sqrt(variance + floor)
        wanted = arrays.gamma * xp.sqrt(squared + rounding)
        return -0.5 * precision * (squared + (sd - wanted) ** 2).sum(-1)

    return value


def boxed(arrays: Arrays) -> Callable[[np.ndarray], np.ndarray]:
    """The same in NumPy, −inf outside the bounds: for samplers that work in α itself."""
    inside = log_density(arrays)
    low, high = arrays.low, arrays.high

    def value(alpha: np.ndarray) -> np.ndarray:
        good = ((alpha >= low) & (alpha <= high)).all(-1)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.where(good, np.nan_to_num(inside(alpha), nan=-np.inf), -np.inf)

    return value


def unbounded(arrays: Arrays, xp: Any = np) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """α of u, and the log-density of u with the Jacobian: for samplers that need the whole real line.

    Coefficients with two bounds go through a sigmoid, as in torchcal; the others stay.
    """
    both = np.isfinite(arrays.low) & np.isfinite(arrays.high)
    if not (both == (np.isfinite(arrays.low) | np.isfinite(arrays.high))).all():
        raise ValueError("Expected two bounds or none on each coefficient. Got one on some.")
    inside = log_density(arrays, xp)
    if not both.any():
        return (lambda u: u), inside
    low, width = np.where(both, arrays.low, 0), np.where(both, arrays.high - arrays.low, 1)

    def bound(u: Any) -> Any:
        return xp.where(both, low + width / (1 + xp.exp(-u)), u)

    def value(u: Any) -> Any:
        # log sigmoid(u) + log sigmoid(−u), without overflow
        size = xp.abs(u)
        slope = xp.where(both, np.log(width) - size - 2 * xp.log1p(xp.exp(-size)), 0.0)
        return inside(bound(u)) + slope.sum(-1)

    return bound, value


def _moments(arrays: Arrays, xp: Any) -> Callable[[Any], tuple[Any, Any]]:
    nodes = len(arrays.psi)
    d = int(arrays.rows.max()) + 1
    # From α to the scaled parameters at all nodes: one matrix product.
    spread = np.zeros((len(arrays.rows), nodes, d))
    for i, (row, column) in enumerate(zip(arrays.rows, arrays.columns, strict=True)):
        spread[i, :, row] = arrays.psi[:, column]
    spread = xp.asarray(spread.reshape(len(spread), -1))
    weights = xp.asarray(arrays.weights)
    project = None if arrays.projection is None else xp.asarray(arrays.projection.T.copy())
    rows, table = _rows(arrays, xp)

    def moments(alpha: Any) -> tuple[Any, Any]:
        values = rows((alpha @ spread).reshape(*alpha.shape[:-1], nodes, d))
        if project is not None:
            # The few terms of the expansion first, then the data: the cheapest order.
            coefficients = project @ values
            coefficients = coefficients if table is None else coefficients @ table
            return coefficients[..., 0, :], (coefficients[..., 1:, :] ** 2).sum(-2)
        outputs = values if table is None else values @ table
        mean = weights @ outputs
        return mean, weights @ (outputs - mean[..., None, :]) ** 2

    return moments


def _rows(arrays: Arrays, xp: Any) -> tuple[Callable[[Any], Any], Any]:
    """From scaled parameters ``(..., Q, d)`` to outputs, or to polynomials and the table that makes outputs of them."""
    if arrays.function:
        function, x = FUNCTIONS[arrays.function], xp.asarray(arrays.x)

        def outputs(scaled: Any) -> Any:
            values = arrays.center + arrays.scale * scaled
            return function(xp, x, *(values[..., j, None] for j in range(values.shape[-1])))

        return outputs, None
    terms, degree = arrays.terms, int(arrays.terms.max())
    # Products with zeros and ones pick the columns: in JAX several times as fast as indexing, gradient included.
    picks = [xp.asarray(np.eye(degree + 1)[terms[:, j]].T.copy()) for j in range(terms.shape[1])]

    def polynomials(scaled: Any) -> Any:
        levels = [xp.ones_like(scaled), scaled]
        for k in range(1, degree):
            levels.append(((2 * k + 1) * scaled * levels[k] - k * levels[k - 1]) / (k + 1))
        stacked = xp.stack(levels, -1)
        columns = stacked[..., 0, :] @ picks[0]
        for j in range(1, len(picks)):
            columns = columns * (stacked[..., j, :] @ picks[j])
        return columns

    return polynomials, xp.asarray(arrays.table)
