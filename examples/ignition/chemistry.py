"""Ignition delays of methane in air: GRI-Mech 3.0 and the one-step mechanism that is calibrated against it.

Both models are a homogeneous, adiabatic, ideal-gas mixture at 1 atm and constant pressure, CH4 with air
(O2 + 3.76 N2) at equivalence ratio phi. The ignition delay is the time at which the temperature first
reaches 1500 K.

* `detailed_delay` and `detailed_delays` run GRI-Mech 3.0 in Cantera.
* `one_step_delay` runs CH4 + 2 O2 -> CO2 + 2 H2O in Cantera: one call, one float, as any external code.
* `OneStep` gives the same delay as an integral over the temperature: batched and differentiable.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 37-39 and 42.
"""

import csv
import math
import os
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, as_completed
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchcal.errors import DomainError, MissingDependencyError, RecordingError, ShapeError, SimulatorError

#: Gas constant that turns E into a rate, cal/(mol K) (Eq. 39).
R_CAL = 1.9872041
#: Temperature that defines ignition, K.
T_IGNITION = 1500.0
#: Reference temperature and concentration of the generalised rate, K and mol/cm^3.
T_REFERENCE, C_REFERENCE = 1150.0, 2e-6
#: The box of the surrogates (Eq. 42; phi from case study 2). Units: K, 1, ln(cm^3/(mol s)), cal/mol.
DOMAIN = {"T0": (1000.0, 1300.0), "phi": (0.6, 1.8), "lnA": (28.5, 36.0), "E": (36315.5, 56954.0)}

MECHANISM = "gri30.yaml"
SPECIES = ("CH4", "O2", "N2", "CO2", "H2O")
STOICHIOMETRY = np.array([-1.0, -2.0, 0.0, 1.0, 2.0])
# ln tau is then within 1e-7 of its limit for GRI-Mech, and within 1e-6 for the one-step mechanism.
DETAILED_RTOL, DETAILED_ATOL = 1e-9, 1e-15
ONE_STEP_RTOL, ONE_STEP_ATOL = 1e-8, 1e-14
# Far beyond any delay of the domain; a mixture that is still cold then is taken as one that never ignites.
LONGEST_DELAY = 1e6

_local = threading.local()  # a Cantera Solution must not be shared between threads


def case_1(num: int = 11) -> dict[str, NDArray[np.float64]]:
    """Conditions of case study 1: `num` temperatures from 1000 to 1300 K at phi = 1.

    >>> case_1(4)["T0"]
    array([1000., 1100., 1200., 1300.])
    """
    if num < 2:
        raise DomainError(f"Expected at least two temperatures. Got num = {num} (the paper has 11 and 51).")
    return {"T0": np.linspace(*DOMAIN["T0"], num), "phi": np.ones(num)}


def case_2() -> dict[str, NDArray[np.float64]]:
    """Conditions of case study 2: seven phi from 0.6 to 1.8, each with eleven T0; phi varies slowest.

    >>> case_2()["phi"][[0, 10, 11, 76]]
    array([0.6, 0.6, 0.8, 1.8])
    """
    # Rounded, because linspace is off by 1e-16 and this number is a label and a cache key too.
    return {
        "T0": np.tile(np.linspace(*DOMAIN["T0"], 11), 7),
        "phi": np.repeat(np.linspace(*DOMAIN["phi"], 7).round(12), 11),
    }


# --- detailed model ------------------------------------------------------------------------------------


def detailed_delay(T0: float, phi: float) -> float:
    """Ignition delay by GRI-Mech 3.0, in seconds.

    Args:
        T0: Initial temperature, K.
        phi: Equivalence ratio (fuel-to-air ratio over its stoichiometric value), dimensionless.

    Raises:
        DomainError: If `T0` or `phi` has no meaning.
        SimulatorError: If Cantera fails, or the mixture does not reach 1500 K.
        MissingDependencyError: If Cantera is not installed.
    """
    _check_conditions(T0, phi)
    gas = getattr(_local, "detailed", None)
    if gas is None:
        gas = _local.detailed = _cantera().Solution(MECHANISM, transport_model=None)
    return _run(gas, T0, phi, DETAILED_RTOL, DETAILED_ATOL)


