r"""Prior distributions on α that Pyro and NUTS accept, and the coordinates in which they are sampled.

Every prior is made from a propagation: ``Flat(propagate)``. Physical bounds of a parameter bound its leading
coefficient, which is E[λ] in scaled coordinates (the median for a parameter on a logarithmic scale); a smooth
bijection keeps samplers inside. Draws from an improper prior are starting points.
"""

import copy
import math
from typing import Any, ClassVar

import pyro.distributions
import torch
from torch import Tensor
from torch.distributions import biject_to, constraints, transform_to
from torch.distributions.transforms import Transform

from torchcal.checks import positive
from torchcal.errors import DomainError, ShapeError
from torchcal.propagation import NISP

_Shape = torch.Size | list[int] | tuple[int, ...]

__all__ = ["Bounds", "CoefficientPrior", "Flat", "Normal", "Uniform"]


class Bounds(Transform):
    r"""Real vectors to vectors within bounds, coordinate by coordinate, then optionally after an affine map.

    Two bounds: :math:`l + (h - l)\,\mathrm{sigmoid}(u)`; one: :math:`l + \mathrm{softplus}(u)`, which is the
    identity far from the bound; none: u itself. With a whitening, :math:`u = m + L z` first.

    Args:
        low: Lower bounds, ``(P,)``, −inf where there is none.
        high: Upper bounds, ``(P,)``, +inf where there is none.
        loc: m, ``(P,)``.
        scale_tril: L, lower triangular with a positive diagonal, ``(P, P)``.
    """

    domain = constraints.real_vector
    codomain: constraints.Constraint
    bijective = True

    def __init__(
        self, low: Tensor, high: Tensor, loc: Tensor | None = None, scale_tril: Tensor | None = None
    ) -> None:
        super().__init__(cache_size=0)
        self.codomain = _Within(self)
        self.low, self.high = low, high
        self.loc, self.scale_tril = loc, scale_tril
        has_low, has_high = torch.isfinite(low), torch.isfinite(high)
        zero = torch.zeros_like(low)
        self._low, self._high = torch.where(has_low, low, zero), torch.where(has_high, high, zero)
        self._both, self._only_low, self._only_high = has_low & has_high, has_low & ~has_high, has_high & ~has_low
        self._any = tuple(bool(case.any()) for case in (self._both, self._only_low, self._only_high))
        self.free = not any(self._any)
        # The log of the slope is c + a u - b softplus(u), with b the number of bounds.
        self._log_width = torch.where(self._both, self._high - self._low, zero + 1).log()
        self._along, self._softened = has_low.to(low), has_low.to(low) + has_high.to(low)

    def unwhiten(self, z: Tensor) -> Tensor:
        """u of z."""
        if self.loc is None or self.scale_tril is None:
            return z
        return self.loc.to(z) + z @ self.scale_tril.to(z).transpose(-1, -2)

    def bound(self, u: Tensor) -> Tensor:
        """α of u."""
        both, only_low, only_high = self._any
        value = u
        if both:
            low, high = self._low.to(u), self._high.to(u)
            value = torch.where(self._both.to(u.device), low + (high - low) * u.sigmoid(), value)
        if only_low:
            value = torch.where(self._only_low.to(u.device), self._low.to(u) + _softplus(u), value)
        if only_high:
            value = torch.where(self._only_high.to(u.device), self._high.to(u) - _softplus(-u), value)
        return value

    def unbound(self, alpha: Tensor) -> Tensor:
        """u of α; a value on a bound is taken a little inside."""
        if self.free:
            return alpha
        low, high = self._low.to(alpha), self._high.to(alpha)
        both, only_low, only_high = (
            case.to(alpha.device) for case in (self._both, self._only_low, self._only_high)
        )
        inside = max(1e-9, torch.finfo(alpha.dtype).eps)
        share = ((alpha - low) / torch.where(both, high - low, torch.ones_like(low))).clamp(inside, 1 - inside)
        value = torch.where(both, share.logit(), alpha)
        value = torch.where(only_low, _inverse_softplus((alpha - low).clamp_min(1e-9)), value)
        return torch.where(only_high, -_inverse_softplus((high - alpha).clamp_min(1e-9)), value)

    def log_slope(self, u: Tensor) -> Tensor:
        """Σ log ``|dα/du|``, ``(*batch,)``."""
        if self.free:
            return torch.zeros_like(u[..., 0])
        softened = _softplus(u) * self._softened.to(u)
        return (self._log_width.to(u) + self._along.to(u) * u - softened).sum(-1)

    def _call(self, x: Tensor) -> Tensor:
        return self.bound(self.unwhiten(x))

    def _inverse(self, y: Tensor) -> Tensor:
        u = self.unbound(y)
        if self.loc is None or self.scale_tril is None:
            return u
        offset = (u - self.loc.to(u)).unsqueeze(-1)
        return torch.linalg.solve_triangular(self.scale_tril.to(u), offset, upper=False).squeeze(-1)

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        """log ``|dα/dz|``, ``(*batch,)``."""
        value = self.log_slope(self.unwhiten(x))
        if self.scale_tril is not None:
            value = value + self.scale_tril.diagonal().log().sum().to(x)
        return value


