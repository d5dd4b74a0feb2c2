"""What is asked of a simulator or a term before long work: that it repeats itself, is finite, fast and exact enough."""

import time
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchcal.discovery.fits.fitting import Fitted
from torchcal.discovery.fits.problem import Problem
from torchcal.errors import SimulatorError, SurrogateWarning, TorchcalWarning, warn
from torchcal.simulators import ExternalSimulator, PolynomialSurrogate

__all__ = ["check_finite", "check_repeats", "place_of", "point_of", "warn_if_coarse", "warn_if_long"]

#: Difference of two evaluations, relative to the largest output, up to which a simulator repeats itself.
JITTER = 1e-4
#: Evaluations of an external simulator, at all conditions, that a diagnosis takes, from and to; and how many seconds
#: the fewest of them may take without a word.
EVALUATIONS, LONG = (1000, 10000), 120.0
#: Error of a surrogate, in the noise sd, from which on it may be what is found.
COARSE = 0.5


def check_finite(found: Fitted) -> None:
    """Raise if the base's outputs are not finite where its calibration ends: that may be at an edge of what is.

    Newton's method may end where they are finite, and the next pass is not.

    Raises:
        SimulatorError: If they are not.
    """
    problem = found.problem
    y = problem.evaluate(found.values[None], [], found.warm)[0][0]
    bad = (~torch.isfinite(y)).nonzero()[:, 0]
    if len(bad):
        raise SimulatorError(
            f"Expected finite outputs of the base where its calibration ends, with "
            f"{point_of(problem, found.values, found.free)}. Got {float(y[bad[0]])} for {len(bad)} of {problem.n} "
            f"data, first {place_of(problem, int(bad[0]))} (that is the base alone, without any candidate: keep its "
            "logarithms, roots and quotients finite wherever its states may go, as in torch.sqrt(h.clamp_min(1e-9)), "
            "or give its parameters bounds within which it is finite)."
        )


def check_repeats(problem: Problem, values: Tensor, what: str = "the simulator") -> None:
    """Raise if the outputs at parameter values ``(P,)`` are others when they are computed again.

    Raises:
        SimulatorError: If they are.
    """
    once, again = (torch.nan_to_num(problem.evaluate(values[None], [])[0][0]) for _ in range(2))
    moved = (again - once).abs()
    # What jitters less than this is no random number, but an external solver or sums of single precision.
    if bool((moved > JITTER * torch.maximum(once.abs().max(), problem.recording.spread[problem.index])).any()):
        k = int(moved.argmax())
        raise SimulatorError(
            f"Expected the same outputs whenever {what} is called with the same parameters. Got {float(once[k]):.6g} "
            f"and then {float(again[k]):.6g}: {place_of(problem, k)}. Leave random numbers out of it, or draw them "
            "once, before."
        )


def warn_if_long(problem: Problem, values: Tensor) -> None:
    """Say how long an external simulator will take, by one evaluation at parameter values ``(P,)``.

    Warns:
        TorchcalWarning: If that is long.
    """
    simulator = problem.simulator.extended[0] if problem.simulator.extended else problem.simulator
    if not isinstance(simulator, ExternalSimulator):
        return
    begun = time.perf_counter()
    problem.evaluate(values[None], [])
    seconds = time.perf_counter() - begun
    few, many = (count * seconds for count in EVALUATIONS)
    if few > LONG:
        spread = "" if simulator.executor is not None else ", or spread the runs (executor= of the simulator)"
        warn(
            f"The simulator takes {seconds:.2g} s at all {problem.recording.n} conditions, and a diagnosis evaluates "
            f"it {EVALUATIONS[0]:,} to {EVALUATIONS[1]:,} times: that is {_span(few)} to {_span(many)}. Build a "
            "surrogate of it over the conditions and all parameters, the dormant ones too, and diagnose that "
            f"(torchcal.build_surrogate, with points= where they are many){spread}.",
            TorchcalWarning,
        )


def _span(seconds: float) -> str:
    """A time in words."""
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 172800 else f"{seconds / 86400:.0f} days"


def warn_if_coarse(problem: Problem) -> None:
    """Hold a surrogate's error against the noise, where both are known.

    Warns:
        SurrogateWarning: If what is found may be that error.
    """
    simulator, noise = problem.simulator, problem.recording.noise
    if not isinstance(simulator, PolynomialSurrogate) or simulator.error is None or not isinstance(noise, Tensor):
        return
    names = simulator.error.outputs if simulator.outputs is not None else problem.recording.outputs  # or it has no name
    rms = dict(zip(names, simulator.error.rms.tolist(), strict=True))
    sizes = {name: float(values[values.isfinite()].median())
             for name, values in problem.recording.split(noise).items()}  # fmt: skip
    large = [name for name, size in sizes.items() if name in rms and rms[name] > COARSE * size]
    if large:
        listed = ", ".join(f"{name!r}: {rms[name]:.2g} of a noise sd of {sizes[name]:.2g}" for name in large)
        warn(
            f"The surrogate's own error is large beside the noise of the data ({listed}): what is found may be that "
            "error. Raise its order=, narrow its box, or add the error to the noise.",
            SurrogateWarning,
        )


def point_of(problem: Problem, values: Tensor, free: Sequence[int]) -> str:
    """Some parameters by their places with their values ``(P,)``, in words."""
    return ", ".join(f"{problem.parameters[i].name} = {float(values[i]):.3g}" for i in free)


def place_of(problem: Problem, k: int) -> str:
    """Which output a used datum is, and at which condition or time, in words."""
    x, row = problem.recording.x, int(problem.condition_of[k])
    at = ", ".join(f"{n} = {float(v[row]):.4g}" for n, v in (x if isinstance(x, Mapping) else {"x": x}).items())
    return f"output {problem.recording.outputs[int(problem.output_of[k])]!r} at {at}"
