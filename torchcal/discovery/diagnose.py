"""`diagnose`: locate the mismatch of a simulation and a recording, name it, model it, prove it."""

import dataclasses
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor
from tqdm.auto import tqdm

from torchcal.data import Recording
from torchcal.discovery import explain, verify
from torchcal.discovery.candidates import base_columns
from torchcal.discovery.experiment import propose
from torchcal.discovery.fitting import Fitted
from torchcal.discovery.problem import Problem
from torchcal.discovery.records import Estimate, Hypothesis, Scores, Table
from torchcal.discovery.result import Diagnosis
from torchcal.discovery.search import PRIOR, Model, Search, describe
from torchcal.discovery.structure import Structure
from torchcal.errors import ConvergenceWarning, DomainError, RecordingError
from torchcal.simulators import Parameter, Simulator, Trajectories
from torchcal.terms import Term, extend

__all__ = ["diagnose"]

#: A hypothesis is named when it has at least this probability among those the library offers.
NAMED = 0.96
#: Structure left after a hypothesis with less probability than this by noise alone speaks against it.
WHITE = 0.005
#: Of the tied hypotheses, those that together have this probability are listed.
TIED = 0.98
#: Of a recording without noise, the share of the held-out misfit that a named term must remove.
REMOVED = 0.9
#: The same of a recording whose noise is unknown, and how much more of the misfit every rival must leave.
NEARLY, BEATEN = 0.97, 3.0
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
    progress: bool = True,
) -> Diagnosis:
    """Find the physics that was left out of a simulation, or say that nothing is missing, or that it is unknown.

    All base parameters and unknown initial states are calibrated first, which bends them to hide what is missing. What is
    left is compared with noise, located, and screened in the tangent space of the candidates. Every surviving candidate
    is then added and refitted together with everything else, several together too; evidence, physical bounds and the
    whiteness of what is left decide, and held-out data must agree.

    Args:
        simulator: The base model, a `Simulator` or an `ODESimulator`. Parameters with a neutral value stay there until a
            candidate frees them.
        recording: The data; of a `Recording(runs=...)` for an `ODESimulator`.
        candidates: Terms that might have been left out. A later term replaces an earlier one of the same name.
        holdout: None to hold out the last quarter (see `torchcal.discovery.verify.choose`), False for nothing, a share,
            or a bool array, True where held out.
        fixed: Values of parameters that are not calibrated.
        confidence: 1 minus the probability of calling noise a mismatch.
        max_terms: Terms that may be missing together.
        num_starts: Starting values of the base's calibration.
        seed: Of every random number.
        progress: Whether to show a bar.

    Returns:
        The diagnosis; print it.

    Raises:
        DomainError: If an argument is not as described.
        RecordingError: If simulator and recording do not belong together.
        ConvergenceError: If the base cannot be calibrated at all.
    """
    begun = time.perf_counter()
    terms = _check(simulator, recording, candidates, confidence, max_terms, num_starts)
    problem = Problem.of(simulator, recording)
    free, _ = base_columns(problem, fixed or {})
    if not free:
        raise DomainError("Expected at least one parameter to calibrate. Got all of them fixed or dormant.")
    if problem.n <= len(free):
        raise RecordingError(
            f"Expected more data than parameters to calibrate. Got {problem.n} data and {len(free)} free parameters."
        )
    for term in terms:
        extend(simulator, [term])  # raises for names that do not fit, before any long work
    mask = verify.choose(recording, holdout, len(free))
    bar = tqdm(disable=not progress, desc="diagnose", unit="step", leave=False)

    def tick(text: str) -> None:
        bar.set_postfix_str(text)
        bar.update()

    try:
        search = Search(problem, terms, fixed or {}, seed, num_starts, max_terms, tick)
        tick("calibrate the base")
        search.calibrate_base()
        search.screen_all()
        detected = search.exact or search.p_detect < 1.0 - confidence
        if terms:
            search.refit_singles()
            if detected and _wants_more(search):
                search.refit_several()
        decision = _decide(search, detected, mask)
        return _result(search, decision, simulator, recording, mask, confidence, begun, terms, seed)
    finally:
        bar.close()


