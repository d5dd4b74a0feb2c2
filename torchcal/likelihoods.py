r"""Likelihoods of α: log-densities on tensors, all options of the paper's Table I and the additive Gaussian.

Moment likelihoods take ``(y, mean, sd)``, sample likelihoods ``(y, samples)``. Shapes: ``y`` is ``(n,)``, moments
are ``(*batch, n)``, samples ``(*batch, S, n)``; results are ``(*batch,)``. A known noise sd s of the recording is
used at once: Gaussian forms take σ² + s² for σ², and the ABC form asks σ to match only what the noise does not
explain of a residual.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchcal.checks import whole
from torchcal.errors import DegenerateLikelihoodError, DomainError, ShapeError

__all__ = [
    "ABC",
    "ABCMean",
    "Additive",
    "Full",
    "GaussianMarginal",
    "Likelihood",
    "Marginal",
    "abc_log_prob",
    "get",
    "rounding",
]

DEFAULT_TOLERANCE = 0.01
"""ε as a share of the sd of the data, where none is given: a visible but small part of what there is to fit."""

DRAWS = 256
"""Germ draws of the likelihoods that estimate densities from samples."""

SMOOTHING = 1e-3
"""δ as a share of ε. It rounds the kink of γ|μ − y| at a width far below the tolerance."""


def _positive(value: float | Tensor, name: str) -> None:
    if isinstance(value, float | int):  # the fast way: this is called at every step of a sampler
        good = math.isfinite(value) and value > 0 and not isinstance(value, bool)
    else:
        try:
            number = torch.as_tensor(value, dtype=torch.float64)
            if torch.as_tensor(value).dtype == torch.bool:
                raise TypeError(name)
        except (TypeError, ValueError, RuntimeError) as error:
            raise DomainError(f"Expected {name} as a positive number or a tensor of them. Got {value!r}.") from error
        good = bool((torch.isfinite(number) & (number > 0)).all())
    if not good:
        raise DomainError(f"Expected {name} > 0 and finite. Got {value!r}.")


def _number(value: float, name: str) -> None:
    if isinstance(value, str) or value is None:
        raise DomainError(f"Expected {name} as a positive number. Got {value!r}.")
    _positive(value, name)
    if not isinstance(value, float | int) and torch.as_tensor(value).ndim:
        shape = tuple(torch.as_tensor(value).shape)
        raise DomainError(f"Expected {name} as one number for all outputs. Got numbers of shape {shape}.")


def _check_shapes(y: Tensor, **values: Tensor | None) -> None:
    """Raise where the last dimension is not that of the data, which broadcasting would hide."""
    if not isinstance(y, Tensor) or y.ndim != 1:
        got = tuple(y.shape) if isinstance(y, Tensor) else type(y).__name__
        raise ShapeError(f"Expected y as a tensor of shape (n,). Got {got}.")
    for name, value in values.items():
        if value is not None and value.shape[-1:] != y.shape:
            raise ShapeError(f"Expected {name} of shape (..., {len(y)}), as y. Got {tuple(value.shape)}.")


def _per_output(number: float | Tensor, y: Tensor, name: str) -> Tensor:
    value = torch.as_tensor(number, dtype=y.dtype, device=y.device)
    if value.ndim and value.shape != y.shape:
        raise ShapeError(f"Expected {name} as a number or of shape {tuple(y.shape)}. Got {tuple(value.shape)}.")
    return value


def rounding(epsilon: Any, gamma: Any) -> Any:
    """δ of `abc_log_prob`, in the unit of the tolerance ε: neither it nor γδ is more than a thousandth of that."""
    return SMOOTHING * epsilon / max(1.0, float(gamma))


def abc_log_prob(
    y: Tensor,
    mean: Tensor,
    sd: Tensor,
    *,
    epsilon: float | Tensor,
    gamma: float = 1.0,
    noise: Tensor | None = None,
) -> Tensor:
    r"""Log of the moment-matching ABC likelihood, up to a constant (Eq. 24).

    .. math:: -\frac{1}{2\varepsilon^2} \sum_i (\mu_i - y_i)^2 + (\sigma_i - \gamma |\mu_i - y_i|)^2

    With a noise sd s the wanted spread is :math:`\gamma \sqrt{\max((\mu_i - y_i)^2 - s_i^2, 0) + \delta^2}`
    with :math:`\delta = 10^{-3} \varepsilon / \max(1, \gamma)`.

    Args:
        y: Recorded outputs, shape ``(n,)``, in the recording's unit.
        mean: Push-forward mean, shape ``(*batch, n)``, same unit.
        sd: Push-forward standard deviation, shape ``(*batch, n)``, same unit.
        epsilon: Tolerance, same unit, > 0; a number or ``(n,)``.
        gamma: Wanted ratio of the model-error sd to the residual, dimensionless, > 0.
        noise: Sd of the measurement noise, ``(n,)``, same unit.

    Returns:
        Shape ``(*batch,)``, dimensionless.

    Raises:
        DomainError: If ``epsilon`` or ``gamma`` is not positive.
        ShapeError: If the shapes do not agree.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eq. 24.

    >>> one = torch.ones(1, dtype=torch.float64)
    >>> print(f"{float(abc_log_prob(0 * one, one, one, epsilon=0.5)):.3f}")
    -2.000
    """
    _positive(epsilon, "epsilon")
    _number(gamma, "gamma")
    _check_shapes(y, mean=mean, sd=sd, noise=noise)
    epsilon = _per_output(epsilon, y, "epsilon")
    squared = (mean - y).square()
    unexplained = squared if noise is None else (squared - noise.square()).clamp_min(0)
    wanted = gamma * (unexplained + rounding(epsilon, gamma) ** 2).sqrt()
    return -0.5 * ((squared + (sd - wanted).square()) / epsilon.square()).sum(-1)


@dataclass(frozen=True)
class Likelihood:
    """Base class. ``needs`` says what ``log_prob`` is given: ``"moments"``, ``"mean"`` or ``"samples"``."""

    needs = "moments"
    name = "likelihood"
    log_prob: ClassVar[Callable[..., Tensor]]

    def resolve(
        self, y: Tensor, spread: Tensor, num_embedded: int, noise: Tensor | None = None
    ) -> "Likelihood":
        """The likelihood with its defaults filled in from the data.

        Args:
            y: Recorded outputs, ``(n,)``.
            spread: Sd of each output over the recording, ``(n,)``.
            num_embedded: Number of uncertain parameters, d.
            noise: Sd of the measurement noise, ``(n,)``, or None.
        """
        return self


@dataclass(frozen=True)
class ABC(Likelihood):
    """Match the mean to the data and the sd to γ times the residual (Eq. 24).

    Args:
        epsilon: Tolerance ε in the outputs' unit, a number or ``(n,)``; None for 1 % of the data's sd, and with a known
            noise sd s for √((1 % of the data's sd)² + s²). A tolerance far below the noise makes α look better known
            than the data allow.
        gamma: Wanted ratio γ of sd to residual.

    Raises:
        DomainError: If ε or γ is not positive.
    """

    epsilon: float | Tensor | None = None
    gamma: float = 1.0

    name = "abc"

    def __post_init__(self) -> None:
        if self.epsilon is not None:
            _positive(self.epsilon, "epsilon")
        _number(self.gamma, "gamma")

    def resolve(
        self, y: Tensor, spread: Tensor, num_embedded: int, noise: Tensor | None = None
    ) -> "ABC":
        """Fill in the default tolerance."""
        if self.epsilon is not None:
            return self
        tolerance = DEFAULT_TOLERANCE * spread
        # A mean cannot be asked to match data more closely than they are known.
        return replace(self, epsilon=tolerance if noise is None else (tolerance.square() + noise.square()).sqrt())

    def log_prob(self, y: Tensor, mean: Tensor, sd: Tensor, noise: Tensor | None = None) -> Tensor:
        """Log-likelihood up to a constant, ``(*batch,)``."""
        epsilon = _default_epsilon(y) if self.epsilon is None else self.epsilon
        return abc_log_prob(y, mean, sd, epsilon=epsilon, gamma=self.gamma, noise=noise)


@dataclass(frozen=True)
class ABCMean(Likelihood):
    """Match the mean to the data alone (Eq. 20). It says nothing about non-leading coefficients.

    Args:
        epsilon: Tolerance ε in the outputs' unit, a number or ``(n,)``; None for 1 % of the data's sd.
    """

    epsilon: float | Tensor | None = None

    needs = "mean"
    name = "abc_mean"

    def __post_init__(self) -> None:
        if self.epsilon is not None:
            _positive(self.epsilon, "epsilon")

    def resolve(
        self, y: Tensor, spread: Tensor, num_embedded: int, noise: Tensor | None = None
    ) -> "ABCMean":
        """Fill in the default tolerance."""
        return self if self.epsilon is not None else replace(self, epsilon=DEFAULT_TOLERANCE * spread)

    def log_prob(
        self, y: Tensor, mean: Tensor, sd: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Log-likelihood up to a constant, ``(*batch,)``. Noise adds its variance to ε²."""
        epsilon = _default_epsilon(y) if self.epsilon is None else self.epsilon
        epsilon = _per_output(epsilon, y, "epsilon")
        _check_shapes(y, mean=mean, noise=noise)
        variance = epsilon.square() if noise is None else epsilon.square() + noise.square()
        return -0.5 * ((mean - y).square() / variance).sum(-1)


@dataclass(frozen=True)
class GaussianMarginal(Likelihood):
    """Product of normal marginals with the output's own mean and sd (Eq. 17).

    Without noise it is unbounded: wherever one σ_i vanishes it has a spurious maximum (Fig. 6).
    """

    name = "gaussian_marginal"

    def log_prob(self, y: Tensor, mean: Tensor, sd: Tensor, noise: Tensor | None = None) -> Tensor:
        """Normalised log-likelihood, ``(*batch,)``."""
        _check_shapes(y, mean=mean, sd=sd, noise=noise)
        variance = sd.square() if noise is None else sd.square() + noise.square()
        return _normal_log_prob(y, mean, variance)


@dataclass(frozen=True)
class Additive(Likelihood):
    """Independent normal discrepancies of one sd σ, the conventional calibration (Eq. 4)."""

    needs = "mean"
    name = "additive"

    def log_prob(
        self, y: Tensor, mean: Tensor, log_sigma: Tensor, noise: Tensor | None = None
    ) -> Tensor:
        """Normalised log-likelihood, ``(*batch,)``; ``log_sigma`` is ``(*batch,)``, or ``(*batch, n)``."""
        _check_shapes(y, mean=mean, noise=noise)
        if log_sigma.shape != mean.shape:
            log_sigma = log_sigma.unsqueeze(-1).expand(mean.shape)
        variance = (2 * log_sigma).exp()
        return _normal_log_prob(y, mean, variance if noise is None else variance + noise.square())


@dataclass(frozen=True)
class Marginal(Likelihood):
    """Product of marginal densities, each by a kernel density estimate of the output's samples (Eq. 16).

    Args:
        num_samples: Number S of germ draws, the same for every α.
        bandwidth: Kernel sd relative to the samples' sd; None for Silverman's rule, (4 / 3S)^(1/5).
        floor: Smallest kernel sd, in the outputs' unit; None for 1e-6 of the data's sd. It cuts off the spikes.
    """

    num_samples: int = DRAWS
    bandwidth: float | None = None
    floor: float | Tensor | None = None

    needs = "samples"
    name = "marginal"

    def __post_init__(self) -> None:
        object.__setattr__(self, "num_samples", whole("num_samples", self.num_samples, 2))
        _check_kernels(self.bandwidth, self.floor)

    def resolve(
        self, y: Tensor, spread: Tensor, num_embedded: int, noise: Tensor | None = None
    ) -> "Marginal":
        """Fill in the smallest kernel."""
        return self if self.floor is not None else replace(self, floor=_KERNEL_FLOOR * spread)

    def log_prob(self, y: Tensor, samples: Tensor, noise: Tensor | None = None) -> Tensor:
        """Log-likelihood, ``(*batch,)``, from samples ``(*batch, S, n)``."""
        _check_shapes(y, samples=samples, noise=noise)
        count = samples.shape[-2]
        relative = self.bandwidth or (4 / (3 * count)) ** 0.2
        variance = samples.var(-2, keepdim=True) * relative**2 + _floor_variance(self.floor, y)
        if noise is not None:
            variance = variance + noise.square()
        kernels = -0.5 * ((y - samples).square() / variance + (2 * math.pi * variance).log())
        return (kernels.logsumexp(-2) - math.log(count)).sum(-1)


@dataclass(frozen=True)
class Full(Likelihood):
    r"""The joint density of all N outputs, by a kernel density estimate (Eq. 13).

    It exists only where N ≤ d. For N > d the outputs fill a d-dimensional surface in N dimensions, the data almost
    surely lie off it, and the likelihood vanishes for every α (Eqs. 14-15): for f = λx and two points there is a
    likelihood only if both lie on one line through the origin.

    Args:
        num_samples: Number S of germ draws, the same for every α.
        bandwidth: Kernel size relative to the samples' covariance; None for Silverman's rule,
            (4 / (S (N + 2)))^(1 / (N + 4)).
        floor: Smallest kernel sd, in the outputs' unit; None for 1e-6 of the data's sd.
    """

    num_samples: int = DRAWS
    bandwidth: float | None = None
    floor: float | Tensor | None = None

    needs = "samples"
    name = "full"

    def __post_init__(self) -> None:
        object.__setattr__(self, "num_samples", whole("num_samples", self.num_samples, 2))
        _check_kernels(self.bandwidth, self.floor)

    def resolve(
        self, y: Tensor, spread: Tensor, num_embedded: int, noise: Tensor | None = None
    ) -> "Full":
        """Raise where the likelihood is degenerate.

        Raises:
            DegenerateLikelihoodError: If there are more data than uncertain parameters.
        """
        if len(y) > num_embedded:
            raise DegenerateLikelihoodError(
                f"Expected no more data than uncertain parameters for the full likelihood. Got N = {len(y)} > "
                f"d = {num_embedded}: the N outputs lie on a {num_embedded}-dimensional surface that misses the "
                "data, and the likelihood is zero for every alpha (Eqs. 14-15). Use ABC(), or a marginal "
                "likelihood."
            )
        return self if self.floor is not None else replace(self, floor=_KERNEL_FLOOR * spread)

    def log_prob(self, y: Tensor, samples: Tensor, noise: Tensor | None = None) -> Tensor:
        """Log-likelihood, ``(*batch,)``, from samples ``(*batch, S, n)``."""
        _check_shapes(y, samples=samples, noise=noise)
        count, n = samples.shape[-2:]
        relative = self.bandwidth or (4 / (count * (n + 2))) ** (1 / (n + 4))
        offset = samples - samples.mean(-2, keepdim=True)
        covariance = offset.transpose(-1, -2) @ offset / (count - 1) * relative**2
        extra = _floor_variance(self.floor, y).expand(n)
        if noise is not None:
            extra = extra + noise.square()
        # A floor relative to the largest variance keeps the factor finite where outputs move as one.
        floor = 1e-10 * covariance.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True)
        # Samples that overflowed have no covariance: that trial is impossible, and the others of its batch go on.
        factor, info = torch.linalg.cholesky_ex(covariance + torch.diag_embed(extra + floor))
        white = torch.linalg.solve_triangular(factor, (y - samples).transpose(-1, -2), upper=False)
        log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        kernels = -0.5 * white.square().sum(-2)
        value = kernels.logsumexp(-1) - math.log(count) - log_det - 0.5 * n * math.log(2 * math.pi)
        return torch.where((info == 0) & torch.isfinite(value), value, -torch.inf)


_KERNEL_FLOOR = 1e-6
"""Smallest kernel sd as a share of the data's sd, where none is given."""


def _floor_variance(floor: float | Tensor | None, y: Tensor) -> Tensor:
    if floor is None:
        spread = y.std() if len(y) > 1 else y.abs().max()
        floor = _KERNEL_FLOOR * torch.where(spread > 0, spread, torch.ones_like(spread))
    return _per_output(floor, y, "floor").square()


_BY_NAME: dict[str, type[Likelihood]] = {
    "full": Full,
    "marginal": Marginal,
    "marg": Marginal,
    "gaussian_marginal": GaussianMarginal,
    "gausmarg": GaussianMarginal,
    "abc_mean": ABCMean,
    "abcm": ABCMean,
    "abc": ABC,
    "additive": Additive,
    "classical": Additive,
}


def get(likelihood: str | Likelihood) -> Likelihood:
    """A likelihood by its name, the paper's or the short one of existing tools.

    >>> get("gausmarg")
    GaussianMarginal()
    """
    if isinstance(likelihood, Likelihood):
        return likelihood
    if isinstance(likelihood, str) and likelihood in _BY_NAME:
        return _BY_NAME[likelihood]()
    instead = f" (write {likelihood.__name__}(), with brackets)" if isinstance(likelihood, type) else ""
    raise DomainError(
        f"Expected a torchcal.likelihoods object or one of {sorted(_BY_NAME)}. Got {likelihood!r}{instead}."
    )


def _normal_log_prob(y: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    return -0.5 * ((mean - y).square() / variance + (2 * math.pi * variance).log()).sum(-1)


def _default_epsilon(y: Tensor) -> float:
    _check_shapes(y)
    if not bool(torch.isfinite(y).all()):
        raise DomainError(
            "Expected data that are finite. Got NaN or infinity in y. Leave missing samples out, of y and of the "
            "moments (recording.observed says which are there)."
        )
    spread = float(y.std()) if len(y) > 1 else 0.0
    if not spread > 0:
        raise DomainError("Expected data that vary, for a default tolerance. Got constant y. Pass epsilon=.")
    return DEFAULT_TOLERANCE * spread


def _check_kernels(bandwidth: float | None, floor: float | Tensor | None) -> None:
    if bandwidth is not None:
        _number(bandwidth, "bandwidth")
    if floor is not None:
        _positive(floor, "floor")
