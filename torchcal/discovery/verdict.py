"""The verdict: consistent, named, ambiguous or unexplained."""

import math
from collections.abc import Sequence

from torch import Tensor

from torchcal.discovery import explain, verify
from torchcal.discovery.doubts import distinct, doubt, left_open
from torchcal.discovery.model import PRIOR, Model
from torchcal.discovery.own_noise import weigh_alone
from torchcal.discovery.search import Search
from torchcal.discovery.structure import Structure
from torchcal.display import NONE

__all__ = ["Decision", "base_alone", "decide"]

#: A hypothesis is named when it has at least this probability among those of no more terms that the library offers.
NAMED = 0.97
#: The same among hypotheses of more terms too.
NAMED_AMONG_LARGER = 0.8
#: And at least this among all, "none of these" and the base included: a wrong name costs more than three right ones.
#: Of ten names with 0.75 to 0.86 four were wrong, of 58 with more than that one (concealed suite, seeds 1031 and 1032).
SURE = 0.85
#: Probability of "none of these" from which on the verdict is that; where it has what is missing to 1, it is tied.
UNKNOWN = 0.7
#: The same where that is a nameless change in the window of a term, which the term may be after all.
UNNAMED = 0.9
#: Log odds behind the best model up to which one with fewer terms may be named for what all share.
BEHIND = 5.0
#: Structure left after a hypothesis with less probability than this by noise alone speaks against it.
WHITE = 0.005
#: Structure left with at least this probability is none; and the share of its log evidence by which a linear estimate
#: of something unknown, which is not refitted, may be too large.
PLAINLY_WHITE, LINEAR = 0.05, 0.02
#: χ² that a term in a window must remove for its shape to be as telling as that of one that acts everywhere; and the
#: same along the only condition of a static recording, where nothing else of the term is seen than a piece of a curve.
TELLING, TELLING_ALONE = 500.0, 3000.0
#: By how much more than the sd that is given a named model may miss the data, beyond chance: such sd are seldom exact.
LARGER, CHANCE = 1.25, 3.0
#: Noise variances a datum by which held-out predictions may be worse whatever the standard error: 1 % of the RMSE of a
#: model that leaves noise alone.
NOTHING = 0.02
#: Data a free parameter below which a fit without held-out data names nothing.
LEAST_FITTED = 4
#: Of those less likely than the base, a hypothesis is listed among the tied ones with log odds down to this against the
#: base, and at least this probability.
WORSE, WORTH = 1.0, 0.05
#: Of the tied hypotheses, those that together have this probability are listed.
TIED = 0.98
#: Of a recording without noise, the share of the held-out misfit that a named term must remove.
REMOVED = 0.9
#: The same of a recording whose noise is unknown, how much more of the misfit every rival must leave, how many times
#: its noise may be left, and data a free parameter that tell what is noise.
NEARLY, BEATEN, LEFT, PLENTY = 0.97, 3.0, 3.0, 20


class Decision:
    """Verdict, accepted model and probabilities.

    Attributes:
        verdict: As in `Diagnosis`.
        best: The accepted model.
        tied: Sets of names that the data cannot tell apart; of a name that is not all, the sets that hold it.
        tied_models: Their models.
        probability: Of every model, by its ``id``.
        none: Probability of something that is not in the library.
        base: Probability of the base alone.
        none_evidence: Log weight of something that is not in the library.
        none_note: What that is, in words.
        beside: Terms beside which that is likeliest to act; none where it would act alone.
        withdrawn: Why a name was withdrawn, in words.
        doubt: Why the best explanation is no name, though probable, in words.
        nearly: Whether what is left is not white, and the name rests on the share of the misfit that it removes.
    """

    def __init__(self) -> None:
        self.verdict = "consistent"
        self.best: Model | None = None
        self.tied: list[list[str]] = []
        self.tied_models: list[Model] = []
        self.probability: dict[int, float] = {}
        self.none = 0.0
        self.base = 1.0
        self.none_evidence = 0.0
        self.none_note = "something unknown and smooth"
        self.beside: tuple[str, ...] = ()
        self.withdrawn = ""
        self.doubt = ""
        self.nearly = False


