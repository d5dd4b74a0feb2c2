r"""Building a polynomial surrogate: design, evaluation, projection or regression, held-out error.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 41-43.
"""

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.checks import as_seed, real_number, whole
from torchcal.errors import DomainError, SimulatorError, SurrogateWarning, warn
from torchcal.polychaos._checks import limit_rows
from torchcal.simulators.design import Evaluations, evaluate_points
from torchcal.simulators.executor import check_executor
from torchcal.simulators.external import ExternalSimulator
from torchcal.simulators.held_out import HeldOutError, mean_and_sd, root_mean_square
from torchcal.simulators.parameter import Parameter, Scaling
from torchcal.simulators.points import PointCall, describe_point
from torchcal.simulators.scattered import check_points, fit_scattered, scatter
from torchcal.simulators.static import Conditions, Simulator, check_parameters, check_static
from torchcal.simulators.surrogate import Box, PolynomialSurrogate, check_box

__all__ = ["build_surrogate"]

MANY = 4
"""Conditions and parameters from which on scattered points are far fewer than those of a grid."""

_ELEMENTS = 2**22
"""Numbers evaluated at once: 32 MiB."""


def build_surrogate(
    simulator: Simulator | Callable[[Any, dict[str, float]], Any],
    *,
    conditions: Box,
    parameters: Sequence[Parameter] | None = None,
    order: int = 6,
    nodes: int | Sequence[int] | None = None,
    points: int | None = None,
    outputs: Sequence[str] | None = None,
    executor: Executor | None = None,
    cache: str | os.PathLike[str] | Evaluations | None = None,
    progress: bool = True,
    holdout: int = 200,
    seed: int = 0,
    threshold: float = 0.01,
) -> PolynomialSurrogate:
    r"""Project a simulator on Legendre polynomials, jointly in its conditions and parameters.

    .. math:: s_k = \frac{1}{\langle L_k^2 \rangle} \int_{[-1,1]^D} f(\eta)\, L_k(\eta)\, \frac{d\eta}{2^D}
        \approx \frac{1}{\langle L_k^2 \rangle} \sum_q w_q f(\eta_q) L_k(\eta_q), \qquad |k| \le p

    on a full grid of Gauss points: ``nodes**D`` evaluations for D conditions and parameters. From four of them on
    that is a great many; ``points=`` takes so many random ones instead, and the same polynomial by weighted least
    squares.

    Args:
        simulator: A function ``f(x, p)`` of plain floats that returns a number (or a dict of numbers), an
            `ExternalSimulator`, or a `Simulator` written in torch, which is evaluated in one batch.
        conditions: ``{name: (low, high)}``; or one pair where x is a plain number.
        parameters: With both bounds. By default all of the simulator's; those left out are held at their neutral
            value.
        order: Total degree p, >= 1.
        nodes: Gauss points per dimension, above `order`; one number, or one for each condition and parameter. The
            default ``order + 1`` is exact for polynomials of the order; more of them changed the error
            of smooth functions by less than a tenth, where a higher order divides it.
        points: Number of random points instead of the grid, at least twice the number of terms, which is
            :math:`\binom{D + p}{p}`: 420 for six conditions and parameters at order 4, where the grid has 15,625.
        outputs: Names of the outputs to keep, where there are several; by default all.
        executor: Any ``concurrent.futures.Executor`` for functions of plain floats; None evaluates here. When a
            worker dies, only what it had not handed over is repeated, in a fresh process pool where that broke.
        cache: For functions of plain floats: a file (.npz) that evaluations are kept in and taken from, or
            the ``.partial`` of an error. One kept evaluation is repeated, to see that the function is the same.
        progress: Whether to show a bar.
        holdout: Number of random points at which the error is measured, >= 10.
        seed: Of these points, and of those of ``points=``, of which more begin with the fewer.
        threshold: Largest error, rms over the output's sd, that passes without a warning.

    Returns:
        The surrogate; ``.error`` holds its error.

    Raises:
        DomainError: If an argument has no meaning: before anything is evaluated.
        SimulatorError: If an evaluation fails or is not finite, named with its point. What was evaluated is in the
            cache, and in ``.partial``. Ctrl-C leaves both too.

    Warns:
        SurrogateWarning: If the error is above `threshold`.
        WorkerWarning: If workers died; nothing is lost then.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 41-43; with ``points=``
    A. Cohen & G. Migliorati (2017), SMAI J. Comput. Math. 3, 181-203.

    >>> a = Parameter("a", low=0.0, high=2.0)
    >>> s = build_surrogate(lambda x, p: p["a"] * x["t"] ** 2, conditions={"t": (-1, 1)}, parameters=[a],
    ...                     order=3, progress=False)
    >>> print(f"{float(s.at({'t': torch.tensor([0.5])})(torch.tensor([1.0]))):.6f}")
    0.250000
    """
    parameters = _choose_parameters(simulator, parameters)
    check_static(parameters)
    outputs = None if outputs is None else _check_outputs(outputs)
    names, bounds = check_box(conditions, parameters)
    dim = len(bounds) + len(parameters)
    order = whole("order", order, 1)
    if points is not None and nodes is not None:
        raise DomainError("Expected nodes= of a grid, or points= instead of one. Got both.")
    limit_rows("the polynomial", math.comb(dim + order, order), advice="use a lower order= or fewer dimensions")
    counts = _check_nodes(nodes, order, dim) if points is None else []
    if points is not None:
        points = check_points(points, math.comb(dim + order, order))
    holdout, seed = whole("holdout", holdout, 10), as_seed(seed)
    if not real_number(threshold) > 0:
        raise DomainError(f"Expected threshold > 0. Got {threshold!r}.")
    external = not isinstance(simulator, Simulator) or isinstance(simulator, ExternalSimulator)
    if not external and (executor is not None or cache is not None):
        raise DomainError(
            "Expected no executor= or cache= beside a torch simulator, which is evaluated in one batch. "
            "They are for functions of plain floats."
        )
    low, high = bounds.T
    scaling = Scaling.from_parameters(parameters)

    def located(x: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        return 0.5 * (low + high) + 0.5 * (high - low) * x, scaling.physical(p)

    if points is None:
        condition_rule = polychaos.tensor_rule(polychaos.LEGENDRE, len(bounds), counts[: len(bounds)])
        parameter_rule = polychaos.tensor_rule(polychaos.LEGENDRE, len(parameters), counts[len(bounds) :])
        x_design, p_design = located(condition_rule.nodes, parameter_rule.nodes)
    else:
        indices = polychaos.multi_indices(dim, order)
        scattered = scatter(indices, points, seed)
        x_design, p_design = located(scattered[:, : len(bounds)], scattered[:, len(bounds) :])
    random = 2 * torch.from_numpy(np.random.default_rng(seed).random((holdout, dim))) - 1
    x_random, p_random = located(random[:, : len(bounds)], random[:, len(bounds) :])
    labels = [*(names or ("x",)), *(parameter.name for parameter in parameters)]
    if external:
        call = _point_call(simulator, names, parameters)
        if isinstance(simulator, ExternalSimulator) and executor is None:
            executor = simulator.executor
        check_executor(executor, call.function)
        pairs = (x_design, p_design)
        if points is None:
            pairs = (x_design.repeat_interleave(len(p_design), 0), p_design.repeat(len(x_design), 1))
        design = torch.cat(pairs, dim=-1)
        every = torch.cat([design, torch.cat([x_random, p_random], dim=-1)])
        done = evaluate_points(call, every.numpy(), labels, executor=executor, cache=cache, progress=progress)
        found, values = done.outputs, torch.from_numpy(done.values).T
        fitted, held_out = values[:, : len(design)], values[:, len(design) :]
    else:
        model = _TorchModel(simulator, names, parameters, outputs)  # type: ignore[arg-type]
        at_design = model.grid if points is None else model.pairs
        fitted, held_out = at_design(x_design, p_design), model.pairs(x_random, p_random)
        found = model.outputs
    if found is None and outputs is not None and outputs != ("y",):  # which is what it is called elsewhere
        raise SimulatorError(
            f"Expected outputs {list(outputs)}. Got one without a name. Return a dict of them, or leave outputs= out."
        )
    if found is not None:
        kept = found if outputs is None else outputs
        missing = [name for name in kept if name not in found]
        if missing:
            raise SimulatorError(f"Expected outputs {list(kept)}. Got {list(found)}: {missing} missing.")
        rows = [found.index(name) for name in kept]
        fitted, held_out, found = fitted[rows], held_out[rows], kept
    if points is None:
        coefficients = _project(fitted, condition_rule, parameter_rule, order)
    else:
        coefficients = fit_scattered(fitted, indices, scattered)
    settings: dict[str, Any] = {
        "conditions": conditions,
        "parameters": parameters,
        "order": order,
        "outputs": found,
        "nodes": None if points is not None else counts[0] if len(set(counts)) == 1 else counts,
    }
    surrogate = PolynomialSurrogate(coefficients, **settings)
    psi = polychaos.evaluate(polychaos.LEGENDRE, surrogate.indices, random)
    error = (coefficients @ psi.T - held_out).abs()
    where = torch.cat([x_random, p_random], dim=-1)
    mean, sd = mean_and_sd(held_out)
    measured = HeldOutError(
        num=holdout,
        outputs=found or ("y",),
        max_abs=error.amax(1),
        rms=root_mean_square(error),
        mean=mean,
        sd=sd,
        worst=tuple(dict(zip(labels, where[int(i)].tolist(), strict=True)) for i in error.argmax(1)),
    )
    if bool((measured.relative > threshold).any()):
        few = " (points= takes fewer evaluations than a grid)" if points is None and dim >= MANY else ""
        few = " and points=" if points is not None else few
        warn(
            f"The surrogate of order {order} has a large {measured}\n(threshold {threshold:g} of the sd). Raise "
            f"order={few}, narrow the box, or take the logarithm of an output that spans decades.",
            SurrogateWarning,
        )
    return PolynomialSurrogate(coefficients, error=measured, **settings)


class _TorchModel:
    """A torch simulator at grids and at pairs of conditions and parameters."""

    def __init__(
        self,
        simulator: Simulator,
        names: tuple[str, ...] | None,
        parameters: Sequence[Parameter],
        outputs: Sequence[str] | None,
    ) -> None:
        self.simulator, self.names, self.parameters = simulator, names, parameters
        self.outputs = None if outputs is None else tuple(outputs)
        self.template = torch.tensor(
            [parameter.neutral or 0.0 for parameter in simulator.parameters], dtype=torch.float64
        )
        order = list(simulator.names)
        self.places = [order.index(parameter.name) for parameter in parameters]

    def grid(self, x: Tensor, p: Tensor) -> Tensor:
        """Outputs ``(outputs, C * P)`` at all pairs of the conditions ``(C, c)`` and parameters ``(P, d)``."""
        if self.outputs is None:
            self.outputs = self._names(x, p)
        evaluate = self.simulator.at(self._conditions(x), self.outputs)
        values = self.template.repeat(len(p), 1)
        values[:, self.places] = p
        size = max(1, _ELEMENTS // len(x))
        with torch.no_grad():
            parts = [evaluate(values[i : i + size]).to("cpu", torch.float64) for i in range(0, len(p), size)]
        found = torch.cat(parts).reshape(len(p), -1, len(x)).permute(1, 2, 0)  # (outputs, C, P)
        if not bool(torch.isfinite(found).all()):
            which, i, j = (int(index) for index in (~torch.isfinite(found)).nonzero()[0])
            row = [*x[i].tolist(), *p[j].tolist()]
            point = describe_point(row, self.names, tuple(parameter.name for parameter in self.parameters))
            raise SimulatorError(
                f"Expected finite values all over the box. Got {float(found[which, i, j])} at {point}. Narrow the "
                "bounds so that the simulator has an answer everywhere between them."
            )
        return found.reshape(len(found), -1)

    def pairs(self, x: Tensor, p: Tensor) -> Tensor:
        """Outputs ``(outputs, m)`` at m pairs: the diagonals of small grids."""
        parts = []
        for i in range(0, len(x), 32):
            block = self.grid(x[i : i + 32], p[i : i + 32])
            count = len(x[i : i + 32])
            parts.append(block.reshape(len(block), count, count).diagonal(dim1=1, dim2=2))
        return torch.cat(parts, dim=1)

    def _conditions(self, x: Tensor) -> Conditions:
        if self.names is None:
            return x[:, 0]
        return {name: x[:, i].clone() for i, name in enumerate(self.names)}

    def _names(self, x: Tensor, p: Tensor) -> tuple[str, ...] | None:
        """Output names: a simulator tells them only by its function's own result."""
        if isinstance(self.simulator, PolynomialSurrogate):
            return self.simulator.outputs
        values = self.template.clone()
        values[self.places] = p[0]
        # `at` has the checks of what comes back; it also turns what the function raises into a named error.
        self.simulator.at(self._conditions(x[:1]))(values)
        point = {name: values[i : i + 1] for i, name in enumerate(self.simulator.names)}
        with torch.no_grad():
            result = self.simulator.function(self._conditions(x[:1]), point)
        return tuple(result) if isinstance(result, dict) else None


def _project(values: Tensor, outer: polychaos.Rule, inner: polychaos.Rule, order: int) -> Tensor:
    """Coefficients ``(outputs, K)`` of values ``(outputs, C * P)`` on the product of two rules (Eq. 43)."""
    indices = polychaos.multi_indices(outer.dim + inner.dim, order)
    left = polychaos.evaluate(polychaos.LEGENDRE, indices[:, : outer.dim], outer.nodes) * outer.weights[:, None]
    right = polychaos.evaluate(polychaos.LEGENDRE, indices[:, outer.dim :], inner.nodes) * inner.weights[:, None]
    grid = values.reshape(len(values), outer.num, inner.num)
    # One output at a time bounds memory to C x K.
    rows = [((table @ right) * left).sum(0) for table in grid]
    return torch.stack(rows) / polychaos.norms(polychaos.LEGENDRE, indices)


def _point_call(simulator: Any, names: tuple[str, ...] | None, parameters: Sequence[Parameter]) -> PointCall:
    labels = tuple(parameter.name for parameter in parameters)
    if not isinstance(simulator, ExternalSimulator):
        return PointCall(simulator, names, labels)
    held = {p.name: p.neutral for p in simulator.parameters if p.name not in labels and p.neutral is not None}
    return PointCall(simulator.external, names, labels, simulator.vectorized, tuple(held.items()))


def _choose_parameters(simulator: Any, parameters: Sequence[Parameter] | None) -> tuple[Parameter, ...]:
    if not callable(simulator) and not isinstance(simulator, Simulator):
        raise DomainError(f"Expected a simulator or a callable f(x, p). Got {type(simulator).__name__}.")
    if not isinstance(simulator, Simulator):
        if parameters is None:
            raise DomainError("Expected parameters= beside a function. Got none.")
        return check_parameters(parameters)
    chosen = simulator.parameters if parameters is None else check_parameters(parameters)
    labels = [parameter.name for parameter in chosen]
    unknown = [name for name in labels if name not in simulator.names]
    if unknown:
        raise DomainError(f"Expected parameters among {list(simulator.names)}. Got {unknown}.")
    open_ = [p.name for p in simulator.parameters if p.name not in labels and p.neutral is None]
    if open_:
        raise DomainError(
            f"Expected a neutral value for each parameter that is left out. Got none for {open_}. Add them to "
            "parameters=, or give them neutral=."
        )
    return tuple(chosen)


def _check_outputs(outputs: Sequence[str]) -> tuple[str, ...]:
    names = () if isinstance(outputs, str) or not isinstance(outputs, Iterable) else tuple(outputs)
    if not names or not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
        raise DomainError(f"Expected outputs as a list of different names. Got {outputs!r} (one too, in brackets).")
    return names


def _check_nodes(nodes: int | Sequence[int] | None, order: int, dim: int) -> list[int]:
    if nodes is None:
        return [order + 1] * dim
    counts = list(nodes) if isinstance(nodes, Sequence) else [nodes] * dim
    if len(counts) != dim:
        raise DomainError(f"Expected nodes as one number or {dim}, one per condition and parameter. Got {nodes}.")
    advice = f"fewer cannot tell polynomials of order {order} apart"
    counts = [whole("nodes", count, order + 1, advice=advice) for count in counts]
    limit_rows("the design", math.prod(counts), advice="use fewer nodes or dimensions")
    return counts