def _check(
    simulator: Any, recording: Any, candidates: Any, confidence: float, max_terms: int, num_starts: int
) -> list[Term]:
    if not isinstance(simulator, Simulator):
        raise DomainError(f"Expected a Simulator or an ODESimulator. Got {type(simulator).__name__}.")
    if not isinstance(recording, Recording):
        raise RecordingError(f"Expected a torchcal.Recording. Got {type(recording).__name__}.")
    if isinstance(candidates, Term):
        candidates = [candidates]
    by_name: dict[str, Term] = {}
    for term in candidates:
        if not isinstance(term, Term):
            raise DomainError(f"Expected candidates as torchcal.Term objects. Got {type(term).__name__}: {term!r}.")
        by_name[term.name] = term
    if not 0.5 < confidence < 1:
        raise DomainError(f"Expected confidence between 0.5 and 1. Got {confidence!r}.")
    for name, value in (("max_terms", max_terms), ("num_starts", num_starts)):
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise DomainError(f"Expected {name} as a positive integer. Got {value!r}.")
    return list(by_name.values())


def _wants_more(search: Search) -> bool:
    """Whether one term is not the whole story."""
    physical = [m for m in search.models if m.physical]
    if not physical:
        return True
    best = max(physical, key=lambda m: m.weight)
    if search.exact:
        return explain.removed(search, best) < 0.99999
    return search.examine(best).p_value < 0.05


class _Decision:
    """Verdict, accepted model and probabilities."""

    def __init__(self) -> None:
        self.verdict = "consistent"
        self.best: Model | None = None
        self.tied: list[list[str]] = []
        self.tied_models: list[Model] = []
        self.probability: dict[int, float] = {}
        self.none = 0.0
        self.base = 1.0
        self.none_evidence = 0.0
        self.withdrawn = ""


def _unknown(search: Search, structure: Structure, *, calibrated: bool) -> float:
    """Log evidence of something smooth and unknown beside a model.

    Calibrated, it is held against what noise alone gives: at most −1/(e p ln p) for a probability p (Sellke, Bayarri &
    Berger 2001), and beyond the largest simulated value the surplus.
    """
    kinds = ("equation", "output") if search.problem.in_time else ("parameter", "output")
    places = [p.evidence for p in structure.places if p.channel.kind in kinds]
    if not places:
        return -math.inf
    seen = max(places)
    if not calibrated:
        return seen - math.log(len(places))
    p = structure.p_value
    bound = -math.log(-math.e * p * math.log(p)) if p < 1.0 / math.e else 0.0
    return bound + max(seen - float(structure.null_best.max()), 0.0)


def _none_evidence(search: Search, ranked: list[Model]) -> float:
    """Log weight of "none of these": something unknown in the base, or beside the best models."""
    prior = math.log(PRIOR["none"])
    found = _unknown(search, search.structure, calibrated=False) + prior
    for model in ranked[:4]:
        found = max(found, model.weight + _unknown(search, search.examine(model), calibrated=True) + prior)
    return found


def _decide(search: Search, detected: bool, mask: Tensor | None) -> _Decision:
    decision = _Decision()
    ranked = sorted((m for m in search.models if m.physical), key=lambda m: -m.weight)
    if search.exact:
        return _decide_exact(search, ranked, mask, decision)
    decision.none_evidence = _none_evidence(search, ranked) if detected else math.log(PRIOR["none"])
    _weigh(search, decision)
    if not detected or decision.base >= max(decision.none, *decision.probability.values(), 0.0):
        decision.verdict = "consistent"
        return decision
    groups = _groups(ranked)
    white = [m for m in ranked[:6] if search.examine(m).p_value >= WHITE]
    if not white or decision.none > 0.5:
        decision.verdict = "unexplained"
        _nearly(search, ranked, mask, decision)
        return decision
    best = white[0]
    if groups[frozenset(best.names)] >= NAMED and not _other_names(search, best):
        decision.verdict, decision.best = "named", best
        _prove(search, decision, mask)
        return decision
    decision.verdict = "ambiguous"
    covered = 0.0
    seen: set[frozenset[str]] = set()
    for model in ranked:
        names = frozenset(model.names)
        if names in seen or model.note:
            continue
        if covered >= TIED and seen:
            break
        if seen and model.weight < math.log(PRIOR["base"]):
            break  # no better than the base is no explanation
        seen.add(names)
        covered += groups[names]
        decision.tied.append(list(model.names))
        decision.tied_models.append(model)
        for other in _other_names(search, model):
            decision.tied.append([other if name == search.candidates[model.numbers[0]].name else name for name in model.names])
    if len(decision.tied) < 2:
        decision.verdict, decision.best, decision.tied, decision.tied_models = "named", best, [], []
        _prove(search, decision, mask)
    return decision


