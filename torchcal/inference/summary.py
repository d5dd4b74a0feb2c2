"""Figures and warnings about a finished calibration."""

import math
from typing import Any

import torch
from torch import Tensor

from torchcal import likelihoods
from torchcal.data import Recording
from torchcal.errors import (
    ConvergenceWarning,
    ExtrapolationWarning,
    IdentifiabilityWarning,
    PropagationWarning,
    ToleranceWarning,
    warn,
)
from torchcal.inference import diagnostics as measure
from torchcal.inference.draws import WORTH_CHAINS, Draws, most_divergences
from torchcal.inference.estimate import Estimate
from torchcal.inference.fitting import LeastSquares
from torchcal.models import Problem
from torchcal.propagation import NISP, PropagationCheck
from torchcal.results import Diagnostics, Quality
from torchcal.results.additive import NEGLIGIBLE
from torchcal.results.diagnostics import ess_threshold, r_hat_threshold
from torchcal.simulators import Simulator, Trajectories

__all__ = [
    "diagnose",
    "mean_square",
    "settings_of",
    "to_result",
    "warn_of_bounds",
    "warn_of_box",
    "warn_of_chains",
    "warn_of_moments",
    "warn_of_spike",
    "warn_of_tolerance",
]

#: Distance from a bound, in scaled coordinates, up to which a mean may lie at it.
AT_BOUND = 1e-4
#: Share of what one parameter's spread gives at a datum below which all of them together have cancelled.
SPIKE = 1e-2
#: How many times the floor of an output's sd it may be where it has vanished; and other spreads, scaled, that show
#: whether it could be more.
NO_SPREAD, SOME = 10.0, (0.1, 0.2)
#: Points of a density that a surrogate's box is held against, and the share of them outside from which on it matters: a
#: polynomial's error grows with a power of the distance.
LOOKED_AT, OUTSIDE = 2000, 0.01


def diagnose(
    estimate: Estimate,
    draws: Draws | None,
    samples: Tensor | None,
    propagate: NISP | None,
    names: tuple[str, ...],
    check: PropagationCheck | None,
) -> Diagnostics:
    """Judge starts and chains; the predictive variances are filled in by the caller."""
    alpha: dict[str, Quality] = {}
    parameters: dict[str, Quality] = {}
    problems: list[str] = []
    converged: bool | None = None
    if draws is not None and samples is not None:
        alpha = _quality(samples, names, draws.figures)
        if propagate is not None:
            labels, moments = _parameter_draws(propagate, samples)
            parameters = _quality(moments, labels)
        everything = {**alpha, **parameters}
        wanted = ess_threshold(samples.shape[0] * samples.shape[1])
        limit = r_hat_threshold(samples.shape[1])
        count = samples.shape[1]
        if count < measure.FEWEST:
            problems.append(
                f"{count} draw{'' if count == 1 else 's'} a chain cannot be judged: R-hat and effective sample size "
                f"need {measure.FEWEST} or more"
            )
            everything = {}
        loud = {name: q for name, q in everything.items() if not q.r_hat <= limit}
        if loud:
            worst = max(loud, key=lambda name: math.inf if math.isnan(loud[name].r_hat) else loud[name].r_hat)
            problems.append(
                f"R-hat of {worst} is {loud[worst].r_hat:.4f} (threshold {limit:.4f}); {len(loud)} of "
                f"{len(everything)} quantities are past it"
            )
        few = {name: min(q.ess_bulk, q.ess_tail) for name, q in everything.items()}
        worst = min(few, key=lambda name: few[name], default="")
        if few and not few[worst] >= wanted:
            problems.append(f"effective sample size of {worst} is {few[worst]:.0f} (threshold {wanted:.0f})")
        idle = [mode.weight for mode in draws.modes if not mode.started and mode.weight >= WORTH_CHAINS]
        if idle:
            problems.append(
                f"no chain began at a separate maximum that holds about {max(idle):.0%} of the posterior (raise "
                "num_chains)"
            )
        started = [mode for mode in draws.modes if mode.started]
        if loud and len(started) > 1:
            problems.append(
                f"chains began at {len(started)} separate maxima and have not mixed: how many draws each has rests "
                "on normal approximations (" + ", ".join(f"{mode.weight:.2g}" for mode in started) + ")"
            )
        if draws.divergences > most_divergences(samples.shape[0] * samples.shape[1]):
            problems.append(f"{draws.divergences} divergent transitions")
        converged = not problems
    return Diagnostics(
        alpha=alpha,
        parameters=parameters,
        divergences=0 if draws is None else draws.divergences,
        null_directions=to_result(estimate.null_directions),
        starts=estimate.starts,
        agreeing=estimate.agreeing,
        ties=estimate.ties,
        propagation=check,
        model_error_variance=math.nan,
        posterior_variance=math.nan,
        map_variance=math.nan,
        converged=converged,
        problems=tuple(problems),
        modes=() if draws is None else draws.modes,
    )


