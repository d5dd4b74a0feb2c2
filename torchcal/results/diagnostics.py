"""What is known about how far a calibration can be trusted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from torchcal.propagation import PropagationCheck

__all__ = [
    "ESS_THRESHOLD",
    "R_HAT_THRESHOLD",
    "Diagnostics",
    "Mode",
    "Quality",
    "ess_threshold",
    "r_hat_threshold",
    "table",
]

R_HAT_THRESHOLD = 1.01
"""Largest R-hat that passes for chains of 400 draws or more (Vehtari et al. 2021)."""

ESS_THRESHOLD = 400.0
"""Smallest effective sample size that passes: 100 a chain for four chains (Vehtari et al. 2021). Fewer draws than
four times that are held to a quarter of their number."""

R_HAT_MOST, ESS_LEAST = 1.05, 100.0
"""What passes for no chains, however short: less is too little to tell whether they have met."""


@dataclass(frozen=True)
class Quality:
    """Convergence of one quantity.

    Attributes:
        r_hat: Rank-normalised split R-hat.
        ess_bulk: Effective sample size of the centre.
        ess_tail: Effective sample size of the tails.
    """

    r_hat: float
    ess_bulk: float
    ess_tail: float


@dataclass(frozen=True)
class Mode:
    """A maximum of the posterior.

    Attributes:
        alpha: Where it is.
        objective: Negative log-posterior there.
        weight: Its share of the posterior, by the normal approximations at all of them.
        started: Whether chains began there. At one of little weight a single chain would be too many.
    """

    alpha: tuple[float, ...]
    objective: float
    weight: float
    started: bool = True


@dataclass(frozen=True, repr=False)
class Diagnostics:
    """Convergence of optimiser, propagation and chains.

    Attributes:
        alpha: Quality of every α by name, germ signs folded.
        parameters: Quality of E[λ] and Cov[λ] by name, which no sign touches.
        divergences: Number of divergent transitions.
        null_directions: Unit vectors in α that the data do not see, ``(k, P)``.
        starts: Number of optimiser starts.
        agreeing: Number of them that reached the best objective.
        ties: Number of different densities of λ that reach it; more than one where model and data have a symmetry.
        propagation: How far quadrature and expansion have converged at the MAP.
        model_error_variance: E[σ²], mean over the data (Eq. 32); of several outputs in units of each one's spread.
        posterior_variance: V[μ], in the same way; NaN without draws.
        map_variance: σ² at the MAP, in the same way.
        converged: Whether every figure is within its threshold; None without draws.
        problems: What is not, in words.
        modes: Separate maxima that were found, the best first; empty without draws.
    """

    alpha: Mapping[str, Quality]
    parameters: Mapping[str, Quality]
    divergences: int
    null_directions: Tensor
    starts: int
    agreeing: int
    ties: int
    propagation: PropagationCheck | None
    model_error_variance: float
    posterior_variance: float
    map_variance: float
    converged: bool | None
    problems: tuple[str, ...] = field(default=())
    modes: tuple[Mode, ...] = field(default=())

    @property
    def r_hat(self) -> float:
        """The worst R-hat of all quantities; NaN without draws."""
        return max((q.r_hat for q in self._all), default=float("nan"))

    @property
    def ess(self) -> float:
        """The smallest effective sample size of all quantities, bulk or tail; NaN without draws."""
        return min((min(q.ess_bulk, q.ess_tail) for q in self._all), default=float("nan"))

    @property
    def _all(self) -> list[Quality]:
        return [*self.alpha.values(), *self.parameters.values()]

    def __repr__(self) -> str:
        lines = [f"starts that agree: {self.agreeing} of {self.starts}"]
        if self.ties > 1:
            lines.append(f"different maxima of the same objective: {self.ties}")
        if len(self.modes) > 1:
            shares = ", ".join(
                f"{mode.objective:.6g} (weight {mode.weight:.2g}{'' if mode.started else ', no chains'})"
                for mode in self.modes
            )
            lines.append(f"separate maxima: {len(self.modes)}, objectives {shares}")
        if len(self.null_directions):
            lines.append(f"directions that the data do not see: {len(self.null_directions)}")
        if self.alpha:
            rows = [
                (name, f"{q.r_hat:.3f}", f"{q.ess_bulk:.0f}", f"{q.ess_tail:.0f}")
                for name, q in {**self.alpha, **self.parameters}.items()
            ]
            lines.append(table(("", "R-hat", "ESS bulk", "ESS tail"), rows))
            lines.append(f"divergences: {self.divergences}")
        if self.posterior_variance > 0 and self.model_error_variance > 0:
            lines.append(
                f"mean predictive variance: {self.model_error_variance:.3g} of model error, "
                f"{self.posterior_variance:.3g} of the posterior ({self.map_variance:.3g} at the MAP)"
            )
        lines.extend(f"problem: {problem}" for problem in self.problems)
        return "\n".join(lines)


def r_hat_threshold(num_draws: int) -> float:
    """Largest R-hat that passes.

    Chains of n independent draws have, split in halves, an R-hat of about √(1 + 2/n) by chance alone; four times that
    variance is allowed for the worst of many quantities where chains are short, but never more than 1.05.

    >>> r_hat_threshold(1000), r_hat_threshold(10)
    (1.01, 1.05)
    """
    return min(max(R_HAT_THRESHOLD, (1 + 8 / max(num_draws, 1)) ** 0.5), R_HAT_MOST)


def ess_threshold(num_draws: int) -> float:
    """Smallest effective sample size that passes, of so many draws in all.

    >>> ess_threshold(4000), ess_threshold(1000), ess_threshold(80)
    (400.0, 250.0, 100.0)
    """
    return max(ESS_LEAST, min(ESS_THRESHOLD, num_draws / 4))


def table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Rows as aligned plain text, the first column to the left and the others to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row in [header, *rows]:
        cells = [row[0].ljust(widths[0])] + [c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)