def _unknown(search: Search, structure: Structure, *, calibrated: bool) -> float:
    """Log evidence of something smooth and unknown beside a model.

    Calibrated, it is held against what noise alone gives: at most −1/(e p ln p) for a probability p (Sellke, Bayarri &
    Berger 2001), and beyond the largest simulated value the surplus.
    """
    places = [p.evidence for p in structure.places if p.channel.kind in search.problem.kinds]
    if not places:
        return -math.inf
    seen = max(places)
    if not calibrated:
        return seen - math.log(len(places))
    p = structure.p_value
    bound = -math.log(-math.e * p * math.log(p)) if p < 1.0 / math.e else 0.0
    return bound + max(seen - float(structure.null_best.max()), 0.0)


def _none_evidence(search: Search, ranked: list[Model], here: float) -> tuple[float, Model | None]:
    """Log weight of "none of these": something unknown in the base, or beside one of the best models; and that model.

    ``here`` is the log evidence of the base with the noise in use.
    """
    prior = math.log(PRIOR["none"])
    found = _unknown(search, search.structure, calibrated=False) + here + prior
    if any(search.examine(model).p_value >= PLAINLY_WHITE for model in ranked[:2]):
        found -= LINEAR * max(found, 0.0)  # refitted and white: its rival is linear, and as wrong as that
    beside = None
    for model in ranked[:4]:
        left = _unknown(search, search.examine(model), calibrated=True)  # of the search's noise, as this evidence
        value = model.in_use + model.log_prior + left + prior + _by_chance(model)
        if value > found:
            found, beside = value, model
    return found, beside


def _by_chance(model: Model) -> float:
    """Log factor by which something unknown is likelier beside a term in a window than beside one that acts everywhere.

    What is unknown may begin somewhere too, and some term in some window comes near it. That one number of its shape
    agrees with the term's so well that noise hides the rest has a probability as the root of noise over misfit.
    """
    if model.window is None:
        return 0.0
    problem = model.found.problem
    telling = TELLING if problem.in_time or problem.order is None else TELLING_ALONE
    removed = 2.0 * (model.log_evidence - model.price)
    return max(0.5 * math.log(telling / max(removed, 1.0)), 0.0)


def decide(search: Search, detected: bool, mask: Tensor | None) -> Decision:
    """Weigh base, refitted models and something unknown; `mask` marks the held-out data."""
    decision = Decision()
    ranked = sorted((m for m in search.models if m.physical), key=lambda m: -m.weight)
    if search.exact:
        return _decide_exact(search, ranked, mask, decision)
    decision.none_evidence = math.log(PRIOR["none"])
    if detected:
        unknown, beside, here = weigh_alone(search)
        ranked.sort(key=lambda m: -m.weight)
        found = _none_evidence(search, ranked, here)
        decision.none_evidence, beside = max(
            (unknown + decision.none_evidence, beside), found, key=lambda one: one[0]
        )
        nameless = max(search.nameless, key=lambda m: m.weight, default=None)
        leading = next((p for p in search.structure.places if p.channel.kind in search.problem.kinds), None)
        search.unnamed = None
        if nameless is not None and nameless.weight > decision.none_evidence:
            search.unnamed = nameless
            decision.none_evidence = nameless.weight
            decision.none_note = f"{nameless.candidate.name} where {nameless.where}"
        elif beside is not None:
            decision.beside = beside.names
            decision.none_note = f"something unknown beside {' and '.join(beside.names)}"
        elif leading is not None and leading.period is not None:
            decision.none_note = "an unknown oscillation"
    _weigh(search, decision)
    if not detected or decision.base >= max(decision.none, *decision.probability.values(), 0.0):
        decision.verdict = "consistent"
        return decision
    groups = _groups(ranked)
    white = [m for m in ranked[:6] if search.examine(m).p_value >= WHITE and _small(search, m)]
    if not white or decision.none > (UNKNOWN if search.unnamed is None else UNNAMED):
        decision.verdict = "unexplained"
        _nearly(search, ranked, mask, decision)
        return decision
    for best in white:
        if (
            best.weight > white[0].weight - BEHIND  # what all likely models share is a name, but not of a bad fit
            and set(best.names) <= set(white[0].names)
            and _certain(groups, best)
            and not _other_names(search, best)
        ):
            _name(search, decision, best, mask)
            return decision
    best = white[0]
    decision.verdict = "ambiguous"
    covered = 0.0
    seen: set[frozenset[str]] = set()
    for model in ranked:
        names = frozenset(model.names)
        if names in seen or model.note:
            continue
        if covered >= TIED and seen:
            break
        behind = math.log(PRIOR["base"]) - model.weight
        if seen and behind > 0 and (behind > WORSE or decision.probability[id(model)] < WORTH):
            break  # clearly less likely than the base is no explanation
        seen.add(names)
        covered += groups[names]
        if any(set(tied) < names for tied in decision.tied):
            continue  # one that is listed, and more
        decision.tied.append(list(model.names))
        decision.tied_models.append(model)
        _tie_other_names(search, model, decision)
    # One alone is not sure enough, or it had been named; and where several do what something unknown there would do.
    rival = any(m.weight > best.weight - BEHIND for m in search.nameless)
    local = rival and all(model.window is not None for model in decision.tied_models)
    if len(decision.tied) < 2 or decision.none > min(1 - UNKNOWN, _second(decision, ranked)) or local:
        decision.tied.append(list(NONE))
    return decision


