"""White coordinates for samplers, and the points that chains start from."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchcal.errors import ConvergenceError
from torchcal.inference.arrays import Array
from torchcal.inference.bends import LEAST, Bend, found_in

__all__ = ["Laplace", "Slopes", "Whitened", "dealt_out", "gathered", "group_means", "slopes_of", "starting_points"]

#: Times the height that it would have in a normal density above which a starting point is far from its mode; and the
#: share of such points above which they are gathered first.
FAR, MANY = 3.0, 0.1
#: Moves of every point between two looks at their heights, and looks at most.
MOVES, LOOKS = 20, 20


Slopes = Callable[[Tensor], tuple[Tensor, Tensor]]
"""``u (C, P) -> ((C,), (C, P))``, a log-density and its gradient."""


def slopes_of(log_density: Callable[[Tensor], Tensor]) -> Slopes:
    """A log-density ``u (C, P) -> (C,)`` with PyTorch's gradient."""

    def both(u: Tensor) -> tuple[Tensor, Tensor]:
        u = u.detach().requires_grad_(True)
        with torch.enable_grad():
            value = log_density(u)
            (slope,) = torch.autograd.grad(value.sum(), u)  # with grad_outputs=, PyTorch would import SymPy first
        return value.detach(), slope

    return both


@dataclass(frozen=True)
class Laplace:
    """A normal approximation at a mode in unbounded coordinates.

    Attributes:
        loc: The mode, ``(P,)``.
        scale_tril: Factor of its covariance, ``(P, P)``.
        weight: Its share of the posterior among all modes, as far as the normal approximations tell.
    """

    loc: Tensor
    scale_tril: Tensor
    weight: float = 1.0

    def to(self, dtype: torch.dtype) -> "Laplace":
        """In another dtype."""
        return Laplace(self.loc.to(dtype), self.scale_tril.to(dtype), self.weight)


class Whitened:
    """A log-density in coordinates z with u = loc + scale_tril (z + shifts), with its gradient for the sampler.

    Shifts are those of a `Bend`, if there is one. The gradient is PyTorch's where ``slopes`` does not give it.
    """

    def __init__(
        self,
        log_density: Callable[[Tensor], Tensor],
        loc: Tensor,
        scale_tril: Tensor,
        bend: Bend | None = None,
        *,
        slopes: Slopes | None = None,
    ) -> None:
        self.log_density, self.loc, self.scale_tril, self.bend = log_density, loc, scale_tril, bend
        self.slopes = slopes_of(log_density) if slopes is None else slopes
        self._downhill = -scale_tril

    def potential(self, z: Array) -> tuple[Array, Array]:
        """Negative log-density ``(C,)`` and its gradient ``(C, P)``; +inf and 0 where they are not finite.

        Of a tensor or, on the CPU, of a NumPy array, in kind.
        """
        if isinstance(z, np.ndarray):
            return self._on_host.potential(z)
        value, slope = self.slopes(self.outer(z.detach()))
        energy, slope = -value, slope @ self._downhill
        if self.bend is not None:
            slope = slope + self.bend.pulled_back(z, slope)
        good = torch.isfinite(energy + slope.sum(-1))  # which is not finite where any of them is not
        return torch.where(good, energy, torch.inf), torch.where(good[:, None], slope, 0.0)

    @functools.cached_property
    def _on_host(self) -> "_HostPotential":
        return _HostPotential(self)

    def height(self, z: Tensor) -> Tensor:
        """Negative log-density ``(C,)`` alone; +inf where it is not finite."""
        with torch.no_grad():
            value = -self.log_density(self.outer(z))
        return torch.where(torch.isfinite(value), value, torch.inf)

    def outer(self, z: Tensor) -> Tensor:
        """The coordinates u of z, ``(..., P)``."""
        flat = z.reshape(-1, z.shape[-1])
        return torch.addmm(self.loc, self._bent(flat), self.scale_tril.T).reshape(z.shape)

    def inner(self, u: Tensor) -> Tensor:
        """The whitened coordinates z of u, ``(C, P)``."""
        z = torch.linalg.solve_triangular(self.scale_tril, (u - self.loc).T, upper=False).T
        return z if self.bend is None else z - self.bend.shift(z)  # no shift moves a driver

    def _bent(self, z: Tensor) -> Tensor:
        return z if self.bend is None else z + self.bend.shift(z)

    def refined(self, z: Tensor, groups: Tensor, chains: Tensor, *, weight: float = 5.0) -> "Whitened":
        """Coordinates in which draws of chains are white: z ``(S, P)``, each about the mean of its group ``(S,)``.

        Groups are the modes that chains began at: where they stay apart, the distance between modes is no width. Where
        they are places on one bent ridge, all draws together fill less room when it is straightened.
        """
        # In double precision, as single precision loses a narrow direction beside a long one.
        wide = self._bent(z).double()
        means = group_means(wide, groups)
        center, factor = means[0], _factor(wide - means[groups], weight)
        middle, whole = wide.mean(0), _factor(wide - wide.mean(0), weight)
        white = torch.linalg.solve_triangular(whole, (wide - middle).T, upper=False).T
        bend, found = None, found_in(white, chains)
        apart = 2 * float(factor.diagonal().log().sum() - whole.diagonal().log().sum())
        if found is not None and found[1] < apart + math.log(LEAST):
            rest = white - found[0].shift(white)
            offset = rest.mean(0)  # drivers have no part in it
            inner = _factor(rest - offset, weight * math.exp(found[1]))
            bend = found[0].seen_from(inner).to(z.dtype)
            center, factor = middle + whole @ offset, whole @ inner
        center, factor = center.to(z.dtype), factor.to(z.dtype)
        loc, scale_tril = self.loc + self.scale_tril @ center, self.scale_tril @ factor
        return Whitened(self.log_density, loc, scale_tril, bend, slopes=self.slopes)


