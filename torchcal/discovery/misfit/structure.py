"""Is there more in a residual than noise, and where does it sit?

The residual of a fit, whitened and projected off the fit's tangent space, is compared with unknown smooth changes of
every channel against every driver, with oscillations of every output, and of every equation and parameter in time.
Probabilities come from simulated noise that went through the same projection.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchcal.discovery.fits.local import Span
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.misfit.channels import Channel, channels
from torchcal.discovery.misfit.lines import Lines, lines_of
from torchcal.discovery.misfit.noise import quantisation
from torchcal.discovery.misfit.places import SIZES, Change, Place, evidence_of
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.misfit.steps import Sudden
from torchcal.discovery.misfit.waves import wave_places
from torchcal.display import ITSELF

__all__ = ["Rough", "Structure", "analyse", "evidences", "responses_of", "together_of"]

#: Radial functions along time, and along any other driver: the evidence chooses how many.
IN_TIME, ALONG = (12, 24, 48), (12, 24)
#: The same along two conditions together, and of few data, where these are looked for beside noise that is known.
TOGETHER, FEW_TOGETHER = ((4, 4), (3, 8), (8, 3), (6, 6)), ((2, 2), (3, 3))
#: Of more functions than the fewest, how many data there must be for each, in time and among conditions.
DATA_EACH = (4, 3)


@dataclass(frozen=True, eq=False)
class Structure:
    """What an analysis of a residual found.

    Attributes:
        places: Along one driver each, by falling evidence.
        together: The likeliest smooth change of an output along two conditions together, and the likeliest sum of one
            along each of them; None where none is looked for.
        seen: The largest evidence of what counts for the test.
        p_value: Probability of so much structure by noise alone.
        channels: All of them.
        null_best: Largest evidence in each simulated residual.
    """

    places: list[Place]
    together: tuple[Place, Place] | None
    seen: float
    p_value: float
    channels: list[Channel]
    null_best: Tensor


def _features(driver: Tensor, count: int) -> Tensor:
    """Radial functions ``(K, count)`` that sum to smooth curves along a driver."""
    low, high = float(driver.min()), float(driver.max())
    centres = torch.linspace(low, high, count, dtype=torch.float64)
    width = 1.2 * (high - low) / (count - 1)
    return torch.exp(-0.5 * ((driver[:, None] - centres) / width).square())


@dataclass(frozen=True, eq=False)
class Rough:
    """A wave or a sudden change of an output.

    Attributes:
        curve: Its values at the data, ``(n,)``.
        evidence: Its log evidence in another residual, out of all that are as likely there.
    """

    curve: Tensor
    evidence: Callable[[Residual], float]


@dataclass(frozen=True, eq=False)
class _Look:
    """Smooth changes of a channel along a driver: functions ``(K, m)`` and responses ``(n, m)``, not whitened."""

    channel: Channel
    driver: str
    features: list[Tensor]
    responses: Tensor


def responses_of(problem: Problem, available: Sequence[Channel]) -> list[_Look]:
    """Every channel along every driver, and its logarithm over decades, with fewer and more functions."""
    found = []
    for channel in available:
        data = problem.n if channel.kind != "output" else int((channel.matrix != 0).sum())
        for name, driver in channel.drivers.items():
            distinct = len(driver.unique())
            if distinct < 2:
                continue
            counts = dict.fromkeys(min(count, distinct) for count in _counts(problem, data, name))
            scales = [driver, driver.log()] if Span.of(driver, time=problem.is_time(name)).log else [driver]
            parts = [_features(scale, count) for scale in scales for count in counts]
            found.append(_Look(channel, name, parts, channel.response(torch.cat(parts, dim=1))))
    return found


def together_of(problem: Problem, available: Sequence[Channel]) -> list[_Look]:
    """Every output along every two of several conditions, and itself, together: what depends on one may depend on the
    other too."""
    found = []
    for channel, names in _pairs(problem, available):
        scales = _scales(channel, names)
        distinct = [len(each.unique()) for each in scales]
        parts = _products(channel, scales, [(a, b) for a, b in TOGETHER if a <= distinct[0] and b <= distinct[1]])
        if parts:
            found.append(_Look(channel, " and ".join(names), parts, channel.response(torch.cat(parts, dim=1))))
    return found


def _pairs(problem: Problem, available: Sequence[Channel]) -> list[tuple[Channel, tuple[str, str]]]:
    """Every output of a static simulation with every two of its drivers."""
    outputs = [channel for channel in available if channel.kind == "output" and not problem.in_time]
    return [(channel, names) for channel in outputs for names in itertools.combinations(channel.drivers, 2)]


def _products(channel: Channel, scales: Sequence[Tensor], counts: Iterable[tuple[int, int]]) -> list[Tensor]:
    """Products ``(K, m)`` of so many radial functions along two drivers, where there are data for as many."""
    data = int((channel.matrix != 0).sum())
    return [
        (_features(scales[0], a)[:, :, None] * _features(scales[1], b)[:, None]).flatten(1)
        for a, b in counts
        if DATA_EACH[1] * a * b <= data
    ]


def _scales(channel: Channel, names: tuple[str, str]) -> list[Tensor]:
    """The values of two drivers, their logarithms where these lie over decades."""
    return [each.log() if Span.of(each, time=False).log else each for each in (channel.drivers[one] for one in names)]


def _together(
    residual: Residual, available: Sequence[Channel], residuals: Tensor
) -> tuple[tuple[Place, Place] | None, list[Tensor]]:
    """As `Structure.together`, and the evidence of every change along two conditions in each simulated residual."""
    best: tuple[Place, Place] | None = None
    nulls: list[Tensor] = []
    for channel, names in _pairs(residual.found.problem, available):
        scales = _scales(channel, names)
        distinct = [len(each.unique()) for each in scales]
        if any(name.endswith(ITSELF) for name in names) or min(distinct) < 2:
            continue
        counts = dict.fromkeys((min(a, distinct[0]), min(b, distinct[1])) for a, b in (*FEW_TOGETHER, *TOGETHER))
        each = torch.cat([_features(one, min(ALONG[0], n)) for one, n in zip(scales, distinct, strict=True)], dim=1)
        product, apart = (
            _best_of(residual, channel, names, parts, residuals)
            for parts in (_products(channel, scales, counts), [each])
        )
        if product is None or apart is None:
            continue
        nulls += [product[1], apart[1]]
        if best is None or product[0].evidence > best[0].evidence:
            best = product[0], apart[0]
    return best, nulls


def _best_of(
    residual: Residual, channel: Channel, names: tuple[str, str], parts: list[Tensor], residuals: Tensor
) -> tuple[Place, Tensor] | None:
    """The likeliest change of a channel that some functions of two drivers give, each ``(K, m)``, and the largest
    evidence of any in each simulated residual; None where the base's parameters make up for all of them."""
    if not parts:
        return None
    driver = " and ".join(names)
    look = _Look(channel, driver, parts, channel.response(torch.cat(parts, dim=1)))
    changes = [change for *_, change in _changes(residual, [look], residuals)]
    if not changes:
        return None
    null = torch.stack([evidence_of(change.null, change.s)[0] for change in changes]).amax(0)
    best = max(changes, key=lambda change: float(evidence_of(change.along[:, None], change.s)[0]))
    return dataclasses.replace(best.place(channel, driver, residual), together=names), null