def _second(decision: Decision, ranked: Sequence[Model]) -> float:
    """Probability of the second likeliest of the tied hypotheses, wherever it acts; another name of one has its own."""
    shares: dict[frozenset[str], float] = {}
    for model in ranked:
        names = frozenset(model.names)
        shares[names] = shares.get(names, 0.0) + decision.probability[id(model)]
    known = [shares.get(frozenset(tied)) for tied in decision.tied]
    best = max((share for share in known if share is not None), default=0.0)
    told = sorted(best if share is None else share for share in known)
    return told[-2] if len(told) > 1 else 1.0


def base_alone(search: Search) -> float:
    """Probability of the base beside the models that were refitted."""
    decision = Decision()
    decision.none_evidence = math.log(PRIOR["none"])
    _weigh(search, decision)
    return decision.base


def _small(search: Search, model: Model) -> bool:
    """Whether a model leaves no more than the noise that is given: correlated noise can look like what is left.

    Where the fastest part of the residual is larger than what is given, that is taken for the noise.
    """
    noise = search.noise
    if noise.source != "given":
        return True
    problem = model.found.problem
    standard = (model.found.residual / noise.sd[problem.index]).square()
    for number, rho in enumerate(noise.correlation.tolist()):
        mine = standard[problem.output_of == number]
        if not len(mine):
            continue
        size = max(float(noise.sizes[number, 0]), 1.0)
        independent = len(mine) * (1 - rho**2) / (1 + rho**2)  # as many squares tell as much of their mean
        if float(mine.mean()) > (LARGER * size) ** 2 * (1 + CHANCE * math.sqrt(2 / max(independent, 1.0))):
            return False
    return True


def _name(search: Search, decision: Decision, best: Model, mask: Tensor | None) -> None:
    """Name what a model adds, if it is probable enough and the held-out data do not object."""
    holding = [m for m in search.models if m.physical and not m.note and set(best.names) <= set(m.names)]
    sure = sum(decision.probability[id(m)] for m in holding)
    larger = sum(decision.probability[id(m)] for m in holding if len(m.names) > len(best.names))
    alone = larger <= sure - larger
    shown = best if alone else _wherever(search, best)
    decision.doubt = doubt(search, shown)
    if not alone:
        _tie_larger(search, decision, holding, sure)
    if sure < SURE or decision.doubt or not shown.physical:
        decision.verdict = "ambiguous"
        if alone:
            decision.tied, decision.tied_models = [list(best.names)], [best]
        decision.tied.append(list(NONE))
        return
    decision.verdict, decision.best = "named", shown
    _prove(search, decision, mask)


def _wherever(search: Search, best: Model) -> Model:
    """A model's terms without its window, where others beside them are likelier: it may only stand in for these."""
    plain = search.plain.get(best.numbers[0])
    return best if best.window is None or plain is None else plain


