"""What data at identical conditions, or at one value of a condition, tell of the noise, whatever the misfit."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem, remembered

__all__ = ["Replicates", "goes_on_along", "in_common_at", "replicates"]

#: Difference of replicates, in the size of the data, up to which they agree.
ROUNDING = 1e-12
#: Degrees of freedom of every output at least; and how many conditions noise with memory is told beside at most.
FEWEST, MOST = 3, 1024
#: Values of a condition at which data may have something in common; how many times what they differ by that is; share
#: of its square that is shared from value to value up to which it is in no order; its probability by chance; and
#: points at which the tail of that is taken.
GROUPS, LARGER, SLOW, SHARED, TAIL = 8, 1.5, 0.4, 0.005, 2001
#: Correlation of neighbours along a condition, in sd, from which on they go on; and data at each value of another one
#: at least, on average, for those to be looked at one by one.
TOGETHER, EACH = 3.3, 5


@dataclass(frozen=True)
class Replicates:
    """Data of one output that are not alone at their conditions.

    Attributes:
        places: Of these, among the used data.
        group: Number of the conditions of each, from 0 on.
        off: How far each is from the mean of its conditions.
        share: Variance of that, in the variance of independent noise.
    """

    places: Tensor
    group: Tensor
    off: Tensor
    share: Tensor

    @classmethod
    def of(cls, problem: Problem, places: Tensor) -> "Replicates":
        """Those among the used data of an output at ``places``."""
        level = problem.levels[1][problem.condition_of[places]]
        places = places[torch.bincount(level)[level] > 1]
        _, group = problem.levels[1][problem.condition_of[places]].unique(return_inverse=True)
        count = torch.bincount(group).double()
        mean = torch.zeros_like(count).index_add_(0, group, problem.y[places]) / count
        return cls(places, group, problem.y[places] - mean[group], (1 - 1 / count)[group])

    @property
    def means(self) -> int:
        """Number of conditions."""
        return int(self.group.max()) + 1 if len(self.group) else 0

    @property
    def freedom(self) -> int:
        """Degrees of freedom."""
        return len(self.places) - self.means

    @property
    def even(self) -> Tensor:
        """How far each is from its mean, in what has the variance of independent noise."""
        return self.off / self.share.sqrt()

    def beyond_means(self, columns: Tensor) -> Tensor:
        """Columns ``(n, k)`` at the replicates, off their means at the conditions."""
        sums = torch.zeros(self.means, columns.shape[1], dtype=torch.float64).index_add_(0, self.group, columns)
        return columns - (sums / torch.bincount(self.group)[:, None])[self.group]

    def sd(self, problem: Problem, unit: Tensor) -> float:
        """Sd of independent noise, in a unit ``(n_total,)`` that is the same at identical conditions."""
        e = self.off / unit[problem.index[self.places]]
        return math.sqrt(float(e.square().sum()) / max(self.freedom, 1))

    def memory(self, problem: Problem, unit: Tensor, grid: Tensor) -> tuple[Tensor, Tensor] | None:
        """Restricted log-likelihood of AR(1) coefficients, up to a constant, and the noise sd in the unit with each,
        ``(grid,)`` both; None beside more conditions than `MOST`, and where replicates are sorted by what was read.

        Noise goes on from row to row; the mean of all conditions is free. Replicates side by side are less unlike than
        such noise is large.
        """
        after, before = self.group[1:], self.group[:-1]
        steps = self.off.diff()[after == before]
        if self.means > MOST or (len(steps) and bool((steps >= 0).all() | (steps <= 0).all())):
            return None
        e, same = self.off / unit[problem.index[self.places]], self.group * (self.means + 1)
        logs, sizes = [], []
        for r in remembered(grid, problem.gaps(self.places)).unbind(-1):
            new, old = (1 - r.square()).rsqrt(), r * (1 - r.square()).rsqrt()  # of a datum, and of the one before it
            first, rest = e[:1], new * e[1:] - old * e[:-1]
            # Whitened indicators of the conditions, multiplied with one another and with the data.
            gram = torch.zeros(self.means**2, dtype=torch.float64)
            gram.index_add_(0, same, torch.cat([torch.ones(1, dtype=torch.float64), new.square()]))
            gram.index_add_(0, same[:-1], old.square())
            gram.index_add_(0, after * self.means + before, -new * old)
            gram.index_add_(0, before * self.means + after, -new * old)
            shown = torch.zeros(self.means, dtype=torch.float64)
            shown.index_add_(0, self.group, torch.cat([first, new * rest])).index_add_(0, before, -old * rest)
            factor = torch.linalg.cholesky(gram.reshape(self.means, self.means))
            taken = torch.linalg.solve_triangular(factor, shown[:, None], upper=False).square().sum()
            square = (first.square().sum() + rest.square().sum() - taken).clamp_min(1e-300)
            log_det = 0.5 * torch.log1p(-r.square()).sum() + factor.diagonal().log().sum()
            logs.append(-0.5 * self.freedom * square.log() - log_det)
            sizes.append((square / self.freedom).sqrt())
        return torch.stack(logs), torch.stack(sizes)


def replicates(problem: Problem) -> list[Replicates] | None:
    """Replicates of every output; None without any, or with too few of one."""
    levels, group = problem.levels
    if problem.in_time or len(levels) == len(group):
        return None
    outputs = range(len(problem.recording.outputs))
    found = [Replicates.of(problem, (problem.output_of == output).nonzero()[:, 0]) for output in outputs]
    if not any(bool((one.off.abs() > ROUNDING * problem.recording.y.nan_to_num().abs().max()).any()) for one in found):
        return None  # what always agrees, as coarse readings do, tells nothing of the noise
    return found if min(one.freedom for one in found) >= FEWEST else None


def in_common_at(problem: Problem, standard: Tensor) -> list[tuple[str, str, float]]:
    """Outputs, and conditions at whose values residuals ``(n,)``, in noise sd, have something in common, whatever the
    other conditions are, but in no order; and how many times it is what they differ by. Noise of each datum has not."""
    found: list[tuple[str, str, float]] = []
    conditions, outputs = problem.recording.x, problem.recording.outputs
    if problem.in_time or not isinstance(conditions, dict) or len(conditions) < 2:
        return found
    for number, name in enumerate(outputs):
        mine = problem.output_of == number
        left, n = standard[mine], int(mine.sum())
        for condition, values in conditions.items():
            _, which, count = values[problem.condition_of[mine]].unique(return_inverse=True, return_counts=True)
            groups = len(count)
            if groups < GROUPS or n < 2 * groups or len(problem.levels[0]) < 2 * groups:
                continue
            mean = torch.zeros(groups, dtype=torch.float64).index_add_(0, which, left) / count.sqrt()
            between, whole = float(mean.square().sum()), float(left.square().sum())
            size = math.sqrt(between / groups / max((whole - between) / (n - groups), 1e-300))
            slow = float(mean[1:] @ mean[:-1]) >= SLOW * between
            often = len(outputs) * len(conditions)
            if size > LARGER and not slow and _by_chance(between / whole, groups, n - groups) * often < SHARED:
                found.append((name, condition, size))
    return found


def goes_on_along(problem: Problem, standard: Tensor) -> list[tuple[str, str]]:
    """Outputs, and conditions of several along which residuals ``(n,)`` go on from each value to the next, whatever the
    other conditions are, or at each of the few values of another one. Noise of each datum does not."""
    conditions, outputs = problem.recording.x, problem.recording.outputs
    if problem.in_time or not isinstance(conditions, dict) or len(conditions) < 2:
        return []
    found = []
    for number, name in enumerate(outputs):
        mine = (problem.output_of == number).nonzero()[:, 0]
        e, n = standard[mine], len(mine)
        columns = {each: values[problem.condition_of[mine]].unique(return_inverse=True)[1]
                   for each, values in conditions.items()}  # fmt: skip
        count = {each: int(which.max()) + 1 if n else 0 for each, which in columns.items()}
        for along, which in columns.items():
            if count[along] < GROUPS:
                continue
            if _goes_on(e, which):
                found.append((name, along))
                continue
            few = [other for other in columns if other != along and 1 < count[other] <= n / EACH]
            found += [(name, f"{along} at each {other}") for other in few if _goes_on(e, which, columns[other])][:1]
    return found


def _goes_on(e: Tensor, which: Tensor, group: Tensor | None = None) -> bool:
    """Whether residuals ``(n,)`` go on from each of their numbered values to the next; in each group, off its mean,
    where there are some."""
    left, values, at = e, int(which.max()) + 1, which
    if group is not None:
        sums = torch.zeros(int(group.max()) + 1, dtype=torch.float64).index_add_(0, group, e)
        left, at = e - (sums / torch.bincount(group))[group], group * values + which
    places, place = at.unique(return_inverse=True)
    mean = torch.zeros(len(places), dtype=torch.float64).index_add_(0, place, left) / torch.bincount(place).sqrt()
    beside = places[1:] // values == places[:-1] // values
    size = float(mean.square().sum()) + ROUNDING * float(e.square().sum())
    together = float((mean[1:] * mean[:-1])[beside].sum()) / max(size, 1e-300)
    return int(beside.sum()) >= GROUPS - 1 and together * len(places) / math.sqrt(int(beside.sum()) + 1) > TOGETHER


def _by_chance(share: float, one: int, other: int) -> float:
    """Probability of so large a share of a sum of squares for one of two sums of as many squares of white noise: the
    tail of a beta distribution."""
    a, b = 0.5 * one, 0.5 * other
    t = torch.linspace(min(share, 1 - 1e-9), 1.0, TAIL, dtype=torch.float64)[:-1]
    scale = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    return float(torch.trapezoid((scale + (a - 1) * t.log() + (b - 1) * (1 - t).log()).exp(), t))