def _other_names(search: Search, model: Model) -> list[str]:
    """Aliases of a single term that are different physics: these data cannot tell which it is."""
    if len(model.numbers) != 1 or model.window is not None:
        return []
    i = model.numbers[0]
    return [name for name in search.aliases.get(i, []) if not search.duplicate(i, name)]


def _groups(models: Sequence[Model]) -> dict[frozenset[str], float]:
    """Probability of each set of terms among all physical ones, wherever they act."""
    if not models:
        return {}
    top = max(m.weight for m in models)
    total = sum(math.exp(m.weight - top) for m in models)
    found: dict[frozenset[str], float] = {}
    for m in models:
        names = frozenset(m.names)
        found[names] = found.get(names, 0.0) + math.exp(m.weight - top) / total
    return found


def _gain(search: Search, model: Model, mask: Tensor | None, against: Model | None = None) -> float:
    """Share of the squared misfit of the base, or of another model, that a model removes on held-out data."""
    before = search.base if against is None else against.found
    if mask is None:
        return 1.0 - model.found.chi2 / before.chi2
    seen = mask & search.problem.keep
    old, new = (verify.held_out_fit(found, search.noise, mask) for found in (before, model.found))
    if old is None or new is None:
        return 0.0
    y = search.problem.recording.y[seen]
    floor = 0.0 if search.exact else float(search.noise.sd[seen].square().sum())
    left = [max(float((y - part.prediction[seen]).square().sum()) - floor, 0.0) for part in (old, new)]
    return 1.0 - left[1] / max(left[0], 1e-300)


def _nearly(search: Search, ranked: list[Model], mask: Tensor | None, decision: _Decision) -> None:
    """Real recordings are never quite white: name what removes nearly all, on held-out data too, far before any rival."""
    clean = [m for m in ranked if not m.note]
    if search.problem.recording.noise is not None or not clean:
        return
    for size in sorted({len(m.numbers) for m in clean}):
        mine = sorted((m for m in clean if len(m.numbers) == size), key=lambda m: m.found.chi2)
        best = mine[0]
        if explain.removed(search, best) < NEARLY or _gain(search, best, mask) < REMOVED:
            continue
        left = 1.0 - explain.removed(search, best)
        rivals = [m for m in mine[1:] if frozenset(m.names) != frozenset(best.names)]
        if not _other_names(search, best) and all(1.0 - explain.removed(search, m) > BEATEN * left for m in rivals):
            decision.verdict, decision.best = "named", best
            _prove(search, decision, mask)
        return


def _weigh(search: Search, decision: _Decision, models: Sequence[Model] | None = None) -> None:
    """Probabilities of all hypotheses (or of some of them alone), "none of these" among them."""
    models = search.models if models is None else models
    weights = [m.weight for m in models]
    base = math.log(PRIOR["base"])
    top = max([*weights, base, decision.none_evidence])
    total = sum(math.exp(w - top) for w in [*weights, base, decision.none_evidence])
    decision.probability = {id(m): math.exp(m.weight - top) / total for m in models}
    decision.base = math.exp(base - top) / total
    decision.none = math.exp(decision.none_evidence - top) / total


