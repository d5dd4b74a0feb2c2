"""`diagnose`: locate the mismatch of a simulation and a recording, name it, model it, prove it."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from typing import Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchcal.checks import whole
from torchcal.data import Recording
from torchcal.discovery import explain, verify
from torchcal.discovery.candidates import base_columns
from torchcal.discovery.decision import Decision
from torchcal.discovery.embedded import embed_each, model_error_sd
from torchcal.discovery.experiment import propose
from torchcal.discovery.fitting import Fitted, starts
from torchcal.discovery.given import coarser, from_samples, held_otherwise
from torchcal.discovery.likeliest import settled
from torchcal.discovery.limits import limits
from torchcal.discovery.model import Model
from torchcal.discovery.nameless import refit_nameless
from torchcal.discovery.noise import Noise
from torchcal.discovery.own_noise import beside, explains
from torchcal.discovery.problem import Problem
from torchcal.discovery.ranking import ranking
from torchcal.discovery.records import Scores, Table
from torchcal.discovery.result import Diagnosis
from torchcal.discovery.rounds import settle, with_all, with_explained, without_others
from torchcal.discovery.search import Search
from torchcal.discovery.several import refit_several
from torchcal.discovery.symptoms import more_than_replicates, symptoms, unlike
from torchcal.discovery.trial import check_repeats
from torchcal.discovery.verdict import PLAINLY_WHITE, decide
from torchcal.discovery.where import locate, missing_rate, needed_shifts
from torchcal.display import NONE
from torchcal.errors import ConvergenceWarning, DomainError, EmbeddingError, RecordingError, warn
from torchcal.simulators import ODESimulator, Parameter, Simulator, Trajectories, is_value_of
from torchcal.simulators.executor import check_executor
from torchcal.terms import Term, extend
from torchcal.threads import with_few_threads

__all__ = ["diagnose"]

#: RMSE of a calibrated base, in the data's spread, from which on it explains nothing.
NO_BETTER = 0.95
#: Probability of what is tied from which on its noise is told.
HALF = 0.5
#: Power of the stated detection limits.
POWER = 0.95


@with_few_threads
def diagnose(
    simulator: Simulator,
    recording: Recording,
    candidates: Sequence[Term] = (),
    *,
    holdout: Any = None,
    fixed: Mapping[str, float] | None = None,
    confidence: float = 0.99,
    max_terms: int = 3,
    num_starts: int = 12,
    seed: int = 0,
    executor: Executor | None = None,
    progress: bool = True,
) -> Diagnosis:
    """Find the physics that was left out of a simulation, or say that nothing is missing, or that it is unknown.

    All base parameters and unknown initial states are calibrated first, which bends them to hide what is missing. What
    is left is compared with noise, located, and screened in the tangent space of the candidates. Every surviving
    candidate is then added and refitted together with everything else, several together too; evidence, physical bounds
    and the whiteness of what is left decide, and held-out data must agree.

    Args:
        simulator: The base model, a `Simulator` or an `ODESimulator`. Parameters with a neutral value stay there until
            a candidate frees them.
        recording: The data; of a `Recording(runs=...)` for an `ODESimulator`.
        candidates: Terms that might have been left out. A later term replaces an earlier one of the same name.
        holdout: None to hold out the last quarter (see `torchcal.discovery.verify.choose`), or blocks within where the
            rest leaves the base, or what is named, too open to predict it; False for nothing, a share, or a bool array,
            True where held out.
        fixed: Values of parameters that are not calibrated.
        confidence: 1 minus the probability of calling noise a mismatch: above 0.5, and at most 0.998, as a thousand
            simulated residuals tell no more.
        max_terms: Terms that may be missing together: 1, 2 or 3; more is taken for 3.
        num_starts: Starting values of the base's calibration.
        seed: Of every random number.
        executor: Any ``concurrent.futures.Executor``, on whose workers hypotheses are refitted; None refits them
            here. It pays where one refit takes seconds. Every term but one that only frees a parameter needs
            cloudpickle to get there, here and on the workers (``pip install cloudpickle``, or ``torchcal[dask]``).
        progress: Whether to show a bar.

    Returns:
        The diagnosis; print it.

    Raises:
        DomainError: If an argument is not as described.
        RecordingError: If simulator and recording do not belong together.
        SimulatorError: If the simulator or a term raises, gives other outputs when it is called again, or loses a
            derivative, as NumPy does.
        ConvergenceError: If the base cannot be calibrated at all.

    Warns:
        ConvergenceWarning: If few starting values of the base agree, or it explains no more than a constant. After
            Ctrl-C, the diagnosis keeps the refits that have ended: it names nothing, and says what it has not refitted.
    """
    begun = time.perf_counter()
    terms = _check(simulator, recording, candidates, confidence)
    max_terms, num_starts = whole("max_terms", max_terms, 1), whole("num_starts", num_starts, 1)
    seed = whole("seed", seed, 0)
    check_executor(executor, diagnose)
    given = terms
    terms = [term for term in given if not _contains(simulator, term)]
    problem = Problem.of(simulator, recording).keeping(recording.observed_once)
    try:
        free, held = base_columns(problem, fixed)
    except EmbeddingError as error:  # which says of the same that it cannot be embedded
        raise DomainError(str(error)) from error
    if problem.n <= len(free):
        raise RecordingError(
            f"Expected more data than parameters to calibrate. Got {problem.n} data and {len(free)} free parameters."
        )
    for term in given:
        if stuck := [name for name in fixed or {} if any(is_value_of(name, freed) for freed in term.frees)]:
            raise DomainError(
                f"Expected fixed= without the parameters that candidates free. Got {stuck[0]!r}, which the term "
                f"{term.name!r} frees (leave one of the two out)."
            )
    for term in terms:
        unknown = [name for name in term.outputs if name not in (*recording.outputs, "y")]  # what has no name is y
        if unknown and not isinstance(simulator, ODESimulator):  # which knows its outputs' names itself
            raise DomainError(f"Expected the term {term.name!r} on outputs of {recording.outputs}. Got {unknown}.")
        extend(simulator, [term])  # raises for names that do not fit, before any long work
    mask = verify.choose(recording, holdout, len(free))
    for values in starts(problem, 2, seed, held):  # at zero nothing may move
        check_repeats(problem, values)
        problem.check_slopes(values, free)
    bar = tqdm(disable=not progress, desc="diagnose", unit="step", leave=False)

    def tick(text: str) -> None:
        bar.set_postfix_str(text)
        bar.update()

    try:
        search = Search(problem, terms, fixed or {}, seed, num_starts, max_terms, tick, executor)
        with search.stop.listening():
            tick("calibrate the base")
            search.calibrate_base()
            if (times := coarser(search.base)) > 1 and isinstance(recording.noise, Tensor):
                recording = recording.with_noise(times * recording.noise)
                problem = dataclasses.replace(problem, recording=recording)
                search = dataclasses.replace(search, problem=problem, coarser=times)
                search.calibrate_base()
            if holdout is not None and mask is not None:
                verify.check_left(search.base, mask)
            if holdout is None and mask is not None and _beyond_prediction(search, search.base, mask):
                mask = verify.within(recording)
            search, detected = settle(search, problem, confidence)
            suspect: tuple[str, ...] = ()
            aside = search.problem.n < problem.n and not search.stop.is_set()
            if terms and aside and not (detected and explains(search)):
                # What the best model misses is no outlier of it; where there is none, all physics may have been set
                # aside.
                every, suspect = with_all(search, problem, detected, confidence)
                if every is not None:
                    search, detected = every, True
            if detected and terms and not search.stop.is_set():
                refit_several(search)
                search = with_explained(search, problem, confidence) or without_others(search, problem)
                refit_nameless(search)
            decision = decide(search, detected, mask)
            best = decision.best or (search.physical_leader if decision.verdict == "ambiguous" else None)
            if holdout is None and mask is not None and best and _beyond_prediction(search, best.found, mask):
                mask = verify.within(recording)
                decision = decide(search, detected, mask)
            interrupted = _interruption(search)
            if interrupted:
                _hold_back(search, decision)
            return _result(
                search, decision, simulator, recording, mask, confidence, begun, given, seed, suspect, interrupted
            )
    finally:
        bar.close()


def _hold_back(search: Search, decision: Decision) -> None:
    """An interrupted search names nothing: what it has not refitted might explain as much."""
    warn(
        f"The diagnosis was interrupted. It keeps {len(search.models)} refitted hypotheses and names none of them.",
        ConvergenceWarning,
    )
    if decision.verdict == "named" and decision.best is not None:
        decision.tied = [list(decision.best.names), list(NONE)]
        decision.tied_models = [decision.best]
        decision.verdict, decision.best = "ambiguous", None
        decision.doubt = "As the search was interrupted, that is no name."


def _interruption(search: Search) -> str:
    """In words; empty where there was none."""
    if not search.stop.is_set():
        return ""
    left = search.unfinished
    missing = f"{', '.join(left)} had been refitted" if left else "all their combinations and ranges had been compared"
    return f"The search was interrupted before {missing}."


def _check(simulator: Any, recording: Any, candidates: Any, confidence: float) -> list[Term]:
    if torch.is_inference_mode_enabled():
        raise DomainError(
            "Expected a diagnosis outside torch.inference_mode(), which takes no derivatives. Got one within "
            "(torch.no_grad() is allowed)."
        )
    if not isinstance(simulator, Simulator):
        raise DomainError(f"Expected a Simulator or an ODESimulator. Got {type(simulator).__name__}.")
    if not isinstance(recording, Recording):
        raise RecordingError(f"Expected a torchcal.Recording. Got {type(recording).__name__}.")
    if isinstance(candidates, Term):
        candidates = [candidates]
    candidates = [] if candidates is None else candidates
    if not isinstance(candidates, Sequence) or isinstance(candidates, str):
        raise DomainError(f"Expected candidates as a sequence of terms. Got {type(candidates).__name__}.")
    if isinstance(confidence, bool) or not isinstance(confidence, int | float):
        raise DomainError(f"Expected confidence as a number. Got {confidence!r}.")
    by_name: dict[str, Term] = {}
    for term in candidates:
        if not isinstance(term, Term):
            raise DomainError(f"Expected candidates as torchcal.Term objects. Got {type(term).__name__}: {term!r}.")
        if any(q.per_run for q in term.parameters):
            raise DomainError(
                f"Expected one value of each parameter of the term {term.name!r} for all runs. Got per_run=True (make "
                "it a parameter of the simulator, with a neutral value, and free it)."
            )
        by_name[term.name] = term
    if not 0.5 < confidence <= 0.998:
        raise DomainError(
            "Expected confidence above 0.5 and at most 0.998, which 1000 simulated residuals can resolve. "
            f"Got {confidence!r}."
        )
    return list(by_name.values())


def _contains(simulator: Simulator, term: Term) -> bool:
    """Whether the simulator holds a term already, as an improved one does."""
    freed = {q.name for q in simulator.parameters if q.neutral is None}
    if term.parameters:
        return all(term.full(q.name) in simulator.names for q in term.parameters)
    return set(term.frees) <= freed


def _beyond_prediction(search: Search, found: Fitted, mask: Tensor) -> bool:
    """Whether the rest of the data leaves a model so open that its predictions of the held-out ones mean nothing."""
    apart = search.held_out(found, mask)
    seen = mask & search.problem.keep
    if apart is None or not bool(seen.any()):
        return False
    own = (apart.sd.square() - search.noise.sd.square()).clamp_min(0).sqrt()[seen]
    return bool((own > search.problem.recording.spread[seen]).any())


def _embeddable(search: Search) -> list[str]:
    """The base's calibrated parameters without unknown initial states."""
    base = [search.base.problem.parameters[i].name for i in search.base.free]
    hidden = getattr(search.base.problem.simulator, "initial_names", [])
    return [name for name in base if name not in hidden]


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


