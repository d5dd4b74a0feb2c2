r"""Stopping distances: a true effect that its data cannot prove.

A car that brakes with a constant deceleration a from the speed v stops after

.. math:: d = \frac{v^2}{2 a}.

A driver needs a reaction time t_r first, which adds v t_r: this is certain. The 50 stopping distances scatter by
4.5 m, though, and the calibrated deceleration has taken most of the reaction into itself: 2.14 m/s², where 3.6 m/s²
belongs to a reaction time of 0.84 ± 0.38 s. Two standard deviations; BIC prefers the reaction at odds of 1.6 to 1. So
the honest answer is not a name: ``consistent``, with the smallest reaction time that these data could have shown, or
``ambiguous``.

Recording: typed in (see `data.cars` for the source), in m and m/s. The noise is not known.

Runs as ``python -m examples.physics.cars``.
"""

from collections.abc import Sequence

from torch import Tensor

import torchcal as tc
from examples.physics import data, job

__all__ = ["candidates", "main", "recording", "simulator"]


def recording() -> tc.Recording:
    """Stopping distance against speed."""
    speed, distance = data.cars()
    return tc.Recording(x={"v": speed}, y={"d": distance}, units={"v": "m/s", "d": "m"})


def _distance(x: dict[str, Tensor], p: dict[str, Tensor]) -> dict[str, Tensor]:
    v = x["v"]
    return {"d": v**2 / (2 * p["a"]) + p["reaction_time"] * v}


def simulator() -> tc.Simulator:
    """Braking alone, with the reaction time dormant."""
    return tc.Simulator(
        _distance,
        parameters=[
            tc.Parameter("a", unit="m/s^2", low=0.5, high=20.0, initial=3.0),
            tc.Parameter("reaction_time", unit="s", low=0.0, high=5.0, neutral=0.0),
        ],
    )


def candidates() -> list[tc.Term]:
    """The reaction time, brakes that fade or are slow to grip, and how the distance was measured."""
    return [
        tc.Term(
            "reaction time",
            frees=("reaction_time",),
            formula="d ∋ t_r v",
            description="The car rolls on while the driver reacts.",
        ),
        tc.Term(
            "brake fade",
            shifts={"a": lambda x, p: -p["f"] * x["v"]},
            parameters=[tc.Parameter("f", unit="1/s", low=0.0, high=0.1)],
            formula="a ∋ -f v",
            description="Brakes that get hot at high speed hold less.",
        ),
        *tc.terms.sensor(outputs=("d",), static=True, units={"d": "m"}),
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """Diagnose the stopping distances, and write figures and report."""
    job.run("cars", simulator, recording, candidates, argv)


if __name__ == "__main__":
    main()
