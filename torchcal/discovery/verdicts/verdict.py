"""The verdict: consistent, named, ambiguous or unexplained."""

import math
from collections.abc import Sequence

from torch import Tensor

from torchcal.discovery.hypotheses.judge import UNPHYSICAL
from torchcal.discovery.hypotheses.model import PRIOR, Model
from torchcal.discovery.hypotheses.own_noise import weigh_alone
from torchcal.discovery.hypotheses.search import Search
from torchcal.discovery.misfit.noise import estimate
from torchcal.discovery.misfit.places import Place
from torchcal.discovery.misfit.replicates import in_common_at
from torchcal.discovery.misfit.structure import Structure
from torchcal.discovery.verdicts.by_share import decide_exact, nearly
from torchcal.discovery.verdicts.decision import Decision, certain, other_names, shares_of, tie_other_names, weigh
from torchcal.discovery.verdicts.doubts import by_hold, doubt, in_common, in_order, unfit
from torchcal.discovery.verdicts.explain import removed
from torchcal.discovery.verdicts.instruments import bends_to_physics, no_instrument, only_instruments, reads_otherwise
from torchcal.discovery.verdicts.proof import prove
from torchcal.discovery.verdicts.together import only_together
from torchcal.display import NONE

__all__ = ["base_alone", "decide"]

#: What is certain among the terms of the library is named when it has at least this probability among all, "none of
#: these" and the base included: a wrong name costs more than three right ones. Of ten names with 0.75 to 0.86 four had
#: been wrong (concealed suite, seeds 1031 and 1032), before what bends like something in no list was a doubt; of eight
#: with 0.80 to 0.85, not given then, all are right (seeds 1035 to 1037).
SURE = 0.8
#: Probability of the base alone above which nothing is called missing, where noise of unknown size and memory may do
#: much: of AR(1) noise of 60 data it had been more than that in four of six false alarms, and of what is missing hardly
#: ever is (seed 5006).
STILL = 0.2
#: Probability of "none of these" from which on the verdict is that; where it has what is missing to 1, it is tied.
UNKNOWN = 0.7
#: The same where that is a nameless change in the window of a term, which the term may be after all.
UNNAMED = 0.9
#: Log odds behind the best model up to which one with fewer terms may be named for what all share.
BEHIND = 5.0
#: The same up to which it is a rival at all; and up to which one explains the data as well.
RIVAL, AS_WELL = 8.0, 1.0
#: Structure left after a hypothesis with less probability than this by noise alone speaks against it.
WHITE = 0.005
#: Structure left with at least this probability is none; and the share of its log evidence by which a linear estimate
#: of something unknown, which is not refitted, may be too large.
PLAINLY_WHITE, LINEAR = 0.05, 0.02
#: χ² that a term in a window must remove for its shape to be as telling as that of one that acts everywhere; and the
#: same along the only condition of a static recording, where nothing else of the term is seen than a piece of a curve.
TELLING, TELLING_ALONE = 500.0, 3000.0
#: Share of the misfit that a term removes beside which what is left may be noise all the same.
NEARLY_ALL = 0.9
#: By how much more than the sd that is given a named model of one term may miss the data, and one of several, which
#: bend to more, beyond chance: such sd are seldom exact.
LARGER, LARGER_TOGETHER, CHANCE = 1.15, 1.08, 2.0
#: Of those less likely than the base, a hypothesis is listed among the tied ones with log odds down to this against the
#: base, and at least this probability; with as much, and more than another one, so is something unknown.
WORSE, WORTH = 1.0, 0.05
#: Of the tied hypotheses, those that together have this probability are listed.
TIED = 0.98


def _unknown(search: Search, structure: Structure, *, calibrated: bool) -> float:
    """Log evidence of something smooth and unknown beside a model.

    Calibrated, it is held against what noise alone gives: at most −1/(e p ln p) for a probability p (Sellke, Bayarri &
    Berger 2001), and beyond the largest simulated value the surplus.
    """
    places = [place.evidence for place in (*_counting(search, structure), *(structure.together or ()))]
    if not places:
        return -math.inf
    seen = max(places)
    if not calibrated:
        return seen - math.log(len(places))
    p = structure.p_value
    bound = -math.log(-math.e * p * math.log(p)) if p < 1.0 / math.e else 0.0
    return bound + max(seen - float(structure.null_best.max()), 0.0)


