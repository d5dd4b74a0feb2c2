"""What the one-step mechanism leaves out, found by `torchcal.diagnose` from ln τ of GRI-Mech 3.0.

The base is CH4 + 2 O2 -> CO2 + 2 H2O at the rate A exp(-E/RT) [CH4][O2]. Dormant in it are the reaction orders and an
exponent of the temperature; three more candidates could be missing as well as any.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

import torchcal as tc
from examples.ignition.chemistry import DOMAIN, R_CAL, OneStep

__all__ = ["CANDIDATES", "simulator"]

PARAMETERS = (
    tc.Parameter("lnA", unit="ln(cm³/(mol s))", low=DOMAIN["lnA"][0], high=DOMAIN["lnA"][1]),
    tc.Parameter("E", unit="cal/mol", low=DOMAIN["E"][0], high=DOMAIN["E"][1]),
    tc.Parameter("fuel_order", neutral=1.0, low=-2.0, high=3.0),
    tc.Parameter("oxidizer_order", neutral=1.0, low=-2.0, high=3.0),
    tc.Parameter("temperature_exponent", neutral=0.0, low=-10.0, high=10.0),
)


def simulator() -> tc.Simulator:
    """ln τ of the one-step mechanism, by quadrature; conditions T0 and, where it varies, phi."""
    known: dict[tuple[int, float, float], OneStep] = {}

    def log_delay(x: Mapping[str, Tensor], p: dict[str, Tensor]) -> dict[str, Tensor]:
        T0 = x["T0"]
        phi = x.get("phi", torch.ones_like(T0))
        key = (len(T0), float(T0.sum()), float((T0 * phi).sum()))
        if key not in known:
            known[key] = OneStep(T0.detach().numpy(), phi.detach().numpy())
        ln_tau = known[key].log_delay(
            p["lnA"],
            p["E"],
            temperature_exponent=p["temperature_exponent"],
            fuel_order=p["fuel_order"],
            oxidizer_order=p["oxidizer_order"],
        )
        return {"ln_tau": ln_tau}

    return tc.Simulator(log_delay, PARAMETERS)


#: What might be missing.
CANDIDATES = (
    tc.Term(
        "fuel reaction order",
        frees=("fuel_order",),
        formula="rate ∝ [CH4]^a",
        description="The rate need not be proportional to the fuel; global mechanisms of methane have about -0.3.",
    ),
    tc.Term(
        "oxidizer reaction order",
        frees=("oxidizer_order",),
        formula="rate ∝ [O2]^b",
        description="The rate need not be proportional to the oxygen.",
    ),
    tc.Term(
        "temperature exponent",
        frees=("temperature_exponent",),
        formula="rate ∝ (T / 1150 K)^n",
        description="A pre-exponential factor that depends on the temperature.",
    ),
    tc.Term(
        "induction time",
        outputs={"ln_tau": lambda x, p, y: torch.log(torch.exp(y) + p["delay"])},
        parameters=[tc.Parameter("delay", unit="s", low=0.0, high=0.1)],
        formula="τ + delay",
        description="A delay before anything reacts, such as mixing.",
    ),
    tc.Term(
        "temperature error",
        shifts={"lnA": lambda x, p: p["E"] / R_CAL * (1.0 / x["T0"] - 1.0 / (x["T0"] + p["offset"]))},
        parameters=[tc.Parameter("offset", unit="K", low=-50.0, high=50.0)],
        formula="T0 + offset",
        description="A constant error of the initial temperature.",
    ),
    tc.Term(
        "pressure error",
        shifts={"lnA": lambda x, p: p["log_ratio"] * torch.ones_like(x["T0"])},
        parameters=[tc.Parameter("log_ratio", low=-0.5, high=0.5)],
        formula="rate ∝ (1 + error)",
        description="A constant error of the pressure, which the calibrated A takes up: no data can show it.",
    ),
)
