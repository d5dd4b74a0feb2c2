r"""A mug of hot water: Newton's law of cooling lacks evaporation.

Newton's law says that water loses heat in proportion to its excess over the surroundings,

.. math:: \frac{dT}{dt} = -k (T - T_a).

Hot water also evaporates, at a rate that follows its vapour pressure: 34 times as much at 95 °C as at 21 °C. The
recording is of a real mug, and calibration hides what is missing: with k, the room's temperature and the first
temperature free, Newton's law errs by 1.48 °C, against steps of 0.1 °C, and only after it has made the room 27 °C
warm (33 °C, calibrated to the first two hours alone). With evaporation 0.09 °C is left, in a room that is a little
above 20 °C. Others are close behind: a second heat capacity (the mug's wall) leaves 0.17; radiation 0.31 and
convection 0.82, both with a *negative* coefficient in Newton's law, so that physical signs matter: with them
radiation leaves 1.15 and convection 1.06.

The proof is the second half: fitted to 0-120 min, Newton's law misses 121-221 min by 4.9 °C, and evaporation by
0.5 °C. The humidity of the room cannot be told: with Newton's loss in the model it only moves the room's temperature.

Recording: CoolingWater of mosaicData, 222 points, one a minute, read to 0.1 °C (see `data.cooling_water`).

Runs as ``python -m examples.physics.cooling_water``.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

import torchcal as tc
from examples.physics import data, job

__all__ = ["candidates", "later", "main", "recording", "simulator"]

#: Last minute of the fitted half.
HALF = 120.0


def recording() -> tc.Recording:
    """Temperature against time. Neither the noise nor the first temperature is known."""
    time, temperature = data.cooling_water()
    return tc.Recording(runs=[tc.Run(time=time, outputs={"T": temperature})], units={"time": "min", "T": "degC"})


def later() -> Tensor:
    """The second half of the recording, bool ``(n,)``: what the fit must predict."""
    return torch.from_numpy(data.cooling_water()[0] > HALF)


def simulator() -> tc.ODESimulator:
    """Newton's law of cooling."""
    return tc.ODESimulator(
        rates=lambda t, s, p, u: {"T": -p["k"] * (s["T"] - p["Ta"])},
        states={"T": "degC"},
        parameters=[
            tc.Parameter("k", unit="1/min", low=0.0, high=0.5, initial=0.02),
            tc.Parameter("Ta", unit="degC", low=10.0, high=35.0, initial=22.0),
        ],
    )


def candidates() -> list[tc.Term]:
    """The thermal library and a thermometer's errors."""
    return [
        *tc.terms.thermal(temperature="T", ambient="Ta", loss="k", time="min"),
        *tc.terms.sensor(outputs=("T",), units={"T": "degC"}, time="min"),
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """Diagnose the mug, and write figures and report."""
    job.run("cooling_water", simulator, recording, candidates, argv, holdout=later)


if __name__ == "__main__":
    main()