def _quality(
    draws: Tensor, names: tuple[str, ...], known: measure.Figures | None = None
) -> dict[str, Quality]:
    found = measure.figures(draws) if known is None else known
    return {name: Quality(*(float(figure[i]) for figure in found)) for i, name in enumerate(names)}


def _parameter_draws(propagate: NISP, samples: Tensor) -> tuple[tuple[str, ...], Tensor]:
    """E[λ] and the lower triangle of Cov[λ] for every draw, with their names; no covariance that is 0 by construction.
    """
    with torch.no_grad():
        mean, covariance = propagate.parameter_moments(samples.to(propagate.nodes))
    names = propagate.pattern.names
    labels = [f"E[{name}]" for name in names]
    columns = [mean]
    embedded = [i for i, name in enumerate(names) if name in propagate.pattern.embedded]
    for i in embedded:
        for j in embedded:
            if j == i or (j < i and bool(covariance[..., i, j].any())):
                labels.append(f"Cov[{names[i]}, {names[j]}]" if i != j else f"Var[{names[i]}]")
                columns.append(covariance[..., i, j, None])
    found = torch.cat(columns, dim=-1)
    # What is infinite for a few draws is their largest.
    finite = torch.where(found.isfinite(), found, -torch.inf).flatten(0, -2).amax(0)
    return tuple(labels), to_result(torch.where(found == torch.inf, finite, found))


def warn_of_chains(quality: Diagnostics) -> None:
    """Warn where the chains have not converged, with the numbers."""
    if quality.problems:
        warn(
            "The chains have not converged: " + "; ".join(quality.problems) + ". Draw more, or look at the "
            "diagnostics before using the posterior.",
            ConvergenceWarning,
        )


def warn_of_tolerance(
    quality: Diagnostics, likelihood: likelihoods.Likelihood, recording: Recording, sd: Tensor
) -> None:
    """Warn where ε rather than the model error sets the width of the prediction: the paper's own criterion.

    The posterior predictive variance E[σ²] + V[μ] then exceeds the MAP's σ² by far, because both its terms grow with
    ε and the MAP's does not (Figs. 10 and 12). Where a known noise explains all that the model leaves of the data, the
    MAP's ``sd`` is 0, and no ε makes it more.
    """
    if getattr(likelihood, "epsilon", None) is None or not quality.posterior_variance > 0:
        return
    total = quality.model_error_variance + quality.posterior_variance
    if not total > 2 * quality.map_variance:
        return
    told = (
        f"The tolerance ε sets the width of the prediction: E[σ²] = {quality.model_error_variance:.3g} and V[μ] = "
        f"{quality.posterior_variance:.3g} against σ² = {quality.map_variance:.3g} at the MAP, means over the data."
    )
    noise = recording.noise_sd
    if noise is None:
        advice = "Use a smaller epsilon=, unless the model is as good as exact."
    elif bool((sd.to(noise) <= NEGLIGIBLE * noise)[recording.observed].all()):
        advice = (
            "The noise that was given suffices for what the model leaves of the data: there is no model error to see, "
            "and a smaller epsilon= finds none."
        )
    else:
        advice = "Use a smaller epsilon=, but not far below the noise, unless the model is as good as exact."
    warn(f"{told} {advice}", ToleranceWarning)