def detailed_delays(
    T0: ArrayLike,
    phi: ArrayLike,
    executor: Executor | None = None,
    cache: str | os.PathLike[str] | None = None,
    *,
    progress: bool = True,
) -> NDArray[np.float64]:
    """Natural logarithm of the GRI-Mech 3.0 delays (in s) at many conditions.

    Args:
        T0: Initial temperatures, K; `T0` and `phi` are broadcast against each other.
        phi: Equivalence ratios, dimensionless.
        executor: Where the runs go (any `concurrent.futures.Executor`); without one they run here, in turn.
        cache: A ``.csv`` file with earlier runs. What it holds is not run again; new runs are added. A file
            made by another Cantera, mechanism or tolerance is replaced. Runs that were finished before a
            failure or Ctrl-C are kept.
        progress: Whether to show a bar.

    Returns:
        ln(tau / s), of the broadcast shape.

    Raises:
        DomainError: If a condition has no meaning; nothing is run then.
        ShapeError: If `T0` and `phi` cannot be broadcast.
        SimulatorError: If a run fails; the message names its conditions.
        RecordingError: If the cache file is damaged.
    """
    temperatures, ratios = _conditions(T0, phi)
    points = [(float(a), float(b)) for a, b in zip(temperatures.ravel(), ratios.ravel(), strict=True)]
    path = None if cache is None else Path(cache)
    if path is not None and path.suffix != ".csv":
        raise RecordingError(f"Expected a cache file that ends in .csv. Got {path}.")
    known = _read_cache(path) if path is not None else {}
    todo = [point for point in dict.fromkeys(points) if point not in known]
    if todo:
        bar = tqdm(total=len(todo), desc="GRI-Mech 3.0", unit="run", disable=not progress)
        try:
            for point, delay in _delays(todo, executor):
                bar.update()
                known[point] = math.log(delay)
        finally:
            bar.close()
            if path is not None:
                _write_cache(path, known)
    return np.array([known[point] for point in points], dtype=np.float64).reshape(temperatures.shape)


def _delays(
    points: list[tuple[float, float]], executor: Executor | None
) -> Iterator[tuple[tuple[float, float], float]]:
    """Pairs (point, delay) in the order in which the runs end; an error names its point."""
    futures = {} if executor is None else {executor.submit(detailed_delay, *point): point for point in points}
    try:
        for item in points if executor is None else as_completed(futures):
            point = item if executor is None else futures[item]
            try:
                delay = detailed_delay(*item) if executor is None else item.result()
            except MissingDependencyError:
                raise
            except Exception as error:
                raise SimulatorError(
                    f"The detailed model failed at T0 = {point[0]:g} K, phi = {point[1]:g}: {error}"
                ) from error
            yield point, delay
    finally:
        for future in futures:
            future.cancel()


def _cache_header() -> str:
    return (
        f"# ln of the ignition delay in s, CH4-air at 1 atm; {MECHANISM}, cantera {_cantera().__version__}, "
        f"T = {T_IGNITION:g} K, rtol {DETAILED_RTOL:g}, atol {DETAILED_ATOL:g}"
    )