class _HostPotential:
    """`Whitened.potential` in NumPy, but for the density."""

    def __init__(self, space: Whitened) -> None:
        self._slopes = space.slopes
        self._loc, self._upward = space.loc.numpy(), space.scale_tril.T.contiguous().numpy()
        self._downhill = space._downhill.contiguous().numpy()
        self._bend = None if space.bend is None else space.bend.on_host()

    def potential(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(all="ignore"):  # what is not finite is told by the result; the density keeps its own warnings
            bent = z if self._bend is None else z + self._bend.shift(z)
            u = self._loc + bent @ self._upward
        value, steepest = self._slopes(torch.from_numpy(u))
        with np.errstate(all="ignore"):
            energy, slope = -value.numpy(), steepest.numpy() @ self._downhill
            if self._bend is not None:
                slope += self._bend.pulled_back(z, slope)
            good = np.isfinite(energy + slope.sum(-1))  # which is not finite where any of them is not
        if good.all():
            return energy, slope
        return np.where(good, energy, np.inf), np.where(good[:, None], slope, 0)


def _factor(offset: Tensor, weight: float) -> Tensor:
    """Of the covariance of draws ``(S, P)``, shrunk to what their coordinates assume with the weight of a few draws."""
    count, size = offset.shape
    identity = torch.eye(size, dtype=offset.dtype, device=offset.device)
    return torch.linalg.cholesky((offset.T @ offset + weight * identity) / (count + weight))


def group_means(values: Tensor, groups: Tensor) -> Tensor:
    """Mean of the rows ``(S, P)`` of each group ``(S,)``, ``(G, P)``."""
    member = torch.nn.functional.one_hot(groups).to(values)
    return (member.T @ values) / member.sum(0).clamp_min(1)[:, None]


def dealt_out(weights: Sequence[float], count: int) -> list[int]:
    """Which mode each of ``count`` chains begins at: any first few have their share of each, as far as whole chains go.

    >>> dealt_out([0.75, 0.25], 4)
    [0, 0, 1, 0]
    """
    shares = torch.tensor(weights, dtype=torch.float64)
    dealt = torch.zeros_like(shares)
    chosen = []
    for number in range(count):
        which = int((shares / shares.sum() * (number + 1) - dealt).argmax())
        dealt[which] += 1
        chosen.append(which)
    return chosen


def starting_points(
    space: Whitened, modes: Sequence[Laplace], count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draws of the normal approximations at the modes, as many of each as its weight, drawn in where not finite.

    Returns:
        Points ``(C, P)`` and the mode of each ``(C,)``, dealt out so that any first few chains have their share of
        each mode.

    Raises:
        ConvergenceError: If the density is not finite around a mode.
    """
    size = len(space.loc)
    normal = torch.randn((count, size), dtype=space.loc.dtype, device=space.loc.device, generator=generator)
    chosen = dealt_out([mode.weight for mode in modes], count)
    center = space.inner(torch.stack([mode.loc for mode in modes]))[chosen]
    spread = torch.linalg.solve_triangular(space.scale_tril, torch.stack([m.scale_tril for m in modes]), upper=False)
    offset = (spread[chosen] @ normal[:, :, None])[:, :, 0]
    for _ in range(20):
        bad = ~torch.isfinite(space.potential(center + offset)[0])
        if not bool(bad.any()):
            return center + offset, torch.tensor(chosen, device=space.loc.device)
        offset = torch.where(bad[:, None], 0.5 * offset, offset)
    raise ConvergenceError(
        "Expected a finite posterior around the best point found. Got none. Look at the simulator there."
    )


def gathered(
    space: Whitened, z: Tensor, groups: Tensor, lowest: Tensor, generator: torch.Generator
) -> tuple[Whitened, Tensor]:
    """Points drawn together where the normal approximation is a bad one, as at a bent ridge.

    Half of the points at a time moves along differences of two others of the same mode (differential evolution Markov
    chain, ter Braak 2006, Statistics and Computing 16, 239), whose sizes and directions adapt to the density by
    themselves, until few are far from their modes or they come no nearer. Those that are left behind begin where others
    are. Trajectories from slopes that are too high by thousands would learn steps that are too short.

    Args:
        space: The density.
        z: Starting points ``(C, P)``.
        groups: The mode of each, ``(C,)``.
        lowest: Height of each one's mode, ``(C,)``.
        generator: Of random numbers.

    Returns:
        Coordinates in which the points are white on their last ways, and the points in them ``(C, P)``; both as they
        came where at most a few are far from their modes.
    """
    count, size = z.shape
    height = space.height(z)
    most = lowest + FAR * (0.5 * size + 2 * (0.5 * size) ** 0.5)  # half a chi-square's mean and two sd, three times
    if float((height > most).double().mean()) <= MANY or count < 8:
        return space, z
    before = math.inf
    for _ in range(LOOKS):
        ways, near = [], []
        for move in range(2 * MOVES):
            length = 1.0 if move % 10 == 9 else 2.38 / (2 * size) ** 0.5
            z, height = _moved(space, z, height, groups, length, generator)
            ways.append(z)
            near.append(height <= most)
        excess = float((height - most).clamp_min(0).mean())
        if float((height > most).double().mean()) <= MANY or not excess < 0.9 * before:
            break
        before = excess
    pool, mode = torch.cat(ways)[torch.cat(near)], groups.repeat(len(ways))[torch.cat(near)]
    if len(pool) < 10 * size:
        return space, z
    for group in groups.unique():  # who is left behind begins where others of its mode are
        settled, stuck = ((groups == group) & side for side in (height <= most, height > most))
        if bool(settled.any()) and bool(stuck.any()):
            chosen = torch.multinomial(settled.to(z.dtype), int(stuck.sum()), replacement=True, generator=generator)
            z = z.index_copy(0, stuck.nonzero()[:, 0], z[chosen])
    chains = torch.arange(count, device=z.device).repeat(len(ways))[torch.cat(near)]
    other = space.refined(pool, mode, chains, weight=0.05)
    return other, other.inner(space.outer(z))


def _moved(
    space: Whitened, z: Tensor, height: Tensor, groups: Tensor, length: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Points and heights after half of the points have tried to move along differences of the others."""
    count, size = z.shape
    order = torch.randperm(count, generator=generator, device=z.device)
    moving, others = order[: count // 2], order[count // 2 :]
    same = (groups[moving][:, None] == groups[others]).to(z.dtype)
    moving, same = moving[same.sum(1) >= 2], same[same.sum(1) >= 2]
    if len(moving) == 0:
        return z, height
    first, second = torch.multinomial(same, 2, generator=generator).unbind(1)
    jitter = torch.randn((len(moving), size), dtype=z.dtype, device=z.device, generator=generator)
    there = z[moving] + length * (z[others[first]] - z[others[second]]) + 1e-4 * jitter
    new = space.height(there)
    chance = torch.rand(len(moving), dtype=z.dtype, device=z.device, generator=generator)
    better = chance.log() < height[moving] - new
    z = z.index_copy(0, moving, torch.where(better[:, None], there, z[moving]))
    return z, height.index_copy(0, moving, torch.where(better, new, height[moving]))
