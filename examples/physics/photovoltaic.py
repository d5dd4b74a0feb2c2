r"""A solar cell: an ideal diode lacks its series resistance *and* its shunt.

Light drives a current I_ph through a junction, and the junction leads part of it back:

.. math:: I = I_{ph} - I_s \left(e^{V_j / (n V_t)} - 1\right) - G_{sh} V_j, \qquad V_j = V + R_s I

with the thermal voltage V_t = kT/q = 26.4 mV at 33 °C. An ideal cell has R_s = 0 and G_sh = 0. The contacts of a real
one have a resistance, and some current leaks around the junction. Calibrated without them, the ideal cell takes an
ideality n of 2.26, where a junction has between 1 and 2, and errs by 13 mA. The series resistance alone leaves 2.4 mA.
The shunt alone wants a negative conductance (12 mA): it is hidden until the resistance is there. Both together leave
0.77 mA, at R_s = 0.0365 Ω and 1/G_sh = 53 Ω, as published.

Two kinds of shunt cannot be told apart here: an ohmic one leaves 0.773 mA, and a leakage limited by its own space
charge, -g V_j |V_j|, 0.769 mA. The textbook has the ohmic one, and so have the candidates; with the other among them
as well the honest verdict is ``ambiguous``. A photocurrent that falls with the voltage (I_ph + m V) is no candidate:
with R_s in the model it is the shunt in other words, m = -G_sh up to a factor 1 + R_s G_sh, and no measurement of I
against V can tell them apart.

Recording: the cell of R.T.C. France, 26 points, typed in (see `data.photovoltaic` for the source). The implicit
equation is solved for V_j by Newton's method from above, where it converges without overshooting.

Runs as ``python -m examples.physics.photovoltaic``.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

import torchcal as tc
from examples.physics import data, job

__all__ = ["THERMAL_VOLTAGE", "candidates", "current", "main", "recording", "simulator"]

#: kT/q at 33 °C, V.
THERMAL_VOLTAGE = 1.380649e-23 * (33.0 + 273.15) / 1.602176634e-19
#: Newton steps; from the upper bound at most 8 are needed for 1e-15 V with R_s < 0.5 Ω.
STEPS = 12


def recording() -> tc.Recording:
    """Current against voltage. The noise is not known."""
    voltage, current = data.photovoltaic()
    return tc.Recording(x={"V": voltage}, y={"I": current}, units={"V": "V", "I": "A"})


def current(voltage: Tensor, p: dict[str, Tensor]) -> Tensor:
    """The current at a voltage.

    Args:
        voltage: V, shape ``(n,)``.
        p: ``iph``, ``ln_is`` (I_s in A), ``n``, ``rs``, ``gsh``, ``ln_ratio`` and ``m``, shape ``(*batch, 1)``.

    Returns:
        Current in A, shape ``(*batch, n)``.
    """
    saturation = p["ln_is"].exp()
    scale = p["n"] * THERMAL_VOLTAGE
    # The second diode and the space-charge shunt are dormant: their currents are 0 unless a term frees them.
    second, charge = p["is2"] * 1e-6, p["gsc"]

    def through(junction: Tensor) -> tuple[Tensor, Tensor]:
        """Current that the junction leads back, and its derivative."""
        first = saturation * (junction / scale).exp()
        other = second * (junction / (2 * THERMAL_VOLTAGE)).exp()
        back = first - saturation + other - second + p["gsh"] * junction + charge * junction * junction.abs()
        slope = first / scale + other / (2 * THERMAL_VOLTAGE) + p["gsh"] + 2 * charge * junction.abs()
        return back, slope

    open_circuit = scale * (p["iph"] / saturation).log1p()
    junction = torch.minimum(voltage + p["rs"] * p["iph"], torch.maximum(voltage + 0 * scale, open_circuit))
    for _ in range(STEPS):
        back, slope = through(junction)
        gap = junction - voltage - p["rs"] * (p["iph"] - back)
        junction = junction - gap / (1 + p["rs"] * slope)
    return p["iph"] - through(junction)[0]


def simulator() -> tc.Simulator:
    """The ideal cell, with what a real one has besides it dormant."""
    return tc.Simulator(
        lambda x, p: {"I": current(x["V"], p)},
        parameters=[
            tc.Parameter("iph", unit="A", low=0.5, high=1.0, initial=0.76),
            tc.Parameter("ln_is", unit="ln A", low=-30.0, high=-6.0, initial=-13.0),
            tc.Parameter("n", low=0.8, high=3.0, initial=1.5),
            tc.Parameter("rs", unit="ohm", low=0.0, high=0.5, neutral=0.0),
            tc.Parameter("gsh", unit="S", low=0.0, high=1.0, neutral=0.0),
            tc.Parameter("is2", unit="uA", low=0.0, high=100.0, neutral=0.0),
            tc.Parameter("gsc", unit="A/V^2", low=0.0, high=1.0, neutral=0.0),
        ],
    )


def candidates(*, space_charge: bool = False) -> list[tc.Term]:
    """Two that are missing, and what else a cell or an ammeter might do.

    Args:
        space_charge: Whether a leakage limited by its own space charge is a candidate as well.
    """
    charge = tc.Term(
        "space-charge shunt",
        frees=("gsc",),
        formula="I ∋ -g V_j |V_j|",
        description="A leakage limited by its own space charge grows with the square of the voltage.",
    )
    return [
        tc.Term(
            "series resistance",
            frees=("rs",),
            formula="V_j = V + R_s I",
            description="Contacts and emitter have a resistance, so that the junction sees more than the terminals.",
        ),
        tc.Term(
            "shunt",
            frees=("gsh",),
            formula="I ∋ -G_sh V_j",
            description="Some current leaks around the junction, over the edges of the cell.",
        ),
        tc.Term(
            "second diode",
            frees=("is2",),
            formula="I ∋ -I_s2 (exp(V_j/(2 V_t)) - 1)",
            description="Electrons and holes recombine in the depletion layer, with an ideality of 2.",
        ),
        tc.Term(
            "ideality rises with voltage",
            shifts={"n": lambda x, p: p["m"] * x["V"]},
            parameters=[tc.Parameter("m", unit="1/V", low=0.0, high=3.0)],
            formula="n ∋ m V",
            description="At high injection the junction turns less steep.",
        ),
        *tc.terms.sensor(outputs=("I",), static=True, units={"I": "A"}),
        *([charge] if space_charge else []),
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """Diagnose the cell, and write figures and report."""
    job.run("photovoltaic", simulator, recording, candidates, argv)


if __name__ == "__main__":
    main()