def _read_cache(path: Path) -> dict[tuple[float, float], float]:
    if not path.exists():
        return {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        if not lines or not lines[0].startswith("# ln of the ignition delay"):
            raise ValueError("the first line is not that of a cache")
        if lines[0] != _cache_header():
            return {}
        rows = [tuple(map(float, row)) for row in csv.reader(lines[2:])]
        if any(len(row) != 3 or not all(map(math.isfinite, row)) for row in rows):
            raise ValueError("a row is not three finite numbers")
    except ValueError as error:
        raise RecordingError(
            f"Expected a cache of ignition delays in {path}. Got a damaged file: {error} (delete it)."
        ) from error
    return {(a, b): value for a, b, value in rows}


def _write_cache(path: Path, known: dict[tuple[float, float], float]) -> None:
    """Write beside the target and rename, so that the file is whole or absent."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        with part.open("w", encoding="utf-8", newline="") as file:
            file.write(f"{_cache_header()}\n")
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["T0", "phi", "log_delay"])
            writer.writerows((repr(a), repr(b), repr(value)) for (a, b), value in sorted(known.items()))
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


# --- one-step mechanism --------------------------------------------------------------------------------


def one_step_delay(T0: float, phi: float, lnA: float, E: float) -> float:
    """Ignition delay by the one-step mechanism in a Cantera reactor, in seconds (Eqs. 37-39).

    Args:
        T0: Initial temperature, K.
        phi: Equivalence ratio, dimensionless.
        lnA: Logarithm of the pre-exponential factor in cm^3/(mol s).
        E: Activation energy, cal/mol.

    Raises:
        DomainError: If an argument has no meaning, or the mixture burns out below 1500 K.
        SimulatorError: If Cantera fails, or the delay is longer than 1e6 s.
        MissingDependencyError: If Cantera is not installed.
    """
    _check_conditions(T0, phi)
    if not (math.isfinite(lnA) and math.isfinite(E)):
        raise DomainError(f"Expected finite lnA and E. Got lnA = {lnA}, E = {E}.")
    _check_burnout(np.array([float(T0)]), np.array([float(phi)]))
    ct = _cantera()
    # E/R is what enters the rate: the two values of R must not be mixed. Units: m^3/(kmol s), J/kmol.
    rate = ct.ArrheniusRate(math.exp(lnA) * 1e-3, 0.0, E / R_CAL * ct.gas_constant)
    gas = getattr(_local, "one_step", None)
    if gas is None:
        reaction = ct.Reaction(equation="CH4 + 2 O2 => CO2 + 2 H2O", rate=rate)
        reaction.orders = {"CH4": 1.0, "O2": 1.0}
        gas = _local.one_step = ct.Solution(
            thermo="ideal-gas", kinetics="gas", species=_species(), reactions=[reaction]
        )
    reaction = gas.reaction(0)
    reaction.rate = rate
    gas.modify_reaction(0, reaction)
    return _run(gas, T0, phi, ONE_STEP_RTOL, ONE_STEP_ATOL)


class OneStep(nn.Module):
    r"""Log ignition delay of the one-step mechanism as an integral over the temperature.

    At constant pressure and enthalpy a one-step mechanism has one degree of freedom. The energy balance
    gives the progress :math:`\xi(T)` (mol of CH4 burnt), and with it all concentrations, so that

    .. math:: \tau = \int_{T_0}^{1500\,\mathrm{K}} \frac{d\xi/dT}{V(T)\, \mathcal R(T, \xi(T))}\, dT, \qquad
        \mathcal R = A e^{-E/RT} \Big(\frac{T}{1150\,\mathrm{K}}\Big)^{n}
        c_\mathrm{ref}^{2-a-b} [\mathrm{CH_4}]^a [\mathrm{O_2}]^b

    with :math:`c_\mathrm{ref} = 2\cdot10^{-6}` mol/cm^3. The quadrature is Gauss-Legendre in T. Everything
    that does not depend on the parameters is computed once, in float64, and held in buffers.

    Args:
        T0: Initial temperatures, K; `T0` and `phi` are broadcast to shape ``(n,)``.
        phi: Equivalence ratios, dimensionless.
        num_nodes: Quadrature nodes between T0 and 1500 K; 16 give ln tau to 1e-12 in `DOMAIN` and for orders
            from -2 to 3.

    Raises:
        DomainError: If a condition has no meaning, or a mixture burns out below 1500 K.
        ShapeError: If `T0` and `phi` do not broadcast to one dimension.
        MissingDependencyError: If Cantera, which holds the thermodynamic data, is not installed.

    Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 37-39; the exponents n, a
    and b are 0, 1 and 1 there.
    """

    def __init__(self, T0: ArrayLike, phi: ArrayLike, *, num_nodes: int = 16) -> None:
        super().__init__()
        if num_nodes < 1:
            raise DomainError(f"Expected num_nodes >= 1. Got {num_nodes}.")
        start, ratio = (np.atleast_1d(a) for a in _conditions(T0, phi))
        if start.ndim != 1 or start.size == 0:
            raise ShapeError(f"Expected T0 and phi of shape (n,). Got {start.shape}.")
        _check_burnout(start, ratio)
        points, weights = np.polynomial.legendre.leggauss(num_nodes)
        half = 0.5 * (T_IGNITION - start)[:, None]
        T = T_IGNITION - half * (1.0 - points)  # (n, nodes)
        progress, slope = _progress(T, start[:, None], ratio[:, None])
        # Cubic centimetres: the sum of moles, phi + 2 + 7.52, does not change in this reaction.
        volume = (ratio[:, None] + 9.52) * (_cantera().gas_constant * 1e-3) * T / _cantera().one_atm * 1e6
        log_c = np.log(volume * C_REFERENCE)
        for name, array in {
            "log_weight": np.log(half * weights * slope / volume) - 2.0 * np.log(C_REFERENCE),
            "log_fuel": np.log(ratio[:, None] - progress) - log_c,
            "log_oxidizer": np.log(2.0 - 2.0 * progress) - log_c,
            "log_temperature": np.log(T / T_REFERENCE),
            "inverse_rt": 1.0 / (R_CAL * T),
        }.items():
            self.register_buffer(name, torch.from_numpy(array))

    def log_delay(
        self,
        lnA: Tensor | float,
        E: Tensor | float,
        *,
        temperature_exponent: Tensor | float = 0.0,
        fuel_order: Tensor | float = 1.0,
        oxidizer_order: Tensor | float = 1.0,
    ) -> Tensor:
        """ln(tau / s) at the conditions, differentiable in every parameter.

        Args:
            lnA: Logarithm of the pre-exponential factor in cm^3/(mol s). Like every parameter a number, or a
                tensor of shape ``(*batch, 1)``, or ``(*batch, n)`` where it differs between conditions.
            E: Activation energy, cal/mol.
            temperature_exponent: n, dimensionless.
            fuel_order: a, dimensionless.
            oxidizer_order: b, dimensionless.

        Returns:
            Shape ``(*batch, n)``.

        Raises:
            ShapeError: If a parameter's last dimension is neither 1 nor n.
        """
        n = self._expand("temperature_exponent", temperature_exponent)
        a, b = self._expand("fuel_order", fuel_order), self._expand("oxidizer_order", oxidizer_order)
        log_rate = a * self.log_fuel + b * self.log_oxidizer + n * self.log_temperature
        log_time = self.log_weight + self._expand("E", E) * self.inverse_rt - log_rate
        return torch.logsumexp(log_time, dim=-1) - self._expand("lnA", lnA).squeeze(-1)

    forward = log_delay

    def _expand(self, name: str, value: Tensor | float) -> Tensor:
        buffer = self.log_weight
        if isinstance(value, Tensor):
            tensor = value.to(buffer.device)
        else:  # not as_tensor, which makes a float32 of a number: too coarse for E
            tensor = torch.tensor(value, dtype=buffer.dtype, device=buffer.device)
        if tensor.ndim and tensor.shape[-1] not in (1, len(buffer)):
            raise ShapeError(
                f"Expected {name} of shape (*batch, 1) or (*batch, {len(buffer)}). "
                f"Got {tuple(tensor.shape)} (add a last dimension of one)."
            )
        return tensor.unsqueeze(-1) if tensor.ndim else tensor.reshape(1, 1)


# --- thermodynamics and reactor ------------------------------------------------------------------------


def _cantera() -> ModuleType:
    try:
        import cantera
    except ImportError as error:
        raise MissingDependencyError(
            "The ignition studies need Cantera 3.2 or later (pip install 'torchcal[ignition]')."
        ) from error
    return cantera


@lru_cache(maxsize=1)
def _species() -> list[Any]:
    """Species of the one-step mechanism as GRI-Mech 3.0 has them, in the order of `SPECIES`."""
    every = {species.name: species for species in _cantera().Species.list_from_file(MECHANISM)}
    return [every[name] for name in SPECIES]


@lru_cache(maxsize=1)
def _nasa() -> NDArray[np.float64]:
    """NASA coefficients, shape (5 species, 15): middle temperature, 7 above it, 7 below it."""
    return np.array([species.thermo.coeffs for species in _species()])


def _enthalpy(T: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """h/R in K and cp/R of the five species at temperatures of any shape; the species come first."""
    table = _nasa().reshape(len(SPECIES), 15, *(1,) * T.ndim)
    c = np.where(table[:, :1] < T, table[:, 1:8], table[:, 8:15])
    cp = c[:, 0] + T * (c[:, 1] + T * (c[:, 2] + T * (c[:, 3] + T * c[:, 4])))
    h = c[:, 5] + T * (c[:, 0] + T * (c[:, 1] / 2 + T * (c[:, 2] / 3 + T * (c[:, 3] / 4 + T * c[:, 4] / 5))))
    return h, cp


def _progress(
    T: NDArray[np.float64], T0: NDArray[np.float64], phi: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Moles of CH4 burnt when T is reached from T0 at constant enthalpy, and their slope in T.

    The mixture starts as phi mol of CH4, 2 of O2 and 7.52 of N2.
    """
    (h, cp), (h0, _) = _enthalpy(T), _enthalpy(T0)
    heat = -np.tensordot(STOICHIOMETRY, h, axes=1)
    progress = (phi * (h - h0)[0] + 2.0 * (h - h0)[1] + 7.52 * (h - h0)[2]) / heat
    capacity = phi * cp[0] + 2.0 * cp[1] + 7.52 * cp[2] + progress * np.tensordot(STOICHIOMETRY, cp, axes=1)
    return progress, capacity / heat


def _conditions(T0: ArrayLike, phi: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    try:
        temperatures, ratios = np.broadcast_arrays(np.asarray(T0, dtype=float), np.asarray(phi, dtype=float))
    except ValueError as error:
        raise ShapeError(
            f"Expected T0 and phi that broadcast. Got shapes {np.shape(T0)} and {np.shape(phi)}."
        ) from error
    for point in zip(temperatures.ravel(), ratios.ravel(), strict=True):
        _check_conditions(*point)
    return temperatures, ratios


def _check_conditions(T0: float, phi: float) -> None:
    if not (200.0 <= T0 < T_IGNITION and 0.0 < phi < math.inf):
        raise DomainError(
            f"Expected 200 <= T0 < {T_IGNITION:g} K and a positive, finite phi. Got T0 = {T0} K, phi = {phi}."
        )


def _check_burnout(T0: NDArray[np.float64], phi: NDArray[np.float64]) -> None:
    """Raise where CH4 or O2 is used up before 1500 K is reached."""
    needed, _ = _progress(np.full_like(T0, T_IGNITION), T0, phi)
    for i in np.flatnonzero(needed >= np.minimum(phi, 1.0))[:1]:
        raise DomainError(
            f"Expected a mixture that can reach {T_IGNITION:g} K. Got T0 = {T0[i]:g} K, phi = {phi[i]:g}, "
            f"whose {'CH4' if phi[i] < 1 else 'O2'} is used up below that (take phi nearer to 1)."
        )


def _run(gas: Any, T0: float, phi: float, rtol: float, atol: float) -> float:
    """Time at which a constant-pressure adiabatic reactor first reaches 1500 K, s."""
    ct = _cantera()
    try:
        gas.TPX = T0, ct.one_atm, {"CH4": phi, "O2": 2.0, "N2": 7.52}
        reactor = ct.IdealGasConstPressureReactor(gas, clone=False)
        network = ct.ReactorNet([reactor])
        network.rtol, network.atol = rtol, atol
        time, T = 0.0, T0
        while T < T_IGNITION:
            time_before, T_before = time, T
            time, T = network.step(), reactor.T
            if time > LONGEST_DELAY:
                raise SimulatorError(
                    f"Expected a mixture that ignites. Got T0 = {T0:g} K, phi = {phi:g}, still at {T:.1f} K "
                    f"after {LONGEST_DELAY:g} s (it is too lean, too rich or too cold for these rates)."
                )
        slope = float(network.get_derivative(1)[reactor.component_index("temperature")])
    except ct.CanteraError as error:
        raise SimulatorError(f"Cantera failed at T0 = {T0:g} K, phi = {phi:g}: {error}") from error
    # The parabola t(T) through both ends of the last step with the slope at its end: third order in the step.
    width = T_before - T
    bend = (time_before - time - width / slope) / width**2
    left = T_IGNITION - T
    return time + left / slope + bend * left**2
