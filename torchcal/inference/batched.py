"""Batched sampling: many chains as one tensor program, step size and coordinates adapted across them."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchcal.display import PATIENCE
from torchcal.errors import InterruptionWarning, warn
from torchcal.inference.arrays import arrays_for
from torchcal.inference.coordinates import Laplace, Slopes, Whitened, gathered, starting_points
from torchcal.inference.draws import Draws, most_divergences
from torchcal.inference.kernels import HMC, NUTS, Kernel
from torchcal.inference.warm_up import DualAveraging, warm_up
from torchcal.priors import Bounds

__all__ = ["MOST_ELEMENTS", "run_batched"]

TARGET = {"nuts": 0.65, "hmc": 0.8, "pyro": 0.8}
"""Mean acceptance that the first steps aim at. For No-U-Turn the cost of an effective draw is flat between 0.6 and 0.9
(Betancourt, Byrne & Girolami 2014, arXiv:1411.6669); of the posteriors in ``benchmarks/sampling`` it is lowest at the
lower end. Divergences raise it. Pyro's own is its default."""

_WARM_UP_CHAINS, _FEW_WARM_UP_CHAINS = 64, 16
"""Chains that adapt together: pooled draws make the covariance reliable after a few transitions each. The fewer where
an evaluation of more handles `_WARM_UP_ELEMENTS` numbers, past which its time grows with the chains."""

_WARM_UP_ELEMENTS = 2**17

MOST_ELEMENTS = 2**22
"""Numbers that one evaluation of all chains may handle where the number of chains is ours to choose."""

_REPEATS, _SHORTER = 3, 0.7
"""How often draws with divergences are drawn anew with smaller steps, and these as a share of those before. A higher
mean acceptance would do as well, but where few chains stand at a steep place it takes steps many times shorter."""

_FIRST = 100
"""Draws of a chain after which a first look tells whether they are enough, and whether too many diverged."""

_ENOUGH = 1.05
"""Draws that are taken over those that a wanted sample size seems to need."""

_STUCK = 0.8
"""Where twice the draws leave this much of what was missing, twice in a row, chains stay apart."""


