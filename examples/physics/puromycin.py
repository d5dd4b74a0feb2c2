r"""An enzyme for which the textbook is enough.

The rate of a reaction that an enzyme speeds up follows Michaelis and Menten,

.. math:: v = \frac{V_{max} \, c}{K + c}

with c the concentration of the substrate. Real enzymes may cooperate (Hill exponent), be inhibited by their own
substrate, or let some react without them, and a counter has a background. None of it shows here: the twelve rates are
six pairs at equal concentration, whose differences give a noise sd of 10.8 counts/min² without any model, and the
fitted curve leaves 10.9. The background is the closest: 32 ± 15 counts/min², one in thirty by chance for a single
look, and every candidate is a look. The verdict must be ``consistent``.

Recording: typed in (see `data.puromycin` for the source). The noise is not known, but there are replicates.

Runs as ``python -m examples.physics.puromycin``.
"""

from collections.abc import Sequence

from torch import Tensor

import torchcal as tc
from examples.physics import data, job

__all__ = ["candidates", "main", "recording", "simulator"]


def recording() -> tc.Recording:
    """Reaction rate against concentration."""
    concentration, rate = data.puromycin()
    return tc.Recording(x={"c": concentration}, y={"v": rate}, units={"c": "ppm", "v": "counts/min^2"})


def _rate(x: dict[str, Tensor], p: dict[str, Tensor]) -> dict[str, Tensor]:
    c = x["c"]
    bound = (c / p["K"]) ** p["hill"]
    return {"v": p["Vmax"] * bound / (1 + bound + p["inhibition"] * c * bound) + p["uncatalysed"] * c}


def simulator() -> tc.Simulator:
    """Michaelis and Menten, with what other enzymes do dormant."""
    return tc.Simulator(
        _rate,
        parameters=[
            tc.Parameter("Vmax", unit="counts/min^2", low=0.0, high=1000.0, initial=200.0),
            tc.Parameter("K", unit="ppm", low=0.001, high=1.0, initial=0.05),
            tc.Parameter("hill", low=0.2, high=4.0, neutral=1.0),
            tc.Parameter("inhibition", unit="1/ppm", low=0.0, high=10.0, neutral=0.0),
            tc.Parameter("uncatalysed", unit="counts/min^2/ppm", low=0.0, high=200.0, neutral=0.0),
        ],
    )


def candidates() -> list[tc.Term]:
    """What other enzymes do, and a counter's background and gain."""
    return [
        tc.Term(
            "cooperative binding",
            frees=("hill",),
            formula="v = Vmax c^h / (K^h + c^h)",
            description="One bound substrate molecule changes how easily the next one binds.",
        ),
        tc.Term(
            "substrate inhibition",
            frees=("inhibition",),
            formula="v = Vmax c / (K + c + i c²)",
            description="A second substrate molecule blocks the enzyme.",
        ),
        tc.Term(
            "uncatalysed reaction",
            frees=("uncatalysed",),
            formula="v ∋ m c",
            description="Some substrate reacts without the enzyme.",
        ),
        *tc.terms.sensor(outputs=("v",), static=True, units={"v": "counts/min^2"}),
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """Diagnose the enzyme, and write figures and report."""
    job.run("puromycin", simulator, recording, candidates, argv)


if __name__ == "__main__":
    main()
