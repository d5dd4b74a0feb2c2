r"""Predictive moments and densities of the outputs and of λ, and scores of predictions.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 30-32, 44, A1-A2, Table AI.
"""

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from torchcal import polychaos
from torchcal.data.arrays import to_tensor, unit_of
from torchcal.errors import DomainError, ShapeError
from torchcal.propagation import NISP

__all__ = [
    "AdditivePrediction",
    "Moments",
    "Prediction",
    "Scores",
    "additive_prediction",
    "embedded_prediction",
    "kernel_density",
    "output_moments",
    "parameter_density",
    "scores",
]

#: Sd relative to its datum up to which it is zero but for rounding.
ROUNDING = 1e-13


def _ends(values: Tensor) -> str:
    """From where to where, in words."""
    low, high = (float(v) for v in values.aminmax()) if values.numel() else (math.nan, math.nan)
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


@dataclass(frozen=True, repr=False)
class Moments:
    """Mean and standard deviation of a predictive distribution, ``(n,)`` each, in the output's unit."""

    mean: Tensor
    sd: Tensor

    def __repr__(self) -> str:
        return f"{self.mean.numel()} outputs: mean {_ends(self.mean)}, sd {_ends(self.sd)}"


@dataclass(frozen=True, repr=False)
class Prediction:
    r"""Predictive moments of an embedded calibration (Table AI).

    For an embedded model the push-forward of the posterior and the posterior predictive are one thing.

    Attributes:
        x: The conditions.
        mean: Posterior predictive mean, ``(n,)``: E[μ(α)] (Eq. A1); the MAP predictive mean without draws.
        sd: Posterior predictive sd, ``(n,)``: :math:`\sqrt{E[\sigma(\alpha)^2] + V[\mu(\alpha)]}` (Eq. A2).
        sd_model_error: :math:`\sqrt{E[\sigma(\alpha)^2]}`, what the embedded model error contributes.
        sd_posterior: :math:`\sqrt{V[\mu(\alpha)]}`, what the uncertainty of α contributes; None without draws.
        map: MAP predictive moments (Eq. 30).
        posterior: Posterior predictive moments (Eq. 32); None without draws.
        mean_predictive: Moments at the posterior mean of α (Table AI); None without draws.
    """

    x: Any
    mean: Tensor
    sd: Tensor
    sd_model_error: Tensor
    sd_posterior: Tensor | None
    map: Moments
    posterior: Moments | None
    mean_predictive: Moments | None

    def __repr__(self) -> str:
        parts = [f"model error {_ends(self.sd_model_error)}"]
        if self.sd_posterior is not None:
            parts.append(f"posterior {_ends(self.sd_posterior)}")
        return f"prediction of {Moments(self.mean, self.sd)} ({', '.join(parts)})"


@dataclass(frozen=True, repr=False)
class AdditivePrediction:
    """Predictive moments of a conventional calibration, the two kinds kept apart.

    Attributes:
        x: The conditions.
        push_forward: Of f(x; λ) under the posterior of λ: what the calibrated model alone predicts.
        posterior: Posterior predictive: with the additive discrepancy's variance E[σ²] as well.
        map: f at the MAP λ, with the MAP σ as sd.
    """

    x: Any
    push_forward: Moments
    posterior: Moments
    map: Moments

    def __repr__(self) -> str:
        return f"prediction of {self.posterior}; the calibrated model alone: sd {_ends(self.push_forward.sd)}"


def embedded_prediction(propagate: NISP, alpha_map: Tensor, draws: Tensor | None) -> Prediction:
    """Predictive moments at a propagation's conditions.

    Args:
        propagate: The propagation.
        alpha_map: MAP α, ``(P,)``.
        draws: Posterior draws of α, ``(S, P)``, or None.
    """
    like = propagate.nodes
    with torch.no_grad():
        at_map = _moments(propagate, alpha_map.to(like))
        if draws is None:
            return Prediction(propagate.x, at_map.mean, at_map.sd, at_map.sd, None, at_map, None, None)
        mean, variance = output_moments(propagate, draws.to(like))
        posterior_mean = mean.mean(0)
        model_error = variance.mean(0)
        parameter = mean.var(0, unbiased=False)
        posterior = Moments(_result(posterior_mean), _result((model_error + parameter).sqrt()))
        return Prediction(
            x=propagate.x,
            mean=posterior.mean,
            sd=posterior.sd,
            sd_model_error=_result(model_error.sqrt()),
            sd_posterior=_result(parameter.sqrt()),
            map=at_map,
            posterior=posterior,
            mean_predictive=_moments(propagate, draws.mean(0).to(like)),
        )


