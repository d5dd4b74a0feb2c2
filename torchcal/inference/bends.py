r"""Ridges straightened: coordinates that follow the squares of others.

A spread of an embedded parameter that the data do not need is densest at zero, and what it adds to a variance is made
up for by another: the posterior is a parabola, narrow across and bent along. White coordinates cannot make it round.
With drivers :math:`t_k = w_k \cdot z` and shifts q at right angles to all of them,

.. math:: z \mapsto z + \sum_{k \le l} q_{kl}\, t_k t_l

can, and leaves volumes as they are, so that densities need no correction. It is the second-order case of the triangular
maps of Parno & Marzouk (2018), SIAM/ASA J. Uncertainty Quantification 6, 645-682, learned from draws as these are.
"""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcal.inference.arrays import Array

__all__ = ["LEAST", "Bend", "found_in"]

#: What of the squared volume bends must leave, at most, to be taken in; one driver more of that; drivers at most.
LEAST, NEXT, MOST = 0.5, 0.7, 3
#: Squared correlations of a square with all coordinates, summed, from which on it is looked at.
WORTH = 0.1
#: Directions from which the smallest volume is looked for, and steps on the way.
TRIED, STEPS = 3, 15
#: Draws for each coordinate without which nothing is said of bends, and most draws that are looked at.
DRAWS, ENOUGH = 40, 4000
#: Coordinates at most: the work grows with draws times their square.
LARGEST = 60