def _result(
    search: Search,
    decision: Decision,
    simulator: Simulator,
    recording: Recording,
    mask: Tensor | None,
    confidence: float,
    begun: float,
    terms: list[Term],
    seed: int,
    suspect: tuple[str, ...],
    interrupted: str,
) -> Diagnosis:
    best = decision.best
    told = [best] if best is not None else decision.tied_models if decision.none + decision.base < HALF else []
    if told and (noise := beside(search, told[0])) is not search.noise:
        search.take(noise, told)  # what is told of them rests on the noise beside them
    shown = best or (decision.tied_models[0] if decision.tied_models else None)
    if shown is not None:
        search.examine(shown)
    base = explain.fit_record(search.base, search.structure, ())
    final = base if best is None else explain.fit_record(best.found, best.structure, best.names, best.window)
    lost = decision.verdict == "unexplained" and _explains_nothing(search)
    _warn(search, lost)
    before = _scores(search, search.base, mask)
    after = None if best is None else _scores(search, best.found, mask)
    if best is None:
        improved: Simulator = simulator
    else:
        improved = _improved(simulator, best)
    left = search.base if best is None else best.found
    apart = unlike(search, left) if decision.verdict in ("consistent", "named") else []
    any_unlike = bool(apart)
    if decision.verdict != "consistent":
        apart = [*from_samples(search), *more_than_replicates(search, left), *apart]
    if decision.verdict in ("ambiguous", "unexplained"):
        apart = [*held_otherwise(search), *apart]
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
        else locate(search, shown, named=best is not None),
        ranking=ranking(search, decision, mask),
        detection_limit=limits(
            search, 1.0 - confidence, POWER, [term for term in terms if _contains(simulator, term)]
        ),
        remaining=remaining,
        before=before,
        after=after,
        improved=improved,
        symptoms=[*apart, *symptoms(search, best)],
        noise=_told_noise(search, decision, 1.0 - confidence).record(search.problem),
        base=base,
        final=final,
        embedded=Table(
            embed_each(search.base, search.noise, _embeddable(search)),
            ("parameter", "sd", "output_sd", "log_likelihood"),
        ),
        shifts=needed_shifts(search) if decision.verdict != "consistent" else [],
        missing=missing_rate(search) if decision.verdict != "consistent" else None,
        experiment=propose(decision.tied_models, search.noise) if decision.tied_models else None,
        equations=explain.formulas(best) if best else [],
        identifiability=explain.identifiability(search, best)
        + ([] if best is None else explain.other_minima(search, best))
        + [
            f"{term.name} frees what is calibrated already, and was no candidate"
            for term in terms
            if not term.parameters and _contains(simulator, term)
        ],
        recording=recording,
        simulator=simulator,
        held_out=mask,
        set_aside=recording.observed_once & ~search.problem.keep,
        p_detect=search.p_detect,
        confidence=confidence,
        library=[term.name for term in terms],
        settings={
            "seed": seed,
            "withdrawn": decision.withdrawn,
            "doubt": decision.doubt,
            "depends": depends,
            "unknown_beside": decision.beside,
            "nearly": decision.nearly,
            "lost": lost,
            "unlike": any_unlike,
            "set_aside": suspect,
            "interrupted": interrupted,
            "region": None if best is None else best.where,
            "solver": _solver(search.problem.simulator),
        },
        seconds=time.perf_counter() - begun,
        drivers=search.drivers(),
    )


