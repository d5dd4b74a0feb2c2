"""`diagnose`: locate the mismatch of a simulation and a recording, name it, model it, prove it."""

import dataclasses
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from typing import Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchcal.data import Recording
from torchcal.discovery import explain, verify
from torchcal.discovery.candidates import base_columns, check_repeats
from torchcal.discovery.embedded import embed_each, model_error_sd
from torchcal.discovery.experiment import propose
from torchcal.discovery.fitting import Fitted, starts
from torchcal.discovery.limits import limits
from torchcal.discovery.model import PRIOR, Model
from torchcal.discovery.own_noise import EXPLAINED, explains, fits_by_chance, other_growth, outdone, outliers
from torchcal.discovery.problem import Problem
from torchcal.discovery.records import NONE, Estimate, Hypothesis, Scores, Table
from torchcal.discovery.result import Diagnosis
from torchcal.discovery.search import Search
from torchcal.discovery.several import refit_several
from torchcal.discovery.verdict import PLAINLY_WHITE, Decision, base_alone, decide
from torchcal.discovery.windows import refit_local
from torchcal.errors import ConvergenceWarning, DomainError, RecordingError
from torchcal.polychaos._checks import whole
from torchcal.simulators import ODESimulator, Parameter, Simulator, Trajectories
from torchcal.simulators.executor import check_executor
from torchcal.terms import Term, extend

__all__ = ["diagnose"]

#: How often everything is fitted again because other data turned out to be outliers.
ROUNDS = 3
#: Share of the level at which a fit to few data counts as more than noise by itself.
FEW_DATA = 0.1
#: RMSE of a calibrated base, in the data's spread, from which on it explains nothing.
NO_BETTER = 0.95
#: Times the level up to which a misfit that noise alone gives counts as more than that where the base, beside the
#: refitted candidates, is as improbable as the level: a statistic for all kinds of misfit sees each kind less well.
OFTEN = 5.0
#: Power of the stated detection limits.
POWER = 0.95

