"""Places where something may be missing: unknown changes of a channel along a driver, with their evidence."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.misfit.channels import Channel
from torchcal.discovery.misfit.residual import Residual

__all__ = ["SIZES", "SMALL", "Change", "Place", "evidence_of", "is_unseen"]

#: Singular values below this share of the largest are none.
SMALL = 1e-6
#: Share of a change that is the same everywhere up to which the base's parameters make up for it.
SAME = 1e-3
#: The same of a smooth change of any shape, which its functions follow that well.
MADE_UP = 0.03
#: Share of an estimate that is left without such changes, below which it is told without them, and above which there is
#: more left than rounding.
HARDLY, RESOLVED = 1 / 3, 1e-6
#: Sizes of an unknown change that are tried, in noise sd.
SIZES = torch.logspace(-0.3, 3.0, 14, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Place:
    """An unknown change of one channel against one driver: smooth, an oscillation, or in steps.

    Attributes:
        channel: Where.
        driver: Against what.
        evidence: Log evidence against no change.
        share: Share of the excess misfit that it removes.
        profile: Estimated change at the channel's points, ``(K,)``; its median is 0 where the base's parameters make
            up for one that is the same everywhere.
        sd: Its standard deviation there.
        period: Of an oscillation, in units of the driver; None of any other change.
        edges: Of a change in steps, where these are.
        run: Of a change in one run of several alone, which, counted from 0.
        together: Of a change along two conditions, these.
    """

    channel: Channel
    driver: str
    evidence: float
    share: float
    profile: Tensor
    sd: Tensor
    period: float | None = None
    edges: tuple[float, ...] = ()
    run: int | None = None
    together: tuple[str, ...] = ()


def evidence_of(u: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Log evidence with every one of `SIZES` as likely, ``(B,)``, and the likeliest size; u ``(r, B)``, s ``(r,)``."""
    gain = (SIZES[:, None] * s).square()  # (G, r)
    shrink = gain / (1 + gain)
    logs = 0.5 * shrink @ u.square() - 0.5 * torch.log1p(gain).sum(-1, keepdim=True)
    return logs.logsumexp(0) - math.log(len(SIZES)), SIZES[logs.argmax(0)]


@dataclass(frozen=True, eq=False)
class Change:
    """Smooth changes of a channel along a driver, in principal directions.

    Attributes:
        features: Radial functions at the channel's points, ``(K, m)``.
        scale: Of their responses, which are divided by it.
        s: Singular values of the responses, ``(m,)``.
        v: Right singular vectors, ``(m, m)``.
        along: The residual along the left ones, ``(m,)``.
        null: The simulated residuals along them, ``(m, draws)``.
        whole: The responses with what the base's parameters make up for, whitened, ``(n, m)``; None where nothing is
            told of that.
    """

    features: Tensor
    scale: float
    s: Tensor
    v: Tensor
    along: Tensor
    null: Tensor
    whole: Tensor | None = None

    @classmethod
    def of(
        cls, features: Tensor, columns: Tensor, least: float, residuals: Tensor, whole: Tensor | None = None
    ) -> "Change | None":
        """From the responses, projected, and as they are; None where there are none beyond rounding, ``least``."""
        scale = float(columns.norm()) / math.sqrt(columns.shape[1])
        if scale <= least:
            return None
        columns = columns / scale
        values, v = torch.linalg.eigh(columns.T @ columns)
        s = values.clamp_min(0.0).sqrt()
        there = s > SMALL * s[-1]
        along = (v[:, there].T @ (columns.T @ residuals)) / s[there, None]
        return cls(features, scale, s[there], v[:, there], along[:, 0], along[:, 1:], whole)

    def place(self, channel: Channel, driver: str, residual: Residual) -> Place:
        """The estimate."""
        evidence, size = evidence_of(self.along[:, None], self.s)
        gain = (float(size[0]) * self.s).square()
        shrink = gain / (1 + gain)
        weights = (self.v * (shrink / self.s)) @ self.along / self.scale
        removed = float(((1 - (1 - shrink).square()) * self.along.square()).sum())
        share = residual.share(removed, float(shrink.sum()))
        features, profile = self.features, self.features @ weights
        made_up = torch.linalg.qr(features @ self._made_up()).Q
        rest = profile - made_up @ (made_up.T @ profile)
        if RESOLVED < float(rest.norm()) / max(float(profile.norm()), 1e-300) < HARDLY:
            features, profile = features - made_up @ (made_up.T @ features), rest
        if is_unseen(channel, residual):
            features, profile = features - features.mean(0), profile - profile.median()
        within = (features @ self.v) / (1 + gain).sqrt()
        # What the data say nothing about keeps its prior sd.
        beyond = (features.square().sum(1) - (features @ self.v).square().sum(1)).clamp_min(0.0)
        sd = (within.square().sum(1) + beyond).sqrt() * float(size[0]) / self.scale
        return Place(channel, driver, float(evidence[0]), share, profile, sd)

    def _made_up(self) -> Tensor:
        """Weights of changes that the base's parameters make up for, ``(m, k)``.

        What is left of their responses is how far the functions miss the change that the parameters make. A large
        misfit may go with that, and the change would be told many times as large as all that is missing.
        """
        if self.whole is None:
            return self.v.new_zeros(len(self.v), 0)
        values, v = torch.linalg.eigh(self.whole.T @ self.whole)
        seen = values > SMALL**2 * values[-1].clamp_min(1e-300)
        unit = v[:, seen] / values[seen].sqrt()
        left = (self.scale * self.s[:, None]) * (self.v.T @ unit)
        shares, turn = torch.linalg.eigh(left.T @ left)
        return unit @ turn[:, shares < MADE_UP**2]


def is_unseen(channel: Channel, residual: Residual) -> bool:
    """Whether the base's parameters make up for a change that is the same everywhere, so that it may be any."""
    change = channel.response(channel.time.new_ones(len(channel.time), 1))
    return float(residual.tangent(change).norm()) <= SAME * float(residual.found.whitening(change).norm())