def _counting(search: Search, structure: Structure) -> list[Place]:
    """The places that speak for something unknown in the base: in time a parameter's smooth change is one of the
    equation's, but its swings are not. (Beside a model they are not looked for.)"""
    return [p for p in structure.places if p.channel.kind in search.problem.kinds or p.period is not None]


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
        return decide_exact(search, ranked, mask, decision)
    decision.none_evidence = math.log(PRIOR["none"])
    if detected:
        unknown, beside, here = weigh_alone(search)
        _dismiss(search, ranked)
        ranked = sorted((m for m in ranked if m.physical), key=lambda m: -m.weight)
        found = _none_evidence(search, ranked, here)
        decision.none_evidence, beside = max(
            (unknown + decision.none_evidence, beside), found, key=lambda one: one[0]
        )
        nameless = max(search.nameless, key=lambda m: m.weight, default=None)
        leading = next(iter(_counting(search, search.structure)), None)
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
    weigh(search, decision)
    by_noise = search.noise.open and decision.base > STILL
    if not detected or by_noise or decision.base >= max(decision.none, *decision.probability.values(), 0.0):
        decision.verdict = "consistent"
        return decision
    white = [m for m in ranked[:6] if search.examine(m).p_value >= WHITE and _small(search, m)]
    if not white or decision.none > (UNKNOWN if search.unnamed is None else UNNAMED):
        decision.verdict = "unexplained"
        nearly(search, ranked, mask, decision)
        if decision.best is None:
            _perhaps_noise(search, ranked, decision)
        return decision
    otherwise: set[str] = set()  # terms of what is as likely that could as well be called something else
    for best in white:
        otherwise |= {own for _, _, own in other_names(search, best)}
        if (
            best.weight > white[0].weight - BEHIND  # what all likely models share is a name, but not of a bad fit
            and set(best.names) <= set(white[0].names)
            and certain(ranked, best)
            and not otherwise & set(best.names)
        ):
            _name(search, decision, best, mask)
            return decision
    best = white[0]
    first = next((model for model in ranked if not model.note), None)
    if first is not None and not _worth_telling(decision, first):
        decision.verdict = "unexplained"
        return decision
    decision.verdict = "ambiguous"
    covered = 0.0
    seen: set[frozenset[str]] = set()
    groups = _by_names(ranked, shares_of(ranked))
    for model in ranked:
        names = frozenset(model.names)
        if names in seen or model.note:
            continue
        if covered >= TIED and seen:
            break
        if not _worth_telling(decision, model):
            break
        seen.add(names)
        covered += groups[names]
        in_windows = [list(m.names) for m in decision.tied_models if m.window is not None]
        if any(set(tied) < names for tied in decision.tied if tied not in in_windows):
            continue  # one that is listed, and more
        decision.tied.append(list(model.names))
        decision.tied_models.append(model)
        tie_other_names(search, model, decision)
        seen |= {frozenset(tied) for tied in decision.tied}
    # One alone is not sure enough, or it had been named; and where several do what something unknown there would do.
    rival = any(m.weight > best.weight - BEHIND for m in search.nameless)
    local = rival and all(model.window is not None for model in decision.tied_models)
    told = decision.tied_models[0] if decision.tied_models else best
    decision.doubt = (
        unfit(search, told)
        or by_hold(search, told)
        or only_together(search, told)
        or in_common(search, told)
        or bends_to_physics(search, told)
    )
    # Windows, instruments and several terms, of which they share none, bend to what no term of the list explains.
    shared = set(best.names).intersection(*(m.names for m in decision.tied_models))
    decision.pliant = all(
        m.window is not None or (len(m.names) > 1 and not shared) or only_instruments(m) for m in decision.tied_models
    )
    likely = _none_is_likely(decision, ranked)
    fewest = [tied for tied in decision.tied if not any({*other} < {*tied} for other in decision.tied)]
    if len(fewest) < 2 or likely or local or decision.pliant or decision.doubt:
        decision.tied.append(list(NONE))
    return decision


def _none_is_likely(decision: Decision, ranked: Sequence[Model]) -> bool:
    """Whether something unknown is as likely as what is tied, so that it is, too."""
    shares = _shares(decision, ranked)
    second, least = (shares[1], shares[-1]) if len(shares) > 1 else (1.0, 1.0)
    return decision.none > min(1 - UNKNOWN, second, max(least, WORTH))


def _worth_telling(decision: Decision, model: Model) -> bool:
    """Whether a hypothesis is an explanation: it may not be clearly less likely than the base."""
    behind = math.log(PRIOR["base"]) - model.weight
    return behind <= 0 or (behind <= WORSE and _is_worth(decision, model))


def _is_worth(decision: Decision, model: Model) -> bool:
    return decision.probability[id(model)] >= WORTH


def _perhaps_noise(search: Search, ranked: Sequence[Model], decision: Decision) -> None:
    """Tie what removes nearly all with something unknown beside it, where noise of unknown size may be all of that."""
    lead = next((m for m in ranked if m.window is None and not m.note), None)
    if not search.noise.open or lead is None or lead.names != decision.beside or removed(search, lead) < NEARLY_ALL:
        return
    told = in_order(search, lead)
    if told:
        decision.verdict, decision.doubt = "ambiguous", told
        decision.tied, decision.tied_models = [list(lead.names), list(NONE)], [lead]