def _tie_larger(search: Search, decision: Decision, holding: Sequence[Model], sure: float) -> None:
    """List the hypotheses that share what is named and differ in what else they add, up to a share of theirs."""
    covered = 0.0
    for model in sorted(holding, key=lambda m: -decision.probability[id(m)]):
        if covered >= TIED * sure:
            break
        covered += decision.probability[id(model)]
        if model.window is None:
            decision.tied.append(list(model.names))
            decision.tied_models.append(model)
            _tie_other_names(search, model, decision)


def _other_names(search: Search, model: Model) -> list[tuple[int, str, str]]:
    """Names that the model could as well have: for each the candidate's number, its name, and the one it replaces.

    A model of a window goes by another name only where that does the same everywhere.
    """
    found = []
    for i in model.numbers:
        own = search.candidates[i].name
        for j in search.aliases.get(i, []):
            if model.window is None or search.duplicate(i, j):
                found.append((j, search.candidates[j].name, own))
    return found


def _tie_other_names(search: Search, model: Model, decision: Decision) -> None:
    """Add what a model could as well be called to the tied hypotheses, with its own fit where there is one."""
    for number, name, own in _other_names(search, model):
        decision.tied.append([name if term == own else term for term in model.names])
        other = search.merged.get(number)
        if other is not None and len(model.numbers) == 1 and model.window is None:
            decision.tied_models.append(other)


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


def _certain(groups: dict[frozenset[str], float], model: Model) -> bool:
    """Whether all of a model's terms are there, whatever else is.

    Several others together can copy almost anything, and are the rarer the more they are: against them less will do.
    """
    own = frozenset(model.names)
    holding = sum(share for names, share in groups.items() if names >= own)
    others = sum(share for names, share in groups.items() if not names >= own and len(names) <= len(own))
    return holding >= NAMED * (holding + others) and holding >= NAMED_AMONG_LARGER


def _gain(search: Search, model: Model, mask: Tensor | None, against: Model | None = None) -> float:
    """Share of the squared misfit of the base, or of another model, that a model removes on held-out data."""
    before = search.base if against is None else against.found
    if mask is None:  # what was fitted proves nothing where there are few data a parameter
        enough = distinct(search.problem) >= LEAST_FITTED * len(model.found.free)
        return 1.0 - model.found.chi2 / before.chi2 if enough else 0.0
    seen = mask & search.problem.keep
    if not bool(seen.any()):
        return 0.0
    old, new = (search.held_out(found, mask) for found in (before, model.found))
    if old is None or new is None:
        return 0.0
    y, sd = search.problem.recording.y[seen], search.noise.sd[seen]
    floor = 0.0 if search.exact else float(len(y))
    left = [max(float(((y - part.prediction[seen]) / sd).square().sum()) - floor, 0.0) for part in (old, new)]
    return 1.0 - left[1] / max(left[0], 1e-300)


def _nearly(search: Search, ranked: list[Model], mask: Tensor | None, decision: Decision) -> None:
    """Real recordings are never quite white: name what removes nearly all, on held-out data too, far before rivals."""
    clean = [m for m in ranked if not m.note and m.window is None]  # a window bends to whatever is left
    if search.problem.recording.noise is not None or not clean:
        return
    for size in (1, 2):  # three bend to almost anything
        mine = sorted((m for m in clean if len(m.numbers) == size), key=lambda m: m.found.chi2)
        if not mine:
            continue
        best = mine[0]
        if explain.removed(search, best) < NEARLY or _gain(search, best, mask) < REMOVED:
            continue
        most = min((1 - REMOVED) * search.base.chi2, LEFT**2 * search.problem.n)
        few = distinct(search.problem) < PLENTY * len(best.found.free)
        if best.found.chi2 > most or few or left_open(search, best):
            continue  # most of the misfit was noise, or most of what is left is not; or the data leave it open
        left = 1.0 - explain.removed(search, best)
        rivals = [m for m in mine[1:] if frozenset(m.names) != frozenset(best.names)]
        if not _other_names(search, best) and all(1.0 - explain.removed(search, m) > BEATEN * left for m in rivals):
            decision.verdict, decision.best, decision.nearly = "named", best, True
            _prove(search, decision, mask)
        return


