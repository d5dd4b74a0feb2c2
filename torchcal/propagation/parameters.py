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
    if bool(log.any()) and not (propagate.pattern.order <= 1 and propagate.pattern.basis.name == "hermite"):
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
        lognormal = (mean + 0.5 * variance).exp()
        gain = torch.where(log, lognormal, torch.ones_like(mean))
        both = log[:, None] & log[None, :]
        inner = torch.where(both, torch.where(both, covariance, 0 * covariance).expm1(), covariance)
        covariance = gain[..., :, None] * inner * gain[..., None, :]
        mean = torch.where(log, lognormal, mean)
    return mean, covariance
