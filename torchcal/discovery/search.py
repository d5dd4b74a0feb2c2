"""Every surviving candidate is added and refitted with everything else; evidence and what is left decide."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcal.discovery.candidates import Candidate, base_columns, drivers_scale, prepare
from torchcal.discovery.fitting import Fitted, fit, follow_slopes, refit, starts
from torchcal.discovery.local import localised, region_text
from torchcal.discovery.noise import Noise, estimate, spikes
from torchcal.discovery.problem import Problem
from torchcal.discovery.screen import Screening, Window, screen, windows
from torchcal.discovery.structure import Residual, Structure, analyse
from torchcal.errors import ConvergenceError, DomainError, SimulatorError
from torchcal.simulators import Trajectories
from torchcal.terms import Term

__all__ = ["Model", "Search"]

#: Prior probabilities: of the base, of one library term, of a local one, of two, and of something else.
PRIOR = {"base": 0.30, "single": 0.40, "local": 0.10, "several": 0.08, "none": 0.12}
#: Prior odds against an estimate on a physical bound that it wants to cross.
UNPHYSICAL = math.log(1e-3)
#: Refits at most: single terms, windows, pairs.
MOST = {"single": 40, "local": 6, "pairs": 12}
#: Refitted in any case: this many, and those with at least this share of the largest score.
FEW, CHANCE = 6, 0.2
#: Data below which no window is sought; nor is any without noise, where a window bends to whatever is left.
LEAST_LOCAL = 30
#: Shares of the linear estimate from which refits begin.
STEPS = (0.05, 1.0)
#: Correlation of projected tangents above which two candidates are one.
SAME = 0.9999
#: The solver's error against the noise.
SOLVER_SHARE = 0.05


@dataclass(eq=False)
class Model:
    """A hypothesis that was refitted.

    Attributes:
        numbers: Numbers of its candidates in the library.
        candidate: Terms, simulator and places of parameters.
        found: Its fit.
        log_evidence: Against the base, penalties for parameters included.
        log_prior: Of the hypothesis.
        physical: Whether nothing lies on a bound that it wants to cross.
        note: What speaks against it.
        window: Where it acts, if locally.
        structure: What is left; filled in for the best.
    """

    numbers: tuple[int, ...]
    candidate: Candidate
    found: Fitted
    log_evidence: float
    log_prior: float
    physical: bool
    note: str = ""
    window: Window | None = None
    structure: Structure | None = None
    residual: Residual | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of its terms."""
        return tuple(term.name for term in self.candidate.terms)

    @property
    def weight(self) -> float:
        """Log of prior times evidence."""
        return self.log_evidence + self.log_prior


