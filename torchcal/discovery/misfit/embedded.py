"""Model error embedded in one parameter at a time, to first order: how wide is it, and which parameter explains best.

A parameter λ_j with a normal density of sd σ_j gives every output the model-error sd |∂f_i/∂λ_j| σ_j (the first-order
polynomial chaos of the output). Its likelihood is the marginal Gaussian one,

.. math:: r_i \\sim N\\big(0,\\; s_i^2 + (\\partial f_i/\\partial\\lambda_j)^2 \\sigma_j^2\\big)

with the noise sd s_i. Of a parameter with two bounds σ_j is at most half their distance, the largest sd of any density
between them (Popoviciu 1935). A full embedding, with all coefficients inferred, is `torchcal.calibrate`.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 17, 28-29.
"""

import math
from dataclasses import dataclass

import torch

from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.misfit.noise import Noise

__all__ = ["Embedded", "embed_each", "model_error_sd"]

#: Model-error sd that are tried, in units of the largest residual.
GRID = torch.cat([torch.zeros(1, dtype=torch.float64), torch.logspace(-4, 0.5, 120, dtype=torch.float64)])


@dataclass(frozen=True)
class Embedded:
    """Model error embedded in one parameter.

    Attributes:
        parameter: Its name.
        sd: σ_j in the parameter's unit.
        output_sd: Root mean square of the outputs' model-error sd, in their unit; of several outputs in their spreads.
        log_likelihood: Against no model error.
    """

    parameter: str
    sd: float
    output_sd: float
    log_likelihood: float


def embed_each(found: Fitted, noise: Noise, parameters: list[str] | None = None) -> list[Embedded]:
    """Embed model error in each free parameter in turn; the likeliest first.

    Args:
        found: A fit.
        noise: The noise model.
        parameters: Names of the parameters to try; all free ones by default.
    """
    names = [found.problem.parameters[i].name for i in found.free]
    s2 = noise.sd[found.problem.index].square()
    r2 = found.residual.square()
    recording = found.problem.recording
    several = len(recording.outputs) > 1
    unit2 = recording.spread[found.problem.index].square() if several else torch.ones_like(r2)
    rows = []
    for k, name in enumerate(names):
        if parameters is not None and name not in parameters:
            continue
        slope2 = found.jacobian[:, k].square()
        size = float(slope2.max())
        if size <= 0:
            continue
        q = found.problem.parameters[found.free[k]]
        most = math.inf if q.low is None or q.high is None else 0.5 * (q.high - q.low)
        variance = (float(r2.max()) / size * GRID.square()).clamp_max(most**2)
        total = s2 + variance[:, None] * slope2
        logs = -0.5 * (total.log() + r2 / total).sum(-1)
        best = int(logs.argmax())
        rows.append(
            Embedded(
                name,
                float(variance[best].sqrt()),
                float((variance[best] * slope2 / unit2).mean().sqrt()),
                float(logs[best] - logs[0]),
            )
        )
    return sorted(rows, key=lambda row: -row.log_likelihood)


def model_error_sd(found: Fitted, noise: Noise, parameters: list[str]) -> float | None:
    """Root mean square model-error sd with model error in the likeliest of some parameters."""
    rows = embed_each(found, noise, parameters)
    return rows[0].output_sd if rows else None