def warn_of_bounds(problem: Problem, alpha: Tensor) -> None:
    """Warn where a parameter's mean (the median, on a logarithmic scale) lies at a bound that it wants to cross."""
    propagate = problem.propagate
    low, high = (end.to(alpha) for end in propagate.scaling.bounds(propagate.free))
    places = propagate.pattern.leading.to(alpha.device).nonzero()[:, 0]
    told = []
    for place, q, *ends in zip(places.tolist(), propagate.free, low.tolist(), high.tolist(), strict=True):
        for end, value, side, sign in ((ends[0], q.low, "lower", -1.0), (ends[1], q.high, "upper", 1.0)):
            away = abs(float(alpha[place]) - end)
            if value is None or away > AT_BOUND:
                continue
            beyond = alpha.clone()
            beyond[place] += sign * max(2 * away, 1e-6)
            with torch.no_grad():
                here, there = (float(problem.log_likelihood(point)) for point in (alpha, beyond))
            if not there <= here:  # nor where it has no answer
                told.append(f"{q.name} at its {side} bound {value:g}")
    if told:
        germs = propagate.pattern.num_germs
        best = "density" if germs else "estimate"
        instead = ", and the spreads make up for it" if germs else ""
        instead = ", and sigma makes up for it" if problem.likelihood.name == "additive" else instead
        warn(
            f"The best {best} has {', '.join(told)}: the bound decides it{instead}. Widen bounds that are not "
            "physical; others say that the model lacks something.",
            IdentifiabilityWarning,
        )


def warn_of_moments(propagate: NISP, mean: Tensor, covariance: Tensor) -> None:
    """Warn where the density of a parameter at the maximum has no mean or no variance.

    On a logarithmic scale that is so where the square of a normal germ weighs ½, or ¼, in ln λ.
    """
    if propagate.pattern.order < 2 or propagate.pattern.basis.name != "hermite":
        return  # then they are too large, at most
    for what, finite in (("mean", mean.isfinite()), ("variance", covariance.diagonal().isfinite())):
        if not bool(finite.all()):
            names = [name for name, sure in zip(propagate.pattern.names, finite.tolist(), strict=True) if not sure]
            warn(
                f"The best density of {', '.join(names)} has no finite {what}: on a logarithmic scale the square of a "
                "normal germ makes such tails, and more quadrature nodes do not help. Use germ='legendre', order=1, "
                "or no transform.",
                PropagationWarning,
            )
            return


def warn_of_spike(problem: Problem, alpha: Tensor) -> None:
    """Warn where a likelihood without noise or tolerance has found one of its spurious maxima (Fig. 6).

    There the spreads of several parameters cancel each other at one datum, or those of all that it depends on vanish.
    """
    propagate, pattern, name = problem.propagate, problem.propagate.pattern, problem.likelihood.name
    if name not in ("marginal", "gaussian_marginal", "full") or problem.noise is not None or not pattern.num_germs:
        return
    leading, rows = pattern.leading.to(alpha.device), pattern.rows.to(alpha.device)
    some = torch.linspace(*SOME, len(alpha), dtype=alpha.dtype, device=alpha.device)
    with torch.no_grad():
        sd = propagate(alpha)[1]
        spread = propagate(torch.where(leading, alpha, some))[1]
        own = [propagate(torch.where(leading | (rows == i), alpha, torch.zeros_like(alpha)))[1]
               for i in range(len(pattern.names))]  # fmt: skip
    share = sd / torch.stack(own).amax(0).clamp_min(1e-300)
    least = NO_SPREAD * (propagate.sd_floor or 0.0)
    gone = (sd <= least) & (spread > least)  # what depends on no parameter never had any
    if problem.observed is not None:
        share, gone = share[problem.observed], gone[problem.observed]
    if bool(gone.any()):
        what = f"the output's sd vanishes at {int(gone.sum())} of {len(gone)} data, and"
    elif name != "full" and float(share.min()) < SPIKE:
        what = (
            "the spreads of several parameters cancel each other at one datum, to "
            f"{float(share.min()):.1g} of what one gives alone, and"
        )
    else:
        return
    warn(
        f"The best density is a spike: {what} the {name} likelihood grows without limit as the output's sd vanishes "
        "there. Give the recording's noise=, or use ABC().",
        ConvergenceWarning,
    )


