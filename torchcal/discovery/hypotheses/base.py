"""The base, calibrated: from many starts, without outliers, with the noise estimated and time steps short enough."""

import dataclasses
import math
from collections.abc import Mapping

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import base_columns
from torchcal.discovery.fits.fitting import Fitted, fit, refit
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.sharpen import SOLVER_SHARE, sharpen
from torchcal.discovery.fits.starts import follow_slopes, starts
from torchcal.discovery.fits.trial import check_finite, point_of
from torchcal.discovery.misfit.growth import growth
from torchcal.discovery.misfit.noise import Noise, estimate
from torchcal.discovery.misfit.outliers import clustered, lone_values, spikes
from torchcal.display import raised_there
from torchcal.errors import ConvergenceError, DomainError, SimulatorError
from torchcal.simulators import Trajectories, focused, may_change, step_errors, workable

__all__ = ["FEW_AGREE", "calibrate_base", "growing", "runs_away"]

#: How often steps are chosen anew at most.
HALVED = 7
#: The solver's error at the first starting value, in the data's spread, from which on the fit begins with shorter
#: steps, and how often they are halved for that at most.
WRONG, EARLY = 0.1, 2
#: How often they are shortened where they err, when the first part of the runs has been fitted.
FOCUSED = 4
#: Share of the starts that come to the best fit below which that may not be the best, and how many times as many are
#: tried then.
FEW_AGREE, MORE = 0.2, 4
#: How many of the best starts go on with each run's own values from where that run fits best, and by how much that
#: must be better: χ², and share of it.
CROSSED, WORTH, SHARE_WORTH = 4, 1.0, 0.1
#: Misfit of an output, in that of all, each in its spread, below which the solver need not be more exact for it.
FAR_BELOW = 0.03
#: Difference of χ² up to which an initial angle in another turn gives the same fit.
SAME_FIT = 0.01
#: Share of the data that may be outliers, and how often some are set aside before those that are left are looked at
#: again.
MOST, ROUNDS = 0.2, 5
#: How many robust sd of the others outliers are off that may have drawn the fit into another minimum.
DRAWN = 20.0
#: Share of the misfit of all others that a fit without a datum leaves at most, which follows it at their cost.
RUINED = 0.3
#: How often noise that grows is estimated from what it leaves when it is weighed.
GROWTHS = 4
#: Log odds from which on noise forgets with every sample and not with time.
BY_SAMPLE = 1.0
#: How many times the square of the noise that was given, and of what a fit without a memory leaves, one with a memory
#: may leave: noise that lasts for a third of a recording comes out so large by chance in hardly any.
AWAY = 4.0


def calibrate_base(
    problem: Problem,
    fixed: Mapping[str, float],
    num_starts: int,
    seed: int,
    *,
    clean: bool = False,
    unit: Tensor | None = None,
    begin: Tensor | None = None,
) -> tuple[Fitted, Noise]:
    """Fit the base, set outliers aside, estimate the noise, shorten the solver's steps where they matter.

    Args:
        problem: The data and the base.
        fixed: Parameters that are held, by name.
        num_starts: Starting values.
        seed: Of these.
        clean: Whether outliers are set aside already.
        unit: How unknown noise grows with the outputs, where that is known better than from the base's residual.
        begin: One starting value ``(1, P)`` in place of these, where it is known to be better.

    Raises:
        ConvergenceError: If no starting value gives finite outputs.
        SimulatorError: If the solution does not settle when time steps are halved, or is not finite where the fit ends.
    """
    recording = problem.recording
    exact = isinstance(recording.noise, str)
    free, held = base_columns(problem, fixed)
    rough = recording.noise if isinstance(recording.noise, Tensor) else 0.1 * recording.spread
    outputs = torch.zeros(len(recording.outputs), dtype=torch.float64)
    anew = begin is None
    begin = starts(problem, num_starts, seed, held) if begin is None else begin
    problem = _steady(problem, begin[:1])
    if anew:
        found = _from_starts(problem, begin, free, rough, outputs)
        if found is not None and found.agreeing < FEW_AGREE and not problem.dear:
            others = starts(problem, MORE * num_starts, seed + 1, held)
            other = _from_starts(problem, others, free, rough, outputs)
            found = found if other is None or other.chi2 > found.chi2 else other
    else:
        found = fit(problem, problem.whitening(rough, outputs), begin, free)
    if found is None:
        bad = (~problem.evaluate(begin[:1], [])[0][0].isfinite()).nonzero()[:1, 0]
        cause = problem.simulator.raised(recording.x, begin[0], int(problem.index[bad])) if len(bad) else None
        runs = ", and look at the runs' initial values" if problem.in_time else ""
        raise ConvergenceError(
            f"Expected finite outputs of the base at one of {num_starts} starting values at least. Got none, the first "
            f"with {point_of(problem, begin[0], free)}.{raised_there(cause)} Give initial= near the truth, or bounds, "
            f"to the parameters (a rate is about 1 over the time in which something happens){runs}."
        ) from cause
    found = _unwound(_sharpen(found))
    found = found if exact or clean else _unfollowed(found, begin, rough, outputs)
    found, units = _grown(found, unit)
    if not exact and not clean:
        whole = found, units
        for _ in range(ROUNDS):
            given = recording.noise if isinstance(recording.noise, Tensor) else None
            here = units[found.problem.index]
            bad = spikes(found.problem, found.residual / here, given, found.jacobian / here[:, None])
            if not bool(bad.any()):
                break
            keep = found.problem.keep.clone()
            keep[found.problem.index[bad]] = False
            if float(keep.sum()) < (1 - MOST) * whole[0].problem.n or _lie_together(whole[0].problem, found, keep):
                found, units = whole
                break
            found, units = _grown(_again(found, keep, begin if _drawn(found, bad) else begin[:0]), unit)
    noise = estimate(found.problem, found.residual, found.jacobian, recording.noise, units)
    base = refit(found, noise.whitening(found.problem))
    if not exact:
        base, units = _grown(base, unit, units)
        base, noise = _with_memory(base, units)
        remembering = refit(base, noise.whitening(base.problem))
        away = runs_away(remembering, found)
        if bool(away.any()):
            noise = _without_memory(noise, away)
            remembering = refit(base, noise.whitening(base.problem))
        base = _sharpen(remembering, noise.sd)
    if isinstance(base.problem.simulator, Trajectories):
        check_finite(base)
    return base, noise


