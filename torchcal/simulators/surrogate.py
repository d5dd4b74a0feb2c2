r"""Polynomial surrogates of expensive simulators.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 41-43.
"""

import dataclasses
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.checks import real_number, whole
from torchcal.errors import DomainError, ExtrapolationWarning, ShapeError, SimulatorError, warn
from torchcal.simulators.design import read_npz, write_npz
from torchcal.simulators.held_out import NUMBERS, HeldOutError
from torchcal.simulators.parameter import Parameter, Scaling
from torchcal.simulators.static import Conditions, Simulator, check_values

__all__ = ["Box", "PolynomialSurrogate", "check_box", "warned_once"]

_SAID: ContextVar[set[str] | None] = ContextVar("_SAID", default=None)
"""Warnings already given, where each is to be given once."""

_EDGE = 1e-9
"""How far past its box, in half-widths, a point still counts as on the edge: rounding gives 1e-16."""

Box = Mapping[str, tuple[float, float]] | tuple[float, float]


@contextmanager
def warned_once() -> Iterator[None]:
    """Within, conditions outside a box are warned of once, however often the surrogate is asked there."""
    token = _SAID.set(set() if _SAID.get() is None else _SAID.get())
    try:
        yield
    finally:
        _SAID.reset(token)


class PolynomialSurrogate(Simulator):
    r"""A polynomial in conditions and parameters together that stands in for a simulator.

    .. math:: f(x; \lambda) \approx \sum_{|k| \le p} s_k \prod_j L_{k_j}(\eta_j)

    with Legendre polynomials :math:`L` and :math:`\eta \in [-1, 1]` the conditions and parameters scaled by the box;
    a parameter with ``transform="log"`` is scaled by its logarithm. `build_surrogate` makes one.

    Args:
        coefficients: s, ``(outputs, K)``, for the multi-indices of total degree `order` over conditions and
            parameters, in `polychaos.multi_indices` order.
        conditions: ``{name: (low, high)}``, or one pair where x is a plain tensor.
        parameters: With both bounds.
        order: Total degree p.
        outputs: Names of the outputs; None for one without a name.
        error: Measured error on held-out points.
        nodes: Gauss points per dimension that it was built with; None where it was not on a grid.

    Attributes:
        degree: The order: it is a polynomial of that degree in the parameters, so propagation is exact.
        error: As above; None where it was not measured.

    Raises:
        DomainError: If a bound is missing or reversed, or a name occurs twice.
        ShapeError: If the coefficients do not fit.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eq. 41.

    >>> s = PolynomialSurrogate(torch.tensor([[1.0, 2.0, 0.5]]), conditions=(0.0, 2.0), order=1,
    ...                         parameters=[Parameter("a", low=-1.0, high=1.0)])     # 1 + 2 (x - 1) + a / 2
    >>> s.at(torch.tensor([0.0, 2.0]))(torch.tensor([1.0]))
    tensor([-0.5000,  3.5000])
    """

    def __init__(
        self,
        coefficients: Tensor,
        *,
        conditions: Box,
        parameters: Sequence[Parameter],
        order: int,
        outputs: Sequence[str] | None = None,
        error: HeldOutError | None = None,
        nodes: int | Sequence[int] | None = None,
    ) -> None:
        super().__init__(self._elementwise, parameters, degree=order)
        self.condition_names, self.condition_bounds = check_box(conditions, self.parameters)
        self.order = whole("order", order, 0)
        self.outputs = None if outputs is None else tuple(outputs)
        self.error = error
        self.nodes = nodes if nodes is None or isinstance(nodes, int) else tuple(nodes)
        self.scaling = Scaling.from_parameters(self.parameters)
        self.indices = polychaos.multi_indices(len(self.condition_bounds) + len(self.parameters), order)
        self.coefficients = coefficients.detach().to("cpu", torch.float64)
        shape = (1 if self.outputs is None else len(self.outputs), len(self.indices))
        if self.coefficients.shape != shape or not bool(torch.isfinite(self.coefficients).all()):
            raise ShapeError(
                f"Expected finite coefficients of shape {shape} (outputs, terms). Got {tuple(coefficients.shape)}."
            )

    @property
    def conditions(self) -> dict[str, tuple[float, float]] | tuple[float, float]:
        """The box of the conditions."""
        pairs = [(float(low), float(high)) for low, high in self.condition_bounds]
        if self.condition_names is None:
            return pairs[0]
        return dict(zip(self.condition_names, pairs, strict=True))

    def __repr__(self) -> str:
        error = "" if self.error is None else f"; {self.error}"
        names = ["x"] if self.condition_names is None else list(self.condition_names)
        return (
            f"PolynomialSurrogate of order {self.order} over conditions {names} and parameters "
            f"{list(self.names)}, {len(self.indices)} terms{error}"
        )

    # --- evaluation --------------------------------------------------------------------------------------

    def at(self, x: Conditions, outputs: Sequence[str] | None = None) -> Callable[[Tensor], Tensor]:
        r"""The surrogate at fixed conditions: one matrix product for any number of parameter values.

        .. math:: f_i(\lambda) = \sum_m B_{im} L_m(\eta_\lambda), \qquad
            B_{im} = \sum_{k: k_\lambda = m} s_k L_{k_x}(\eta_x(x_i))

        Args:
            x: Conditions, ``(n,)`` or a dict of them.
            outputs: Names and order of the outputs wanted, where it has several.

        Returns:
            A function from values ``(*batch, d)``, physical units, to outputs ``(*batch, n)``, or
            ``(*batch, n_outputs * n)`` with one output after another.

        Warns:
            ExtrapolationWarning: If a condition is outside the box that the surrogate was built for.
        """
        eta = self._scaled_conditions(x)
        self._warn_outside(eta)
        rows = self._rows(outputs)
        count = eta.shape[1]
        terms = polychaos.multi_indices(len(self.parameters), self.order)
        place = {tuple(term): i for i, term in enumerate(terms.tolist())}
        column = torch.tensor([place[tuple(term)] for term in self.indices[:, count:].tolist()])
        basis = polychaos.evaluate(polychaos.LEGENDRE, self.indices[:, :count], eta)  # (n, K)
        weighted = (self.coefficients[rows, None, :] * basis).reshape(-1, len(self.indices))
        table = torch.zeros(len(weighted), len(terms), dtype=torch.float64).index_add(1, column, weighted)
        cast: dict[tuple[torch.dtype, torch.device], Tensor] = {}

        def evaluate(values: Tensor) -> Tensor:
            check_values(values, self.names)
            key = (values.dtype, values.device)
            if key not in cast:
                cast[key] = table.T.to(values)
            psi = polychaos.evaluate(polychaos.LEGENDRE, terms, self.scaling.scaled(values))
            return psi @ cast[key]

        return evaluate

    def leaves_box(self, values: Tensor) -> Tensor:
        """Which parameter values ``(*batch, d)``, physical units, lie outside the box: bool ``(*batch,)``."""
        check_values(values, self.names)
        eta = self.scaling.scaled(values.detach().to(torch.float64))
        return ~(eta.abs() <= 1 + _EDGE).all(-1)

    def _elementwise(self, x: Conditions, p: Mapping[str, Tensor]) -> Tensor | dict[str, Tensor]:
        """``function(x, p)`` with ``p[name]`` of ``(*batch, 1)``, or ``(*batch, n)`` where a term shifts it."""
        values = torch.stack(torch.broadcast_tensors(*(p[name] for name in self.names)), dim=-1)
        inner = self.scaling.scaled(values)
        outer = self._scaled_conditions(x).to(inner)
        shape = torch.broadcast_shapes(inner.shape[:-1], outer.shape[:1])
        eta = torch.cat([outer.expand(*shape, -1), inner.expand(*shape, -1)], dim=-1)
        psi = polychaos.evaluate(polychaos.LEGENDRE, self.indices, eta)
        result = psi @ self.coefficients.T.to(psi)
        if self.outputs is None:
            return result[..., 0]
        return {name: result[..., i] for i, name in enumerate(self.outputs)}

    def _scaled_conditions(self, x: Conditions) -> Tensor:
        """η of the conditions, ``(n, c)``, float64 on the CPU."""
        names = self.condition_names
        if isinstance(x, Mapping):
            missing = [name for name in names or () if name not in x]
            if names is None or missing:
                wanted = "a plain tensor" if names is None else f"conditions {list(names)}"
                raise ShapeError(f"Expected {wanted}. Got a dict of {list(x)}.")
            columns = [x[name] for name in names]
        elif names is not None and len(names) > 1:
            raise ShapeError(f"Expected a dict of conditions {list(names)}. Got a plain tensor.")
        else:
            columns = [x]
        tensors = [torch.as_tensor(column).detach().to("cpu", torch.float64) for column in columns]
        if any(tensor.ndim != 1 or len(tensor) != len(tensors[0]) for tensor in tensors):
            shapes = [tuple(tensor.shape) for tensor in tensors]
            raise ShapeError(f"Expected conditions of shape (n,), all of one length. Got {shapes}.")
        low, high = self.condition_bounds.T
        return (2 * torch.stack(tensors, dim=-1) - low - high) / (high - low)

    def _warn_outside(self, eta: Tensor) -> None:
        far = (eta.abs() - 1).amax(0)
        for i, name in enumerate(self.condition_names or ("x",)):
            if float(far[i]) > _EDGE:
                low, high = self.condition_bounds[i].tolist()
                value = 0.5 * (low + high) + 0.5 * (high - low) * eta[:, i]
                outside = int((eta[:, i].abs() > 1 + _EDGE).sum())
                message = (
                    f"{outside} of {len(eta)} conditions are outside the surrogate's box: {name} from "
                    f"{float(value.min()):.6g} to {float(value.max()):.6g}, built for {low:.6g} to {high:.6g}. "
                    f"A polynomial of order {self.order} is not to be trusted there; build it for a wider box."
                )
                said = _SAID.get()
                if said is not None:
                    if message in said:
                        continue
                    said.add(message)
                warn(message, ExtrapolationWarning)

    def _rows(self, outputs: Sequence[str] | None) -> list[int]:
        if self.outputs is None:
            return [0]
        wanted = self.outputs if outputs is None else tuple(outputs)
        missing = [name for name in wanted if name not in self.outputs]
        if missing:
            raise SimulatorError(
                f"Expected outputs among {list(self.outputs)}. Got {missing}. Use the same names in the recording "
                "and in the surrogate."
            )
        return [self.outputs.index(name) for name in wanted]

    # --- files -------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz file without pickle, whole or not at all. The name is used as it is given."""
        header = {
            "conditions": self.conditions,
            "parameters": [dataclasses.asdict(parameter) for parameter in self.parameters],
            "order": self.order,
            "outputs": self.outputs,
            "nodes": self.nodes,
            "error": None,
        }
        numbers = np.zeros((4, 0))
        if self.error is not None:
            header["error"] = {k: getattr(self.error, k) for k in ("num", "outputs", "worst")}
            numbers = torch.stack([getattr(self.error, k) for k in NUMBERS]).numpy()
        write_npz(path, "a surrogate", header, coefficients=self.coefficients.numpy(), error=numbers)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "PolynomialSurrogate":
        """Read what `save` wrote.

        Raises:
            DomainError: If the file holds something else.
        """
        header, arrays = read_npz(path, "a surrogate", ("coefficients", "error"))
        conditions = header["conditions"]
        error = None
        if header["error"] is not None:
            about = header["error"]
            numbers = dict(zip(NUMBERS, torch.from_numpy(arrays["error"]), strict=True))
            error = HeldOutError(about["num"], tuple(about["outputs"]), worst=tuple(about["worst"]), **numbers)
        return cls(
            torch.from_numpy(arrays["coefficients"]),
            conditions=tuple(conditions) if isinstance(conditions, list) else conditions,
            parameters=[Parameter(**{**fields, "per_run": False}) for fields in header["parameters"]],
            order=header["order"],
            outputs=header["outputs"],
            error=error,
            nodes=header["nodes"],
        )