def _decide_exact(search: Search, ranked: list[Model], mask: Tensor | None, decision: _Decision) -> _Decision:
    """Without noise nothing is white: a term must remove nearly all of the held-out misfit that is left, and more than any
    rival by far; then another may remove nearly all of what that leaves."""
    decision.none_evidence = -math.inf
    recording = search.problem.recording
    if float(search.base.residual.abs().max()) <= 1e-6 * float(recording.spread.max()):
        decision.verdict = "consistent"
        return decision
    clean = [m for m in ranked if not m.note]
    accepted: Model | None = None
    decision.verdict = "unexplained"
    for size in range(1, search.max_terms + 1):
        have = set() if accepted is None else set(accepted.numbers)
        left = search.base.chi2 if accepted is None else accepted.found.chi2
        group = sorted((m for m in clean if len(m.numbers) == size and have <= set(m.numbers)), key=lambda m: m.found.chi2)
        good = [m for m in group if m.found.chi2 <= (1 - REMOVED) * min(left, _least_part(clean, m))
                and _gain(search, m, mask, accepted) >= REMOVED]  # fmt: skip
        if not good:
            continue
        rivals = [m for m in group if frozenset(m.names) != frozenset(good[0].names) and m.found.chi2 < BEATEN * good[0].found.chi2]
        if rivals or _other_names(search, good[0]):
            if accepted is None:
                decision.verdict = "ambiguous"
                decision.tied_models = [good[0], *rivals]
                decision.tied = [list(m.names) for m in decision.tied_models] + [[n] for n in _other_names(search, good[0])]
            break
        accepted = good[0]
    if accepted is not None:
        decision.verdict, decision.best = "named", accepted
    most = len(accepted.numbers) if accepted else len(decision.tied_models[0].numbers) if decision.tied_models else 1
    _weigh(search, decision, [m for m in search.models if len(m.numbers) <= most])
    return decision


def _least_part(models: Sequence[Model], model: Model) -> float:
    """Smallest χ² of a model with fewer of the same terms."""
    return min((m.found.chi2 for m in models if set(m.numbers) < set(model.numbers)), default=math.inf)


def _prove(search: Search, decision: _Decision, mask: Tensor | None) -> None:
    """Withdraw a name that predicts held-out data worse than the base does."""
    if decision.best is None or mask is None:
        return
    before = verify.held_out_fit(search.base, search.noise, mask)
    after = verify.held_out_fit(decision.best.found, search.noise, mask)
    if before is None or after is None:
        return
    seen = mask & search.problem.keep
    gain, error = verify.compare(search.problem.recording, before.prediction, after.prediction, search.noise, seen)
    if gain < -error:
        decision.withdrawn = (
            f"{' and '.join(decision.best.names)} explained the fitted data but predicted held-out data worse than the base "
            f"(by {-gain:.2g} ± {error:.1g} noise variances a datum), so the name is withdrawn."
        )
        decision.verdict, decision.best = "unexplained", None


def _scores(search: Search, found: Fitted, mask: Tensor | None) -> Scores:
    recording = search.problem.recording
    noise = search.noise
    if search.exact:  # the misfit is what predictions are uncertain by
        noise = dataclasses.replace(noise, sd=noise.sd * explain.misfit_size(found))
    prediction, sd = verify.predict(found, noise)
    fitted = verify.score(recording, prediction, sd, search.problem.keep)
    if mask is None:
        return Scores(fitted, None, None)
    apart = verify.held_out_fit(found, noise, mask)
    if apart is None:
        return Scores(fitted, None, None)
    held = verify.score(recording, apart.prediction, apart.sd, mask & search.problem.keep)
    return Scores(fitted, held, apart.prediction)