def warn_of_box(simulator: Simulator, propagate: NISP, alpha: Tensor, samples: Tensor | None) -> None:
    """Warn where calibrated densities leave the box that a surrogate was built on: that at the maximum ``(P,)``, or
    the average over draws ``(C, S, P)`` that predictions rest on."""
    leaves = getattr(simulator, "leaves_box", None)
    if leaves is None:
        return
    xi = propagate.draw_germ(LOOKED_AT, seed=0)
    rows = [alpha.expand(LOOKED_AT, -1)]
    if samples is not None and samples.numel():
        draws = samples.flatten(0, 1)
        rows.append(draws[torch.linspace(0, len(draws) - 1, LOOKED_AT, dtype=torch.float64).long().to(draws.device)])
    with torch.no_grad():
        shares = [
            float(leaves(propagate.with_held(propagate.parameters_at(row.to(propagate.nodes), xi, paired=True)))
                  .to(torch.float64).mean())
            for row in rows
        ]  # fmt: skip
    if max(shares) > OUTSIDE:
        what = "calibrated density" if shares[0] == max(shares) else "posterior"
        warn(
            f"{max(shares):.1%} of the {what} of the parameters lies outside the box that the surrogate was built on, "
            "where its error grows fast. Build it on a larger box.",
            ExtrapolationWarning,
        )


def settings_of(problem: Problem, fit: LeastSquares, embedding: str, seed: int, num_warmup: int) -> dict[str, Any]:
    """What a result stores of how it was made, as plain data."""
    propagate = problem.propagate
    choice = propagate.rule_choice
    simulator = propagate.simulator
    in_time: dict[str, Any] = {}
    if isinstance(simulator, Trajectories):
        denser = None if simulator.denser is None else [factor.tolist() for factor in simulator.denser]
        in_time = {"subdivide": simulator.subdivide, "denser": denser, "implicit": simulator.implicit}
    return {
        **in_time,
        "embedding": embedding,
        "prior": type(problem.prior).__name__,
        "seed": seed,
        "num_warmup": num_warmup,
        "order": propagate.order,
        "gauss_nodes": choice.size if choice.kind == "tensor" else None,
        "sd_floor": propagate.sd_floor,
        "center": fit.scaling.center.tolist(),
        "scale": fit.scaling.scale.tolist(),
        "log": fit.scaling.log.tolist(),
        "fixed": {name: float(value) for name, value in propagate.fixed.items()},
        "units": {parameter.name: parameter.unit for parameter in propagate.free},
    }


def mean_square(sd: Tensor, recording: Recording) -> float:
    """Mean of squares over the data; of several outputs, each in units of its own spread."""
    unit = recording.spread if len(recording.outputs) > 1 else torch.ones_like(recording.spread)
    return float((sd / unit.to(sd)).square()[recording.observed.to(sd.device)].mean())


def to_result(value: Tensor) -> Tensor:
    """As numbers in results are: detached, float64, on the CPU."""
    return value.detach().to(device="cpu", dtype=torch.float64)