COLUMNS = (
    "terms", "region", "log_evidence", "probability", "misfit_removed", "p_white", "physical", "estimates",
    "held_out_rmse", "score", "refitted", "aliases", "note",
)  # fmt: skip


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
            rest leaves the base too open to predict it; False for nothing, a share, or a bool array, True where held
            out.
        fixed: Values of parameters that are not calibrated.
        confidence: 1 minus the probability of calling noise a mismatch.
        max_terms: Terms that may be missing together.
        num_starts: Starting values of the base's calibration.
        seed: Of every random number.
        executor: Any ``concurrent.futures.Executor``, on whose workers hypotheses are refitted; None refits them
            here. It pays where one refit takes seconds. Terms of lambdas need cloudpickle to get there.
        progress: Whether to show a bar.

    Returns:
        The diagnosis; print it.

    Raises:
        DomainError: If an argument is not as described.
        RecordingError: If simulator and recording do not belong together.
        SimulatorError: If the simulator or a term raises, or gives other outputs when it is called again.
        ConvergenceError: If the base cannot be calibrated at all.
    """
    begun = time.perf_counter()
    terms = _check(simulator, recording, candidates, confidence)
    max_terms, num_starts = whole("max_terms", max_terms, 1), whole("num_starts", num_starts, 1)
    seed = whole("seed", seed, 0)
    check_executor(executor, diagnose)
    given = terms
    terms = [term for term in given if not _contains(simulator, term)]
    problem = Problem.of(simulator, recording)
    _check_fixed(problem, fixed or {})
    free, held = base_columns(problem, fixed or {})
    if not free:
        raise DomainError("Expected at least one parameter to calibrate. Got all of them fixed or dormant.")
    if problem.n <= len(free):
        raise RecordingError(
            f"Expected more data than parameters to calibrate. Got {problem.n} data and {len(free)} free parameters."
        )
    for term in terms:
        unknown = [name for name in term.outputs if name not in (*recording.outputs, "y")]  # what has no name is y
        if unknown and not isinstance(simulator, ODESimulator):  # which knows its outputs' names itself
            raise DomainError(f"Expected the term {term.name!r} on outputs of {recording.outputs}. Got {unknown}.")
        extend(simulator, [term])  # raises for names that do not fit, before any long work
    mask = verify.choose(recording, holdout, len(free))
    for values in starts(problem, 2, seed, held):  # at zero nothing may move
        check_repeats(problem, values)
    bar = tqdm(disable=not progress, desc="diagnose", unit="step", leave=False)

    def tick(text: str) -> None:
        bar.set_postfix_str(text)
        bar.update()

    try:
        search = Search(problem, terms, fixed or {}, seed, num_starts, max_terms, tick, executor)
        tick("calibrate the base")
        search.calibrate_base()
        if holdout is None and mask is not None and _beyond_prediction(search, mask):
            mask = verify.within(recording)
        search, detected = _settled(search, problem, confidence)
        suspect: tuple[str, ...] = ()
        if terms and search.problem.n < problem.n and not (detected and explains(search)):
            # What the best model misses is no outlier of it; where there is none, all physics may have been set aside.
            every, suspect = _with_all(search, problem, detected, confidence)
            search, detected = (search, detected) if every is None else (every, True)
        if detected and terms:
            refit_several(search)
        decision = decide(search, detected, mask)
        return _result(search, decision, simulator, recording, mask, confidence, begun, given, seed, suspect)
    finally:
        bar.close()


def _settled(search: Search, observed: Problem, confidence: float) -> tuple[Search, bool]:
    """Screen and refit, again where others of the observed data turn out to be outliers, or the noise to grow."""
    detected = _refit(search, confidence)
    seen = [search.problem.keep]
    for _ in range(ROUNDS):
        sticking = outliers(search, observed.keep) if detected else None
        unit = other_growth(search) if detected else None
        if sticking is not None and any(torch.equal(keep, observed.keep & ~sticking) for keep in seen):
            sticking = None
        if sticking is None and unit is None:
            break
        # Others than at the base, whose misfit hides them and looks like some; and noise that grows, or does not.
        kept = search.problem if sticking is None else observed.keeping(~sticking)
        search = dataclasses.replace(search, problem=kept, clean=True, unit=search.unit if unit is None else unit)
        seen.append(search.problem.keep)
        search.calibrate_base()
        detected = _refit(search, confidence)
    return search, detected


def _with_all(
    search: Search, observed: Problem, detected: bool, confidence: float
) -> tuple[Search | None, tuple[str, ...]]:
    """The search of all observed data, where its best model is clearly likelier than outliers.

    Where they are too few to prove it, the names of what may explain them are returned instead.
    """
    every = dataclasses.replace(search, problem=observed, clean=True, unit=None)
    every.calibrate_base()
    every.screen_all()
    every.refit_singles()
    odds, spare = outdone(search, every, detected)
    if odds <= EXPLAINED or spare <= 0:
        sticking = outliers(every, observed.keep)
        if sticking is None or not 0 < int(sticking.sum()) < observed.n - search.problem.n:
            best = every.physical_leader
            return None, best.names if best is not None and odds > 0 else ()
    every, _ = _settled(every, observed, confidence)
    odds, spare = outdone(search, every, detected)
    return (every if odds > EXPLAINED and spare > 0 else None), ()


def _refit(search: Search, confidence: float) -> bool:
    """Screen and refit single terms, and local ones where there is more than noise, which is returned."""
    search.screen_all()
    detected = at_once = search.exact or search.p_detect < 1.0 - confidence
    if search.terms:
        search.refit_singles(detected=detected)
        level = 1.0 - confidence
        if not detected and search.few and (p := fits_by_chance(search)) < FEW_DATA * level:
            detected, search.p_detect = True, min(p, search.p_detect)
        elif not detected:
            detected = search.p_detect < OFTEN * level and base_alone(search) < level
        if detected and not at_once:
            search.models = []
            search.refit_singles()
        if detected:
            refit_local(search)
    return detected


def _check(simulator: Any, recording: Any, candidates: Any, confidence: float) -> list[Term]:
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


def _check_fixed(problem: Problem, fixed: Mapping[str, float]) -> None:
    """Raise for names that do not exist and values outside their bounds."""
    if not isinstance(fixed, Mapping):
        raise DomainError(f"Expected fixed as a dict from parameter names to values. Got {fixed!r}.")
    parameters = {q.name: q for q in problem.parameters}
    for name, value in fixed.items():
        if name not in parameters:
            raise DomainError(f"Expected fixed values of parameters among {list(parameters)}. Got {name!r}.")
        if not math.isfinite(float(value)) or not parameters[name].contains(float(value)):
            q = parameters[name]
            raise DomainError(f"Expected the fixed parameter {name!r} within [{q.low}, {q.high}]. Got {value!r}.")


def _contains(simulator: Simulator, term: Term) -> bool:
    """Whether the simulator holds a term already, as an improved one does."""
    freed = {q.name for q in simulator.parameters if q.neutral is None}
    if term.parameters:
        return all(term.full(q.name) in simulator.names for q in term.parameters)
    return set(term.frees) <= freed


def _beyond_prediction(search: Search, mask: Tensor) -> bool:
    """Whether the rest of the data leaves the base so open that its predictions of the held-out ones mean nothing."""
    apart = search.held_out(search.base, mask)
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
) -> Diagnosis:
    best = decision.best
    shown = best or (decision.tied_models[0] if decision.tied_models else None)
    if shown is not None:
        search.examine(shown)
    base = explain.fit_record(search.base, search.structure, ())
    final = base if best is None else explain.fit_record(best.found, best.structure, best.names)
    _warn(search, decision.verdict)
    before = _scores(search, search.base, mask)
    after = None if best is None else _scores(search, best.found, mask)
    if best is None:
        improved: Simulator = simulator
    else:
        improved = _improved(simulator, best)
    remaining = 0.0 if decision.verdict == "consistent" else 1.0
    if best is not None:
        white = best.structure is not None and best.structure.p_value >= PLAINLY_WHITE and not search.exact
        remaining = 0.0 if white else 1.0 - explain.removed(search, best)
        larger = next((m for m in decision.tied_models if len(m.names) > len(best.names)), None)
        if larger is not None:  # something beside it is likely
            remaining = max(remaining, explain.surpassed(search, best, larger))
    return Diagnosis(
        verdict=decision.verdict,
        terms=_in_order(search, best) if best else [],
        tied=decision.tied,
        where=explain.locate(search, shown) if decision.verdict != "consistent" else Table([], ("kind", "target")),
        ranking=_ranking(search, decision, mask),
        detection_limit=limits(
            search, 1.0 - confidence, POWER, [term for term in terms if _contains(simulator, term)]
        ),
        remaining=remaining,
        before=before,
        after=after,
        improved=improved,
        symptoms=explain.symptoms(search, best),
        noise=search.noise.record(search.problem),
        base=base,
        final=final,
        embedded=Table(
            embed_each(search.base, search.noise, _embeddable(search)),
            ("parameter", "sd", "output_sd", "log_likelihood"),
        ),
        shifts=explain.needed_shifts(search) if decision.verdict != "consistent" else [],
        missing=explain.missing_rate(search) if decision.verdict != "consistent" else None,
        experiment=propose(decision.tied_models, search.noise) if decision.tied_models else None,
        equations=explain.formulas(best) if best else [],
        identifiability=explain.identifiability(search) + ([] if best is None else explain.other_minima(search, best)),
        recording=recording,
        simulator=simulator,
        held_out=mask,
        p_detect=search.p_detect,
        confidence=confidence,
        library=[term.name for term in terms],
        settings={
            "seed": seed,
            "withdrawn": decision.withdrawn,
            "doubt": decision.doubt,
            "nearly": decision.nearly,
            "set_aside": suspect,
            "region": None if best is None else best.where,
            "solver": _solver(search.problem.simulator),
        },
        seconds=time.perf_counter() - begun,
        drivers=search._drivers(),
    )


def _in_order(search: Search, best: Model) -> list[str]:
    """Names of the accepted terms, the one with the most evidence of its own first."""
    alone = {m.names[0]: m.log_evidence for m in search.models if len(m.names) == 1}
    return sorted(best.names, key=lambda name: -alone.get(name, -math.inf))


def _solver(simulator: Simulator) -> str:
    if isinstance(simulator, Trajectories):
        return f"classical Runge–Kutta, {simulator.num_steps} steps a run"
    return "static"


def _improved(simulator: Simulator, best: Model) -> Simulator:
    """The user's simulator with the accepted terms, begun at their estimates."""
    improved = extend(simulator, best.candidate.terms)
    estimate = dict(zip([q.name for q in best.found.problem.parameters], best.found.values.tolist(), strict=True))
    own = {best.found.problem.parameters[i].name for i in best.candidate.own}
    parameters = []
    for q in improved.parameters:
        value = estimate.get(q.name)
        if q.name in own and value is not None and q.contains(value) and (q.transform != "log" or value > 0):
            q = Parameter(q.name, q.unit, q.low, q.high, value, None, q.transform, q.per_run)
        parameters.append(q)
    improved.parameters = tuple(parameters)
    return improved