def _dismiss(search: Search, ranked: list[Model]) -> None:
    """Judge likely models with an instrument that is none not to be physical, where another explains the data as well.

    A saturation that is a straight line at the recorded values does what a gain error does.
    """
    top = max((m.weight for m in ranked), default=0.0)
    none = [m for m in ranked if m.weight > top - RIVAL and no_instrument(search, m)]
    others = [m for m in ranked if m.weight > top - AS_WELL and m not in none]
    if not none or not any(search.examine(m).p_value >= WHITE and _small(search, m) for m in others):
        return
    for model in none:
        model.physical, model.note = False, model.note or "no instrument reads like that"
        model.price, model.log_evidence = model.price + UNPHYSICAL, model.log_evidence + UNPHYSICAL


def _by_names(models: Sequence[Model], shares: Sequence[float]) -> dict[frozenset[str], float]:
    """Of each set of terms the sum over its models, wherever they act."""
    found: dict[frozenset[str], float] = {}
    for model, share in zip(models, shares, strict=True):
        names = frozenset(model.names)
        found[names] = found.get(names, 0.0) + share
    return found


def _shares(decision: Decision, ranked: Sequence[Model]) -> list[float]:
    """Probabilities of the tied hypotheses, wherever they act, the largest first; another name of one has its own."""
    shares = _by_names(ranked, [decision.probability[id(model)] for model in ranked])
    known = [shares.get(frozenset(tied)) for tied in decision.tied]
    best = max((share for share in known if share is not None), default=0.0)
    return sorted((best if share is None else share for share in known), reverse=True)


def base_alone(search: Search) -> float:
    """Probability of the base beside the models that were refitted."""
    decision = Decision()
    decision.none_evidence = math.log(PRIOR["none"])
    weigh(search, decision)
    return decision.base


def _small(search: Search, model: Model) -> bool:
    """Whether a model leaves no more than the noise that is given: correlated noise can look like what is left.

    Where the fastest part of what one term leaves is larger than what is given, that is taken for the noise, unless
    data at one value of a condition share it. Several bend to more, and are held to what is given.
    """
    noise, found = search.noise, model.found
    if noise.source != "given":
        return True
    problem = found.problem
    standard = found.residual / noise.sd[problem.index]
    largest = [LARGER_TOGETHER] * len(noise.correlation)
    if len(model.names) == 1 and not in_common_at(problem, standard):
        fastest = estimate(problem, found.residual, found.jacobian, problem.recording.noise).sizes[:, 0]
        largest = (LARGER * fastest.clamp_min(1.0)).tolist()
    for number, (rho, size) in enumerate(zip(noise.correlation.tolist(), largest, strict=True)):
        mine = standard[problem.output_of == number].square()
        if not len(mine):
            continue
        independent = len(mine) * (1 - rho**2) / (1 + rho**2)  # as many squares tell as much of their mean
        if float(mine.mean()) > size**2 * (1 + CHANCE * math.sqrt(2 / max(independent, 1.0))):
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
        decision.doubt = decision.doubt or only_together(search, max(holding, key=lambda m: m.weight))
        more = [m for m in holding if len(m.names) > len(best.names)]
        decision.doubt = decision.doubt or reads_otherwise(shown, max(more, key=lambda m: m.weight))
        _tie_larger(search, decision, holding, sure)
    if sure < SURE or decision.doubt or not shown.physical:
        decision.verdict = "ambiguous"
        physical = [m for m in search.models if m.physical]
        nested: list[Model] = []
        if alone:
            # What acts in a window may stand in for the same everywhere and something beside it, and a term for one
            # that frees more.
            worth = [m for m in physical if m.window is None and not m.note and _is_worth(decision, m)]
            nested = [m for m in worth if m not in holding and m.content > best.content]
            more = [m for m in worth if m in holding and best.window is not None and len(m.names) > len(best.names)]
            others = sorted(
                [*more, *nested, *_rivals(decision, [m for m in physical if m not in holding and m not in nested])],
                key=lambda m: -decision.probability[id(m)],
            )
            decision.tied_models = [best, *others]
            decision.tied = [list(names) for names in dict.fromkeys(m.names for m in decision.tied_models)]
        if decision.doubt or not nested or _none_is_likely(decision, physical):
            decision.tied.append(list(NONE))
        return
    decision.verdict, decision.best = "named", shown
    prove(search, decision, mask)


def _rivals(decision: Decision, others: Sequence[Model]) -> list[Model]:
    """Of some models those that are likely, and likelier than something unknown, without those that are another one of
    these in a window, or add to it."""
    likely = [m for m in others if not m.note and _is_worth(decision, m)]
    found: list[Model] = []
    for model in sorted(likely, key=lambda m: -decision.probability[id(m)]):
        if decision.probability[id(model)] > decision.none and not any({*m.names} <= {*model.names} for m in found):
            found.append(model)
    return found


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
            tie_other_names(search, model, decision)