@dataclass(frozen=True)
class Bend:
    """Shifts by products of drivers.

    Attributes, tensors or NumPy's arrays:
        drivers: W, ``(P, K)``.
        shifts: q, one row for each pair k ≤ l, ``(K (K + 1) / 2, P)``, all at right angles to W.
    """

    drivers: Array
    shifts: Array
    _sides: tuple[Array, Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        first, second = _pairs(self.drivers.shape[1])
        object.__setattr__(self, "_sides", (self.drivers[:, first], self.drivers[:, second]))

    def shift(self, z: Array) -> Array:
        """What is added to z ``(C, P)``."""
        left, right = self._sides
        return ((z @ left) * (z @ right)) @ self.shifts

    def pulled_back(self, z: Array, slope: Array) -> Array:
        """What the shift adds to a gradient ``(C, P)``, given the one in shifted coordinates."""
        (left, right), along = self._sides, slope @ self.shifts.T
        return (along * (z @ right)) @ left.T + (along * (z @ left)) @ right.T

    def seen_from(self, factor: Tensor) -> "Bend":
        """The same in coordinates y with z = factor y (+ shifts)."""
        return Bend(factor.T @ self.drivers, torch.linalg.solve_triangular(factor, self.shifts.T, upper=False).T)

    def to(self, dtype: torch.dtype) -> "Bend":
        """In another dtype."""
        return Bend(self.drivers.to(dtype), self.shifts.to(dtype))

    def on_host(self) -> "Bend":
        """In NumPy."""
        return Bend(self.drivers.cpu().numpy(), self.shifts.cpu().numpy())


def _pairs(count: int) -> tuple[list[int], list[int]]:
    """Numbers k ≤ l of every pair of drivers."""
    pairs = [(first, second) for first in range(count) for second in range(first, count)]
    return [first for first, _ in pairs], [second for _, second in pairs]


def found_in(z: Tensor, chains: Tensor) -> tuple[Bend, float] | None:
    """The bends of draws that are about white, and the log of what they leave of the squared volume.

    Bends that half of the chains show must straighten the draws of the other half too: chains that hardly move, and
    single draws far out, bend by chance.

    Args:
        z: Draws ``(S, P)``.
        chains: Whose each is ``(S,)``.

    Returns:
        None where no ridge is bent.
    """
    size = z.shape[1]
    if size > LARGEST or len(z) < DRAWS * size:
        return None
    if len(z) > ENOUGH:
        chosen = torch.randperm(len(z), generator=torch.Generator().manual_seed(0))[:ENOUGH].to(z.device)
        z, chains = z[chosen], chains[chosen]
    found = _fitted(z)
    if found is None or not found[1] < math.log(LEAST):
        return None
    first = chains // 2 % 2 == 0  # pairs, as neighbours may begin at modes in turn
    gain = 0.0
    for fit, held in ((z[first], z[~first]), (z[~first], z[first])):
        half = _fitted(fit) if len(fit) > size and len(held) > size else None
        if half is None:
            return None
        gain += 0.5 * (_volume(held - half[0].shift(held)) - _volume(held))
    return found if gain < math.log(NEXT) else None


def _fitted(z: Tensor) -> tuple[Bend, float] | None:
    """One driver after another, as long as the volume that the straightened draws fill shrinks."""
    found = None
    drivers, before, volume = z.new_zeros(z.shape[1], 0), _volume(z), 0.0
    while drivers.shape[1] < min(MOST, z.shape[1] - 1):
        rest = z if found is None else z - found[0].shift(z)
        ends = [_sharpened(z, torch.cat([drivers, new[:, None]], dim=1)) for new in _candidates(rest)]
        best = min(ends, key=lambda end: end.volume, default=None)
        if best is None or not best.volume - before < volume + math.log(NEXT):
            break
        drivers, volume = best.drivers, best.volume - before
        found = Bend(drivers, best.shifts), volume
    return found


def _volume(draws: Tensor) -> float:
    """Log of the squared volume that draws fill about their mean, as normal ones would."""
    return 2 * float(_root(draws - draws.mean(0)).diagonal().log().sum())


class _Straight:
    """Draws straightened by drivers ``(P, K)``, which are brought to unit variance.

    Shifts are by least squares on products, beside the drivers themselves. They do not move these, as nothing of them
    is left to be explained.
    """

    def __init__(self, z: Tensor, drivers: Tensor) -> None:
        self.drivers = drivers / (z @ drivers).std(0)
        self.pairs = _pairs(drivers.shape[1])
        first, second = self.pairs
        self.t = z @ self.drivers
        pairs = self.t[:, first] * self.t[:, second]
        # An orthonormal basis of what is fitted: a constant, the drivers, their products.
        self.basis, upper = torch.linalg.qr(torch.cat([torch.ones_like(self.t[:, :1]), self.t, pairs], dim=1))
        slopes = torch.linalg.solve_triangular(upper, self.basis.T @ z, upper=True)
        self.shifts = slopes[1 + drivers.shape[1] :]
        rest = z - pairs @ self.shifts
        self.factor = _root(rest - rest.mean(0))
        self.volume = 2 * float(self.factor.diagonal().log().sum())

    def moved(self, z: Tensor) -> Tensor:
        """A Gauss-Newton step of the drivers towards a smaller volume, ``(P, K)``."""
        size, number = self.drivers.shape
        # What is not fitted, and what every product of a coordinate and a driver adds to it, in its own sd.
        left = z - self.basis @ (self.basis.T @ z)
        white = torch.linalg.solve_triangular(self.factor, left.T, upper=False)  # (P, S)
        shifts = torch.linalg.solve_triangular(self.factor, self.shifts.T, upper=False)  # (P, F)
        first, second = self.pairs
        along = shifts.new_zeros(size, number, number)
        along[:, first, second] += shifts
        along[:, second, first] += shifts
        terms = (z[:, :, None] * self.t[:, None, :]).flatten(1)
        terms = terms - self.basis @ (self.basis.T @ terms)
        # Over draws first, and then over what is moved (p) and the other driver of a product (l, n).
        sums = (white @ terms).unflatten(1, (size, number)).transpose(0, 1).flatten(1)  # j, p l
        slope = sums @ along.transpose(0, 1).flatten(1).T
        inner = (terms.T @ terms).unflatten(1, (size, number)).unflatten(0, (size, number))  # j l m n
        outer = torch.tensordot(along, along, dims=([0], [0]))  # k l o n
        curve = torch.tensordot(inner, outer, dims=([1, 3], [1, 3]))  # j m k o
        curve = curve.transpose(1, 2).reshape(size * number, -1)
        curve = curve + 1e-9 * curve.diagonal().mean() * torch.eye(len(curve)).to(curve)
        return torch.linalg.solve_ex(curve, slope.reshape(-1)).result.reshape(size, number)


def _sharpened(z: Tensor, drivers: Tensor) -> _Straight:
    """Drivers near some that leave the smallest volume: how narrow a ridge becomes tells its direction well."""
    here = _Straight(z, drivers)
    for _ in range(STEPS):
        step = here.moved(z)
        before = here.volume
        for length in (1.0, 0.3, 0.1):
            there = _Straight(z, here.drivers + length * step)
            if there.volume < here.volume:
                here = there
                break
        if not here.volume < before - 1e-3:
            break
    return here


def _candidates(rest: Tensor) -> Tensor:
    """Directions ``(n, P)`` whose squares go along with much of some other, by third moments, which are rough."""
    count, size = rest.shape
    rest = rest - rest.mean(0)
    factor = _root(rest)
    white = torch.linalg.solve_triangular(factor, rest.T, upper=False).T
    squares = (white[:, :, None] * white[:, None, :]).flatten(1)
    third = (white.T @ squares).unflatten(1, (size, size)) / count
    # A direction that is skew stands out with itself too, and does not drive itself.
    others = 1 - torch.eye(size).to(white)
    directions = torch.linalg.eigh(third * others[:, :, None] * others[:, None, :]).eigenvectors
    directions = directions.transpose(1, 2).reshape(-1, size)
    t = white @ directions.T
    square = t.square() - 1
    square = square - (square * t).mean(0) * t
    share = (white.T @ (square / square.square().mean(0).sqrt()) / count).square().sum(0)
    best = share.argsort(descending=True)[:TRIED]
    best = best[share[best] > WORTH]
    return torch.linalg.solve_triangular(factor.T, directions[best].T, upper=True).T


def _root(offset: Tensor) -> Tensor:
    """Triangular root of the covariance of draws about their mean; not a number where there is none."""
    tiny = 1e-12 * torch.eye(offset.shape[1]).to(offset)
    factor, failed = torch.linalg.cholesky_ex(offset.T @ offset / len(offset) + tiny)
    return torch.where(failed == 0, factor, torch.nan)
