"""Intervals of estimates by the profile of χ², where their standard deviations mislead."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted, fit
from torchcal.discovery.fits.local import is_window

__all__ = ["by_profile"]

#: Sd on either side of an estimate that hold 95 % where χ² is a parabola, and how near the root of its rise must come.
SIDES, NEAR = 1.96, 0.03
#: Part of that by which an end must lie elsewhere than the sd puts it, to be told.
MISLED = 0.3
#: Fits along a parameter, steps of each, and how many times as far away as the one before the next may lie.
FITS, STEPS, STRETCH = 8, 30, 4.0
#: A rise that is none.
TINY = 1e-6


@dataclass
class _End:
    """One end of an interval, searched for from the estimate outward.

    Attributes:
        sign: −1 below the estimate, 1 above.
        away: Distance from the estimate, in the logarithm of what is fitted in it.
        wall: Of the parameter's bound.
        values: All parameters ``(P,)`` at the last point that was fitted.
        rise: Root of the rise of χ² there.
        within: Largest distance known to be within the interval, with its rise.
        beyond: Smallest one known to be beyond it, with its rise.
    """

    sign: int
    away: float
    wall: float
    values: Tensor
    rise: float = math.nan
    within: tuple[float, float] | None = None
    beyond: tuple[float, float] | None = None

    @property
    def ended(self) -> bool:
        """Whether it is where χ² has risen enough, or on a bound."""
        return abs(self.rise - SIDES) <= NEAR or (self.rise < SIDES and self.away >= self.wall)

    @property
    def found(self) -> float:
        """Its distance, or what it will be next; infinite where nothing is known to be beyond it."""
        return self.away if self.ended or self.beyond is not None else math.inf

    def see(self, rise: float, values: Tensor) -> None:
        """Take note of the rise, and go where it should be enough, if it grows as a power of the distance."""
        before, self.rise, self.values = self.within, max(rise, TINY), values
        if self.ended:
            return
        if self.rise < SIDES:
            self.within = (self.away, self.rise)
        else:
            self.beyond = (self.away, self.rise)
        others = (self.within if self.rise >= SIDES else self.beyond, before)
        other = next((pair for pair in others if pair is not None and pair[0] != self.away), None)
        power = 1.0 if other is None else math.log(self.rise / other[1]) / math.log(self.away / other[0])
        times = (SIDES / self.rise) ** (1 / power) if power > 1 / FITS else math.copysign(math.inf, SIDES - self.rise)
        self.away = min(self.away * min(max(times, 1 / STRETCH), STRETCH), self.wall)


def by_profile(found: Fitted, places: Sequence[int]) -> dict[int, tuple[float, float]]:
    """95 % intervals of the estimates that their sd mislead about, by their places.

    The ends are where χ², all else fitted again, has risen by 1.96² (the profile likelihood; Venzon & Moolgavkar 1988,
    Applied Statistics 37, 87), or a bound, or infinite where it does not rise so far. What the data leave open, what
    lies at a bound, and ends of windows are left out, and so are intervals that ``value ± 1.96 sd`` tells as well.

    Args:
        found: The fit.
        places: Of the parameters that are asked for.
    """
    sd = found.sd()
    stuck = {i for i, at in zip(found.free, found.at_bound.tolist(), strict=True) if at}
    result = {}
    for i in places:
        q, value = found.problem.parameters[i], float(found.values[i])
        if i not in found.free or i in stuck or is_window(q.name) or not 0 < float(sd[i]) < 1e5 * abs(value):
            continue
        ends = _ends(found, i, float(sd[i]))
        if ends is None:
            continue
        if _misleads(found, i, float(sd[i]), ends, MISLED) and any(map(math.isfinite, ends)):
            result[i] = ends
    return result


def _misleads(found: Fitted, i: int, sd: float, ends: tuple[float, float], share: float) -> bool:
    """Whether an end is not where the sd puts it."""
    q, value, usual = found.problem.parameters[i], float(found.values[i]), SIDES * sd
    low = max(value - usual, -math.inf if q.low is None else q.low)
    high = min(value + usual, math.inf if q.high is None else q.high)
    return max(abs(ends[0] - low), abs(ends[1] - high)) > share * usual


def _ends(found: Fitted, i: int, sd: float) -> tuple[float, float] | None:
    """Where χ² has risen enough on both sides; None where that is as the sd says, or cannot be found out."""
    q, value = found.problem.parameters[i], float(found.values[i])
    log = q.transform == "log"
    unit = sd / value if log else sd
    below = math.inf if q.low is None or (log and q.low <= 0) else math.log(value / q.low) if log else value - q.low
    above = math.inf if q.high is None else math.log(q.high / value) if log else q.high - value
    both = [_End(sign, min(SIDES * unit, wall), wall, found.values) for sign, wall in ((-1, below), (1, above))]
    free = [k for k in found.free if k != i]
    for number in range(FITS):
        todo = [end for end in both if not end.ended]
        if not todo:
            break
        begun = [_moved(found, end.values, i, _at(value, end.sign * end.away, log)) for end in todo]
        fitted = _fitted(found, torch.stack(begun), free)
        if fitted is None:
            return None
        for end, values, rise in zip(todo, *fitted, strict=True):
            end.see(rise, values)
        low, high = (_at(value, end.sign * end.found, log) for end in both)
        if number == 0 and not _misleads(found, i, sd, (low, high), MISLED / 2):
            return None
    return low, high


def _at(value: float, away: float, log: bool) -> float:
    return value * math.exp(away) if log else value + away


def _moved(found: Fitted, values: Tensor, i: int, to: float) -> Tensor:
    """Parameters with one elsewhere, the others moved as they go with it at the best fit, where they can."""
    covariance, at = found.covariance(), found.free.index(i)
    moved = values.clone()
    moved[found.free] += covariance[:, at] / covariance[at, at] * (to - values[i])
    log = torch.tensor([q.transform == "log" for q in found.problem.parameters], dtype=torch.bool)
    moved = torch.where(log & (moved <= 0), values, moved)
    moved[i] = to
    return moved


def _fitted(found: Fitted, rows: Tensor, free: list[int]) -> tuple[Tensor, list[float]] | None:
    """Every row fitted in the others, and the roots of the rise of χ²; None where one cannot be."""
    warm = None if found.warm is None else found.warm.rows(torch.zeros(len(rows), dtype=torch.long))
    again = fit(found.problem, found.whitening, rows, free, warm=warm, max_steps=STEPS, finish=0)
    if again is None or again.ends is None or again.ends_chi2 is None or len(again.ends) < len(rows):
        return None
    return again.ends, (again.ends_chi2 - found.chi2).clamp_min(0).sqrt().tolist()
