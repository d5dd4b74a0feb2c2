"""Heat: base models and candidates."""

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, term
from torchcal.terms import Term


def _cooling(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {"T": -p["h"] * (s["T"] - u["Ta"])},
        {"T": "degC"},
        [positive("h", "1/min", 0.02)],
        observe=outputs,
    )
    return body, [
        *tc.terms.thermal("T", ambient="Ta", loss="h", humidity=1.0, time="min"),
        *tc.terms.sensor(("T",), time="min"),
    ]


def _room(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = tc.ODESimulator(
        lambda t, s, p, u: {
            "T": -p["a"] * (s["T"] - u["To"]) - p["b"] * (s["T"] - s["W"]) + p["e"] * u["q"],
            "W": p["d"] * (s["T"] - s["W"]),
        },
        {"T": "degC", "W": "degC"},
        [positive("a", "1/h", 0.25), positive("b", "1/h", 0.5), positive("d", "1/h", 0.05),
         positive("e", "K/h/kW", 1.0)],
        observe=outputs,
    )  # fmt: skip
    own = [
        term("window", "T",
             lambda t, s, p, u: -p["a"] * (s["T"] - u["To"]) * torch.sigmoid((s["T"] - p["opens"]) / 0.15),
             shapes={"opens": "T"}, formula="dT/dt ∋ -a (T - To) where T > opens"),
        term("heater that saturates", "T", lambda t, s, p, u: -p["a"] * u["q"] ** 2, formula="dT/dt ∋ -a q²"),
        term("sun", "T",
             lambda t, s, p, u: p["a"] * torch.relu(torch.sin(2 * torch.pi * (torch.as_tensor(t) - 6) / 24)),
             formula="dT/dt ∋ a max(0, sin(2π (t - 6)/24))"),
    ]  # fmt: skip
    return body, [
        *tc.terms.thermal("T", ambient="To", humidity=1.0, time="h"),
        *own,
        *tc.terms.sensor(("T",), time="h"),
    ]


BUILDERS: dict[str, Builder] = {
    "cooling body": _cooling,
    "heated room": _room,
}
