"""The unseen families: base models and candidates."""

from typing import Any

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, seen, term
from torchcal.terms import Term


def _chosen(terms: list[Term], *names: str) -> list[Term]:
    return [found for found in terms if found.name in names]


def _cell(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def voltage(t: Any, s: Any, p: Any, u: Any) -> Any:
        rest = 3.45 + s["z"] * (0.55 + 0.25 * s["z"] ** 2) - 0.3 * torch.exp(-8.0 * s["z"])
        return rest + s["v"] + u["i"] * p["R0"]

    body = tc.ODESimulator(
        lambda t, s, p, u: {"z": u["i"] / p["Q"], "v": p["R1"] / p["tau"] * u["i"] - s["v"] / p["tau"]},
        {"z": "", "v": "V"},
        [tc.Parameter("Q", unit="A h", low=1.0, initial=12.0), positive("R0", "ohm", 0.05),
         positive("R1", "ohm", 0.05), tc.Parameter("tau", unit="h", low=0.01, initial=0.25)],
        observe={"V": voltage},
    )  # fmt: skip
    slow = "slow diffusion: current"
    branch = _chosen(tc.terms.electrical("v", time="h"), "leakage current", "non-linear conductance",
                     "dielectric absorption", "Warburg element")  # fmt: skip
    amplitude = tc.Parameter("a", low=0.0, neutral=0.0)
    own = [
        term("self-discharge", "z", lambda t, s, p, u: -p["a"] * s["z"], formula="dz/dt ∋ -a z"),
        term("parasitic load", "z", lambda t, s, p, u: -p["a"] / p["Q"], formula="dz/dt ∋ -a/Q"),
        term("side reaction on charge", "z", lambda t, s, p, u: -p["a"] * torch.relu(u["i"]) / p["Q"],
             formula="dz/dt ∋ -a max(i, 0)/Q"),
        Term("charge transfer", outputs={"V": lambda t, s, p, u, y: y + p["a"] * torch.asinh(u["i"] / p["i0"])},
             parameters=[amplitude, tc.Parameter("i0")], scales={"i0": "i"}, formula="V → V + a arsinh(i/i0)"),
        Term("resistance of an empty cell",
             outputs={"V": lambda t, s, p, u, y: y + p["a"] * (1.0 - s["z"]) ** 2 * u["i"]}, parameters=[amplitude],
             formula="V → V + a (1 - z)² i"),
        Term("slow diffusion", rates={slow: lambda t, s, p, u: (u["i"] - s[slow]) / p["T"]}, states={slow: "A"},
             initial={slow: 0.0}, outputs={"V": lambda t, s, p, u, y: y + p["a"] * s[slow]},
             parameters=[amplitude, tc.Parameter("T")], scales={"T": "t"},
             formula="V → V + a z2, dz2/dt = (i - z2)/T, z2(0) = 0"),
        Term("offset of the ammeter",
             rates={"z": lambda t, s, p, u: p["a"] / p["Q"], "v": lambda t, s, p, u: p["a"] * p["R1"] / p["tau"]},
             outputs={"V": lambda t, s, p, u, y: y + p["a"] * p["R0"]},
             parameters=[tc.Parameter("a", neutral=0.0)], formula="i → i + a"),
    ]  # fmt: skip
    return body, [*own, *branch, *tc.terms.sensor(outputs, dynamic=False, time="h")]


def _car(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def pull(s: Any, p: Any, u: Any, wind: Any = 0.0) -> Any:
        return u["F"] / p["m"] - 9.81 * (u["grade"] + p["c"]) - 1e-3 * p["k"] * (s["v"] + wind) ** 2

    body = tc.ODESimulator(
        lambda t, s, p, u: {"v": pull(s, p, u)},
        {"v": "m/s"},
        [tc.Parameter("m", unit="t", low=0.1, initial=1.5), positive("c", "", 0.012), positive("k", "1/km", 0.35)],
        observe=outputs,
    )  # fmt: skip
    drive = _chosen(tc.terms.mechanics("x", "v", force="F", angle=False), "linear drag", "cubic drag",
                    "viscoelastic branch", "actuator lag")  # fmt: skip
    own = [
        term("copper loss", "v", lambda t, s, p, u: -p["a"] * u["F"] ** 2 / p["m"], formula="F → F - a F²"),
        term("iron that saturates", "v", lambda t, s, p, u: -p["a"] * u["F"] ** 3 / p["m"], formula="F → F - a F³"),
        term("loss with speed and force", "v", lambda t, s, p, u: -p["a"] * u["F"] * s["v"] / 30.0 / p["m"],
             formula="F → F (1 - a v/30)"),
        term("wind from the north", "v",
             lambda t, s, p, u: pull(s, p, u, p["a"] * torch.cos(u["H"])) - pull(s, p, u), low=None,
             formula="v² → (v + a cos H)²"),
        term("wind from the east", "v",
             lambda t, s, p, u: pull(s, p, u, p["a"] * torch.sin(u["H"])) - pull(s, p, u), low=None,
             formula="v² → (v + a sin H)²"),
        term("rotating masses", "v", lambda t, s, p, u: pull(s, p, u) / (1.0 + p["a"]) - pull(s, p, u),
             formula="dv/dt → dv/dt/(1 + a)"),
        term("tyres that warm up", "v", lambda t, s, p, u: -9.81 * p["c"] * p["a"] * torch.exp(-t / 100.0),
             formula="c → c (1 + a exp(-t/100 s))"),
    ]  # fmt: skip
    return body, [*own, *drive, *tc.terms.sensor(outputs)]


def _soil(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def drained(t: Any, s: Any, p: Any, u: Any) -> Any:
        return p["d"] * torch.exp(p["b"] * torch.log((s["S"] / 150.0).clamp_min(1e-3)))

    given = {"S": lambda t, s, p, u: s["S"], "D": drained}
    body = tc.ODESimulator(
        lambda t, s, p, u: {"S": u["R"] - p["e"] * s["S"] / 150.0 * u["E"] - drained(t, s, p, u)},
        {"S": "mm"},
        [positive("e", "", 0.9), positive("d", "mm/d", 4.0), tc.Parameter("b", low=1.0, high=15.0, initial=4.0)],
        observe={name: given[name] for name in outputs},
    )
    amplitude = tc.Parameter("a", low=0.0, neutral=0.0)
    own = [
        term("runoff from wet soil", "S", lambda t, s, p, u: -p["a"] * (s["S"] / 150.0) ** 2 * u["R"],
             formula="dS/dt ∋ -a R (S/150)²"),
        Term("roots that run dry", parameters=[amplitude], formula="e → e S²/(S² + 150² a)",
             shifts={"e": lambda t, s, p, u: -p["e"] * p["a"] / ((s["S"] / 150.0) ** 2 + p["a"])}),
        Term("crop that grows", parameters=[amplitude], formula="e → e (1 + a t/100)",
             shifts={"e": lambda t, s, p, u: p["e"] * p["a"] * t / 100.0}),
    ]  # fmt: skip
    water = tc.terms.hydraulics("S", inflow="R", length="mm", time="d")
    return body, [*water, *own, *tc.terms.sensor({name: given[name] for name in outputs}, time="d")]


def _epidemic(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    given = {"I": lambda t, s, p, u: s["I"], "A": lambda t, s, p, u: 1000.0 - (s["S"] + s["I"])}

    def caught(s: Any, p: Any, u: Any) -> Any:
        return 1e-3 * p["b"] * s["S"] * s["I"] * u["m"]

    body = tc.ODESimulator(
        lambda t, s, p, u: {"S": -caught(s, p, u), "I": caught(s, p, u) - p["g"] * s["I"]},
        {"S": "1/1000", "I": "1/1000"},
        [positive("b", "1/d", 0.3), positive("g", "1/d", 0.1)],
        observe={name: given[name] for name in outputs},
    )

    def contacts(name: str, factor: Any, formula: str, **bounds: Any) -> Term:
        return Term(name, shifts={"b": lambda t, s, p, u: p["b"] * (factor(t, s, p) - 1.0)},
                    parameters=[tc.Parameter("a", neutral=0.0, **bounds)], formula=f"b → b {formula}")  # fmt: skip

    amplitude = tc.Parameter("a", low=0.0, neutral=0.0)
    own = [
        term("waning immunity", "S", lambda t, s, p, u: p["a"] * (1000.0 - s["S"] - s["I"]),
             formula="dS/dt ∋ a (1000 - S - I)"),
        term("births and deaths", {
            "S": lambda t, s, p, u: p["a"] * (1000.0 - s["S"]),
            "I": lambda t, s, p, u: -p["a"] * s["I"],
        }, formula="dS/dt ∋ a (1000 - S), dI/dt ∋ -a I"),
        term("vaccination", "S", lambda t, s, p, u: -p["a"] * s["S"], formula="dS/dt ∋ -a S"),
        term("imported cases", "I", lambda t, s, p, u: p["a"], formula="dI/dt ∋ a"),
        contacts("caution", lambda t, s, p: 100.0 / (100.0 + p["a"] * torch.relu(s["I"])), "/(1 + a I/100)", low=0.0),
        contacts("unequal contacts", lambda t, s, p: torch.exp(p["a"] * torch.log(s["S"].clamp_min(1e-3) / 1000.0)),
                 "(S/1000)^a", low=0.0),
        contacts("season", lambda t, s, p: 1.0 + p["a"] * torch.cos(t * (2.0 * torch.pi / 365.0)),
                 "(1 + a cos(2π t/365))", low=-1.0, high=1.0),
        term("isolation", "I", lambda t, s, p, u: -p["a"] * s["I"] ** 2 / 100.0, formula="dI/dt ∋ -a I²/100"),
        Term("tests that run short", outputs={"I": lambda t, s, p, u, y: 100.0 * y / (100.0 + p["a"] * y)},
             parameters=[amplitude], formula="I → I/(1 + a I/100)"),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor({name: given[name] for name in outputs}, time="d")]


def _isotherm(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def pull(x: Any, p: Any) -> Any:
        """ln(K p)."""
        return torch.log(p["K"] * x["p"]) + p["H"] * (1000.0 / x["T"] - 1000.0 / 313.0) / 8.314

    def coverage(log: Any) -> Any:
        return torch.sigmoid(log)

    body = tc.Simulator(
        lambda x, p: {"q": p["qm"] * coverage(pull(x, p))},
        [tc.Parameter("qm", unit="mol/kg", low=0.0, initial=3.0),
         tc.Parameter("K", unit="1/bar", low=1e-3, initial=0.8), tc.Parameter("H", unit="kJ/mol", initial=20.0)],
    )  # fmt: skip

    def attracted(x: Any, p: Any, y: Any) -> Any:
        """θ/(1 - θ) = K p exp(a θ), by Newton's method for ln(θ/(1 - θ))."""
        bare = pull(x, p)
        z = bare
        for _ in range(25):
            share = torch.sigmoid(z)
            step = (z - bare - p["a"] * share) / (1.0 - p["a"] * share * (1.0 - share)).clamp_min(0.2)
            z = z - step.clamp(-2.0, 2.0)
        return p["qm"] * torch.sigmoid(z)

    def toth(x: Any, p: Any, y: Any) -> Any:
        n = 1.0 - p["a"]
        log = pull(x, p)
        return p["qm"] * torch.exp(log - torch.nn.functional.softplus(n * log) / n)

    def law(name: str, function: Any, low: float, high: float, formula: str) -> Term:
        parameter = tc.Parameter("a", low=low, high=high, neutral=0.0)
        return Term(name, outputs={"q": function}, parameters=[parameter], formula=formula)

    own = [
        law("Sips's law", lambda x, p, y: p["qm"] * coverage((1.0 - p["a"]) * pull(x, p)), 0.0, 0.8,
            "K p → (K p)^(1 - a)"),
        law("Toth's law", toth, 0.0, 0.8, "1 + K p → (1 + (K p)^(1 - a))^(1/(1 - a))"),
        law("lateral attraction", attracted, -3.0, 3.0, "K → K exp(a q/qm)"),
        law("several layers", lambda x, p, y: y / (1.0 - p["a"] * x["p"] / 12.0), 0.0, 0.9, "q → q/(1 - a p/12)"),
        seen("water on the sites", "q",
             lambda x, p, y: p["qm"] / (1.0 + (1.0 + p["a"] * x["w"] / 10.0) * torch.exp(-pull(x, p))),
             formula="1 + K p → 1 + K p + a w/10"),
        seen("second site", "q", lambda x, p, y: y + p["a"] * x["p"] / (x["p"] + p["far"]), shapes={"far": "p"},
             formula="q ∋ a p/(p + far)"),
        seen("capacity that falls with heat", "q", lambda x, p, y: y - y * p["a"] * (x["T"] - 313.0) / 30.0, low=None,
             formula="q → q (1 - a (T - 313)/30)"),
        seen("void volume", "q", lambda x, p, y: y + p["a"] * x["p"] / (x["T"] / 313.0), low=None,
             formula="q ∋ a p 313/T"),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(outputs, static=True)]


BUILDERS: dict[str, Builder] = {
    "battery cell": _cell,
    "car on a road": _car,
    "soil moisture": _soil,
    "epidemic": _epidemic,
    "adsorption": _isotherm,
}
