"""Candidates that no data of this kind tell apart: one hypothesis, under the first name."""

from torchcal.discovery.hypotheses.model import Model
from torchcal.discovery.hypotheses.search import Search

__all__ = ["copies", "duplicate", "merge", "merge_sets"]

#: χ² up to which two fits of one size are one.
SAME_FIT = 0.5


def merge(search: Search) -> None:
    """Candidates whose tangents and refits cannot be told apart become one hypothesis, under the first name."""
    plain, before = search.plain, search.merged
    search.aliases, search.merged = {}, {}
    for i, k in search.twins.items():
        a, b = plain.get(i), plain.get(k)
        own = a or before.get(i)  # once merged it is refitted no more, so that its fit says nothing against it
        if i in search.failed or (own is not None and b is None) or (own is None and not _follows(search, i, k, b)):
            continue
        if a is not None and b is not None and not _same_fit(a, b):
            continue
        search.aliases.setdefault(k, []).append(i)
        search.merged |= {i: own} if own is not None else {}
    search.gone = {i for alike in search.aliases.values() for i in alike}
    same, alone = copies(search), {id(model) for i, model in plain.items() if i in search.gone}
    search.models = [m for m in search.models if id(m) not in alone and not same & set(m.numbers)]
    merge_sets(search)


def merge_sets(search: Search) -> None:
    """Several terms with one that is merged become those with the other, where the rest does not tell them apart."""
    found: dict[frozenset[int], list[Model]] = {}
    for model in sorted(search.models, key=lambda m: len(search.gone & set(m.numbers))):
        if len(model.numbers) > 1 and model.window is None:
            first = frozenset(search.twins[i] if i in search.gone else i for i in model.numbers)
            alike = found.setdefault(first if len(first) == len(model.numbers) else frozenset(model.numbers), [])
            if not any(_same_fit(model, other) for other in alike):
                alike.append(model)
    kept = {id(model) for alike in found.values() for model in alike}
    search.models = [m for m in search.models if len(m.numbers) == 1 or m.window is not None or id(m) in kept]


def _same_fit(a: Model, b: Model) -> bool:
    return a.physical == b.physical and abs(a.found.chi2 - b.found.chi2) <= SAME_FIT


def _follows(search: Search, i: int, k: int, model: Model | None) -> bool:
    """Whether a candidate that was not refitted may have the sign with which it does what another one's model does.
    """
    own, other = search.candidates[i], search.candidates[k]
    side = own.one_sided(own.amplitudes[0])
    if model is None or not side:
        return True
    place = other.amplitudes[0]
    size = float(model.found.values[place]) - other.neutral_at(place)
    return side * search.screening.correlation(i, k) * size >= 0


def copies(search: Search) -> set[int]:
    """Merged candidates that do the same whatever is calibrated beside them, to first order: of the others some may be
    told apart beside another term, or where they act in a range."""
    return {i for i in search.gone if duplicate(search, search.twins[i], i)}


def duplicate(search: Search, i: int, j: int) -> bool:
    """Whether two candidates do the same whatever is calibrated beside them, to first order."""
    u, v = (search.candidates[k].tangents[0, :, 0] for k in (i, j))
    size = float(u.norm() * v.norm())
    return size > 0 and float((u @ v).abs()) >= (1 - 1e-9) * size
