"""Intervals of estimates by the profile of χ², where their standard deviations mislead."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import FINISH, MAX_STEPS, Fitted, fit
from torchcal.discovery.fits.local import is_window
from torchcal.discovery.fits.starts import starts
from torchcal.discovery.verdicts.explain import is_open
from torchcal.errors import SimulatorError

__all__ = ["by_profile"]

#: Sd on either side of an estimate that hold 95 % where χ² is a parabola, and how near the root of its rise must come.
SIDES, NEAR = 1.96, 0.03
#: Part of the distance of an end by which the sd must put it elsewhere, to be told; and by the first fits, to go on.
MISLED, PERHAPS = 0.3, 0.15
#: Fits along a parameter, steps of each, and how many times as far away as the one before the next may lie.
FITS, STEPS, STRETCH = 14, 30, 4.0
#: How near the points within and beyond an end lie where the rise jumps between them, as a share of its distance; and
#: points in a row on one side of it, after which the next is the middle.
JUMP, IN_A_ROW = 0.02, 2
#: How many times as far as the farthest point known to be within may that beyond be which stands for an end in the end;
#: and points in a row within it after which it is open.
ROUGH, OPEN = 1.3, 5
#: A rise that is none, and one that is more than any.
TINY, HUGE = 1e-6, 1e3
#: Power of the distance that the rise grows with at least, to be followed: else it is as good as flat.
FLAT = 0.1
#: Share of the distance of a bound that is none.
AT_WALL = 1e-3
#: First guesses that an end is confirmed from.
GUESSES = 6
#: By how much lower in χ² another fit may be, for the estimate to be the best one.
LOWER = 0.1


@dataclass
class _End:
    """One end of an interval, searched for from the estimate outward.

    Attributes:
        sign: −1 below the estimate, 1 above.
        away: Distance from the estimate that is looked at next, in the logarithm of what is fitted in it.
        wall: Of the parameter's bound.
        values: All parameters ``(P,)`` at the farthest point known to be within the interval.
        last: The same at the last point.
        outside: The same at the nearest point known to be beyond the interval.
        rise: Root of the rise of χ² at the last point.
        within: Distance of the farthest point known to be within the interval, with its rise.
        beyond: That of the nearest one known to be beyond it, with its rise.
        in_a_row: How many points on end have been on the side of the last one.
        ended: Whether the distance is where χ² has risen enough, or that of a bound.
    """

    sign: int
    away: float
    wall: float
    values: Tensor
    last: Tensor
    rise: float = math.nan
    within: tuple[float, float] | None = None
    beyond: tuple[float, float] | None = None
    outside: Tensor | None = None
    in_a_row: int = 0
    ended: bool = False

    @property
    def distance(self) -> float | None:
        """Of the end, or somewhat more; infinite where many points are within it and none is known to be beyond, None
        where it was not found."""
        if self.ended:
            return self.wall if self.away > (1 - AT_WALL) * self.wall else self.away
        if self.beyond is None:
            return math.inf if self.in_a_row >= OPEN else None
        return self.beyond[0] if self.nearly else None

    @property
    def nearly(self) -> bool:
        """Whether points within and beyond tell where it is, roughly."""
        return self.within is not None and self.beyond is not None and self.beyond[0] <= ROUGH * self.within[0]

    def see(self, rise: float, values: Tensor) -> None:
        """Take note of the rise at the point that was looked at, and choose the next one."""
        rise, before = min(max(rise, TINY), HUGE), self.within
        self.in_a_row = self.in_a_row + 1 if (rise < SIDES) == (self.rise < SIDES) else 1
        self.rise, self.last = rise, values
        self.ended = abs(rise - SIDES) <= NEAR or (rise < SIDES and self.away >= self.wall)
        here = (self.away, rise)
        if rise < SIDES:
            self.within, self.values = here, values
        else:
            self.beyond, self.outside = here, values
        if self.within is not None and self.beyond is not None:
            low, high = self.within[0], self.beyond[0]
            if high - low <= JUMP * high:
                self.ended, self.away = True, high if high >= (1 - AT_WALL) * self.wall else self.away
            if not self.ended and self.in_a_row >= IN_A_ROW:  # a power does not describe how it rises
                self.away = 0.5 * (low + high)
                return
        if self.ended:
            return
        other = self.beyond if rise < SIDES else self.within
        other = before if other is None or other == here else other
        self.away = min(_reached(here, other), self.wall)


def _reached(here: tuple[float, float], other: tuple[float, float] | None) -> float:
    """Distance at which the rise is enough, if it grows as the power of it that two points tell; or in proportion.

    >>> round(_reached((1.0, 0.98), None), 3), round(_reached((1.0, 0.49), (2.0, 1.96 / 2)), 3)
    (2.0, 4.0)
    """
    away, rise = here
    power = 1.0 if other is None or other[0] == away else math.log(rise / other[1]) / math.log(away / other[0])
    if power < FLAT:
        return away * (STRETCH if rise < SIDES else 1 / STRETCH)
    return away * min(max((SIDES / rise) ** (1 / power), 1 / STRETCH), STRETCH)


def by_profile(
    found: Fitted, places: Sequence[int], stopped: Callable[[], bool] = lambda: False
) -> dict[int, tuple[float, float]]:
    """95 % intervals of the estimates that their sd mislead about, by their places.

    An end is where χ², all else fitted again, has first risen by 1.96² (the profile likelihood; Venzon & Moolgavkar
    1988, Applied Statistics 37, 87), or a bound before that, or infinite where it does not rise so far. Left out are
    what lies at a bound, ends of windows, what the data leave wholly open, intervals that ``value ± 1.96 sd`` tells as
    well, and those of which an end is not found, or of which another fit is better.

    Args:
        found: The fit.
        places: Of the parameters that are asked for.
        stopped: Whether to make no more of them.
    """
    sd = found.sd()
    stuck = {i for i, at in zip(found.free, found.at_bound.tolist(), strict=True) if at}
    result = {}
    for i in places:
        left_out = i not in found.free or i in stuck or is_window(found.problem.parameters[i].name)
        if left_out or not 0 < float(sd[i]) < math.inf or is_open(found, i, float(sd[i])):
            continue
        try:
            ends = None if stopped() else _ends(found, i, float(sd[i]))
        except SimulatorError:  # a function may raise so far from the estimate
            continue
        if ends is not None and _misleads(found, i, float(sd[i]), ends, MISLED) and any(map(math.isfinite, ends)):
            result[i] = ends
    return result


def _misleads(found: Fitted, i: int, sd: float, ends: tuple[float, float], share: float) -> bool:
    """Whether an end is not where the sd puts it, within the bounds."""
    q, value, usual = found.problem.parameters[i], float(found.values[i]), SIDES * sd
    low = max(value - usual, -math.inf if q.low is None else q.low)
    high = min(value + usual, math.inf if q.high is None else q.high)
    return any(abs(end - by_sd) > share * abs(by_sd - value) for end, by_sd in zip(ends, (low, high), strict=True))


def _ends(found: Fitted, i: int, sd: float) -> tuple[float, float] | None:
    """Where χ² has risen enough on both sides; None where that is as the sd says, or cannot be found out."""
    q, value = found.problem.parameters[i], float(found.values[i])
    log = q.transform == "log"
    unit = sd / value if log else sd
    below = math.inf if q.low is None or (log and q.low <= 0) else math.log(value / q.low) if log else value - q.low
    above = math.inf if q.high is None else math.log(q.high / value) if log else q.high - value
    walls, best = ((-1, below), (1, above)), found.values
    both = [_End(sign, min(SIDES * unit, wall), wall, best, best) for sign, wall in walls]
    for number in range(FITS):
        todo = [end for end in both if not end.ended]
        if not todo:
            break
        if not _look(found, i, todo, [_at(value, end.sign * end.away, log) for end in todo]):
            return None
        low, high = (_at(value, end.sign * end.away, log) for end in both)
        if number == 0 and not _misleads(found, i, sd, (low, high), PERHAPS):
            return None
    for end in both:
        if not end.ended and end.nearly:
            _confirm(found, i, end)
    low_at, high_at = (end.distance for end in both)
    return None if low_at is None or high_at is None else (_at(value, -low_at, log), _at(value, high_at, log))


def _confirm(found: Fitted, i: int, end: _End) -> None:
    """Look once more where χ² seems to have risen enough, from first guesses too, and in as many steps as it takes:
    there may be another valley, and along a bent one steps are short. What is refuted is beyond no more."""
    values, away = end.last, end.away
    if end.rise < SIDES - NEAR and end.beyond is not None and end.outside is not None:
        values, away = end.outside, end.beyond[0]
    held = {k: float(value) for k, value in enumerate(values) if k == i or k not in found.free}
    again = _fitted(found, i, torch.cat([values[None], starts(found.problem, GUESSES, 0, held)]))
    if again is not None and (rise := math.sqrt(max(again.chi2 - found.chi2, 0.0))) < SIDES - NEAR:
        end.away, end.beyond, end.in_a_row = away, None, 0
        end.see(rise, again.values)


def _at(value: float, away: float, log: bool) -> float:
    return value * math.exp(away) if log else value + away


def _look(found: Fitted, i: int, ends: Sequence[_End], points: Sequence[float]) -> bool:
    """Fit all else at a point of each end, from the best fit and from the farthest point within; whether that is no
    better fit."""
    begun, slope = [], _slope(found, i)
    for end, point in zip(ends, points, strict=True):
        begun += [_moved(found, values, slope, i, point) for values in (found.values, end.values)]
        begun.append(end.values.index_fill(0, torch.tensor(i), point))
    again = _fitted(found, i, torch.stack(begun), max_steps=STEPS, finish=0)
    for end, point in zip(ends, points, strict=True):
        chi2, values = math.inf, end.values
        if again is not None and again.ends is not None and again.ends_chi2 is not None:
            here = again.ends_chi2.where(again.ends[:, i] == point, torch.inf)
            chi2, values = float(here.min()), again.ends[here.argmin()]
        if chi2 < found.chi2 - LOWER:
            return False
        end.see(math.sqrt(max(chi2 - found.chi2, 0.0)), values)
        if end.ended and (end.rise >= SIDES - NEAR or end.beyond is not None):
            _confirm(found, i, end)
    return True


def _fitted(
    found: Fitted, i: int, rows: Tensor, max_steps: int = MAX_STEPS, finish: int = FINISH
) -> Fitted | None:
    """All else than one parameter fitted from rows of values ``(H, P)``."""
    warm = None if found.warm is None else found.warm.rows(torch.zeros(len(rows), dtype=torch.long))
    free = [k for k in found.free if k != i]
    return fit(found.problem, found.whitening, rows, free, warm=warm, max_steps=max_steps, finish=finish)


def _slope(found: Fitted, i: int) -> Tensor:
    """How all parameters go with one at the best fit, ``(P,)``."""
    covariance, at = found.covariance(), found.free.index(i)
    slope = torch.zeros_like(found.values)
    slope[found.free] = covariance[:, at] / covariance[at, at]
    return slope


def _moved(found: Fitted, values: Tensor, slope: Tensor, i: int, to: float) -> Tensor:
    """Parameters with one elsewhere, the others moved as they go with it, where they can."""
    moved = values + slope * (to - values[i])
    log = torch.tensor([q.transform == "log" for q in found.problem.parameters], dtype=torch.bool)
    moved = torch.where(log & (moved <= 0), values, moved)
    moved[i] = to
    return moved