def _result(
    search: Search,
    decision: _Decision,
    simulator: Simulator,
    recording: Recording,
    mask: Tensor | None,
    confidence: float,
    begun: float,
    terms: list[Term],
    seed: int,
) -> Diagnosis:
    best = decision.best
    shown = best or (decision.tied_models[0] if decision.tied_models else None)
    if shown is not None:
        search.examine(shown)
    base = explain.fit_record(search.base, search.structure, ())
    final = base if best is None else explain.fit_record(best.found, best.structure, best.names)
    _warn(search)
    before = _scores(search, search.base, mask)
    after = None if shown is None else _scores(search, shown.found, mask)
    if best is None:
        improved: Simulator = simulator
    else:
        improved = _improved(simulator, best)
    remaining = 0.0 if decision.verdict == "consistent" else 1.0
    if best is not None:
        remaining = 1.0 - explain.removed(search, best)
    return Diagnosis(
        verdict=decision.verdict,
        terms=list(best.names) if best else [],
        tied=decision.tied,
        where=explain.locate(search, shown) if decision.verdict != "consistent" else Table([], ("kind", "target")),
        ranking=_ranking(search, decision, mask),
        detection_limit=explain.limits(search, 1.0 - confidence, POWER),
        remaining=remaining,
        before=before,
        after=after,
        improved=improved,
        symptoms=explain.symptoms(search, best),
        noise=search.noise.record(search.problem),
        base=base,
        final=final,
        shifts=explain.needed_shifts(search) if decision.verdict != "consistent" else [],
        missing=explain.missing_rate(search) if decision.verdict != "consistent" else None,
        experiment=propose(decision.tied_models[:4], search.noise) if decision.tied_models else None,
        equations=explain.formulas(best) if best else [],
        identifiability=explain.identifiability(search),
        recording=recording,
        simulator=simulator,
        held_out=mask,
        p_detect=search.p_detect,
        confidence=confidence,
        library=[term.name for term in terms],
        settings={"seed": seed, "withdrawn": decision.withdrawn, "solver": _solver(search.problem.simulator)},
        seconds=time.perf_counter() - begun,
        drivers=search._drivers(),
    )


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


def _warn(search: Search) -> None:
    if search.base.agreeing < 0.2:
        warnings.warn(
            f"Only {search.base.agreeing:.0%} of the base's starting values came to the best fit. Give initial= or bounds "
            "to its parameters, or more num_starts.",
            ConvergenceWarning,
            stacklevel=4,
        )


def _ranking(search: Search, decision: _Decision, mask: Tensor | None) -> Table[Hypothesis]:
    rows = []
    ordered = sorted(search.models, key=lambda m: -decision.probability.get(id(m), 0.0))
    for place, model in enumerate(ordered[:60]):
        held = None
        if mask is not None and (place < 3 or model is decision.best):
            apart = verify.held_out_fit(model.found, search.noise, mask)
            if apart is not None:
                held = verify.score(search.problem.recording, apart.prediction, apart.sd, mask & search.problem.keep).rmse
        names = [q.name for q in model.candidate.problem.parameters]
        own: tuple[Estimate, ...] = explain.estimates(model.found, [i for i in model.candidate.own if names[i]])
        rows.append(
            Hypothesis(
                terms=model.names,
                log_evidence=model.log_evidence,
                probability=decision.probability.get(id(model), 0.0),
                estimates=own,
                physical=model.physical,
                misfit_removed=explain.removed(search, model),
                p_white=model.structure.p_value if model.structure else None,
                held_out_rmse=held,
                score=search.screening.score(model.numbers[0]) if len(model.numbers) == 1 else None,
                refitted=True,
                region=describe(model),
                aliases=tuple(search.aliases.get(model.numbers[0], ())) if len(model.numbers) == 1 else (),
                note=model.note,
            )
        )
    fitted = {m.numbers for m in search.models}
    for i, candidate in enumerate(search.candidates):
        if (i,) not in fitted:
            note = "" if candidate.blind or search.screening.best[i] >= 0 else "already in the base model"
            rows.append(Hypothesis((candidate.name,), -math.inf, 0.0, score=search.screening.score(i), note=note))
    rows.append(Hypothesis((), 0.0, decision.base, p_white=search.structure.p_value, refitted=True, note="the base alone"))
    if not search.exact:
            rows.append(
            Hypothesis(("none of these",), decision.none_evidence - math.log(PRIOR["none"]), decision.none, note="something unknown and smooth")
        )
    rows.sort(key=lambda row: (-row.probability, -row.log_evidence))
    return Table(rows, COLUMNS)
