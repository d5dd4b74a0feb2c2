"""The state of a diagnosis: base, noise, candidates and models, and what each of them is weighed by."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcal.discovery.fits.candidates import Candidate, prepare
from torchcal.discovery.fits.fitting import Fitted, fit, refit, weighed
from torchcal.discovery.fits.local import Span
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.ranges import drivers_scale
from torchcal.discovery.fits.stop import Stop
from torchcal.discovery.hypotheses.base import calibrate_base, runs_away
from torchcal.discovery.hypotheses.beginnings import larger_effects, within_bounds
from torchcal.discovery.hypotheses.judge import judge
from torchcal.discovery.hypotheses.model import PRIOR, Hypothetical, Model
from torchcal.discovery.hypotheses.own_noise import suited
from torchcal.discovery.hypotheses.screen import Screening, Window, screen, twins, windows
from torchcal.discovery.hypotheses.verify import HeldOut, held_out_fit
from torchcal.discovery.misfit.likeliest import Tangents, density, settled, with_unknown
from torchcal.discovery.misfit.noise import LEAST, Noise
from torchcal.discovery.misfit.residual import Residual
from torchcal.discovery.misfit.structure import Structure, analyse
from torchcal.terms import Term

__all__ = ["CHECKED", "HOPELESS", "NEAR", "Search"]

#: Log evidence by which a model may fall short of the best one and still play a part.
NEAR = 20.0
#: Log evidence by which something unknown must explain the base's residual better than any noise, to be there.
CLEARLY = 5.0
#: Share of the best log evidence below which a model is not fitted again when the noise estimate has changed, nor on to
#: its end where it falls slowly, nor with shorter steps.
HOPELESS = 0.5
#: Log odds from which on even a small change of the noise counts: of samples far closer together than most, a weak
#: correlation from each to the next, which a misfit has feigned, is a strong one.
LIKELIER = 3.0
#: Simulated residuals by which what a model leaves is held to be noise or not.
CHECKED = 500


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
    elsewhere: Tensor = field(init=False)
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

    def calibrate_base(self, begin: Tensor | None = None) -> None:
        """Calibrate the base, set outliers aside unless that is done, and estimate the noise; from one starting value
        ``(1, P)`` where that is known to be better than any guess."""
        self.base, self.noise = calibrate_base(
            self.problem, self.fixed, self.num_starts, self.seed, clean=self.clean, unit=self.unit, begin=begin
        )
        self.problem = self.base.problem
        self.elsewhere = self.base.values[None][:0]
        if not self.exact:
            self.tangents = Tangents.of(self.base, self.noise)
        if self.noise.open:
            noise, evidence = self.with_unknown(self.base)
            if evidence - self.settled(self.base)[1] > CLEARLY:
                self.noise, self.base = noise, refit(self.base, noise.whitening(self.problem))

    def restart(self, begin: Tensor) -> None:
        """As new, with the base calibrated from a starting value ``(1, P)``."""
        for one in dataclasses.fields(self):
            if not one.init and one.default_factory is not dataclasses.MISSING:
                setattr(self, one.name, one.default_factory())
            elif not one.init and one.default is not dataclasses.MISSING:
                setattr(self, one.name, one.default)
        self.calibrate_base(begin)

    def screen_all(self) -> None:
        """Tangents of all candidates, and whether there is more than noise."""
        self.residual = Residual(self.base, self.noise, seed=self.seed)
        scale = drivers_scale(self.base.problem, self.base)
        self.candidates = []
        for term in self.terms:
            self.tick(f"screen {term.name}")
            self.candidates.append(prepare(self.base.problem, self.base, [term], self.fixed, scale))
        for candidate in self.candidates if not self.clean else ():  # later searches: these have been asked
            what = f"the simulator with {candidate.name!r}"
            candidate.problem.check_slopes(candidate.acting, candidate.own, what, self.base.warm)
        self.screening = screen(self.residual, self.candidates)
        within = within_bounds(self.base, self.fixed, self.seed)
        for i, candidate in enumerate(self.candidates):
            if self.screening.best[i] < 0 and not candidate.blind:
                bent = larger_effects(self.residual, candidate, within)
                self.candidates[i] = dataclasses.replace(candidate, bent=bent)
        self.twins = twins(self.candidates, self.screening)
        self.structure = analyse(self.residual, every=True)
        self.local, local_null = windows(self.residual, self.candidates, self.screening)
        nulls = [self.screening.null, self.structure.null_best, local_null]
        seen = [
            max((self.screening.score(i) for i in range(len(self.candidates))), default=0.0),
            self.structure.seen,
            max((w.z for w in self.local), default=0.0),
        ]
        self.p_detect, self.least = _joint(nulls, seen)

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

    def aim(self, models: Sequence[Model]) -> float:
        """χ² above which a model plays no part beside some that were found."""
        evidence = [self.gain(model.found.chi2) + model.price for model in models if model.physical]
        best = max(evidence, default=0.0)
        if self.exact or best <= 0:
            return math.inf
        # Where the noise is estimated anew with the best model, the others may come closer to it.
        anew = self.noise.open or bool(self.noise.correlation.any())
        return self.base.chi2 - 2 * ((HOPELESS if anew else 1.0) * best - NEAR)

    def model(self, one: Hypothetical, fitted: Fitted) -> Model:
        """A hypothesis with its fit, judged."""
        return self.judge(Model(one.numbers, one.candidate, fitted, 0.0, one.prior, True, window=one.window))

    def judge(self, model: Model) -> Model:
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
        old, problem = self.noise, best.found.problem
        likelier = density(best.found, fresh.whitening(problem)) - density(best.found, old.whitening(problem))
        change = float((fresh.sd / old.sd).log().abs().max()) + float((fresh.correlation - old.correlation).abs().max())
        if change < 0.05 and likelier < LIKELIER:
            return
        base = refit(self.base, fresh.whitening(self.base.problem))
        if bool(runs_away(base, self.base).any()):
            return
        self.take(fresh, hopeful, base)
        for model in (*self.models, *self.merged.values()):
            self.judge(model)
        self.local, _ = windows(self.residual, self.candidates, self.screening)

    def take(self, noise: Noise, again: Sequence[Model], base: Fitted | None = None) -> None:
        """Go on with another noise: the base, if it has not been, and some models are fitted again, the others weighed.
        """
        self.noise = noise
        self.base = refit(self.base, noise.whitening(self.base.problem)) if base is None else base
        done: list[Model] = []
        every = (*self.models, *self.merged.values(), *self.nameless)
        for model in sorted(every, key=lambda model: -model.log_evidence):
            whitening = noise.whitening(model.found.problem)
            if any(model is one for one in again):
                model.found = refit(model.found, whitening, aim=self.aim(done))
                done.append(model)
            else:
                model.found = weighed(model.found, whitening)
        self.residual = Residual(self.base, self.noise, seed=self.seed)
        self.screening = screen(self.residual, self.candidates, self.screening)
        self.structure = analyse(self.residual, every=True)

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
            model.residual = Residual(model.found, self.noise, seed=self.seed, draws=CHECKED)
            model.structure = analyse(model.residual)
        return model.structure


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