def run_batched(
    log_density: Callable[[Tensor], Tensor],
    transform: Bounds,
    *,
    modes: Sequence[Laplace],
    slopes: Slopes | None = None,
    num_samples: int,
    num_chains: int,
    num_warmup: int,
    seed: int,
    kernel: str = "nuts",
    cost: int = 1,
    target_accept: float | None = None,
    max_tree_depth: int = 10,
    enough: Callable[[Tensor, Tensor], float] | None = None,
    progress: bool = False,
) -> Draws:
    """Draw from a density of unbounded coordinates u.

    Args:
        log_density: ``u (C, P) -> (C,)``, the transform's Jacobian included.
        transform: From u to α.
        slopes: The same density with its gradient, where PyTorch need not find that.
        modes: Normal approximations that chains start from, the best first: its covariance is the first metric.
        num_samples: Draws a chain; the most of them where ``enough`` is given.
        num_chains: Chains.
        num_warmup: Transitions of a chain that are thrown away in the three windows of the warm-up. Finding the length
            of ``"hmc"`` takes about a hundred more, and smaller steps after divergences take a window each.
        seed: Of every random number.
        kernel: ``"nuts"`` or ``"hmc"``.
        cost: Numbers that one evaluation of one chain handles; dear densities warm up with fewer chains.
        target_accept: Mean acceptance that the step size aims at; by default `TARGET`, and more where trajectories
            diverge at the end of the warm-up: a curved ridge needs smaller steps than its width suggests. Where they
            diverge later, draws are drawn anew with smaller steps, up to three times.
        max_tree_depth: Largest depth of a No-U-Turn tree, 2**depth steps.
        enough: From the draws so far, α ``(C, n, P)``, and the mode that each chain began at ``(C,)``, to the factor
            by which there must be more; at most 1 when there are enough.
        progress: Whether to show a bar.

    Raises:
        ConvergenceError: If the density is not finite around a mode.
        KeyboardInterrupt: Before there are draws to keep.
    """
    loc = modes[0].loc
    generator = torch.Generator(device=loc.device).manual_seed(seed)
    arrays = arrays_for(loc.device, seed)
    moves: Kernel = HMC(arrays) if kernel == "hmc" else NUTS(max_tree_depth, arrays)
    most, cheap = max(4, MOST_ELEMENTS // max(1, cost)), max(_FEW_WARM_UP_CHAINS, _WARM_UP_ELEMENTS // max(1, cost))
    crowd = max(num_chains, min(_WARM_UP_CHAINS, most, cheap))
    bar = tqdm(total=num_warmup + num_samples, desc=kernel.upper(), disable=not progress, delay=PATIENCE, leave=False)
    drawn = collector = _Collector(num_chains, loc)
    try:
        space = Whitened(log_density, loc, modes[0].scale_tril, slopes=slopes)
        z, groups = starting_points(space, modes, crowd, generator)
        lowest = space.height(space.inner(torch.stack([mode.loc for mode in modes])))[groups]
        space, z = gathered(space, z, groups, lowest, generator)
        averaging = DualAveraging(math.log(0.5), TARGET[kernel] if target_accept is None else target_accept)
        space, z, averaging = warm_up(
            moves, space, z, groups, num_warmup, averaging, bar, stricter=target_accept is None
        )
        owners, step_size = groups[:num_chains], averaging.settled
        for repeat in range(_REPEATS + 1):
            collector = _Collector(num_chains, loc) if repeat else collector
            state = moves.init(z[:num_chains], space, step_size)
            judge = None if enough is None else lambda draws: enough(_alpha(draws, space, transform), owners)
            last = target_accept is not None or repeat == _REPEATS
            _sample(moves, state, space, step_size, collector, num_samples, judge, bar, whatever=last)
            drawn = collector
            if last or not collector.too_divergent:
                break
            # A lone divergence among thousands escapes the warm-up, which is shorter.
            bar.total += collector.least
            step_size *= _SHORTER
    except KeyboardInterrupt:
        if collector.least >= min(drawn.least, _FIRST):  # those before were given up
            drawn = collector
        if drawn.least < 4:
            raise
        warn(
            f"The sampler was interrupted. It keeps {drawn.least} of {num_samples} draws of each of {num_chains} "
            "chains.",
            InterruptionWarning,
        )
    finally:
        bar.close()
    return Draws(_alpha(drawn.draws, space, transform), drawn.divergences)


def _sample(
    moves: Kernel,
    state: Any,
    space: Whitened,
    step_size: float,
    collector: "_Collector",
    num_samples: int,
    enough: Callable[[np.ndarray], float] | None,
    bar: tqdm,
    *,
    whatever: bool,
) -> None:
    """Draw until there are enough, or as many as asked for; no further where too many diverged, but ``whatever``."""
    goal = min(num_samples, _FIRST)
    before, half, stuck = math.inf, goal, 0
    while True:
        state = collector.collect(moves, state, space, step_size, goal, bar)
        if goal == num_samples or (collector.too_divergent and not whatever):
            return
        if enough is None:
            goal = num_samples
            continue
        more = enough(collector.draws)
        if more <= 1:
            return
        if math.isinf(before):
            before, half = more, goal
        elif goal >= 2 * half:
            stuck = stuck + 1 if more > _STUCK * before else 0
            before, half = more, goal
        if stuck == 2:
            return
        goal = min(num_samples, math.ceil(goal * min(max(_ENOUGH * more, 1.15), 4.0)))


def _alpha(z: np.ndarray, space: Whitened, transform: Bounds) -> Tensor:
    alpha = transform.bound(space.outer(torch.as_tensor(z, device=space.loc.device))).transpose(0, 1)
    return alpha.detach().to(device="cpu", dtype=torch.float64)


class _Collector:
    """Draws of chains that need not be equally far, ``(n, C, P)``; room grows as it is needed.

    What a chain draws while others catch up is kept for later: the draw that ends next after some fixed time would
    more often be one of a long trajectory.
    """

    def __init__(self, chains: int, like: Tensor) -> None:
        self.stored = np.empty((64, chains, len(like)), dtype=like.cpu().numpy().dtype)
        self.filled = np.zeros(chains, dtype=np.int64)
        self.diverged = np.zeros((64, chains), dtype=bool)
        self.least = 0

    def collect(
        self, moves: Kernel, state: Any, space: Whitened, step_size: float, goal: int, bar: tqdm
    ) -> Any:
        """Go on until every chain has ``goal`` draws."""
        while self.least < goal:
            state, outcome = moves.step(state, space, step_size)
            chosen = outcome.done.nonzero()[0]
            if not len(chosen):
                continue
            if int(self.filled.max()) == len(self.stored):
                self.stored = np.concatenate([self.stored, np.empty_like(self.stored)])
                self.diverged = np.concatenate([self.diverged, np.zeros_like(self.diverged)])
            self.stored[self.filled[chosen], chosen] = outcome.position[chosen]
            self.diverged[self.filled[chosen], chosen] = outcome.divergent[chosen]
            self.filled[chosen] += 1
            least = int(self.filled.min())
            bar.update(least - self.least)
            self.least = least
        return state

    @property
    def draws(self) -> np.ndarray:
        """Those that every chain has, ``(n, C, P)``."""
        return self.stored[: self.least]

    @property
    def divergences(self) -> int:
        """How many of them ended a divergent trajectory."""
        return int(self.diverged[: self.least].sum())

    @property
    def too_divergent(self) -> bool:
        """Whether these are more than chance makes of a few."""
        return self.divergences > most_divergences(self.least * len(self.filled))