def _softplus(value: Tensor) -> Tensor:
    return torch.nn.functional.softplus(value, threshold=40.0)  # past which it is the identity to the last bit


def _inverse_softplus(value: Tensor) -> Tensor:
    return value + (-(-value).expm1()).log()


class _Within(constraints.Constraint):
    """Vectors within the bounds of a `Bounds` transform, which is also how they are reached."""

    is_discrete = False
    event_dim = 1

    def __init__(self, transform: Bounds) -> None:
        self.transform = transform

    def check(self, value: Tensor) -> Tensor:
        low, high = self.transform.low.to(value), self.transform.high.to(value)
        return ((value >= low) & (value <= high)).all(-1)


@biject_to.register(_Within)
@transform_to.register(_Within)
def _reach(constraint: _Within) -> Bounds:
    return constraint.transform


class CoefficientPrior(pyro.distributions.TorchDistribution):
    """Base class: a distribution of coefficient vectors α, ``(P,)``.

    Attributes:
        low: Lower bounds, ``(P,)``.
        high: Upper bounds, ``(P,)``.
        proper: Whether the prior integrates to one, so that it constrains every coefficient.
        symmetric: Whether reversing a germ leaves the density as it is.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}
    has_rsample = False
    proper = False
    symmetric = True

    def __init__(self, low: Tensor, high: Tensor, center: Tensor, spread: Tensor) -> None:
        self.low, self.high = low, high
        self._center, self._spread = center, spread
        self.transform = self._start_transform()
        super().__init__(torch.Size(), low.shape, validate_args=False)

    def _start_transform(self) -> Bounds:
        """Coordinates in which a sampler that knows nothing starts sensibly: spreads far smaller than ranges."""
        step = torch.where(self._spread < 1, 0.1, 1.0).to(self.low)
        return Bounds(self.low, self.high, torch.zeros_like(self.low), torch.diag(step))

    @property
    def support(self) -> constraints.Constraint:
        """Where the density is positive; also carries the sampler's coordinates."""
        return _Within(self.transform)

    def whitened(self, loc: Tensor, scale_tril: Tensor) -> "CoefficientPrior":
        """The same prior, sampled in coordinates z with u = loc + scale_tril z."""
        other = copy.copy(self)
        other.transform = Bounds(self.low, self.high, loc, scale_tril)
        return other

    def cast(self, dtype: torch.dtype) -> "CoefficientPrior":
        """The same prior in another dtype."""
        other = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(other, name, value.to(dtype))
        other.transform = other._start_transform()
        return other

    def expand(self, batch_shape: _Shape, _instance: Any = None) -> "CoefficientPrior":
        """The same prior over a batch."""
        other = copy.copy(self)
        other._batch_shape = torch.Size(batch_shape)
        return other

    def sample(self, sample_shape: _Shape = ()) -> Tensor:
        """Draws, or starting points where the prior is improper, ``(*sample_shape, P)``."""
        shape = self._extended_shape(torch.Size(sample_shape))
        both = torch.isfinite(self.low) & torch.isfinite(self.high)
        low = torch.where(torch.isfinite(self.low), self.low, torch.zeros_like(self.low))
        high = torch.where(torch.isfinite(self.high), self.high, torch.zeros_like(self.high))
        uniform = torch.rand(shape, dtype=low.dtype, device=low.device)
        normal = torch.randn(shape, dtype=low.dtype, device=low.device)
        value = self._center + self._spread * normal
        value = torch.where(torch.isfinite(self.low), low + (value - low).abs(), value)
        value = torch.where(torch.isfinite(self.high), high - (high - value).abs(), value)
        return torch.where(both, low + (0.05 + 0.9 * uniform) * (high - low), value)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density, ``(*batch,)``; zero inside and −inf outside where the prior is improper."""
        zero = torch.zeros_like(value[..., 0])
        return zero if self.transform.free else torch.where(self.support.check(value), zero, zero - math.inf)


def _layout(propagate: NISP) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bounds of the leading coefficients, and where starting points lie."""
    if not isinstance(propagate, NISP):
        raise DomainError(f"Expected a torchcal.NISP. Got {type(propagate).__name__}.")
    like = propagate.weights
    leading = propagate.pattern.leading
    low = torch.full((propagate.num_alpha,), -math.inf, dtype=torch.float64)
    high = -low
    low[leading], high[leading] = propagate.scaling.bounds(propagate.free)
    spread = torch.where(leading, 1.0, 0.3).to(torch.float64)
    center = torch.zeros_like(spread)
    return low.to(like), high.to(like), center.to(like), spread.to(like)


