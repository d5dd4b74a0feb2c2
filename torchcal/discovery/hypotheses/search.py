"""Every surviving candidate is added and refitted with everything else; evidence and what is left decide."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, prepare, widened
from torchcal.discovery.fits.fitting import Fitted, fit, refit, weighed
from torchcal.discovery.fits.local import Span
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.ranges import drivers_scale
from torchcal.discovery.fits.refits import Refit, refit_all
from torchcal.discovery.fits.sharpen import SOLVER_SHARE, accurate, halved, sharpen
from torchcal.discovery.fits.stop import Stop
from torchcal.discovery.hypotheses.base import calibrate_base
from torchcal.discovery.hypotheses.beginnings import larger_effects, within_bounds
from torchcal.discovery.hypotheses.judge import held_back, judge
from torchcal.discovery.hypotheses.model import PRIOR, Hypothetical, Model
from torchcal.discovery.hypotheses.own_noise import suited
from torchcal.discovery.hypotheses.screen import Screening, Window, screen, windows
from torchcal.discovery.hypotheses.verify import HeldOut, held_out_fit
from torchcal.discovery.misfit.likeliest import Tangents, settled, with_unknown
from torchcal.discovery.misfit.noise import LEAST, Noise
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.misfit.structure import Structure, analyse
from torchcal.errors import DomainError, SimulatorError
from torchcal.terms import Term

__all__ = ["BETTER", "Search", "alike"]

#: Log evidence that a refit must gain for its time steps to be looked at, by how much several terms may fall short of
#: the best fit for that, and how often steps are chosen anew at most.
WORTH, NEAR, ROUNDS = 3.0, 20.0, 3
#: χ² above the base's from which on a refit, which holds the base, has gone astray.
ASTRAY = 1.0
#: How many times the error of its steps a fit is away from what is wanted of it where shorter ones do not lead there.
SURELY = 3.0
#: Log evidence by which something unknown must explain the base's residual better than any noise, to be there.
CLEARLY = 5.0
#: Share of the best log evidence below which a model is not fitted again when the noise estimate has changed, nor on to
#: its end where it falls slowly, nor with shorter steps.
HOPELESS = 0.5
#: Log weight that a term's refit from another start must gain to take the place of the first.
BETTER = 1.0
#: Correlation of projected tangents above which two candidates are one.
SAME = 0.9999


@dataclass(eq=False)
class Search:
    """The state of a diagnosis: the base's fit, the noise, the candidates and the models refitted so far.

    Noise that was given is taken for ``coarser`` times as large, where arithmetic tells no less. Ctrl-C sets ``stop``:
    refits that have ended stay, and no other one begins.
    """

    problem: Problem
    terms: list[Term]
    fixed: Mapping[str, float]
    seed: int
    num_starts: int
    max_terms: int
    tick: Callable[[str], None]
    executor: Executor | None = None
    clean: bool = False
    unit: Tensor | None = None
    coarser: float = 1.0
    stop: Stop = field(default_factory=Stop)
    base: Fitted = field(init=False)
    noise: Noise = field(init=False)
    tangents: Tangents = field(init=False)
    residual: Residual = field(init=False)
    structure: Structure = field(init=False)
    candidates: list[Candidate] = field(init=False, default_factory=list)
    screening: Screening = field(init=False)
    local: list[Window] = field(init=False, default_factory=list)
    models: list[Model] = field(init=False, default_factory=list)
    nameless: list[Model] = field(init=False, default_factory=list)
    unnamed: Model | None = field(init=False, default=None)
    constants: set[int] = field(init=False, default_factory=set)
    aliases: dict[int, list[int]] = field(init=False, default_factory=dict)
    merged: dict[int, Model] = field(init=False, default_factory=dict)
    twins: dict[int, int] = field(init=False, default_factory=dict)
    gone: set[int] = field(init=False, default_factory=set)
    failed: set[int] = field(init=False, default_factory=set)
    left: set[int] = field(init=False, default_factory=set)
    p_detect: float = field(init=False, default=1.0)
    paired: bool = field(init=False, default=False)
    least: Tensor = field(init=False)
    otherwise: dict[int, tuple[Fitted, Fitted | None]] = field(init=False, default_factory=dict)
    _unknown: dict[int, tuple[Fitted, tuple[Noise, float]]] = field(init=False, default_factory=dict)
    _own: dict[tuple[int, int], tuple[Fitted, Noise, tuple[Noise, float]]] = field(init=False, default_factory=dict)
    _held_out: dict[tuple[int, bytes], tuple[Fitted, HeldOut | None]] = field(init=False, default_factory=dict)
    _from_guesses: dict[int, tuple[Fitted, Fitted | None]] = field(init=False, default_factory=dict)

    @property
    def exact(self) -> bool:
        """Whether the recording is declared noise-free."""
        return self.problem.recording.noise == "none"

    @property
    def few(self) -> bool:
        """Whether noise of unknown size is taken for white, as too few data of every output cannot tell correlated."""
        counts = torch.bincount(self.problem.output_of)
        return self.noise.open and int(counts.max()) < LEAST

    def calibrate_base(self) -> None:
        """Calibrate the base, set outliers aside unless that is done, and estimate the noise."""
        self.base, self.noise = calibrate_base(
            self.problem, self.fixed, self.num_starts, self.seed, clean=self.clean, unit=self.unit
        )
        self.problem = self.base.problem
        if not self.exact:
            self.tangents = Tangents.of(self.base, self.noise)
        if self.noise.open:
            noise, evidence = self.with_unknown(self.base)
            if evidence - self.settled(self.base)[1] > CLEARLY:
                self.noise, self.base = noise, refit(self.base, noise.whitening(self.problem))

    def screen_all(self) -> None:
        """Tangents of all candidates, and whether there is more than noise."""
        self.residual = Residual(self.base, self.noise, seed=self.seed)
        scale = drivers_scale(self.base.problem, self.base)
        self.candidates = []
        for term in self.terms:
            self.tick(f"screen {term.name}")
            self.candidates.append(prepare(self.base.problem, self.base, [term], self.fixed, scale))
        for candidate in self.candidates if not self.clean else ():  # later searches: these have been asked
            candidate.problem.check_slopes(candidate.acting, candidate.own, f"the simulator with {candidate.name!r}")
        self.screening = screen(self.residual, self.candidates)
        within = within_bounds(self.base, self.fixed, self.seed)
        for i, candidate in enumerate(self.candidates):
            if self.screening.best[i] < 0 and not candidate.blind:
                bent = larger_effects(self.residual, candidate, within)
                self.candidates[i] = dataclasses.replace(candidate, bent=bent)
        self._alike()
        self.structure = analyse(self.residual, every=True)
        self.local, local_null = windows(self.residual, self.candidates, self.screening)
        nulls = [self.screening.null, self.structure.null_best, local_null]
        seen = [
            max((self.screening.score(i) for i in range(len(self.candidates))), default=0.0),
            max((p.evidence for p in self.structure.places if p.channel.kind in self.problem.kinds), default=0.0),
            max((w.z for w in self.local), default=0.0),
        ]
        self.p_detect, self.least = _joint(nulls, seen)

    def _alike(self) -> None:
        """Which candidates have the same projected tangent as an earlier one, and may have the same sign."""
        self.twins = {}
        side = {i: c.one_sided(c.amplitudes[0]) for i, c in enumerate(self.candidates)
                if len(c.shapes) == 1 and len(c.amplitudes) == 1}  # fmt: skip
        for i in side:
            for k in side:
                alike = self.screening.correlation(i, k) * (side[i] * side[k] or 1)
                if k < i and k not in self.twins and (alike > SAME or (alike < -SAME and not side[i] * side[k])):
                    self.twins[i] = k
                    break

    @property
    def plain(self) -> dict[int, Model]:
        """Models of one term that acts everywhere, by its number."""
        return {m.numbers[0]: m for m in self.models if len(m.numbers) == 1 and m.window is None}

    @property
    def blind(self) -> list[int]:
        """Candidates whose effect no tangent at the base shows, but a larger one may."""
        return [i for i, c in enumerate(self.candidates) if self.screening.best[i] < 0 and c.blind]

    @property
    def unfinished(self) -> list[str]:
        """Candidates that an interruption has left without a fit of their own."""
        return [self.candidates[i].name for i in sorted(self.left)]

    @property
    def leader(self) -> Model | None:
        """The model with the most weight, where there is any."""
        return max(self.models, key=lambda model: model.weight, default=None)

    @property
    def physical_leader(self) -> Model | None:
        """The physical model with the most weight, where there is any."""
        return max((model for model in self.models if model.physical), key=lambda model: model.weight, default=None)

    @property
    def prior(self) -> float:
        """Log prior odds of a single term that acts everywhere."""
        return math.log(PRIOR["single"] / max(len(self.candidates), 1))

    def merge(self) -> None:
        """Candidates whose tangents and refits cannot be told apart become one hypothesis, under the first name."""
        plain, before = self.plain, self.merged
        self.aliases, self.merged = {}, {}
        for i, k in self.twins.items():
            a, b = plain.get(i), plain.get(k)
            own = a or before.get(i)  # once merged it is refitted no more, so that its fit says nothing against it
            if i in self.failed or (own is not None and b is None) or (own is None and not self._follows(i, k, b)):
                continue
            if a is not None and b is not None and (a.physical != b.physical or abs(a.found.chi2 - b.found.chi2) > 0.5):
                continue
            self.aliases.setdefault(k, []).append(i)
            self.merged |= {i: own} if own is not None else {}
        self.gone = {i for alike in self.aliases.values() for i in alike}
        self.models = [m for m in self.models if not self.gone & set(m.numbers)]

    def _follows(self, i: int, k: int, model: Model | None) -> bool:
        """Whether a candidate that was not refitted may have the sign with which it does what another one's model does.
        """
        own, other = self.candidates[i], self.candidates[k]
        side = own.one_sided(own.amplitudes[0])
        if model is None or not side:
            return True
        place = other.amplitudes[0]
        size = float(model.found.values[place]) - float(other.neutral[other.own.index(place)])
        return side * self.screening.correlation(i, k) * size >= 0

    def duplicate(self, i: int, j: int) -> bool:
        """Whether two candidates do the same whatever is calibrated beside them, to first order."""
        u, v = (self.candidates[k].tangents[0, :, 0] for k in (i, j))
        return alike(u, v)

    def improve(self, wanted: Sequence[Hypothetical]) -> None:
        """Refit single terms from other starts, and keep what is better than what was found before."""
        for one, model in zip(wanted, self.refit_together(wanted), strict=True):
            old = self.plain.get(one.numbers[0])
            if model is not None and (old is None or model.weight > old.weight + BETTER):
                self.models = [m for m in self.models if m is not old] + [model]
                self.failed -= {*one.numbers}

    def held_out(self, found: Fitted, mask: Tensor) -> HeldOut | None:
        """A model of this search fitted without the data in ``mask``; computed once."""
        key = (id(found), mask.numpy().tobytes())
        if key not in self._held_out:  # the fit is kept beside it, so that its id stays its own
            self._held_out[key] = (found, held_out_fit(found, self.noise, mask))
        return self._held_out[key][1]

    def from_guesses(self, found: Fitted, begin: Tensor, max_steps: int) -> Fitted | None:
        """A model of this search fitted from first guesses ``(H, P)``; computed once."""
        if id(found) not in self._from_guesses:  # as above
            again = fit(found.problem, found.whitening, begin, found.free, max_steps=max_steps, finish=0)
            self._from_guesses[id(found)] = (found, again)
        return self._from_guesses[id(found)][1]

    def amplitude(self, column: int) -> int:
        """Place of a screened column's amplitude among its candidate's parameters."""
        candidate = self.candidates[int(self.screening.owner[column])]
        return candidate.amplitudes[int(self.screening.amplitude[column])]

    def drivers(self) -> dict[str, Tensor]:
        """What effects may depend on, at every datum of the calibrated base."""
        return self.base.problem.drivers(self.base.values[None], self.base.warm)

    def spans(self) -> dict[str, Span]:
        """Their ranges."""
        return {name: Span.of(each, time=self.problem.is_time(name)) for name, each in self.drivers().items()}

    def refit_together(self, wanted: Sequence[Hypothetical]) -> list[Model | None]:
        """Refit several hypotheses, on the executor where there is one; None where no start gives a fit.

        Each holds the base: what has ended in a worse fit begins there again.
        """
        found = self._fits(wanted)
        astray = [k for k, one in enumerate(found) if one is not None and one.chi2 > self.base.chi2 + ASTRAY]
        again = [dataclasses.replace(wanted[k], begin=wanted[k].candidate.begin[None]) for k in astray]
        for k, fitted in zip(astray, self._fits(again), strict=True):
            old = found[k]
            if fitted is not None and old is not None and fitted.chi2 < old.chi2:
                found[k] = fitted
        every = [*(model.found for model in self.models), *(fitted for fitted in found if fitted is not None)]
        best = max((self.gain(fitted.chi2) for fitted in every), default=0.0)
        models: list[Model | None] = []
        for one, fitted in zip(wanted, found, strict=True):
            if fitted is None:
                models.append(None)
                continue
            least = max(WORTH, HOPELESS * best - NEAR if len(one.numbers) == 1 else best - NEAR)
            if one.window is None and self.gain(fitted.chi2) >= least:  # an edge within a step would only move
                fitted = self._in_short_steps(fitted, self.base.chi2 - 2 * (best - NEAR))
            models.append(self._model(one, fitted))
        return self._with_room(models)

    def _with_room(self, models: list[Model | None]) -> list[Model | None]:
        """The models, those anew that only the range in which a shape was sought holds back; where more room is enough,
        that is the model."""
        models, jobs = list(models), {}
        for k, model in enumerate(models):
            if model is None or model.physical or self.gain(model.found.chi2) < WORTH:
                continue
            stays, given = held_back(model, self.base), [self.terms[i] for i in model.numbers]
            roomy = widened(self.base.problem, model.candidate, stays, given) if stays else None
            if roomy is not None:
                jobs[k] = Hypothetical(model.numbers, roomy, model.found.values[None], model.log_prior, model.window)
        for (k, one), fitted in zip(jobs.items(), self._fits(list(jobs.values())), strict=True):
            if fitted is not None:
                free = self._model(one, self._in_short_steps(fitted))
                models[k] = free if free.physical else models[k]
        return models

    def _fits(self, wanted: Sequence[Hypothetical]) -> list[Fitted | None]:
        """The fits of hypotheses; None where no start gives one, and where the search has been stopped."""
        found: list[Fitted | None] = [None] * len(wanted)
        if self.stop.is_set() or not wanted:
            return found
        aim, jobs = self._aim(self.models), []
        for one in wanted:
            candidate, begin = one.candidate, one.begin
            warm = candidate.problem.guess(self.base.warm, begin)
            shape = [i for i in candidate.own if i not in candidate.amplitudes]
            whitening = self.noise.whitening(candidate.problem)
            jobs.append(Refit(candidate.problem, whitening, begin, candidate.free, shape, warm, aim))
        names = [" + ".join(term.name for term in one.candidate.terms) for one in wanted]

        def take(index: int, fitted: Fitted | None) -> None:
            found[index] = fitted
            self.tick(f"refit with {names[index]}")

        with self.stop.refitting():
            refit_all(jobs, take, self.executor)
        if self.stop.is_set():
            return found
        # A long way is gone to its end only where that may matter beside what the others have come to.
        ended = [self._model(one, fitted) for one, fitted in zip(wanted, found, strict=True) if fitted is not None]
        aim = self._aim([*self.models, *ended])
        slow = {k: fitted for k, fitted in enumerate(found) if fitted is not None and fitted.leads_to(aim)}
        longer = [dataclasses.replace(jobs[k], begun=fitted, aim=aim) for k, fitted in slow.items()]
        if longer:
            with self.stop.refitting():
                refit_all(longer, lambda index, fitted: found.__setitem__([*slow][index], fitted), self.executor)
        return found

    def _aim(self, models: Sequence[Model]) -> float:
        """χ² above which a model plays no part beside some that were found."""
        evidence = [self.gain(model.found.chi2) + model.price for model in models if model.physical]
        best = max(evidence, default=0.0)
        if self.exact or best <= 0:
            return math.inf
        # Where the noise is estimated anew with the best model, the others may come closer to it.
        anew = self.noise.open or bool(self.noise.correlation.any())
        return self.base.chi2 - 2 * ((HOPELESS if anew else 1.0) * best - NEAR)

    def _in_short_steps(self, found: Fitted, wanted: float = math.inf) -> Fitted:
        """A fit with time steps that are short enough for it: what a term brings may be faster than the base.

        One whose steps err by much less than it is away from a χ² that is ``wanted`` stays as it is.
        """
        sd = self.noise.sd[found.problem.index]
        if self.exact or accurate(found, sd):
            return found
        away = math.sqrt(found.chi2) - math.sqrt(max(wanted, 0.0))
        try:
            finer = halved(found)
            if away > 0 and away > SURELY * float(found.whitening.vector(finer - found.y).norm()):
                return found
            return sharpen(found, lambda now: SOLVER_SHARE * sd, rounds=ROUNDS, patient=False, half=finer)[0]
        except (SimulatorError, DomainError):  # with steps so short, or with too many of them
            return found

    def _model(self, one: Hypothetical, fitted: Fitted) -> Model:
        """A hypothesis with its fit, judged."""
        return self._judge(Model(one.numbers, one.candidate, fitted, 0.0, one.prior, True, window=one.window))

    def _judge(self, model: Model) -> Model:
        """The model with its evidence and what speaks against it."""
        judge(model, self.base)
        model.log_evidence = self.gain(model.found.chi2) + model.price
        return model

    def gain(self, chi2: float) -> float:
        """Log evidence of a fit against the base, without its price."""
        if self.exact:  # the size of the misfit is all that is known
            floor = 1e-12 * max(self.base.chi2, 1e-300)
            return 0.5 * self.problem.n * math.log(max(self.base.chi2, floor) / max(chi2, floor))
        return 0.5 * (self.base.chi2 - chi2)

    def reweigh(self) -> None:
        """Estimate the noise again with the best model, and fit everything again where that changes it."""
        best = self.leader
        if self.exact or best is None or best.log_evidence < 3.0:
            return
        hopeful = [m for m in (*self.models, *self.merged.values()) if m.log_evidence > HOPELESS * best.log_evidence]
        fresh = suited(self, hopeful)
        old = self.noise
        change = float((fresh.sd / old.sd).log().abs().max()) + float((fresh.correlation - old.correlation).abs().max())
        if change < 0.05:
            return
        self.take(fresh, hopeful)
        for model in (*self.models, *self.merged.values()):
            self._judge(model)
        self.local, _ = windows(self.residual, self.candidates, self.screening)

    def take(self, noise: Noise, again: Sequence[Model]) -> None:
        """Go on with another noise: the base and some models are fitted again, the others weighed."""
        self.noise = noise
        self.base = refit(self.base, noise.whitening(self.base.problem))
        done: list[Model] = []
        every = (*self.models, *self.merged.values(), *self.nameless)
        for model in sorted(every, key=lambda model: -model.log_evidence):
            whitening = noise.whitening(model.found.problem)
            if any(model is one for one in again):
                model.found = refit(model.found, whitening, aim=self._aim(done))
                done.append(model)
            else:
                model.found = weighed(model.found, whitening)
        self.residual = Residual(self.base, self.noise, seed=self.seed)
        self.screening = screen(self.residual, self.candidates, self.screening)
        self.structure = analyse(self.residual, every=True)

    def take_over(self, models: Sequence[Model]) -> None:
        """Models of another search of the same candidates, fitted to the data of this one from where they stood."""
        best = max((model.log_evidence for model in models), default=0.0)
        for old in models:
            problem = dataclasses.replace(old.found.problem, keep=self.problem.keep)
            whitening = self.noise.whitening(problem)
            found = refit(old.found, whitening, problem) if old.log_evidence > HOPELESS * best else None
            if found is None:
                y, jacobian, _ = problem.evaluate(old.found.values[None], old.found.free, old.found.warm)
                found = dataclasses.replace(old.found, problem=problem, y=y[0], jacobian=jacobian[0])
                found = weighed(found, whitening)
            model = dataclasses.replace(old, found=found, structure=None, residual=None)
            self.models.append(self._judge(model))
        self.reweigh()
        self.merge()

    def with_unknown(self, found: Fitted) -> tuple[Noise, float]:
        """Noise and log evidence of something unknown beside a fit; computed once."""
        if id(found) not in self._unknown:  # the fit is kept beside it, so that its id stays its own
            seen = with_unknown(found, self.problem.recording.noise, self.tangents, self.noise.unit)
            self._unknown[id(found)] = found, seen
        return self._unknown[id(found)][1]

    def settled(self, found: Fitted) -> tuple[Noise, float]:
        """The likeliest noise of a model alone, fitted again under it, and the log-likelihood; computed once."""
        key = id(found), id(self.noise)
        if key not in self._own:
            self._own[key] = found, self.noise, settled(found, self.noise, self.tangents)
        return self._own[key][2]

    def examine(self, model: Model) -> Structure:
        """What is left after a model."""
        if model.structure is None or model.residual is None or model.residual.found is not model.found:
            model.residual = Residual(model.found, self.noise, seed=self.seed, draws=500)
            model.structure = analyse(model.residual)
        return model.structure


def alike(u: Tensor, v: Tensor) -> bool:
    """Whether two effects ``(n,)`` are one but for their sizes."""
    size = float(u.norm() * v.norm())
    return size > 0 and float((u @ v).abs()) >= (1 - 1e-9) * size


def _joint(nulls: Sequence[Tensor], seen: Sequence[float]) -> tuple[float, Tensor]:
    """Probability that noise alone gives one of several statistics as extreme a value as the most extreme one seen.

    Also returns the smallest of their probabilities in every simulated residual.
    """
    draws = len(nulls[0])
    ranks, p = [], []
    for null, value in zip(nulls, seen, strict=True):
        if len(null) != draws or not bool((null > 0).any()):
            continue
        ordered = null.sort().values
        above = draws - torch.searchsorted(ordered, null, right=False)
        ranks.append(above.double() / draws)
        p.append((1.0 + float((null >= value).sum())) / (1.0 + draws))
    if not p:
        return 1.0, torch.ones(draws, dtype=torch.float64)
    least = torch.stack(ranks).amin(0)
    return (1.0 + float((least <= min(p)).sum())) / (1.0 + draws), least