def _counts(problem: Problem, data: int, driver: str) -> list[int]:
    """Numbers of smooth functions along a driver that are tried with some data."""
    most = max(ALONG[0], data // DATA_EACH[0 if problem.in_time else 1])
    return [count for count in (IN_TIME if problem.is_time(driver) else ALONG) if count <= most]


def _lines(residual: Residual, available: Sequence[Channel]) -> list[Lines]:
    """Oscillations of every output."""
    problem = residual.found.problem
    return lines_of(
        problem, available, quantisation(problem), residual.found.whitening.sd,
        lambda data, driver: _counts(problem, data, driver)[-1],
    )  # fmt: skip


def _line_place(lines: Lines, residual: Residual) -> Place:
    """The likeliest oscillation of an output."""
    found = residual.found
    evidence, number = lines.evidence(residual.e[:, None], SIZES)
    profile, removed, frequency = lines.wave(found.residual, residual.e, number, SIZES)
    taken = 2.0 * len(lines.parts) + 1.0  # two amplitudes in every run, and the frequency
    return Place(
        lines.channel, lines.driver, float(evidence[0]), residual.share(removed, taken), profile,
        lines.sd(found.whitening.sd), 1.0 / frequency,
    )  # fmt: skip


def evidences(
    residual: Residual, looks: Sequence[_Look], available: Sequence[Channel], sudden: Sequence[Sudden]
) -> tuple[list[float], Rough | None]:
    """Log evidence for a smooth change of each channel against each driver, and oscillations and sudden changes of
    each output.

    Also returns the oscillation or sudden change that the residual has where one is likelier than all else.
    """
    smooth: dict[int, float] = {}
    for key, _, change in _changes(residual, looks, residual.e[:, None]):
        smooth[key] = max(smooth.get(key, -math.inf), float(evidence_of(change.along[:, None], change.s)[0]))
    found, rough = list(smooth.values()), None
    for lines in _lines(residual, available):
        evidence, number = lines.evidence(residual.e[:, None], SIZES)
        if float(evidence[0]) > max([0.0, *found]):
            wave = lines.wave(residual.found.residual, residual.e, number, SIZES)[0]
            rough = Rough(wave, partial(lines.evidence_of, number=number, sizes=SIZES))
        found.append(float(evidence[0]))
    for each in sudden:
        likely, place, curve = each.evidence(residual)
        if likely > max([0.0, *found]):
            rough = Rough(curve, partial(each.evidence_of, number=place))
        found.append(likely)
    return found, rough


def _changes(residual: Residual, looks: Sequence[_Look], residuals: Tensor) -> Iterator[tuple[int, _Look, Change]]:
    """Changes of every channel along every driver, under the residual's noise."""
    for number, look in enumerate(looks):
        responses = residual.found.whitening(look.responses)
        columns = residual.project(responses)
        if not bool(torch.isfinite(columns).all()):
            continue
        sizes = [part.shape[1] for part in look.features]
        pieces = zip(look.features, columns.split(sizes, 1), responses.split(sizes, 1), strict=True)
        for features, block, whole in pieces:
            change = Change.of(features, block, 1e-9 * float(whole.norm()), residuals, whole)
            if change is not None:
                yield number, look, change


def analyse(residual: Residual, *, every: bool = False) -> Structure:
    """Look for smooth changes of every channel against every driver, and for oscillations.

    Args:
        residual: The fit's.
        every: Also look at channels of kinds that do not count for the test, for the report.
    """
    found = residual.found
    available = channels(found.problem, found)
    kinds = found.problem.kinds
    chosen = [c for c in available if every or c.kind in kinds]
    best: dict[int, Place] = {}
    nulls: dict[int, Tensor] = {}
    both = torch.cat([residual.e[:, None], residual.null], dim=1)
    for key, look, change in _changes(residual, responses_of(found.problem, chosen), both):
        place = change.place(look.channel, look.driver, residual)
        if key not in best or place.evidence > best[key].evidence:
            best[key] = place
        if look.channel.kind in kinds:
            simulated = evidence_of(change.null, change.s)[0]
            nulls[key] = torch.maximum(nulls[key], simulated) if key in nulls else simulated
    places = list(best.values())
    for lines in _lines(residual, chosen):
        places.append(_line_place(lines, residual))
        nulls[-len(places)] = lines.evidence(residual.null, SIZES)[0]
    for place, simulated in wave_places(residual, chosen, both):
        places.append(place)
        if place.channel.kind in kinds:
            nulls[-len(places)] = simulated
    places.sort(key=lambda place: -place.evidence)
    together, more = _together(residual, available, both)
    if not nulls and not more:
        return Structure(places, together, 0.0, 1.0, available, torch.zeros(1, dtype=torch.float64))
    null = torch.stack([*nulls.values(), *more]).amax(0)
    counting = [p.evidence for p in places if p.channel.kind in kinds] + [p.evidence for p in together or ()]
    seen = max(counting, default=0.0)
    p_value = (1.0 + float((null >= seen).sum())) / (1.0 + len(null))
    return Structure(places, together, seen, p_value, available, null)