def check_box(conditions: Box, parameters: Sequence[Parameter]) -> tuple[tuple[str, ...] | None, Tensor]:
    """Names (None for a plain x) and bounds ``(c, 2)`` of the conditions; the parameters must have bounds too."""
    if isinstance(conditions, Mapping):
        names, pairs = tuple(conditions), list(conditions.values())
    else:
        names, pairs = None, [conditions]
    if not pairs:
        raise DomainError("Expected at least one condition. Got none. Pass conditions={name: (low, high)}.")
    for name, pair in zip(names or ("x",), pairs, strict=True):
        try:
            low, high = (real_number(end) for end in pair)
        except (TypeError, ValueError):
            low = high = math.nan
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise DomainError(f"Expected finite bounds low < high for condition {name!r}. Got {pair!r}.")
    free = [p.name for p in parameters if p.low is None or p.high is None]
    if free:
        raise DomainError(
            f"Expected both bounds on every parameter of a surrogate. Got none or one for {free}. Give low= and "
            "high=: they say where the polynomial has to hold."
        )
    twice = sorted(set(names or ()) & {parameter.name for parameter in parameters})
    if twice:
        raise DomainError(f"Expected different names for conditions and parameters. Got {twice} in both.")
    return names, torch.tensor([[float(end) for end in pair] for pair in pairs], dtype=torch.float64)