class Flat(CoefficientPrior):
    """Constant density on all α, within the physical bounds of E[λ] (Eq. 12). Improper, as spreads are not bounded."""

    def __init__(self, propagate: NISP) -> None:
        super().__init__(*_layout(propagate))


class Uniform(CoefficientPrior):
    """Constant density on a box, normalised.

    Args:
        propagate: The propagation whose α are meant.
        leading: Half-width for means of parameters without bounds, around 0, in scaled coordinates; with one bound
            the box begins there, and reaches as far beyond 0, or is twice as wide as this if it would be narrower.
        spread: Half-width for all other coefficients, around 0, in scaled coordinates.
    """

    proper = True

    def __init__(self, propagate: NISP, *, leading: float = 10.0, spread: float = 2.0) -> None:
        leading, spread = positive("leading", leading), positive("spread", spread)
        low, high, center, scale = _layout(propagate)
        width = torch.where(propagate.pattern.leading.to(low.device), leading, spread).to(low)
        low = torch.where(torch.isfinite(low), low, torch.minimum(-width, high - 2 * width))
        high = torch.where(torch.isfinite(high), high, torch.maximum(width, low + 2 * width))
        super().__init__(low, high, center, scale)

    def sample(self, sample_shape: _Shape = ()) -> Tensor:
        """Draws, ``(*sample_shape, P)``."""
        shape = self._extended_shape(torch.Size(sample_shape))
        uniform = torch.rand(shape, dtype=self.low.dtype, device=self.low.device)
        return self.low + uniform * (self.high - self.low)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density, ``(*batch,)``."""
        return super().log_prob(value) - (self.high - self.low).log().sum()


class Normal(CoefficientPrior):
    """Independent normal coefficients, in scaled coordinates, cut at the physical bounds of E[λ].

    Args:
        propagate: The propagation whose α are meant.
        loc: Means, a number or ``(P,)``.
        scale: Standard deviations, a number or ``(P,)``, > 0.
    """

    proper = True

    def __init__(self, propagate: NISP, *, loc: float | Tensor = 0.0, scale: float | Tensor = 1.0) -> None:
        low, high, _, _ = _layout(propagate)
        try:
            self.loc = torch.as_tensor(loc).to(low).expand(low.shape)
            self.scale = torch.as_tensor(scale).to(low).expand(low.shape)
        except RuntimeError as error:
            raise ShapeError(
                f"Expected loc and scale as numbers or of shape {tuple(low.shape)}. Got "
                f"{tuple(torch.as_tensor(loc).shape)} and {tuple(torch.as_tensor(scale).shape)}."
            ) from error
        except (TypeError, ValueError) as error:
            raise DomainError(f"Expected loc and scale as numbers or tensors. Got {loc!r} and {scale!r}.") from error
        if not bool(torch.isfinite(self.loc).all()):
            raise DomainError(f"Expected a finite loc. Got {loc!r}.")
        if not bool((torch.isfinite(self.scale) & (self.scale > 0)).all()):
            raise DomainError(f"Expected scale > 0 and finite. Got {scale!r}.")
        super().__init__(low, high, self.loc, self.scale)
        self.symmetric = bool((self.loc[~propagate.pattern.leading.to(low.device)] == 0).all())

    def sample(self, sample_shape: _Shape = ()) -> Tensor:
        """Draws, ``(*sample_shape, P)``."""
        shape = self._extended_shape(torch.Size(sample_shape))
        uniform = torch.rand(shape, dtype=torch.float64, device=self.low.device)
        ends = torch.stack([self.low, self.high])
        z = ((ends - self.loc) / self.scale).double()
        flip = z[0] > 0  # tails are resolved below zero alone; ndtr itself is 0 from -9 on
        low, high = torch.where(flip, -z.flip(0), z)
        below, above = (0.5 * torch.special.erfc(-end / math.sqrt(2)) for end in (low, high))
        z = torch.special.ndtri((below + uniform * (above - below)).clamp(1e-300, 1 - 1e-16))
        z = torch.where(flip, -z, z).to(self.low)
        return torch.maximum(torch.minimum(self.loc + self.scale * z, self.high), self.low)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density up to the constant of the cut, ``(*batch,)``."""
        z = (value - self.loc) / self.scale
        density = -0.5 * z.square() - self.scale.log() - 0.5 * math.log(2 * math.pi)
        return super().log_prob(value) + density.sum(-1)
