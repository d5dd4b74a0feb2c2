"""Mean and covariance of λ for given coefficients of its expansion."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcal import polychaos

if TYPE_CHECKING:
    from torchcal.propagation.nisp import NISP

__all__ = ["moments"]


def moments(propagate: "NISP", alpha: Tensor) -> tuple[Tensor, Tensor]:
    """E[λ] ``(*batch, d)`` and Cov[λ] ``(*batch, d, d)``, physical units; see `NISP.parameter_moments`."""
    matrix = propagate.pattern.matrix(alpha)
    center, scale = propagate.scaling.center.to(alpha), propagate.scaling.scale.to(alpha)
    log = propagate.scaling.log.to(alpha.device)
    hermite = propagate.pattern.basis.name == "hermite"
    if bool(log.any()) and hermite and propagate.pattern.order == 2:
        return _of_exponentials(propagate, matrix)
    if bool(log.any()) and not hermite:
        # The output's own nodes need not be enough for exp(λ): a line in ln λ takes two.
        germs = propagate.pattern.num_germs
        count = {0: 1, 1: 48, 2: 32, 3: 16}.get(germs)
        if count is None:
            nodes, weights = propagate.nodes, propagate.weights
        else:
            rule = polychaos.tensor_rule(propagate.pattern.basis, germs, count)
            nodes, weights = rule.nodes.to(alpha), rule.weights.to(alpha)
        values = propagate.parameters_at(alpha, nodes)
        mean = torch.einsum("q,...qd->...d", weights, values)
        offset = values - mean.unsqueeze(-2)
        return mean, torch.einsum("q,...qd,...qe->...de", weights, offset, offset)
    mean = center + scale * matrix[..., 0]
    factor = scale[:, None] * matrix[..., 1:]
    norms = polychaos.norms(propagate.pattern.basis, propagate.pattern.indices[1:]).to(alpha)
    covariance = (factor * norms) @ factor.transpose(-1, -2)
    if bool(log.any()):
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        lognormal = torch.where(log, mean + 0.5 * variance, 0 * mean).exp()
        gain = torch.where(log, lognormal, torch.ones_like(mean))
        both = log[:, None] & log[None, :]
        inner = torch.where(both, torch.where(both, covariance, 0 * covariance).expm1(), covariance)
        covariance = gain[..., :, None] * inner * gain[..., None, :]
        mean = torch.where(log, lognormal, mean)
    return mean, covariance


def _of_exponentials(propagate: "NISP", matrix: Tensor) -> tuple[Tensor, Tensor]:
    r"""Moments of polynomials of degree 2 in normal germs, and of exponentials of such; +inf where there is none.

    With :math:`L = c + b^T\xi + \xi^T Q\xi` and :math:`S = (I - 2Q)^{-1}`, where that is positive definite,

    .. math:: E[e^L] = \sqrt{\det S}\, e^{c + b^T S b / 2}, \qquad E[e^L g(\xi)] = E[e^L]\, E[g(Sb + S^{1/2}\xi)]
    """
    constant, slope, bend = _quadratics(propagate, matrix)
    log = propagate.scaling.log.to(matrix.device)
    plain = constant + bend.diagonal(dim1=-2, dim2=-1).sum(-1)
    # Of those that are no exponential nothing is taken that might be too large for one.
    lean, turn = slope * log[:, None], bend * log[:, None, None]
    raised, at, spread = _tilted(lean, turn)
    lifted = torch.where(log, torch.where(log, constant, 0.0).exp() * raised.exp(), torch.ones_like(constant))
    mean = torch.where(log, lifted, plain)
    # Of two exponentials their product is one; of one, the other is looked at where it leans; of none, as they are.
    together, _, _ = _tilted(
        lean[..., :, None, :] + lean[..., None, :, :], turn[..., :, None, :, :] + turn[..., None, :, :, :]
    )
    pairs = lifted[..., :, None] * lifted[..., None, :]
    both = pairs * torch.expm1(together - raised[..., :, None] - raised[..., None, :])
    wider = 2 * turn @ spread + at[..., :, None] * at[..., None, :]  # than of germs that nothing weighs
    one = torch.einsum("...jg,...ig->...ij", slope, at) + torch.einsum("...jgh,...igh->...ij", bend, wider)
    one = lifted[..., :, None] * one
    none = slope @ slope.transpose(-1, -2) + 2 * torch.einsum("...igh,...jgh->...ij", bend, bend)
    covariance = torch.where(log[:, None], torch.where(log, both, one), torch.where(log, one.transpose(-1, -2), none))
    endless = torch.isinf(lifted)
    either = endless[..., :, None] | endless[..., None, :] | (torch.isinf(together) & log & log[:, None])
    return mean, torch.where(either, torch.inf, covariance)


def _quadratics(propagate: "NISP", matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """c ``(*batch, d)``, b ``(*batch, d, germs)`` and Q ``(*batch, d, germs, germs)`` of expansions of degree 2."""
    center, scale = propagate.scaling.center.to(matrix), propagate.scaling.scale.to(matrix)
    germs = propagate.pattern.num_germs
    coefficients = scale[:, None] * matrix
    constant = center + coefficients[..., 0]
    slope = matrix.new_zeros(*constant.shape, germs)
    bend = matrix.new_zeros(*constant.shape, germs, germs)
    for k, powers in enumerate(propagate.pattern.indices.tolist()):
        here = [g for g, power in enumerate(powers) for _ in range(power)]
        if len(here) == 1:
            slope[..., here[0]] = coefficients[..., k]
        elif len(here) == 2:
            g, h = here
            bend[..., g, h] = bend[..., h, g] = coefficients[..., k] * (1.0 if g == h else 0.5)
            if g == h:  # He₂(ξ) = ξ² − 1
                constant = constant - coefficients[..., k]
    return constant, slope, bend


def _tilted(slope: Tensor, bend: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """ln E[exp(bᵀξ + ξᵀQξ)] ``(*batch,)``, and mean and covariance of the germs weighed with that exponential."""
    unit = torch.eye(slope.shape[-1]).to(bend)
    values = torch.linalg.eigvalsh(bend)
    finite = (values < 0.5).all(-1)
    spread = torch.linalg.inv(unit - 2 * torch.where(finite[..., None, None], bend, 0 * bend))
    at = (spread @ slope.unsqueeze(-1)).squeeze(-1)
    shrunk = torch.log1p(-2 * torch.where(finite[..., None], values, 0 * values)).sum(-1)
    size = 0.5 * ((slope * at).sum(-1) - shrunk)
    return torch.where(finite, size, torch.inf), at, spread
