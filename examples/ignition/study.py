"""The ignition studies: data, surrogates and calibrations.

The data are ln τ of GRI-Mech 3.0. The calibrated model is CH4 + 2 O2 -> CO2 + 2 H2O with the two parameters ln A and E
(Eqs. 37-39), which a polynomial stands in for (Eqs. 41-43). Case 1 varies T0 at Φ = 1, case 2 varies T0 and Φ.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Figs. 7-22.
"""

import dataclasses
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchcal as tc
from examples.ignition import chemistry
from examples.ignition.chemistry import DOMAIN, R_CAL
from torchcal.results import AdditiveCalibration, Calibration

#: Tolerances of the ABC likelihood that are compared (the paper's, in ln τ).
EPSILONS = (0.1, 0.01, 0.001, 1e-4)
#: The studies: which conditions vary, and how many data there are.
STUDIES = {"1a": (1, 11), "1b": (1, 51), "2": (2, 77)}
#: Units of conditions and output. Φ has none; ln τ is the logarithm of a time in seconds.
UNITS = {"T0": "K", "ln_tau": "ln s"}
PARAMETERS = (
    tc.Parameter("lnA", unit="ln(cm³/(mol s))", low=DOMAIN["lnA"][0], high=DOMAIN["lnA"][1]),
    tc.Parameter("E", unit="cal/mol", low=DOMAIN["E"][0], high=DOMAIN["E"][1]),
)
#: Total degree of the surrogate.
SURROGATE_ORDER = 6
#: Degree of the output's expansion in the germs, as the paper chose it (text under Eq. 43).
OUTPUT_ORDER = 1


# --- data and model ------------------------------------------------------------------------------------


def record(
    case: int, n: int = 11, *, cache: str | os.PathLike[str] | None = None, progress: bool = False
) -> tc.Recording:
    """ln τ of GRI-Mech 3.0 for case 1 with n temperatures, or for case 2.

    Args:
        case: 1 or 2.
        n: Number of temperatures of case 1.
        cache: A ``.csv`` file of delays, see `chemistry.detailed_delays`.
        progress: Whether to show a bar.
    """
    conditions = _conditions(case, n)
    delays = chemistry.detailed_delays(**conditions, cache=cache, progress=progress)
    x = conditions if case == 2 else {"T0": conditions["T0"]}
    return tc.Recording(x=x, y={"ln_tau": delays}, noise="none", units=UNITS)


def _conditions(case: int, n: int) -> dict[str, np.ndarray]:
    if case not in (1, 2):
        raise tc.errors.DomainError(f"Expected case 1 or 2. Got {case!r}.")
    return chemistry.case_1(n) if case == 1 else chemistry.case_2()


def log_delay_1(x: Mapping[str, float], p: Mapping[str, float]) -> float:
    """ln τ of the one-step mechanism at Φ = 1, by Cantera."""
    return math.log(chemistry.one_step_delay(x["T0"], 1.0, p["lnA"], p["E"]))


def log_delay_2(x: Mapping[str, float], p: Mapping[str, float]) -> float:
    """ln τ of the one-step mechanism, by Cantera."""
    return math.log(chemistry.one_step_delay(x["T0"], x["phi"], p["lnA"], p["E"]))


def surrogate(
    case: int, *, cache: str | os.PathLike[str] | None = None, progress: bool = False
) -> tc.PolynomialSurrogate:
    """The sixth-order surrogate of the one-step mechanism, over (T0, lnA, E), in case 2 over (T0, Φ, lnA, E).

    Args:
        case: 1 or 2.
        cache: A ``.npz`` file of evaluations, see `torchcal.build_surrogate`.
        progress: Whether to show a bar.
    """
    names = ("T0",) if case == 1 else ("T0", "phi")
    return tc.build_surrogate(
        log_delay_1 if case == 1 else log_delay_2,
        conditions={name: DOMAIN[name] for name in names},
        parameters=PARAMETERS,
        order=SURROGATE_ORDER,
        cache=cache,
        progress=progress,
    )


# --- calibrations --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Study:
    """One of the `STUDIES`: its data, its model and what has been calibrated.

    Attributes:
        key: Its key in `STUDIES`.
        recording: ln τ of GRI-Mech 3.0.
        surrogate: The one-step mechanism.
        embedded: Calibrations with embedded model error, by ε.
        additive: The conventional calibration.
    """

    key: str
    recording: tc.Recording
    surrogate: tc.PolynomialSurrogate
    embedded: dict[float, Calibration] = field(default_factory=dict)
    additive: AdditiveCalibration | None = None

    @property
    def case(self) -> int:
        """1 or 2."""
        return STUDIES[self.key][0]

    @property
    def title(self) -> str:
        """How reports and figures call it."""
        return f"case 1, N = {self.recording.n}" if self.case == 1 else "case 2, N = 77"

    @property
    def conventional(self) -> AdditiveCalibration:
        """The conventional calibration; an error where it was not run."""
        if self.additive is None:
            raise tc.errors.DomainError("Expected a conventional calibration. Got none (run it with baseline=True).")
        return self.additive


#: Chains and draws. Case 2 has a bent posterior, which takes more chains to see.
DRAWS = {
    "1a": {"num_chains": 16, "num_samples": 250},
    "1b": {"num_chains": 16, "num_samples": 250},
    "2": {"num_chains": 32, "num_samples": 400},
}
#: Chains and draws of the conventional calibrations.
ADDITIVE_DRAWS = {"num_chains": 16, "num_samples": 250}