@dataclass(eq=False)
class Search:
    """The state of a diagnosis: the base's fit, the noise, the candidates and the models refitted so far."""

    problem: Problem
    terms: list[Term]
    fixed: Mapping[str, float]
    seed: int
    num_starts: int
    max_terms: int
    tick: Callable[[str], None]
    base: Fitted = field(init=False)
    noise: Noise = field(init=False)
    residual: Residual = field(init=False)
    structure: Structure = field(init=False)
    candidates: list[Candidate] = field(init=False, default_factory=list)
    screening: Screening = field(init=False)
    local: list[Window] = field(init=False, default_factory=list)
    models: list[Model] = field(init=False, default_factory=list)
    aliases: dict[int, list[str]] = field(init=False, default_factory=dict)
    twins: dict[int, int] = field(init=False, default_factory=dict)
    gone: set[int] = field(init=False, default_factory=set)
    p_detect: float = field(init=False, default=1.0)
    outliers: int = 0

    @property
    def exact(self) -> bool:
        """Whether the recording is declared noise-free."""
        return self.problem.recording.noise == "none"

    # --- base -------------------------------------------------------------------------------------------

    def calibrate_base(self) -> None:
        """Fit the base, set outliers aside, estimate the noise, shorten the solver's steps where they matter."""
        recording = self.problem.recording
        free, held = base_columns(self.problem, self.fixed)
        self.free = free
        rough = recording.noise if isinstance(recording.noise, Tensor) else 0.1 * recording.spread
        outputs = torch.zeros(len(recording.outputs), dtype=torch.float64)
        begin = starts(self.problem, self.num_starts, self.seed, held)
        for i, value in held.items():
            begin[:, i] = value
        found = self._from_starts(begin, free, rough, outputs)
        if found is None:
            raise ConvergenceError(
                "Expected finite outputs of the base at one of the starting values at least. Got none in "
                f"{self.num_starts} (give initial= or bounds to the parameters)."
            )
        found = self._sharpen(found)
        if not self.exact:
            for _ in range(3):
                given = recording.noise if isinstance(recording.noise, Tensor) else None
                sd = given
                bad = spikes(found.problem, found.residual, sd)
                if not bool(bad.any()) or float(bad.double().mean()) > 0.2:
                    break
                keep = found.problem.keep.clone()
                keep[found.problem.index[bad]] = False
                found = self._again(found, keep)
        self.problem = found.problem
        self.noise = estimate(found.problem, found.residual, found.jacobian, recording.noise)
        self.base = refit(found, self.noise.whitening(found.problem))
        if not self.exact:
            self.noise = estimate(self.base.problem, self.base.residual, self.base.jacobian, recording.noise)
            self.base = refit(self.base, self.noise.whitening(self.base.problem))
            self.base = self._sharpen(self.base)
            self.problem = self.base.problem

    def _from_starts(self, begin: Tensor, free: list[int], rough: Tensor, outputs: Tensor) -> Fitted | None:
        """The best fit from many starts: over the first part of the runs, then over all, so that no phase is lost."""
        problem = self.problem
        if not problem.in_time:
            return fit(problem, problem.whitening(rough, outputs), begin, free)
        guided = follow_slopes(problem, begin)
        begin = torch.cat([guided, begin[: max(2, len(begin) // 4)]])
        keep = torch.zeros(problem.recording.n, dtype=torch.bool)
        run = problem.recording.x["run"]  # type: ignore[index]
        for r in run.unique():
            mine = (run == r).nonzero()[:, 0]
            keep[mine[: max(8, len(mine) // 4)]] = True
        early = problem.keeping(keep.repeat(len(problem.recording.outputs)))
        ends = begin
        if early.n >= 3 * len(free):
            first = fit(early, early.whitening(rough, outputs), begin, free, max_steps=15)
            if first is not None and first.ends is not None and first.ends_chi2 is not None:
                order = first.ends_chi2.argsort()
                ends = torch.cat([first.ends[order[: max(4, len(order) // 2)]], guided[:4]])
        return fit(problem, problem.whitening(rough, outputs), ends, free)

    def _again(self, found: Fitted, keep: Tensor) -> Fitted:
        problem = dataclasses.replace(found.problem, keep=keep)
        rough = torch.zeros(len(keep), dtype=torch.float64)
        rough[found.problem.index] = found.whitening.sd
        return refit(
            found, problem.whitening(rough, torch.zeros(len(problem.recording.outputs), dtype=torch.float64)), problem
        )

    def _sharpen(self, found: Fitted) -> Fitted:
        """Halve the time steps until the solver's error is small against the noise."""
        recording = self.problem.recording
        for _ in range(7):
            simulator = found.problem.simulator
            if not isinstance(simulator, Trajectories) or simulator.ode.max_step is not None:
                return found
            if isinstance(recording.noise, Tensor):
                allowed = SOLVER_SHARE * recording.noise[found.problem.index]
            else:
                size = found.residual.square().mean().sqrt()
                allowed = SOLVER_SHARE * torch.maximum(size, 1e-6 * recording.spread[found.problem.index])
            finer = simulator.refined(2)
            y = finer.outputs_of(found.values[None], finer.solve(found.values[None]))[0, found.problem.index]
            error = (y - found.y).abs()
            if bool((error <= allowed).all()):
                return found
            problem = dataclasses.replace(found.problem, simulator=finer)
            whitening = found.whitening
            again = fit(problem, whitening, found.values[None], found.free)
            found = found if again is None else again
        raise SimulatorError(
            "Expected the solution to settle when time steps are halved. Got a change of "
            f"{float(error.max()):.3g} after 7 times (a stiff or discontinuous model: smooth it, give max_step=, or "
            "rescale it)."
        )

    # --- screening --------------------------------------------------------------------------------------

    def screen_all(self) -> None:
        """Tangents of all candidates, and whether there is more than noise."""
        self.residual = Residual(self.base, self.noise, seed=self.seed)
        scale = drivers_scale(self.base.problem, self.base)
        self.candidates = []
        for term in self.terms:
            self.tick(f"screen {term.name}")
            self.candidates.append(prepare(self.base.problem, self.base, [term], self.fixed, scale))
        self.screening = screen(self.residual, self.candidates)
        self._alike()
        self.structure = analyse(self.residual, every=True)
        self.local, local_null = windows(self.residual, self.candidates, self.screening)
        nulls = [self.screening.null, self.structure.null_best, local_null]
        kinds = ("equation", "output") if self.problem.in_time else ("parameter", "output")
        seen = [
            max((self.screening.score(i) for i in range(len(self.candidates))), default=0.0),
            max((p.evidence for p in self.structure.places if p.channel.kind in kinds), default=0.0),
            max((w.z for w in self.local), default=0.0),
        ]
        self.p_detect = _joint(nulls, seen)

    def _alike(self) -> None:
        """Which candidates have the same projected tangent as an earlier one."""
        self.twins = {}
        single = [c for c in range(len(self.candidates))
                  if len(self.candidates[c].shapes) == 1 and len(self.candidates[c].amplitudes) == 1]  # fmt: skip
        for i in single:
            for k in single:
                if k < i and k not in self.twins and abs(self.screening.correlation(i, k)) > SAME:
                    self.twins[i] = k
                    break

    def merge(self) -> None:
        """Candidates whose tangents and refits cannot be told apart become one, under the first name."""
        plain = {m.numbers[0]: m for m in self.models if len(m.numbers) == 1 and m.window is None}
        self.aliases = {}
        gone: set[int] = set()
        for i, k in self.twins.items():
            a, b = plain.get(i), plain.get(k)
            if a is not None and b is not None and (a.physical != b.physical or abs(a.found.chi2 - b.found.chi2) > 0.5):
                continue
            self.aliases.setdefault(k, []).append(self.candidates[i].name)
            gone.add(i)
        self.models = [m for m in self.models if not gone & set(m.numbers)]
        self.gone = gone

    def duplicate(self, i: int, name: str) -> bool:
        """Whether an alias does the same whatever is calibrated beside it: the same model under another name."""
        j = next(k for k, c in enumerate(self.candidates) if c.name == name)
        a, b = self.candidates[i], self.candidates[j]
        u, v = a.tangents[0, :, 0], b.tangents[0, :, 0]
        return float((u @ v).abs()) >= (1 - 1e-9) * float(u.norm() * v.norm())

    # --- refits -----------------------------------------------------------------------------------------

    def refit_singles(self, *, detected: bool = True) -> None:
        """Every candidate that the screening leaves a chance, then the best local ones.

        Where nothing was detected only the leading few, for the record.
        """
        count = len(self.candidates)
        prior = math.log(PRIOR["single"] / max(count, 1))
        blind = [i for i in range(count) if self.screening.best[i] < 0 and self.candidates[i].blind]
        order = sorted((i for i in range(count) if self.screening.best[i] >= 0), key=lambda i: -self.screening.score(i))
        top = self.screening.score(order[0]) if order else 0.0
        promising = [i for k, i in enumerate(order) if k < FEW or self.screening.score(i) >= CHANCE * top]
        chosen = promising[: MOST["single"]] if detected else order[:FEW]
        for i in [*chosen, *blind]:
            self.tick(f"refit with {self.candidates[i].name}")
            model = self._refit((i,), self.candidates[i], self._begin(i), prior)
            if model is not None:
                self.models.append(model)
        self._reweigh()
        self.merge()
        if detected:
            self._refit_local()

    def _refit_local(self) -> None:
        """Windows that promise more than the same term everywhere."""
        if self.exact or self.problem.n < LEAST_LOCAL:
            return
        gains = {model.numbers[0]: 2 * model.log_evidence + math.log(self.problem.n) for model in self.models}
        leading = 2 * max((model.log_evidence for model in self.models if model.physical), default=0.0)
        promising = []
        for w in self.local:
            plain = max(gains.get(w.candidate, 0.0), self.screening.score(w.candidate) ** 2)
            if w.candidate not in self.gone and w.z > 3.5 and w.z**2 > max(plain + 6.0, leading - 10.0):
                promising.append(w)
        promising.sort(key=lambda w: -w.z)
        prior = math.log(PRIOR["local"] / max(len(self.candidates), 1))
        for w in promising[: MOST["local"]]:
            self.tick(f"refit with local {self.candidates[w.candidate].name}")
            model = self._refit_window(w, prior)
            if model is not None:
                self.models.append(model)

    def _refit_window(self, w: Window, prior: float) -> Model | None:
        plain = self.candidates[w.candidate]
        driver = self._drivers()[w.driver]
        span = (float(driver.min()), float(driver.max()))
        term = plain.terms[0]
        if term.frees:
            return None
        local = localised(term, w.driver, w.low, w.high, span, static=not self.problem.in_time)
        try:
            candidate = prepare(self.base.problem, self.base, [local], self.fixed, {})
        except (SimulatorError, DomainError):
            return None
        column = self.screening.best[w.candidate]
        values = dict(zip([plain.problem.parameters[i].name for i in plain.own],
                          plain.shapes[int(self.screening.shape[column])].tolist(), strict=True))  # fmt: skip
        amplitude = plain.problem.parameters[plain.amplitudes[int(self.screening.amplitude[column])]].name
        begin = candidate.begin.clone()
        values[amplitude] += 0.02 * w.amplitude
        for i in candidate.own:
            name = candidate.problem.parameters[i].name
            if name in values:
                begin[i] = values[name]
            else:
                begin[i] = w.low if name.endswith("from") else w.high
        # Windows were searched on a grid of about 12 edges: the best of so many costs its logarithm.
        model = self._refit(
            (w.candidate,), candidate, begin[None], prior - math.log(3.0 * len(self._drivers())), window=w
        )
        if model is None:
            return None
        low, high = w.low, w.high
        for i in candidate.own:
            name = candidate.problem.parameters[i].name
            if name.endswith("window from"):
                low = float(model.found.values[i])
            elif name.endswith("window to"):
                high = float(model.found.values[i])
        model.window = dataclasses.replace(w, low=low, high=high)
        return model

    def _drivers(self) -> dict[str, Tensor]:
        return self.base.problem.drivers(self.base.values[None], self.base.warm)

    def _begin(self, i: int) -> Tensor:
        """Starting values of a candidate's refit: the linear estimate at its best shapes."""
        candidate = self.candidates[i]
        mine = (self.screening.owner == i).nonzero()[:, 0]
        usable = mine[self.screening.norm[mine] > 0]
        if len(usable) == 0:
            return self._blind_begin(candidate)
        rows, used = [], set()
        for column in usable[self.screening.z[usable].argsort(descending=True)].tolist():
            g = int(self.screening.shape[column])
            if g in used:
                continue
            used.add(g)
            a = int(self.screening.amplitude[column])
            signed = float(self.screening.columns[:, column] @ self.residual.e) / float(self.screening.norm[column])
            for factor in STEPS if len(used) == 1 else STEPS[:1]:
                rows.append(self._step_along(candidate, g, a, factor * signed))
            if len(used) == 3:
                break
        return torch.stack(rows)

    def _step_along(self, candidate: Candidate, shape: int, amplitude: int, size: float) -> Tensor:
        """The base's estimate with an amplitude of some size, and the rest moved to make up for it (linearised)."""
        row = candidate.begin.clone()
        row[candidate.own] = candidate.shapes[shape]
        row[candidate.amplitudes[amplitude]] += size
        w = self.base.whitening
        slope, tangent = w(self.base.jacobian), w(candidate.tangents[shape, :, amplitude, None])
        unit = slope.norm(dim=0).clamp_min(1e-300)
        change = torch.linalg.lstsq(slope / unit, tangent, driver="gelsd").solution[:, 0] / unit
        names = [q.name for q in candidate.problem.parameters]
        for i, moved in zip(self.base.free, change.tolist(), strict=True):
            row[names.index(self.base.problem.parameters[i].name)] -= size * moved
        return row

    def _blind_begin(self, candidate: Candidate) -> Tensor:
        """Amplitudes of all magnitudes, where the tangent says nothing."""
        rows = []
        for place in candidate.amplitudes:
            q = candidate.problem.parameters[place]
            if q.low is not None and q.high is not None:
                values = [q.low + (q.high - q.low) * k for k in (0.1, 0.3, 0.5, 0.7, 0.9)]
            else:
                values = [sign * 10.0**k for k in range(-4, 3) for sign in (1, -1)]
            for value in values:
                row = candidate.begin.clone()
                row[place] = value
                rows.append(row)
        return torch.stack(rows)

    def _refit(
        self, numbers: tuple[int, ...], candidate: Candidate, begin: Tensor, prior: float, window: Window | None = None
    ) -> Model | None:
        whitening = self.noise.whitening(candidate.problem)
        warm = None
        if isinstance(self.base.warm, Tensor) and isinstance(candidate.problem.simulator, Trajectories):
            if len(candidate.problem.simulator.ode.states) == self.base.warm.shape[-1]:
                warm = self.base.warm.expand(len(begin), *self.base.warm.shape[1:])
        shape = [i for i in candidate.own if i not in candidate.amplitudes]
        if shape:  # while the amplitude is small its shape means nothing
            first = fit(
                candidate.problem,
                whitening,
                begin,
                [i for i in candidate.free if i not in shape],
                warm=warm,
                max_steps=12,
            )
            if first is None or first.ends is None or first.ends_chi2 is None:
                return None
            begin, warm = first.ends[first.ends_chi2.argsort()[:2]], None
            if isinstance(first.warm, Tensor):
                warm = first.warm.expand(len(begin), *first.warm.shape[1:])
        found = fit(candidate.problem, whitening, begin, candidate.free, warm=warm, max_steps=60)
        if found is None:
            return None
        return self._judge(Model(numbers, candidate, found, 0.0, prior, True, window=window))

    def _judge(self, model: Model) -> Model:
        """Evidence, bounds and what speaks against it."""
        found, candidate = model.found, model.candidate
        names = [q.name for q in candidate.problem.parameters]
        stuck = [names[i] for i, at in zip(found.free, found.at_bound.tolist(), strict=True) if at]
        before = [q.name for q, at in zip([self.base.problem.parameters[i] for i in self.base.free],
                                          self.base.at_bound.tolist(), strict=True) if at]  # fmt: skip
        edges = [name for name in stuck if "window" in name]
        new = [name for name in stuck if name not in before and name not in edges]
        amplitude = {names[i] for i in candidate.amplitudes}
        off = set()
        for i, at in zip(found.free, found.at_bound.tolist(), strict=True):
            if at and names[i] in amplitude:
                value, neutral = float(found.values[i]), float(candidate.neutral[candidate.own.index(i)])
                if abs(value - neutral) <= 1e-9 * (1 + abs(value)):
                    off.add(names[i])
        model.physical = not new
        if off:
            model.note = f"wants the wrong sign: {', '.join(sorted(off))} stays at its neutral value"
        elif new:
            model.note = f"at its bound: {', '.join(new)}"
        else:
            model.note = ""
        own = [i for i in candidate.own if names[i] not in off]
        model.log_evidence = self._evidence(found.chi2, len(own)) + (UNPHYSICAL if new and not off else 0.0)
        return model

    def _evidence(self, chi2: float, parameters: int) -> float:
        n = self.problem.n
        if self.exact:  # the size of the misfit is all that is known
            floor = 1e-12 * max(self.base.chi2, 1e-300)
            gain = 0.5 * n * math.log(max(self.base.chi2, floor) / max(chi2, floor))
            return gain - 0.5 * parameters * math.log(n)
        return 0.5 * (self.base.chi2 - chi2) - 0.5 * parameters * math.log(n)

    def _reweigh(self) -> None:
        """Estimate the noise again with the best model, and fit everything again where that changes it."""
        if self.exact or not self.models:
            return
        best = max(self.models, key=lambda model: model.weight)
        if best.log_evidence < 3.0:
            return
        given = self.problem.recording.noise
        fresh = estimate(best.found.problem, best.found.residual, best.found.jacobian, given)
        old = self.noise
        change = float((fresh.sd / old.sd).log().abs().max()) + float((fresh.correlation - old.correlation).abs().max())
        if change < 0.05:
            return
        self.noise = fresh
        self.base = refit(self.base, fresh.whitening(self.base.problem))
        for model in self.models:
            model.found = refit(model.found, fresh.whitening(model.found.problem))
            self._judge(model)
        self.residual = Residual(self.base, self.noise, seed=self.seed)
        self.structure = analyse(self.residual, every=True)

    # --- several terms ----------------------------------------------------------------------------------

    def examine(self, model: Model) -> Structure:
        """What is left after a model."""
        if model.structure is None or model.residual is None or model.residual.found is not model.found:
            model.residual = Residual(model.found, self.noise, seed=self.seed, draws=500)
            model.structure = analyse(model.residual)
        return model.structure

    def refit_several(self) -> None:
        """Pairs from the linear search at the base, and second terms after the best single ones; then thirds."""
        single = sorted((m for m in self.models if len(m.numbers) == 1), key=lambda m: -m.weight)
        count = len(self.candidates)
        if count < 2 or self.max_terms < 2:
            return
        wanted: dict[tuple[int, ...], None] = {}
        for pair in self._linear_pairs():
            wanted[pair] = None
        for model in single[:3]:
            for j in self._next_terms(model)[:5]:
                wanted[tuple(sorted((model.numbers[0], j)))] = None
        pairs = [pair for pair in wanted if len(set(pair)) == 2][: MOST["pairs"]]
        prior = math.log(PRIOR["several"] / (0.5 * count * (count - 1)))
        tried = [self._refit_terms(pair, prior) for pair in pairs]
        fitted = [m for m in tried if m is not None]
        self.models += fitted
        if self.max_terms < 3 or not fitted:
            return
        best = max(fitted, key=lambda m: m.weight)
        if self.examine(best).p_value < 0.01 or self.exact:
            third = math.log(0.2 * PRIOR["several"] / (count * (count - 1) * max(count - 2, 1) / 6))
            for j in self._next_terms(best)[:4]:
                if j in best.numbers:
                    continue
                again = self._refit_terms(tuple(sorted((*best.numbers, j))), third)
                if again is not None:
                    self.models.append(again)

    def _linear_pairs(self) -> list[tuple[int, int]]:
        usable = [i for i in range(len(self.candidates)) if self.screening.best[i] >= 0 and i not in self.gone]
        if len(usable) < 2:
            return []
        columns = self.screening.columns[:, [self.screening.best[i] for i in usable]]
        z = columns.T @ self.residual.e
        c = columns.T @ columns
        gain = (z[:, None].square() + z.square() - 2 * c * z[:, None] * z) / (1 - c.square()).clamp_min(1e-6)
        gain = torch.where(c.abs() > 0.9995, torch.zeros_like(gain), gain).triu(1)
        order = gain.flatten().argsort(descending=True)[:8]
        return [(usable[int(k) // len(usable)], usable[int(k) % len(usable)]) for k in order]

    def _next_terms(self, model: Model) -> list[int]:
        """Other candidates by their score at a model's fit."""
        residual = model.residual or Residual(model.found, self.noise, seed=self.seed, draws=10)
        scale = drivers_scale(model.found.problem, model.found)
        scores = []
        for j, other in enumerate(self.candidates):
            if j in model.numbers or j in self.gone:
                continue
            self.tick(f"screen {other.name} after {', '.join(model.names)}")
            try:
                prepared = prepare(model.found.problem, model.found, other.terms, self.fixed, scale)
            except (SimulatorError, DomainError):
                continue
            found = screen(residual, [prepared])
            if found.best[0] >= 0:
                scores.append((-found.score(0), j))
        return [j for _, j in sorted(scores)]

    def _refit_terms(self, numbers: tuple[int, ...], prior: float) -> Model | None:
        terms = [term for i in numbers for term in self.candidates[i].terms]
        self.tick("refit with " + ", ".join(term.name for term in terms))
        try:
            candidate = prepare(
                self.base.problem, self.base, terms, self.fixed, drivers_scale(self.base.problem, self.base)
            )
        except (SimulatorError, DomainError):
            return None
        names = [q.name for q in candidate.problem.parameters]
        rows = []
        for lead in numbers:
            single = next((m for m in self.models if m.numbers == (lead,) and m.window is None), None)
            row = candidate.begin.clone()
            if single is not None:
                known = dict(
                    zip(
                        [q.name for q in single.candidate.problem.parameters], single.found.values.tolist(), strict=True
                    )
                )
                for k, name in enumerate(names):
                    if name in known:
                        row[k] = known[name]
            for other in numbers:
                if other == lead:
                    continue
                fitted = next((m for m in self.models if m.numbers == (other,) and m.window is None), None)
                source = self.candidates[other]
                for place in source.own:
                    name = source.problem.parameters[place].name
                    k = names.index(name)
                    neutral = float(source.neutral[source.own.index(place)])
                    value = float(fitted.found.values[place]) if fitted is not None else neutral
                    row[k] = neutral + 0.02 * (value - neutral) if place in source.amplitudes else value
            rows.append(row)
        return self._refit(numbers, candidate, torch.stack(rows), prior)


def _joint(nulls: Sequence[Tensor], seen: Sequence[float]) -> float:
    """Probability that noise alone gives one of several statistics as extreme a value as the most extreme one seen."""
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
        return 1.0
    least = torch.stack(ranks).amin(0)
    return (1.0 + float((least <= min(p)).sum())) / (1.0 + draws)


def describe(model: Model) -> str | None:
    """Where a local model acts."""
    return None if model.window is None else region_text(model.window.driver, model.window.low, model.window.high)
