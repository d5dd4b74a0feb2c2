"""What a search found, told: the verdict with its fits before and after, its estimates, and what is left."""

import dataclasses
import math
import time

from torch import Tensor

from torchcal.data import Recording
from torchcal.discovery.findings.aside import side_by_side
from torchcal.discovery.findings.experiment import propose
from torchcal.discovery.findings.feasible import Feasible
from torchcal.discovery.findings.limits import limits
from torchcal.discovery.findings.ranking import ranking
from torchcal.discovery.findings.result import Diagnosis
from torchcal.discovery.findings.symptoms import (
    along,
    in_blocks,
    in_rows,
    in_times,
    larger_than_given,
    more_than_replicates,
    shared,
    symptoms,
    together,
    unlike,
)
from torchcal.discovery.findings.where import locate, missing_rate, needed_shifts, sharpened
from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.jumps import within
from torchcal.discovery.hypotheses import verify
from torchcal.discovery.hypotheses.base import FEW_AGREE
from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.own_noise import beside
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.judged import Judged
from torchcal.discovery.misfit.embedded import embed_each, model_error_sd
from torchcal.discovery.misfit.noise import Noise
from torchcal.discovery.records import Scores, Table
from torchcal.discovery.verdicts import explain
from torchcal.discovery.verdicts.decision import Decision
from torchcal.discovery.verdicts.given import begun_elsewhere, held_otherwise, unbounded
from torchcal.discovery.verdicts.intervals import by_profile
from torchcal.discovery.verdicts.lost import is_lost, misfit_in_spreads
from torchcal.discovery.verdicts.verdict import PLAINLY_WHITE
from torchcal.errors import ConvergenceWarning, warn
from torchcal.simulators import Simulator, Trajectories, is_value_of
from torchcal.terms import Term, extend

__all__ = ["Asked", "conclude"]