def prepare(key: str, folder: str | os.PathLike[str] | None = None, *, progress: bool = False) -> Study:
    """Data and surrogate of a study, without any calibration.

    Args:
        key: One of `STUDIES`.
        folder: Where evaluations of both models are kept, and taken from; None keeps nothing.
        progress: Whether to show bars.
    """
    if key not in STUDIES:
        raise tc.errors.DomainError(f"Expected one of the studies {list(STUDIES)}. Got {key!r}.")
    case, n = STUDIES[key]
    delays = None if folder is None else Path(folder) / "gri30_delays.csv"
    evaluations = None if folder is None else Path(folder) / f"one_step_case_{case}.npz"
    if folder is not None:
        Path(folder).mkdir(parents=True, exist_ok=True)
    recording = record(case, n, cache=delays, progress=progress)
    return Study(key, recording, surrogate(case, cache=evaluations, progress=progress))


def calibrate(study: Study, epsilon: float, *, seed: int = 0, progress: bool = False, **options: Any) -> Calibration:
    """Embedded calibration: normal (ln A, E), ABC likelihood with γ = 1, first-order output expansion.

    Args:
        study: Data and surrogate.
        epsilon: Tolerance, in ln τ.
        seed: Of every random number.
        progress: Whether to show a bar.
        **options: Further options of `torchcal.calibrate`, such as ``num_samples=0`` for the MAP alone.
    """
    settings = {"order": OUTPUT_ORDER, **DRAWS[study.key], **options}
    likelihood = tc.likelihoods.ABC(epsilon=epsilon, gamma=1.0)
    embedding = tc.embeddings.Gaussian()
    return tc.calibrate(
        study.surrogate,
        study.recording,
        embedding=embedding,
        likelihood=likelihood,
        seed=seed,
        progress=progress,
        **settings,
    )


def calibrate_conventional(
    study: Study, *, seed: int = 0, progress: bool = False, **options: Any
) -> AdditiveCalibration:
    """The same model under an additive normal discrepancy (Eq. 4)."""
    settings = {**ADDITIVE_DRAWS, **options}
    return tc.calibrate_additive(study.surrogate, study.recording, seed=seed, progress=progress, **settings)


def run(
    key: str,
    *,
    epsilons: tuple[float, ...] = EPSILONS,
    baseline: bool = True,
    folder: str | os.PathLike[str] | None = None,
    seed: int = 0,
    progress: bool = False,
    **options: Any,
) -> Study:
    """Prepare a study and calibrate its model, at every ε and conventionally.

    Args:
        key: One of `STUDIES`.
        epsilons: Tolerances of the ABC likelihood, in ln τ.
        baseline: Whether to run the conventional calibration too.
        folder: As for `prepare`.
        seed: Of every random number.
        progress: Whether to show bars.
        **options: Further options of `torchcal.calibrate`.
    """
    study = prepare(key, folder, progress=progress)
    embedded = {e: calibrate(study, e, seed=seed, progress=progress, **options) for e in epsilons}
    additive = calibrate_conventional(study, seed=seed, progress=progress) if baseline else None
    return dataclasses.replace(study, embedded=embedded, additive=additive)


# --- what is read off them -----------------------------------------------------------------------------


def grid(study: Study, num: int = 61, phi: float = 1.0) -> dict[str, Tensor]:
    """Conditions along T0 for curves, at one Φ in case 2."""
    T0 = torch.linspace(*DOMAIN["T0"], num, dtype=torch.float64)
    return {"T0": T0} if study.case == 1 else {"T0": T0, "phi": torch.full_like(T0, phi)}


def upright(calibration: Calibration) -> Calibration:
    """The same posterior with germs signed so that ln A grows with ξ1, and E with ξ2.

    The paper's signs, both coefficients of E positive, would cut the posterior of case 2 in two: b1 is nearly zero
    there.
    """
    pattern = calibration.propagation_at().pattern
    names = list(calibration.alpha_names)
    target = torch.zeros(len(names), dtype=torch.float64)
    target[[names.index("lnA[xi1]"), names.index("E[xi2]")]] = 1.0
    estimate = dataclasses.replace(calibration.map, alpha=pattern.flip(calibration.map.alpha, target))
    samples = None if calibration.samples is None else pattern.flip(calibration.samples, target)
    return dataclasses.replace(calibration, map=estimate, samples=samples)


def log_rate(x: Mapping[str, Tensor], p: Mapping[str, Tensor]) -> Tensor:
    """ln k(T) = ln A − E / (R T), with T under the name T0 that the data's temperature has (Eq. 45)."""
    return p["lnA"] - p["E"] / (R_CAL * x["T0"])


def log_rate_moments(alpha: Tensor, T: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and sd of ln k(T) for normal (ln A, E) with coefficients α = (a0, a1, b0, b1, b2) (Eqs. 46-48).

    Args:
        alpha: Scaled coefficients, ``(5,)``.
        T: Temperatures, K, ``(n,)``.
    """
    (center_a, half_a), (center_e, half_e) = (
        (0.5 * (high + low), 0.5 * (high - low)) for low, high in (DOMAIN["lnA"], DOMAIN["E"])
    )
    a0, a1, b0, b1, b2 = alpha
    rt = R_CAL * T
    mean = center_a - center_e / rt + a0 * half_a - b0 * half_e / rt
    variance = (a1 * half_a - b1 * half_e / rt) ** 2 + (b2 * half_e / rt) ** 2
    return mean, variance.sqrt()


def rms_residual(study: Study, mean: Tensor) -> float:
    """Root mean square of a predicted mean's error, in ln τ."""
    return float((mean - study.recording.y).square().mean().sqrt())


def coverage(study: Study, moments: Any, level: float = 0.95) -> float:
    """Share of the data inside a prediction's central interval of probability ``level``."""
    return tc.scores(study.recording.y, moments, level=level).coverage
