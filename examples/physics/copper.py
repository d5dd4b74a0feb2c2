r"""Thermal expansion of copper: Einstein's or Debye's solid lacks anharmonicity.

By Grüneisen's rule a crystal expands in proportion to its heat capacity,

.. math:: \alpha(T) = A \, c(\theta/T), \qquad
   c_E(u) = \frac{u^2 e^u}{(e^u - 1)^2}, \quad c_D(u) = \frac{3}{u^3} \int_0^u \frac{z^4 e^z}{(e^z - 1)^2} dz,

c = 1 when it is hot. In Einstein's solid every atom has the same frequency; in Debye's the frequencies are those of
sound, and c falls with T³ instead of exponentially when it is cold. Both are harmonic: above θ the coefficient would be
constant. In copper it keeps rising, because the springs soften as the crystal grows: α = A c(θ/T) (1 + a T).

The two spectra share one θ here: Einstein's frequency is (π/6)^(1/3) of Debye's, where c_E and c_D meet when it is hot.
Numbers (rmse in 1e-6/K): Einstein 0.881, with anharmonicity 0.198, with Debye's spectrum instead 0.744, with both
0.119 (0.116 with a spectrum between the two). NIST's own certified fit, seven coefficients without meaning, leaves
0.081. Calibrated below 500 K, both together give a spectrum that is 1.04 ± 0.02 Debye's and θ = 323 K (literature: 315
to 343 K), which nobody told them.

Recording: 236 points of NIST StRD Hahn1 (see `data.copper` for the source), 14 to 852 K. The noise is not known.

Runs as ``python -m examples.physics.copper``.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

import torchcal as tc
from examples.physics import data, job

__all__ = ["candidates", "debye", "einstein", "main", "recording", "simulator"]

#: Gauss-Legendre nodes of the Debye integral: 1e-13 relative up to θ/T = 30.
NODES, WEIGHTS = (torch.from_numpy(array) for array in np.polynomial.legendre.leggauss(40))
#: Ratio of Einstein's to Debye's temperature at which both have the same heat capacity when it is hot.
RATIO = (math.pi / 6) ** (1 / 3)


def recording() -> tc.Recording:
    """Coefficient of expansion against temperature."""
    temperature, expansion = data.copper()
    return tc.Recording(x={"T": temperature}, y={"alpha": expansion}, units={"T": "K", "alpha": "1e-6/K"})


def einstein(u: Tensor) -> Tensor:
    """Heat capacity of Einstein's solid, in units of 3 k per atom, of u = θ_E/T."""
    # u² e^u / (e^u - 1)², written so that nothing overflows or cancels.
    return (u / (2 * torch.sinh(u / 2))) ** 2


def debye(u: Tensor) -> Tensor:
    """Heat capacity of Debye's solid, in units of 3 k per atom, of u = θ_D/T."""
    z = u.unsqueeze(-1) * (0.5 * (NODES.to(u) + 1))
    return 1.5 / u**2 * (z**2 * einstein(z) * WEIGHTS.to(u)).sum(-1)


def simulator(spectrum: str = "einstein") -> tc.Simulator:
    """A harmonic crystal.

    Args:
        spectrum: ``"einstein"``, with Debye's spectrum dormant, or ``"debye"``.
    """

    def expansion(x: dict[str, Tensor], p: dict[str, Tensor]) -> dict[str, Tensor]:
        u = p["theta"] / x["T"]
        one, sound = einstein(RATIO * u), debye(u)
        capacity = sound if spectrum == "debye" else one + p["debye"] * (sound - one)
        return {"alpha": p["A"] * capacity * (1 + 1e-4 * p["a"] * x["T"]) + 1e-4 * p["electrons"] * x["T"]}

    parameters = [
        tc.Parameter("A", unit="1e-6/K", low=5.0, high=40.0, initial=17.0),
        tc.Parameter("theta", unit="K", low=100.0, high=800.0, initial=320.0),
        tc.Parameter("a", unit="1e-4/K", low=0.0, high=20.0, neutral=0.0),
        tc.Parameter("electrons", unit="1e-10/K^2", low=0.0, high=10.0, neutral=0.0),
    ]
    if spectrum != "debye":
        parameters.insert(2, tc.Parameter("debye", low=0.0, high=1.2, neutral=0.0))
    return tc.Simulator(expansion, parameters=parameters)


def candidates(spectrum: str = "einstein") -> list[tc.Term]:
    """Physics of a real crystal and of a dilatometer.

    Args:
        spectrum: As for `simulator`.
    """
    terms = [
        tc.Term(
            "anharmonicity",
            frees=("a",),
            formula="α = A c(θ/T) (1 + a T)",
            description="The forces between the atoms weaken with their distance, so that a hot crystal expands more.",
        ),
        tc.Term(
            "electrons",
            frees=("electrons",),
            formula="α ∋ b T",
            description="The conduction electrons' own expansion, linear in T; 1 to 2e-10/K² in copper.",
        ),
        tc.Term(
            "vacancies",
            outputs={"alpha": lambda x, p, y: y + p["v"] * _vacancies(x["T"], p["E"])},
            parameters=[
                tc.Parameter("v", unit="1e-6/K", low=0.0),
                tc.Parameter("E", unit="eV", low=0.8, high=1.5),
            ],
            formula="α ∋ v (1000 K/T)² exp(-E/k (1/T - 1/(1000 K)))",
            description="Empty lattice sites form when it is hot and make the crystal larger.",
        ),
        tc.Term(
            "softening",
            shifts={"theta": lambda x, p: -p["s"] * x["T"]},
            parameters=[tc.Parameter("s", low=0.0, high=0.2)],
            formula="θ ∋ -s T",
            description="Frequencies fall as the crystal expands.",
        ),
        *tc.terms.sensor(outputs=("alpha",), static=True, units={"alpha": "1e-6/K"}),
    ]
    if spectrum != "debye":
        terms.insert(
            1,
            tc.Term(
                "Debye spectrum",
                frees=("debye",),
                formula="c = c_E + d (c_D - c_E)",
                description="Frequencies are spread as those of sound instead of being all the same.",
            ),
        )
    return terms


def _vacancies(temperature: Tensor, energy: Tensor) -> Tensor:
    """Expansion by vacancies of formation energy E in eV; 1 at 1000 K."""
    exponent = energy / 8.617333e-5 * (1 / 1000.0 - 1 / temperature)
    return (1000.0 / temperature) ** 2 * exponent.exp()


def main(argv: Sequence[str] | None = None) -> None:
    """Diagnose the expansion, and write figures and report."""
    job.run("copper", simulator, recording, candidates, argv)


if __name__ == "__main__":
    main()