def _lie_together(whole: Problem, found: Fitted, keep: Tensor) -> bool:
    """Whether what is set aside lies together among several conditions: one after the other it may have seemed not
    to."""
    if whole.order is not None:
        return False
    left = whole.y - whole.evaluate(found.values[None], [], found.warm)[0][0]
    out = ~keep[whole.index]
    return any(clustered(whole, places, out[places], left[places]) for places in whole.sequences)


def _steady(problem: Problem, begin: Tensor) -> Problem:
    """With steps that do for a starting value ``(1, P)``, roughly."""
    simulator = problem.simulator
    if not isinstance(simulator, Trajectories):
        return problem
    return problem.with_simulator(workable(simulator, begin, WRONG * problem.recording.spread, halvings=EARLY))


def _grown(found: Fitted, known: Tensor | None, before: Tensor | None = None) -> tuple[Fitted, Tensor]:
    """A fit and how its noise grows, ``(n_total,)``, each by the other; as ``known`` where it is, else from ``before``.

    What large data leave hides how little small ones scatter, until they are weighed so.
    """
    unit = torch.ones_like(found.problem.recording.y) if before is None else before
    if known is not None:
        return found, known
    for _ in range(GROWTHS):
        before, unit = unit, growing(found, unit)
        if torch.allclose(unit, before):
            break
        noise = estimate(found.problem, found.residual, found.jacobian, None, unit)
        found = refit(found, noise.whitening(found.problem))
    return found, unit


def _with_memory(found: Fitted, units: Tensor) -> tuple[Fitted, Noise]:
    """A fit and its noise, which forgets with time, or with every sample where that is clearly likelier."""
    known = found.problem.recording.noise
    with_time = dataclasses.replace(found.problem, by_sample=False)
    noise = estimate(with_time, found.residual, found.jacobian, known, units)
    if with_time.uneven:
        by_sample = dataclasses.replace(with_time, by_sample=True)
        other = estimate(by_sample, found.residual, found.jacobian, known, units)
        if other.log_density > noise.log_density + BY_SAMPLE:
            return dataclasses.replace(found, problem=by_sample), other
    return dataclasses.replace(found, problem=with_time), noise


def runs_away(found: Fitted, before: Fitted) -> Tensor:
    """Of which outputs a fit that weighs the data with a memory leaves much more than the noise that was given to one
    before, with less of it, and than that leaves; bool ``(outputs,)``.

    Slow noise of any size is likelier than a fast misfit that is known to be none, and frees the fit to miss the data.
    """
    problem = before.problem
    noise, outputs = problem.recording.noise, len(problem.recording.outputs)
    if not isinstance(noise, Tensor):
        return torch.zeros(outputs, dtype=torch.bool)

    def by_output(of: Problem, values: Tensor) -> Tensor:
        return torch.zeros(outputs, dtype=torch.float64).index_add_(0, of.output_of, values)

    left, least = (
        by_output(one.problem, (one.residual / noise[one.problem.index]).square()) for one in (found, before)
    )
    return left > AWAY * torch.maximum(least, by_output(problem, torch.ones(problem.n, dtype=torch.float64)))