def _told_noise(search: Search, decision: Decision, alpha: float) -> Noise:
    """The noise that the verdict rests on."""
    if decision.verdict == "consistent" and search.noise.open and search.p_detect < alpha:
        return settled(search.base, search.noise, search.tangents)[0]
    return search.noise


def _in_order(search: Search, best: Model) -> list[str]:
    """Names of the accepted terms, the one with the most evidence of its own first."""
    alone = {m.names[0]: m.log_evidence for m in search.models if len(m.names) == 1}
    return sorted(best.names, key=lambda name: -alone.get(name, -math.inf))


def _solver(simulator: Simulator) -> str:
    if isinstance(simulator, Trajectories):
        method = "Radau IIA (implicit)" if simulator.implicit else "classical Runge–Kutta"
        return f"{method}, {simulator.num_steps} steps a run"
    return "static"


def _improved(simulator: Simulator, best: Model) -> Simulator:
    """The user's simulator with the accepted terms, begun at their estimates, or at the mean of each run's."""
    improved = extend(simulator, best.candidate.terms)
    estimate = best.found.by_name
    own = [best.found.problem.parameters[i].name for i in best.candidate.own]
    parameters = []
    for q in improved.parameters:
        values = [estimate[name] for name in own if is_value_of(name, q.name)]
        value = sum(values) / max(len(values), 1)
        if values and q.contains(value) and (q.transform != "log" or value > 0):
            q = Parameter(q.name, q.unit, q.low, q.high, value, None, q.transform, q.per_run)
        parameters.append(q)
    improved.parameters = tuple(parameters)
    return improved


