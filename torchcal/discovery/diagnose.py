"""`diagnose`: locate the mismatch of a simulation and a recording, name it, model it, prove it."""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from numbers import Real
from typing import Any

from torch import Tensor
from tqdm.auto import tqdm

from torchcal.checks import as_seed, outside_inference_mode, whole
from torchcal.data import Recording, same_unit
from torchcal.discovery.conclude import Asked, conclude
from torchcal.discovery.findings.feasible import Feasible
from torchcal.discovery.findings.result import Diagnosis
from torchcal.discovery.fits.candidates import base_columns, call_once
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.ranges import check_measured
from torchcal.discovery.fits.starts import starts
from torchcal.discovery.fits.trial import check_repeats, warn_if_coarse, warn_if_long
from torchcal.discovery.hypotheses import verify
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.judged import Judged, judged
from torchcal.discovery.verdicts.decision import Decision
from torchcal.discovery.verdicts.given import resolved, told_apart
from torchcal.display import NONE, units_of
from torchcal.errors import DomainError, EmbeddingError, InterruptionWarning, RecordingError, UnitWarning, warn
from torchcal.simulators import ODESimulator, Simulator, is_value_of
from torchcal.simulators.executor import check_executor
from torchcal.terms import Term, extend
from torchcal.terms.labels import labelled
from torchcal.threads import with_torch_settings

__all__ = ["diagnose"]