#: Probability of what is tied from which on its noise is told.
HALF = 0.5
#: Power of the stated detection limits.
POWER = 0.95


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the user asked.

    Args:
        simulator: The base model.
        recording: The data.
        terms: All that were given, those that the simulator holds already too.
        confidence: As in `diagnose`.
        seed: As in `diagnose`.
        begun: When, by ``time.perf_counter``.
        feasible: Where a new experiment can be made.
    """

    simulator: Simulator
    recording: Recording
    terms: list[Term]
    confidence: float
    seed: int
    begun: float
    feasible: Feasible


def conclude(judged: Judged, asked: Asked, *, interrupted: str = "") -> Diagnosis:
    """The diagnosis of a search that has ended.

    Args:
        judged: The search and the verdict; estimates of noise are still made for the models that are told.
        asked: By the user.
        interrupted: In words, or empty.
    """
    search, decision, mask = judged.search, judged.decision, judged.mask
    best = decision.best
    if best is not None and (found := explain.deeper(search, best)) is not None:
        best.found, best.structure, best.residual = found, None, None
    contained = [term for term in asked.terms if all(term is not one for one in search.terms)]
    told = [best] if best is not None else decision.tied_models if decision.none + decision.base < HALF else []
    if told and (noise := beside(search, told[0])) is not search.noise:
        search.take(noise, told)  # what is told of them rests on the noise beside them
    shown = best or (decision.tied_models[0] if decision.tied_models else None)
    if shown is not None:
        search.examine(shown)
    base = explain.fit_record(search.base, search.structure, ())
    final = base
    if best is not None:
        if not search.exact:
            best.intervals = by_profile(best.found, best.candidate.own, search.stop.is_set)
            best.intervals |= within(best.found, best.candidate.shape_places)
        final = explain.fit_record(best.found, best.structure, best.names, best.window, best.intervals)
    lost = is_lost(search, decision)
    _warn(search, lost)
    before = _scores(search, search.base, mask)
    after = None if best is None else _scores(search, best.found, mask)
    improved = asked.simulator if best is None else _improved(asked.simulator, best)
    left = search.base if best is None else best.found
    apart = [*unlike(search, left), *shared(search, left)] if decision.verdict in ("consistent", "named") else []
    blocks = in_blocks(search)
    apart += blocks
    blocks = blocks if len(search.problem.recording.outputs) == 1 else []  # of others rows tell the rest
    if decision.verdict == "consistent":
        apart += [*(() if blocks else in_rows(search, left)), *along(search, left), *together(search, left)]
    aside = asked.recording.observed_once & ~search.problem.keep
    apart += side_by_side(search.problem, final.residual / search.noise.sd, aside)
    any_unlike = bool(apart)
    larger_noise = in_times(judged.larger_noise or larger_than_given(search, best), search.problem.recording.outputs)
    if decision.verdict != "consistent":
        # Of what has no name the best fit tells the noise: the base leaves the misfit too, which goes on along rows.
        every = () if best is not None else (model.found for model in (*search.models, *search.nameless))
        least = min(every, key=lambda found: found.chi2, default=left)
        apart = [*unbounded(search), *begun_elsewhere(search), *more_than_replicates(search, least), *apart]
        apart += () if blocks else in_rows(search, least)
    places = [] if decision.verdict == "consistent" else sharpened(search)
    if decision.verdict in ("ambiguous", "unexplained"):
        apart = [*held_otherwise(search), *apart, *shared(search, least, places)]
    remaining, depends = 0.0 if decision.verdict == "consistent" else 1.0, ""
    if best is not None:
        white = best.structure is not None and best.structure.p_value >= PLAINLY_WHITE and not search.exact
        remaining = 0.0 if white else 1.0 - explain.removed(search, best)
        larger = next((m for m in decision.tied_models if len(m.names) > len(best.names)), None)
        if larger is not None:  # something beside it is likely
            remaining = max(remaining, explain.surpassed(search, best, larger))
            if decision.probability[id(larger)] > decision.probability[id(best)]:
                more = [name for name in larger.names if name not in best.names]
                other = explain.estimates(larger.found, larger.found.free)
                depends = explain.depends(final.estimates, other, more)
    return Diagnosis(
        verdict=decision.verdict,
        terms=_in_order(search, best) if best else [],
        tied=decision.tied,
        where=Table([], ("kind", "target"))
        if decision.verdict == "consistent"
        else locate(search, places, shown, named=best is not None),
        ranking=ranking(search, decision, mask),
        detection_limit=limits(search, 1.0 - asked.confidence, POWER, contained),
        remaining=remaining,
        before=before,
        after=after,
        improved=improved,
        symptoms=[*apart, *symptoms(search, best, larger_noise)],
        noise=dataclasses.replace(
            _told_noise(search, decision, 1.0 - asked.confidence).record(search.problem), enlarged=search.coarser
        ),
        base=base,
        final=final,
        embedded=Table(
            embed_each(search.base, search.noise, _embeddable(search)),
            ("parameter", "sd", "output_sd", "log_likelihood"),
        ),
        shifts=needed_shifts(places),
        missing=missing_rate(search, places),
        experiment=propose(decision.tied_models, search.noise, asked.feasible) if decision.tied_models else None,
        equations=explain.formulas(best) if best else [],
        identifiability=explain.identifiability(search, best)
        + ([] if best is None else explain.other_minima(search, best))
        + [
            f"{term.name} frees what is calibrated already, and was no candidate"
            for term in contained
            if not term.parameters
        ],
        recording=asked.recording,
        simulator=asked.simulator,
        held_out=mask,
        set_aside=aside,
        p_detect=search.p_detect,
        confidence=asked.confidence,
        library=[term.name for term in asked.terms],
        settings={
            "seed": asked.seed,
            "withdrawn": decision.withdrawn,
            "doubt": decision.doubt,
            "depends": depends,
            "unknown_beside": decision.beside,
            "pliant": decision.pliant,
            "feasible": dict(asked.feasible),
            "nearly": decision.nearly,
            "lost": lost,
            "unlike": any_unlike,
            "larger_noise": larger_noise,
            "set_aside": judged.suspect,
            "interrupted": interrupted,
            "region": None if best is None else best.where,
            "solver": _solver(search.problem.simulator),
        },
        seconds=time.perf_counter() - asked.begun,
        drivers=search.drivers(),
    )


def _told_noise(search: Search, decision: Decision, alpha: float) -> Noise:
    """The noise that the verdict rests on."""
    if decision.verdict == "consistent" and search.noise.open and search.p_detect < alpha:
        return search.settled(search.base)[0]
    return search.noise


def _in_order(search: Search, best: Model) -> list[str]:
    """Names of the accepted terms, the one with the most evidence of its own first."""
    alone = {m.names[0]: m.log_evidence for m in search.models if len(m.names) == 1}
    for i, j in search.twins.items():
        alone.setdefault(search.candidates[i].name, alone.get(search.candidates[j].name, -math.inf))
    return sorted(best.names, key=lambda name: -alone.get(name, -math.inf))


def _solver(simulator: Simulator) -> str:
    if isinstance(simulator, Trajectories):
        method = "Radau IIA (implicit)" if simulator.implicit else "classical Runge–Kutta"
        return f"{method}, {simulator.num_steps} steps a run"
    return "static"


def _improved(simulator: Simulator, best: Model) -> Simulator:
    """The user's simulator with the accepted terms, begun at the estimates of both, or at the mean of each run's.

    What ran to a bound, or is zero, is no place to begin.
    """
    improved = extend(simulator, best.candidate.terms)
    estimate, problem = best.found.by_name, best.found.problem
    own = {problem.parameters[i].name for i in best.candidate.own}
    fitted = {problem.parameters[i].name for i in best.found.free} - {*best.found.stuck}
    parameters = []
    for q in improved.parameters:
        names = [name for name in fitted if is_value_of(name, q.name)]
        value = sum(estimate[name] for name in names) / max(len(names), 1)
        if names and value != 0 and q.contains(value):
            q = dataclasses.replace(q, initial=value, neutral=None if own & {*names} else q.neutral)
        parameters.append(q)
    improved.parameters = tuple(parameters)
    return improved


def _warn(search: Search, lost: bool) -> None:
    base = search.base
    if base.agreeing < FEW_AGREE:
        free = [base.problem.parameters[i] for i in base.free]
        guided = all(None not in (q.initial, q.low, q.high) for q in free)
        advice = (
            "Its misfit has several minima: more num_starts look at more of them, narrower bounds leave fewer."
            if guided else "Give initial= or bounds to its parameters, or more num_starts."
        )  # fmt: skip
        warn(
            f"Only {base.agreeing:.0%} of the base's starting values came to the best fit. {advice}",
            ConvergenceWarning,
        )
    if lost:
        warn(
            "The calibrated base explains no more than a constant would (its RMSE is "
            f"{misfit_in_spreads(search):.2g} of the data's spread). Check the units and the simulator, and give "
            "initial= or bounds to its parameters.",
            ConvergenceWarning,
        )


def _scores(search: Search, found: Fitted, mask: Tensor | None) -> Scores:
    recording = search.problem.recording
    noise = search.noise
    if search.exact:  # the misfit is what predictions are uncertain by
        noise = dataclasses.replace(noise, sd=noise.sd * explain.misfit_size(found))
    width = model_error_sd(found, search.noise, _embeddable(search))
    prediction, sd = verify.predict(found, noise)
    fitted = verify.score(recording, prediction, sd, search.problem.keep)
    if mask is None:
        return Scores(fitted, None, None, width)
    apart = verify.held_out_fit(found, noise, mask) if search.exact else search.held_out(found, mask)
    if apart is None:
        return Scores(fitted, None, None, width)
    seen = mask & search.problem.keep
    if not bool(seen.any()):
        return Scores(fitted, None, None, width)
    held = verify.score(recording, apart.prediction, apart.sd, seen)
    return Scores(fitted, held, apart.prediction, width)


def _embeddable(search: Search) -> list[str]:
    """The base's calibrated parameters without unknown initial states."""
    base = [search.base.problem.parameters[i].name for i in search.base.free]
    hidden = getattr(search.base.problem.simulator, "initial_names", [])
    return [name for name in base if name not in hidden]