def additive_prediction(
    propagate: NISP,
    map_point: Tensor,
    draws: Tensor | None,
    *,
    log_sigma_map: float,
    unit: Tensor | None = None,
) -> AdditivePrediction:
    """Predictive moments of an additive calibration at a propagation's conditions.

    Args:
        propagate: Zero-order propagation, for f itself.
        map_point: MAP λ̃, ``(d,)``.
        draws: Posterior draws of (λ̃, ln σ), ``(S, d + 1)``, or None for the MAP alone.
        log_sigma_map: MAP ln σ.
        unit: What σ is measured in at each output value, ``(n,)``; one by default.
    """
    like = propagate.nodes
    with torch.no_grad():
        center = _result(propagate.mean(map_point.to(like)))
        one = torch.ones_like(center) if unit is None else unit.to(center)
        at_map = Moments(center, math.exp(log_sigma_map) * one)
        if draws is None:
            return AdditivePrediction(propagate.x, Moments(center, 0 * center), at_map, at_map)
        outputs = propagate.mean(draws[:, :-1].to(like))
        mean, variance = outputs.mean(0), outputs.var(0, unbiased=False)
        total = variance + ((2 * draws[:, -1]).exp().mean() * one.square()).to(like)
    return AdditivePrediction(
        propagate.x,
        Moments(_result(mean), _result(variance.sqrt())),
        Moments(_result(mean), _result(total.sqrt())),
        at_map,
    )