def _explains_nothing(search: Search) -> bool:
    """Whether the calibrated base explains no more than a constant would."""
    return _size(search) > NO_BETTER and not _is_constant(search)


def _is_constant(search: Search) -> bool:
    """Whether the calibrated base is the mean of each output, as one is that has no more to say."""
    found, recording = search.base, search.problem.recording
    weight = found.whitening.sd.square().reciprocal()
    for k in found.problem.output_of.unique():
        mine = found.problem.output_of == k
        mean = float((weight[mine] * found.problem.y[mine]).sum() / weight[mine].sum())
        spread = recording.spread[found.problem.index[mine]]
        if bool(((found.y[mine] - mean).abs() > (1 - NO_BETTER) * spread).any()):
            return False
    return True


def _size(search: Search) -> float:
    """RMSE of the calibrated base, in the spread of the data."""
    found = search.base
    return float((found.residual / search.problem.recording.spread[found.problem.index]).square().mean().sqrt())


def _warn(search: Search, lost: bool) -> None:
    if search.base.agreeing < 0.2:
        warn(
            f"Only {search.base.agreeing:.0%} of the base's starting values came to the best fit. Give initial= or "
            "bounds to its parameters, or more num_starts.",
            ConvergenceWarning,
        )
    if lost:
        warn(
            f"The calibrated base explains no more than a constant would (its RMSE is {_size(search):.2g} of the "
            "data's spread). Check the units and the simulator, and give initial= or bounds to its parameters.",
            ConvergenceWarning,
        )