def _without_memory(noise: Noise, which: Tensor) -> Noise:
    """With white noise of some outputs, bool ``(outputs,)``."""
    posterior = torch.zeros_like(noise.posterior)
    posterior[:, 0] = 1.0
    return dataclasses.replace(
        noise,
        correlation=noise.correlation.masked_fill(which, 0.0),
        posterior=torch.where(which[:, None], posterior, noise.posterior),
    )


def growing(found: Fitted, before: Tensor) -> Tensor:
    """How unknown noise grows with the outputs, by the residual of a fit weighed by what was found before,
    ``(n_total,)``; see `growth`."""
    if found.problem.recording.noise is not None:
        return torch.ones_like(found.problem.recording.y)
    whole = dataclasses.replace(found.problem, keep=torch.ones_like(found.problem.keep))
    f = whole.evaluate(found.values[None], [], found.warm)[0][0]
    return growth(found.problem, found.residual, found.jacobian, f, before)


def _from_starts(problem: Problem, begin: Tensor, free: list[int], rough: Tensor, outputs: Tensor) -> Fitted | None:
    """The best fit from many starts: over the first part of the runs, then over all, so that no phase is lost."""
    if not problem.in_time:
        return fit(problem, problem.whitening(rough, outputs), begin, free)
    guided = follow_slopes(problem, begin)
    begin = torch.cat([guided, begin[: max(2, len(begin) // 4)]])
    keep = torch.zeros(problem.recording.n, dtype=torch.bool)
    run = problem.recording.x["run"]  # type: ignore[index]
    for r in run.unique():
        mine = (run == r).nonzero()[:, 0]
        keep[mine[: max(8, len(mine) // 4)]] = True
    early = problem.keeping(keep.repeat(len(problem.recording.outputs)))
    ends = begin
    if early.n >= 3 * len(free):
        first = fit(early, early.whitening(rough, outputs), begin, free, max_steps=15, finish=0)
        if first is not None and first.ends is not None and first.ends_chi2 is not None:
            order = first.ends_chi2.argsort()
            ends = torch.cat([first.ends[order[: max(4, len(order) // 2)]], guided[:4]])
            problem = _as_short(problem, first.values)
    found = fit(problem, problem.whitening(rough, outputs), ends, free)
    return None if found is None else _best_of_each_run(found)


def _best_of_each_run(found: Fitted) -> Fitted:
    """A fit from many starts, or a better one that begins with each run's own values from where that run fitted best.

    Of several runs with values of their own few starts are in the right minimum for all of them.
    """
    bound, ends, chi2 = found.problem.simulator, found.ends, found.ends_chi2
    if not isinstance(bound, Trajectories) or len(bound.runs) < 2 or ends is None or chi2 is None:
        return found
    origin = bound.layout.origins
    own = torch.tensor([i for i in found.free if origin[i][1] is not None], dtype=torch.long)
    if not len(own):
        return found
    y = found.problem.evaluate(ends, [])[0]
    left = found.whitening.vector(found.problem.y - y).square()
    by_run = found.problem.by_run(torch.nan_to_num(left, nan=torch.inf))
    best = by_run.argmin(0)
    if not float(by_run.amin(0).sum()) < found.chi2 - max(WORTH, SHARE_WORTH * found.chi2):
        return found
    begin = ends[chi2.argsort(stable=True)[:CROSSED]].clone()
    begin[:, own] = ends[best[torch.tensor([origin[i][1] for i in own.tolist()])], own]
    again = fit(found.problem, found.whitening, begin.unique(dim=0), found.free)
    if again is None or again.chi2 >= found.chi2:
        return found
    return dataclasses.replace(again, agreeing=found.agreeing)


def _as_short(problem: Problem, values: Tensor) -> Problem:
    """With steps that are shorter where those at hand err by more than little at some values ``(P,)``: what is sudden
    and follows later, as the passage of a comet, would lead every fit astray."""
    simulator = problem.simulator
    for _ in range(FOCUSED):
        if not isinstance(simulator, Trajectories) or not may_change(simulator) or simulator.implicit:
            break
        states = simulator.solve(values[None])
        excess = float(step_errors(simulator, values, states).sum()) / WRONG
        if not 1 < excess < math.inf:
            break
        try:
            simulator = focused(simulator, values, states, excess)
        except DomainError:  # more steps than anyone can take
            break
    return problem.with_simulator(simulator)


def _unwound(found: Fitted) -> Fitted:
    """The same fit with unseen initial angles within half a turn of zero, where whole turns change nothing.

    Not everything that may be missing is as periodic as the base.
    """
    bound = found.problem.simulator
    if not isinstance(bound, Trajectories):
        return found
    names = [q.name for q in found.problem.parameters]
    values = found.values.clone()
    for i in found.free:
        turns = round(float(values[i]) / (2 * math.pi))
        if turns and names[i] in bound.initial_names:
            values[i] -= 2 * math.pi * turns
            same = float(found.chi2_at(values[None])) <= found.chi2 + SAME_FIT
            values[i] = values[i] if same else found.values[i]
    if torch.equal(values, found.values):
        return found
    again = fit(found.problem, found.whitening, values[None], found.free)
    if again is None or again.chi2 > found.chi2 + SAME_FIT:
        return found
    return dataclasses.replace(again, agreeing=found.agreeing)


def _again(found: Fitted, keep: Tensor, begin: Tensor) -> Fitted:
    """The same fit to fewer data, or a better one from some starting values ``(H, P)``."""
    problem = dataclasses.replace(found.problem, keep=keep)
    rough = torch.zeros(len(keep), dtype=torch.float64)
    rough[found.problem.index] = found.whitening.sd
    outputs = torch.zeros(len(problem.recording.outputs), dtype=torch.float64)
    again = refit(found, problem.whitening(rough, outputs), problem)
    if not len(begin) or problem.dear:
        return again
    try:
        other = _from_starts(problem, begin, found.free, rough, outputs)
        other = other and fit(problem, again.whitening, other.values[None], found.free)
    except SimulatorError:
        return again
    return again if other is None or other.chi2 > again.chi2 - WORTH else other


def _unfollowed(found: Fitted, begin: Tensor, rough: Tensor, outputs: Tensor) -> Fitted:
    """The fit, or one without data that it follows at the cost of all others: a peak may be as high and narrow as a
    decimal point in the wrong place makes one."""
    problem = found.problem
    alone = lone_values(problem)
    if not bool(alone.any()) or problem.dear:
        return found
    keep = problem.keep.clone()
    keep[problem.index[alone]] = False
    fewer = dataclasses.replace(problem, keep=keep)
    try:
        other = _from_starts(fewer, begin, found.free, rough, outputs)
    except SimulatorError:
        return found
    if other is None:
        return found
    for output in problem.output_of[alone].unique():
        now = found.residual[~alone & (problem.output_of == output)].square().mean()
        then = other.residual[fewer.output_of == output].square().mean()
        if not float(then) < RUINED**2 * float(now):
            return found
    return other


def _drawn(found: Fitted, bad: Tensor) -> bool:
    """Whether outliers, bool ``(n,)``, are so far off that they may have drawn a fit away from the others."""
    size, output_of = found.residual.abs(), found.problem.output_of
    return any(
        bool((size[bad & (output_of == k)] > DRAWN * 1.4826 * size[~bad & (output_of == k)].median()).any())
        for k in output_of[bad].unique()
    )


def _misfit_of_each(found: Fitted) -> Tensor:
    """RMSE of each output, at its data ``(n,)``."""
    size = torch.zeros_like(found.y)
    for k in found.problem.output_of.unique():
        mine = found.problem.output_of == k
        size[mine] = found.residual[mine].square().mean().sqrt()
    return size


def _sharpen(found: Fitted, sd: Tensor | None = None) -> Fitted:
    """Shorten time steps, where they err, until the solver's error is small against the noise, of an sd ``(n_total,)``;
    against each output's misfit where none is known yet, but not far below that of all: one without noise tells no more
    than that of how exact the others must be."""
    recording = found.problem.recording

    def allowed(now: Fitted) -> Tensor:
        spread = recording.spread[now.problem.index]
        if isinstance(recording.noise, Tensor):
            return SOLVER_SHARE * torch.maximum(recording.noise[now.problem.index], 1e-6 * spread)
        size = _misfit_of_each(now) if sd is None else sd[now.problem.index]
        least = FAR_BELOW * float((now.residual / spread).square().mean().sqrt())
        return SOLVER_SHARE * torch.maximum(size, max(least, 1e-6) * spread)

    found, error = sharpen(found, allowed, rounds=HALVED)
    if not error:
        return found
    raise SimulatorError(
        "Expected the solution to settle when time steps are halved. Got a change of "
        f"{error:.3g} after {HALVED} times, with {point_of(found.problem, found.values, found.free)} (a discontinuous "
        "model: smooth it, or give max_step=; or a fit that an initial= far from the truth led astray)."
    )