def output_moments(propagate: NISP, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of the outputs, ``(*batch, n)``; where nothing is uncertain the variance is zero."""
    if propagate.pattern.num_germs:
        return propagate.moments(alpha)
    mean = propagate.mean(alpha)
    return mean, torch.zeros_like(mean)


def _moments(propagate: NISP, alpha: Tensor) -> Moments:
    mean, variance = output_moments(propagate, alpha)
    return Moments(_result(mean), _result(variance.sqrt()))


def _result(value: Tensor) -> Tensor:
    return value.detach().to(device="cpu", dtype=torch.float64)


def parameter_density(propagate: NISP, alpha: Tensor, points: Tensor, *, seed: int = 0) -> Tensor:
    r"""Density of λ averaged over draws of α (Eq. 44), at physical points.

    .. math:: p(\lambda | D) = E_\alpha[\pi_\lambda(\lambda; \alpha)]

    A first-order normal embedding of every free parameter, or of its logarithm where it has ``transform="log"``, is
    averaged exactly; otherwise, or where a density is singular, a normal kernel density estimate of draws of these is
    used.

    Args:
        propagate: The propagation.
        alpha: Draws ``(S, P)``, or one α ``(1, P)``.
        points: ``(M, d)``, physical units, the free parameters in order.
        seed: Of the draws of λ, where they are needed.

    Returns:
        ``(M,)``, per unit of the product of the parameters' units.

    Raises:
        ShapeError: If the points do not have one column for each free parameter.
        DomainError: If a parameter has one value only, and therefore no density.
    """
    if points.ndim != 2 or points.shape[1] != len(propagate.free):
        raise ShapeError(
            f"Expected points of shape (M, {len(propagate.free)}), one column per free parameter. "
            f"Got {tuple(points.shape)}."
        )
    pattern, scaling = propagate.pattern, propagate.scaling
    alpha = _result(alpha)
    points = points.to(torch.float64)
    log = scaling.log
    known = torch.where(log, points > 0, torch.ones_like(points, dtype=torch.bool)).all(-1)
    where = points[known]
    size = torch.where(log, where, torch.ones_like(where)).prod(-1)  # of a physical unit, in units of ln λ
    coordinates = torch.where(log, where.log(), where)
    density = torch.zeros(len(points), dtype=torch.float64)
    found = _averaged_exactly(propagate, alpha, coordinates)
    if found is None:
        num = max(1, 20_000 // len(alpha))
        xi = propagate.draw_germ(num * len(alpha), seed=seed).reshape(len(alpha), num, -1)
        psi = polychaos.evaluate(pattern.basis, pattern.indices, _result(xi))
        draws = scaling.center + scaling.scale * torch.einsum("adk,ask->asd", pattern.matrix(alpha), psi)
        draws = draws.reshape(-1, draws.shape[-1])
        _check_varies(torch.where(log, draws.exp(), draws))
        found = kernel_density(draws, coordinates)
    density[known] = found / size
    return density


def _averaged_exactly(propagate: NISP, alpha: Tensor, points: Tensor) -> Tensor | None:
    """The average of normal densities at points ``(M, d)``, ln λ where a parameter is on a logarithmic scale; None
    where they are not normal, or one is singular."""
    pattern, scaling = propagate.pattern, propagate.scaling
    if not (pattern.basis.name == "hermite" and pattern.order == 1 and pattern.embedded == pattern.names):
        return None
    matrix = pattern.matrix(alpha)
    factor, failed = torch.linalg.cholesky_ex(matrix[..., 1:] @ matrix[..., 1:].transpose(-1, -2))
    if bool(failed.any()) or not bool((factor.diagonal(dim1=-2, dim2=-1) > 1e-7).all()):
        return None
    total = torch.zeros(len(points), dtype=torch.float64)
    constant = scaling.scale.log().sum() + 0.5 * len(scaling.scale) * math.log(2 * math.pi)
    scaled = (points - scaling.center) / scaling.scale
    for m, f in zip(matrix[..., 0].split(256), factor.split(256), strict=True):
        white = torch.linalg.solve_triangular(f, (scaled - m.unsqueeze(1)).transpose(-1, -2), upper=False)
        log_det = f.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)
        total += (-0.5 * white.square().sum(-2) - log_det - constant).exp().sum(0)
    return total / len(alpha)


def kernel_density(draws: Tensor, points: Tensor) -> Tensor:
    """Normal kernel density estimate with Silverman's bandwidth in whitened coordinates.

    Args:
        draws: ``(S, d)``.
        points: ``(M, d)``.

    Returns:
        ``(M,)``.

    Raises:
        DomainError: If a column is constant.
    """
    count, size = draws.shape
    _check_varies(draws)
    center, scale = draws.mean(0), draws.std(0)
    z = (draws - center) / scale
    covariance = z.T @ z / (count - 1) + 1e-10 * torch.eye(size, dtype=draws.dtype)
    factor = torch.linalg.cholesky(covariance) * (4 / (count * (size + 2))) ** (1 / (size + 4))
    white = torch.linalg.solve_triangular(factor, z.T, upper=False).T
    target = torch.linalg.solve_triangular(factor, ((points - center) / scale).T, upper=False).T
    log_norm = factor.diagonal().log().sum() + scale.log().sum() + 0.5 * size * math.log(2 * math.pi)
    parts = [(-0.5 * torch.cdist(part, white).square()).exp().mean(1) for part in target.split(256)]
    return torch.cat(parts) * torch.exp(-log_norm)


def _check_varies(draws: Tensor) -> None:
    center = draws.mean(0)
    still = draws.std(0) <= 1e-12 * center.abs()  # equal numbers, but for the rounding of their mean
    if bool(still.any()):
        raise DomainError(
            f"Expected draws that vary in every column. Got the value {float(center[still][0]):.6g} alone in column "
            f"{int(still.nonzero()[0])}: a parameter without spread has no density."
        )


@dataclass(frozen=True)
class Scores:
    """How well a predictive distribution did on data.

    Attributes:
        rmse: Root mean squared error of the mean, in the output's unit.
        log_score: Mean log-density of the data under a normal with the predicted moments.
        coverage: Share of the data within ``level`` central intervals of that normal.
        level: The nominal coverage.
    """

    rmse: float
    log_score: float
    coverage: float
    level: float


def scores(y: Any, moments: Moments | Prediction, *, noise: Any = None, level: float = 0.95) -> Scores:
    """RMSE, log score and coverage of predicted moments against data ``(n,)``.

    Args:
        y: The data, in the prediction's unit; NaN where one is missing, which counts nowhere.
        moments: Predicted mean and sd.
        noise: Sd of the measurement noise, one number or ``(n,)`` of any kind of array, added in square.
        level: Nominal coverage, between 0 and 1.

    Raises:
        ShapeError: If data, moments and noise differ in shape.
        DomainError: If the level is not between 0 and 1, no datum is there, a sd is not a number or zero, or data or
            noise come with a unit: a prediction has none to convert to.

    >>> found = scores([1.0, float("nan"), 3.0], Moments(torch.zeros(3), torch.ones(3)), noise=1.0)
    >>> print(f"{found.rmse:.4f} {found.coverage}")     # √((1 + 9) / 2), and 3 is past 1.96 √2
    2.2361 0.5
    """
    _check_plain(y, "y")
    _check_plain(noise, "noise")
    y, _ = to_tensor(y, "y", None)
    if not isinstance(moments, Moments | Prediction):
        parts = [name for name in ("posterior", "push_forward") if isinstance(getattr(moments, name, None), Moments)]
        advice = f" (give one of its parts, .{' or .'.join(parts)})" if parts else ""
        raise DomainError(f"Expected moments as a Prediction or Moments. Got {type(moments).__name__}{advice}.")
    if y.shape != moments.mean.shape:
        raise ShapeError(f"Expected y of shape {tuple(moments.mean.shape)}, as the mean. Got {tuple(y.shape)}.")
    if isinstance(level, bool) or not isinstance(level, Real) or not 0 < level < 1:
        raise DomainError(f"Expected level between 0 and 1. Got {level!r}.")
    known = ~torch.isnan(y)
    if bool(y.isinf().any()):
        raise DomainError("Expected finite data. Got an infinite one (correct it, or give NaN where one is missing).")
    if not bool(known.any()):
        raise DomainError("Expected at least one datum that is not missing. Got NaN alone.")
    error = (y - moments.mean)[known]
    sd = moments.sd if noise is None else (moments.sd.square() + _noise_sd(noise, moments.sd).square()).sqrt()
    sd = sd[known]
    least = ROUNDING * moments.mean[known].abs()
    if not bool((sd > least).all()):
        worst = float(sd[~(sd > least)][0])
        nothing = math.isnan(worst) or bool(moments.mean[known].isnan().any())
        told = "NaN" if nothing else f"{worst:.3g}" + ", which is 0 but for rounding" * (worst >= 0)
        raise DomainError(f"Expected sd > 0 for a log score. Got {told}. Give noise=, or compare the means alone.")
    quantile = math.sqrt(2) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
    z = error / sd
    log_score = (-0.5 * z.square() - sd.log()).mean() - 0.5 * math.log(2 * math.pi)
    return Scores(
        rmse=float(error.square().mean().sqrt()),
        log_score=float(log_score),
        coverage=float((z.abs() <= quantile).to(torch.float64).mean()),
        level=level,
    )


def _check_plain(value: Any, label: str) -> None:
    if (unit := unit_of(value)) is not None:
        raise DomainError(
            f"Expected {label} as numbers in the unit of the prediction, which does not know it. Got some in "
            f"{unit!r} (convert it yourself: give {label}.to(unit).magnitude, or the .values of a DataArray)."
        )


def _noise_sd(noise: Any, like: Tensor) -> Tensor:
    """The sd of the noise as a float64 tensor that spreads over the data."""
    try:
        value, _ = to_tensor(noise, "noise", None)
    except (TypeError, ValueError, RuntimeError) as error:
        raise DomainError(f"Expected noise as one number or {tuple(like.shape)} of them. Got {noise!r}.") from error
    if value.ndim and value.shape != like.shape:
        raise ShapeError(
            f"Expected noise of shape {tuple(like.shape)}, as the data, or one number. Got {tuple(value.shape)}."
        )
    if bool((value < 0).any()):
        raise DomainError(f"Expected noise >= 0, a standard deviation. Got {float(value.min())}.")
    return value