@with_torch_settings
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
    feasible: Mapping[str, tuple[float | None, float | None]] | None = None,
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
        holdout: None to hold out the last quarter of every run, the upper quarter of one condition, or of several the
            quarter of the data farthest from their centre; or blocks within where the rest leaves the base, or what is
            named, too open to predict it. False for nothing, a share, or a bool array, True where held out.
        fixed: Values of parameters that are not calibrated.
        confidence: 1 minus the probability of calling noise a mismatch: above 0.5, and at most 0.998, as a thousand
            simulated residuals tell no more.
        max_terms: Terms that may be missing together: 1, 2 or 3; more is taken for 3.
        num_starts: Starting values of the base's calibration; four times as many more where fewer than one in five of
            them come to the best fit, of which a warning tells.
        feasible: Ranges ``{name: (low, high)}`` in which new experiments can be made, None for an open end: of
            conditions, or in time of initial states, inputs and the clock, ``"t"``. What is not named may be anything
            in the experiment that `Diagnosis.experiment` proposes.
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
        UnitWarning: If terms of a library are in another unit of time than the recording.
        TorchcalWarning: If an external simulator is so slow that the diagnosis will take long.
        SurrogateWarning: If a surrogate's own error is large beside the noise.
        ConvergenceWarning: If few starting values of the base agree, or it explains no more than a constant.
        InterruptionWarning: After Ctrl-C: the diagnosis keeps the refits that have ended, names nothing, and says what
            it has not refitted.
    """
    begun = time.perf_counter()
    given = _check(simulator, recording, candidates, confidence)
    max_terms, num_starts = whole("max_terms", max_terms, 1), whole("num_starts", num_starts, 1)
    seed = as_seed(seed)
    check_executor(executor, diagnose)
    asked = Asked(simulator, recording, given, confidence, seed, begun, Feasible.of(feasible, simulator, recording))
    terms = [term for term in given if not _contains(simulator, term)]
    problem = Problem.of(simulator, resolved(recording)).keeping(recording.observed_once)
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
        check_measured(problem, term)
    _compare_times(recording, terms)
    mask = verify.choose(recording, holdout, len(free))
    warn_if_coarse(problem)
    rows = starts(problem, 2, seed, held)
    for number, values in enumerate(rows):  # at zero nothing may move
        check_repeats(problem, values)
        if number == 0:  # the first call may take longer, for what it imports or begins
            warn_if_long(problem, values)
        problem.check_slopes(values, free)
    for term in terms:
        call_once(problem, term, rows)
    bar = tqdm(disable=not progress, desc="diagnose", unit="step", leave=False)

    def tick(text: str) -> None:
        bar.set_postfix_str(text)
        bar.update()

    try:
        search = Search(problem, terms, fixed or {}, seed, num_starts, max_terms, tick, executor)
        with search.stop.listening():
            tick("calibrate the base")
            search.calibrate_base()
            if (noise := told_apart(search.base)) is not None and isinstance(recording.noise, Tensor):
                problem = dataclasses.replace(problem, recording=recording.with_noise(noise))
                search = dataclasses.replace(search, problem=problem, coarser=float((noise / recording.noise).max()))
                search.calibrate_base()
            if holdout is not None and mask is not None:
                verify.check_left(search.base, mask)
            found = judged(search, problem, mask, confidence, movable=holdout is None)
            interrupted = _interruption(found)
            if interrupted:
                _hold_back(found.search, found.decision)
            return conclude(found, asked, interrupted=interrupted)
    finally:
        bar.close()


def _hold_back(search: Search, decision: Decision) -> None:
    """An interrupted search names nothing: what it has not refitted might explain as much."""
    warn(
        f"The diagnosis was interrupted. It keeps {len(search.models)} refitted hypotheses and names none of them.",
        InterruptionWarning,
    )
    if decision.verdict == "named" and decision.best is not None:
        decision.tied = [list(decision.best.names), list(NONE)]
        decision.tied_models = [decision.best]
        decision.verdict, decision.best = "ambiguous", None
        decision.doubt = "As the search was interrupted, that is no name."


def _interruption(found: Judged) -> str:
    """In words; empty where there was none."""
    search = found.search
    if not search.stop.is_set():
        return ""
    if found.cut:
        return "The search was interrupted before the same had been tried with a larger noise than was given."
    left = search.unfinished
    missing = f"{', '.join(left)} had been refitted" if left else "all their combinations and ranges had been compared"
    return f"The search was interrupted before {missing}."


def _check(simulator: Any, recording: Any, candidates: Any, confidence: float) -> list[Term]:
    outside_inference_mode()
    if not isinstance(simulator, Simulator):
        raise DomainError(f"Expected a Simulator or an ODESimulator. Got {type(simulator).__name__}.")
    if not isinstance(recording, Recording):
        raise RecordingError(f"Expected a torchcal.Recording. Got {type(recording).__name__}.")
    if isinstance(candidates, Term):
        candidates = [candidates]
    candidates = [] if candidates is None else candidates
    if not isinstance(candidates, Sequence) or isinstance(candidates, str):
        raise DomainError(f"Expected candidates as a sequence of terms. Got {type(candidates).__name__}.")
    if isinstance(confidence, bool) or not isinstance(confidence, Real):
        raise DomainError(f"Expected confidence as a number. Got {confidence!r}.")
    by_name: dict[str, Term] = {}
    for term in candidates:
        if not isinstance(term, Term):
            raise DomainError(f"Expected candidates as torchcal.Term objects. Got {type(term).__name__}: {term!r}.")
        if any(q.per_run for q in term.parameters):
            advice = "make it a parameter of the simulator, with a neutral value, and free it"
            if not isinstance(simulator, ODESimulator):
                advice = "drop it: a static recording has no runs"
            raise DomainError(
                f"Expected one value of each parameter of the term {term.name!r} for all runs. Got per_run=True "
                f"({advice})."
            )
        by_name[term.name] = term
    if not 0.5 < confidence <= 0.998:
        raise DomainError(
            "Expected confidence above 0.5 and at most 0.998, which 1000 simulated residuals can resolve. "
            f"Got {confidence!r}."
        )
    states = {name: unit for name, unit in getattr(simulator, "states", {}).items() if unit}
    return [labelled(term, units_of(recording, simulator), states) for term in by_name.values()]


def _compare_times(recording: Recording, terms: Sequence[Term]) -> None:
    """Warn where the units of terms are by another unit of time than the recording's: its numbers are what counts."""
    mine = recording.units.get("time")
    if mine is None or recording.runs is None:
        return
    others: dict[str, list[str]] = {}
    for term in terms:
        if term.time is not None and not same_unit(term.time, mine):
            others.setdefault(term.time, []).append(repr(term.name))
    for unit, names in others.items():
        named = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        warn(
            f"The recording's time is in {mine}, and in the units of the terms {named} it is in {unit}: their "
            f"estimates and limits will be numbers in {mine} under labels in {unit}. Build them with time={mine!r}.",
            UnitWarning,
        )


def _contains(simulator: Simulator, term: Term) -> bool:
    """Whether the simulator holds a term already, as an improved one does."""
    freed = {q.name for q in simulator.parameters if q.neutral is None}
    if term.parameters:
        return all(term.full(q.name) in simulator.names for q in term.parameters)
    return set(term.frees) <= freed