def _warn(search: Search, verdict: str) -> None:
    if search.base.agreeing < 0.2:
        warnings.warn(
            f"Only {search.base.agreeing:.0%} of the base's starting values came to the best fit. Give initial= or "
            "bounds to its parameters, or more num_starts.",
            ConvergenceWarning,
            stacklevel=4,
        )
    recording, found = search.problem.recording, search.base
    size = float((found.residual / recording.spread[found.problem.index]).square().mean().sqrt())
    best = recording.y[found.problem.index].mean()
    if verdict == "unexplained" and size > NO_BETTER and not torch.allclose(found.y, best):
        warnings.warn(
            f"The calibrated base explains no more than a constant would (its RMSE is {size:.2g} of the data's "
            "spread). Check the units and the simulator, and give initial= or bounds to its parameters.",
            ConvergenceWarning,
            stacklevel=4,
        )


def _ranking(search: Search, decision: Decision, mask: Tensor | None) -> Table[Hypothesis]:
    rows = []
    alike: dict[int, tuple[Model, float]] = {}
    ordered = sorted(search.models, key=lambda m: -decision.probability.get(id(m), 0.0))
    listed = ordered[:60]
    if decision.best is not None and decision.best not in listed:
        listed.append(decision.best)
    for place, model in enumerate(listed):
        held = None
        if mask is not None and (place < 3 or model is decision.best):
            apart = search.held_out(model.found, mask)
            if apart is not None and bool((mask & search.problem.keep).any()):
                held = verify.score(
                    search.problem.recording, apart.prediction, apart.sd, mask & search.problem.keep
                ).rmse
        names = [q.name for q in model.candidate.problem.parameters]
        own: tuple[Estimate, ...] = explain.estimates(model.found, [i for i in model.candidate.own if names[i]])
        others = search.aliases.get(model.numbers[0], []) if model in search.plain.values() else []
        share = decision.probability.get(id(model), 0.0) / (1 + len(others))  # nothing tells which of them it is
        for j in others:
            alike[j] = (model, share)
        rows.append(
            Hypothesis(
                terms=model.names,
                log_evidence=model.log_evidence,
                probability=share,
                estimates=own,
                physical=model.physical,
                misfit_removed=explain.removed(search, model),
                p_white=model.structure.p_value if model.structure else None,
                held_out_rmse=held,
                score=search.screening.score(model.numbers[0]) if len(model.numbers) == 1 else None,
                refitted=True,
                region=model.where,
                aliases=tuple(search.candidates[j].name for j in others),
                note=model.note,
            )
        )
    fitted = {m.numbers for m in search.models}
    for i, candidate in enumerate(search.candidates):
        if i in alike:
            model, share = alike[i]
            own_fit = search.merged.get(i)
            rows.append(
                Hypothesis(
                    (candidate.name,),
                    model.log_evidence,
                    share,
                    estimates=() if own_fit is None else explain.estimates(own_fit.found, own_fit.candidate.own),
                    physical=model.physical,
                    misfit_removed=explain.removed(search, model),
                    score=search.screening.score(i),
                    refitted=own_fit is not None,
                    note=f"the same as {model.names[0]} here",
                )
            )
        elif (i,) not in fitted:
            seen = candidate.blind or search.screening.best[i] >= 0
            note = "" if seen else "already in the base model"
            note = "no fit from any starting value" if i in search.failed else note
            rows.append(Hypothesis((candidate.name,), -math.inf, 0.0, score=search.screening.score(i), note=note))
    rows.append(
        Hypothesis((), 0.0, decision.base, p_white=search.structure.p_value, refitted=True, note="the base alone")
    )
    if not search.exact:
        rows.append(
            Hypothesis(
                NONE,
                decision.none_evidence - math.log(PRIOR["none"]),
                decision.none,
                note="something unknown and smooth",
            )
        )
    rows.sort(key=lambda row: (-row.probability, -row.log_evidence))
    return Table(rows, COLUMNS)
