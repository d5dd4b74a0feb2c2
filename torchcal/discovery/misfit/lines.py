"""Oscillations in what is left: faster than smooth functions follow, and no noise that a coefficient describes.

A line in the spectrum is neither smooth nor correlated noise. What is left of an output is compared, whitened, with a
wave of unknown size and phase in every run, at each of the frequencies that the smooth functions are too few for.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.misfit.channels import Channel
from torchcal.discovery.misfit.residual import Residual

__all__ = ["Lines", "lines_of"]

#: Fewest data of an output, and of a run of it, in which a line is sought.
LEAST, LEAST_RUN = 24, 8
#: Steps of the grid in a gap between data where gaps are uneven, and how far from whole multiples even ones may be.
FINER, EVEN = 4, 0.02
#: Cells of the grid for each datum beyond which the data are too uneven for it.
MOST_CELLS = 16
#: Waves that smooth functions follow, for each function, in one run; in several, where phases differ and they follow
#: none, the fewest of the longest run; and the share of the fastest that data can show.
FOLLOWED, FEWEST, FASTEST = 0.25, 1.5, 0.98
#: Frequencies to each side of the likeliest of the grid that are tried within half a step of it.
NEAR = 16
#: Quantisation step, in noise sd, from which on rounding makes lines of its own.
COARSE = 1.7
#: Simulated residuals that are transformed at a time, times cells.
NUMBERS = 2**22


@dataclass(frozen=True, eq=False)
class Lines:
    """Waves of one output at the frequencies of a grid.

    Attributes:
        channel: The output.
        driver: Along what: time, or the condition that they were recorded along.
        along: That, at every datum, ``(n,)``.
        parts: Places of the data of every run, and their cells on the grid.
        size: Cells, with as many empty ones behind.
        first: The slowest frequency, by its number.
        last: One more than the fastest's.
        step: Width of a cell.
    """

    channel: Channel
    driver: str
    along: Tensor
    parts: list[tuple[Tensor, Tensor]]
    size: int
    first: int
    last: int
    step: float

    @classmethod
    def of(cls, problem: Problem, channel: Channel, functions: int) -> "Lines | None":
        """Of an output; None where its data follow in nothing, or are too few or too uneven.

        Args:
            problem: The used data.
            channel: Of kind ``"output"``.
            functions: How many smooth functions are tried along what its data follow in.
        """
        if problem.clock is None:
            return None
        number = problem.recording.outputs.index(channel.target)
        driver, clock = problem.clock
        along = clock[problem.condition_of]
        runs = [p for p in problem.sequences if int(problem.output_of[p[0]]) == number and len(p) >= LEAST_RUN]
        runs = [places[along[places].argsort(stable=True)] for places in runs]
        gaps = [along[places].diff() for places in runs]
        moving = torch.cat([gap[gap > 0] for gap in gaps]) if gaps else torch.zeros(0)
        count = sum(len(places) for places in runs)
        if count < LEAST or len(moving) < LEAST // 2:
            return None
        usual = float(moving.median())
        multiple = moving / usual
        step = usual if float((multiple - multiple.round()).abs().max()) < EVEN else usual / FINER
        span = max(float(gap.sum()) for gap in gaps)
        cells = round(span / step) + 1
        if cells > MOST_CELLS * count:
            return None
        parts = [(p, ((along[p] - along[p[0]]) / step).round().long()) for p in runs]
        size = 2 * cells
        slowest = FOLLOWED * functions if len(runs) == 1 else FEWEST
        first = max(math.ceil(slowest * size * step / span), 1)
        last = math.floor(FASTEST * 0.5 / usual * size * step) + 1
        return None if last <= first else cls(channel, driver, along, parts, size, first, last, step)

    @property
    def frequencies(self) -> Tensor:
        """Of all waves, ``(F,)``."""
        return torch.arange(self.first, self.last, dtype=torch.float64) / (self.size * self.step)

    def evidence(self, residuals: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
        """Log evidence of a wave against none, with all frequencies and sizes as likely, in each column ``(B,)``.

        Also returns the likeliest frequency's number in the first column.

        Args:
            residuals: Whitened, ``(n, B)``.
            sizes: That are tried, in noise sd.
        """
        found: list[Tensor] = []
        for block in residuals.split(max(1, NUMBERS // self.size), dim=1):
            logs = torch.full((), -math.inf, dtype=torch.float64)
            seen = self._seen(block)
            for size in sizes.tolist():
                logs = torch.logaddexp(logs, self._log(size, seen))
            if not found:
                best = logs[:, 0].argmax()
            found.append(logs.logsumexp(0))
        return torch.cat(found) - math.log(len(sizes) * (self.last - self.first)), best

    def evidence_of(self, residual: Residual, number: Tensor, sizes: Tensor) -> float:
        """Log evidence of a wave of about one frequency, out of all that are as likely."""
        logs = self._near(number, residual.e[:, None], sizes)[0]
        return float(logs.logsumexp((0, 1))) - math.log(logs.numel() * (self.last - self.first))

    def wave(self, values: Tensor, whitened: Tensor, number: Tensor, sizes: Tensor) -> tuple[Tensor, float, float]:
        """The likeliest wave of about one frequency in the residual ``(n,)``, the χ² that it removes, and its
        frequency: many waves tell that better than the grid has it.

        Args:
            values: The residual.
            whitened: The same, whitened.
            number: Of the frequency.
            sizes: That are tried.
        """
        both = torch.stack([whitened, values], dim=-1)
        logs, found = self._near(number, both, sizes)
        size, best = divmod(int(logs.argmax()), logs.shape[1])
        profile, removed = torch.zeros_like(values), 0.0
        prior = self._variance(float(sizes[size]))
        for (places, _), (design, gram, products) in zip(self.parts, found, strict=True):
            inner = gram[best] + torch.eye(2, dtype=torch.float64) / prior
            fitted, profile[places] = (design[best] @ torch.linalg.solve(inner, products[best])).unbind(-1)
            removed += float(2 * whitened[places] @ fitted - fitted @ fitted)
        return profile, removed, float(self._around(number)[best])

    def _around(self, number: Tensor) -> Tensor:
        """Frequencies within half a step of one of the grid, ``(m,)``."""
        return self.frequencies[number] + torch.linspace(-0.5, 0.5, 2 * NEAR + 1, dtype=torch.float64) / (
            self.size * self.step
        )

    def _near(
        self, number: Tensor, residuals: Tensor, sizes: Tensor
    ) -> tuple[Tensor, list[tuple[Tensor, Tensor, Tensor]]]:
        """Log evidence of waves around one frequency of the grid against none, in the first column of residuals
        ``(n, B)``, ``(sizes, m)``; and of every run the waves ``(m, data, 2)`` and their products with themselves and
        with the residuals, ``(m, 2, 2)`` and ``(m, 2, B)``."""
        near, one = self._around(number), torch.eye(2, dtype=torch.float64)
        prior = torch.tensor([self._variance(size) for size in sizes.tolist()], dtype=torch.float64)
        prior = prior[:, None, None, None]
        logs, found = torch.zeros(len(sizes), len(near), dtype=torch.float64), []
        for places, _ in self.parts:
            angle = 2 * math.pi * near[:, None] * self.along[places]
            design = torch.stack([angle.cos(), angle.sin()], dim=-1)
            gram, products = design.mT @ design, design.mT @ residuals[places]
            inner = one + prior * gram  # (sizes, frequencies, 2, 2)
            first = products[..., :1]
            gain = (first * torch.linalg.solve(inner, prior * first)).sum((2, 3))
            logs += 0.5 * (gain - torch.logdet(inner))
            found.append((design, gram, products))
        return logs, found

    def sd(self, sd: Tensor) -> Tensor:
        """Of a wave at every datum ``(n,)``, r.m.s. over its run, for noise of some sd ``(n,)``.

        Infinite where none is sought.
        """
        found = torch.full_like(sd, math.inf)
        for places, _ in self.parts:
            found[places] = sd[places] * math.sqrt(2.0 / len(places))
        return found

    def _log(self, size: float, seen: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
        """Log evidence of a wave of some size, by what every run shows of it."""
        prior = self._variance(size)
        terms = [0.5 * (prior * squares / (1 + prior * norms) - torch.log1p(prior * norms)) for norms, squares in seen]
        return torch.stack(terms).sum((0, 1))

    def _variance(self, size: float) -> float:
        """Prior variance of the amplitudes of a wave's cosine and sine."""
        return 2 * size**2 / sum(len(places) for places, _ in self.parts)

    def _seen(self, residuals: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Of each run, squared norms of a cosine and a sine, ``(2, F, 1)``, and the squares of their products with
        residuals, ``(2, F, B)``, for each frequency."""
        found = []
        for (places, cells), (norms, turn) in zip(self.parts, self._norms, strict=True):
            turned = turn * self._transformed(cells, residuals[places])
            found.append((norms, torch.stack([turned.real.square(), turned.imag.square()])))
        return found

    @functools.cached_property
    def _norms(self) -> list[tuple[Tensor, Tensor]]:
        r"""Of each run, squared norms of a cosine and a sine, ``(2, F, 1)``, and what turns to them, ``(F, 1)``.

        Uneven data weigh the two unlike: their phase is the one at which they are orthogonal,
        :math:`2\psi = \arg \sum_j e^{2 i \theta_j}` (Lomb 1976, Astrophysics and Space Science 39, 447-462).
        """
        found = []
        for places, cells in self.parts:
            double = self._transformed(2 * cells, torch.ones(len(cells), 1, dtype=torch.float64))
            norms = torch.stack([len(places) + double.abs(), (len(places) - double.abs()).clamp_min(0)]) / 2
            found.append((norms, torch.polar(torch.ones_like(double.real), -0.5 * double.angle())))
        return found

    def _transformed(self, cells: Tensor, values: Tensor) -> Tensor:
        r"""Sums of values times :math:`e^{-i \theta}` at their cells, ``(F, B)``."""
        grid = torch.zeros(self.size, values.shape[1], dtype=torch.float64).index_add_(0, cells, values)
        return torch.fft.rfft(grid, dim=0)[self.first : self.last]


def lines_of(
    problem: Problem,
    available: Sequence[Channel],
    step: Mapping[str, float],
    sd: Tensor,
    functions: Callable[[int, str], int],
) -> list[Lines]:
    """Of all outputs but those that are recorded in steps as large as their noise.

    Args:
        problem: The used data.
        available: All channels, of which outputs are taken.
        step: Of quantised outputs.
        sd: Of the used data, ``(n,)``.
        functions: How many smooth functions are tried along what data follow in, by the number of data and its name.
    """
    found: list[Lines] = []
    if problem.clock is None:
        return found
    for channel in available:
        if channel.kind != "output":
            continue
        mine = channel.matrix != 0
        if step.get(channel.target, 0.0) > COARSE * float(sd[mine].median() if bool(mine.any()) else math.inf):
            continue
        lines = Lines.of(problem, channel, functions(int(mine.sum()), problem.clock[0]))
        if lines is not None:
            found.append(lines)
    return found