def _weigh(search: Search, decision: Decision, models: Sequence[Model] | None = None) -> None:
    """Probabilities of all hypotheses (or of some of them alone), "none of these" among them."""
    models = search.models if models is None else models
    weights = [m.weight for m in models]
    base = math.log(PRIOR["base"])
    top = max([*weights, base, decision.none_evidence])
    total = sum(math.exp(w - top) for w in [*weights, base, decision.none_evidence])
    decision.probability = {id(m): math.exp(m.weight - top) / total for m in models}
    decision.base = math.exp(base - top) / total
    decision.none = math.exp(decision.none_evidence - top) / total


def _decide_exact(search: Search, ranked: list[Model], mask: Tensor | None, decision: Decision) -> Decision:
    """Without noise nothing is white: a term must remove nearly all of the held-out misfit that is left, far more than
    any rival; then another may remove nearly all of what that leaves."""
    decision.none_evidence = -math.inf
    recording = search.problem.recording
    if bool((search.base.residual.abs() <= 1e-6 * recording.spread[search.base.problem.index]).all()):
        decision.verdict = "consistent"
        return decision
    clean = [m for m in ranked if not m.note]
    accepted: Model | None = None
    decision.verdict = "unexplained"
    for size in range(1, search.max_terms + 1):
        have = set() if accepted is None else set(accepted.numbers)
        left = search.base.chi2 if accepted is None else accepted.found.chi2
        group = sorted(
            (m for m in clean if len(m.numbers) == size and have <= set(m.numbers)), key=lambda m: m.found.chi2
        )
        good = [m for m in group if m.found.chi2 <= (1 - REMOVED) * min(left, _least_part(clean, m))
                and _gain(search, m, mask, accepted) >= REMOVED]  # fmt: skip
        if not good:
            continue
        rivals = [
            m
            for m in group
            if frozenset(m.names) != frozenset(good[0].names) and m.found.chi2 < BEATEN * good[0].found.chi2
        ]
        if rivals or _other_names(search, good[0]):
            if accepted is None:
                decision.verdict = "ambiguous"
                decision.tied_models = [good[0], *rivals]
                decision.tied = [list(m.names) for m in decision.tied_models]
                _tie_other_names(search, good[0], decision)
            break
        if accepted is not None and doubt(search, good[0]):
            break  # what is there already may be a name all the same
        accepted = good[0]
    if accepted is not None and (why := doubt(search, accepted)):
        decision.verdict, decision.doubt = "ambiguous", why
        decision.tied, decision.tied_models = [list(accepted.names), list(NONE)], [accepted]
    elif accepted is not None:
        decision.verdict, decision.best = "named", accepted
    most = len(accepted.numbers) if accepted else len(decision.tied_models[0].numbers) if decision.tied_models else 1
    _weigh(search, decision, [m for m in search.models if len(m.numbers) <= most])
    return decision


def _least_part(models: Sequence[Model], model: Model) -> float:
    """Smallest χ² of a model with fewer of the same terms."""
    return min((m.found.chi2 for m in models if set(m.numbers) < set(model.numbers)), default=math.inf)


def _prove(search: Search, decision: Decision, mask: Tensor | None) -> None:
    """Withdraw a name that predicts held-out data worse than the base does."""
    if decision.best is None or mask is None:
        return
    before = search.held_out(search.base, mask)
    after = search.held_out(decision.best.found, mask)
    if before is None or after is None:
        return
    seen = mask & search.problem.keep
    if not bool(seen.any()):
        return
    gain, error = verify.compare(search.problem.recording, before, after, search.noise, seen)
    if gain < -max(error, NOTHING):
        decision.withdrawn = (
            f"{' and '.join(decision.best.names)} explained the fitted data but predicted held-out data worse than the "
            f"base (by {-gain:.2g} ± {error:.1g} noise variances a datum), so the name is withdrawn."
        )
        decision.tied, decision.tied_models = [list(decision.best.names), list(NONE)], [decision.best]
        decision.verdict, decision.best = "ambiguous", None
