"""The blind families: base models and candidates."""

from collections.abc import Callable
from typing import Any

import torch

import torchcal as tc
from benchmarks.concealed.models.base import Builder, positive, seen, term
from torchcal.terms import Term

Function = Callable[..., Any]


def _amplitude(low: float | None = 0.0, high: float | None = None) -> tc.Parameter:
    return tc.Parameter("a", low=low, high=high, neutral=0.0)


def _quarter(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    body = 0.32

    def rates(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        strut = p["k"] * (s["w"] - s["x"]) + p["c"] * (s["q"] - s["v"])
        return {"x": s["v"], "v": strut / body, "w": s["q"], "q": (p["kt"] * (u["h"] - s["w"]) - strut) / p["m"]}

    car = tc.ODESimulator(
        rates,
        {"x": "cm", "v": "cm/s", "w": "cm", "q": "cm/s"},
        [tc.Parameter("m", unit="t", low=0.005, initial=0.04), positive("k", "kN/m", 20.0),
         positive("c", "kN s/m", 1.4), positive("kt", "kN/m", 150.0)],
        observe=outputs,
    )  # fmt: skip

    def strut(name: str, force: Function, formula: str, shapes: dict[str, str] | None = None) -> Term:
        """A force ``force(z, dz/dt, p)`` that resists extension z = x - w."""

        def of(s: Any, p: Any) -> Any:
            return force(s["x"] - s["w"], s["v"] - s["q"], p)

        return term(name, {"v": lambda t, s, p, u: -of(s, p) / body, "q": lambda t, s, p, u: of(s, p) / p["m"]},
                    shapes=shapes, formula=f"strut ∋ {formula}, z = x - w")  # fmt: skip

    def tyre(name: str, force: Function, formula: str, shapes: dict[str, str] | None = None) -> Term:
        return term(name, "q", lambda t, s, p, u: force(u["h"] - s["w"], p) / p["m"], shapes=shapes,
                    formula=f"m dq/dt ∋ {formula}, y = h - w")  # fmt: skip

    give = "rubber mount: give"
    own = [
        strut("progressive spring", lambda z, r, p: p["a"] * z**3, "a z³"),
        strut("bump stop", lambda z, r, p: p["a"] * (torch.relu(z - p["gap"]) - torch.relu(-z - p["gap"])),
              "a sign(z) max(|z| - gap, 0)", {"gap": "x"}),
        strut("turbulent damper", lambda z, r, p: p["a"] * r * r.abs(), "a |dz/dt| dz/dt"),
        strut("damper that hardens", lambda z, r, p: p["a"] * r**3, "a (dz/dt)³"),
        strut("damper softer in compression", lambda z, r, p: p["a"] * r.abs(), "a |dz/dt|"),
        strut("friction in the strut", lambda z, r, p: p["a"] * torch.tanh(r / p["width"]), "a tanh(dz/dt/width)",
              {"width": "v"}),
        Term("rubber mount",
             rates={"v": lambda t, s, p, u: -p["a"] * s[give] / body, "q": lambda t, s, p, u: p["a"] * s[give] / p["m"],
                    give: lambda t, s, p, u: s["v"] - s["q"] - s[give] / p["T"]},
             states={give: "cm"}, initial={give: 0.0}, parameters=[_amplitude(), tc.Parameter("T")], scales={"T": "t"},
             formula="strut ∋ a y, dy/dt = dz/dt - y/T, y(0) = 0, z = x - w"),
        tyre("tyre that hardens", lambda y, p: p["a"] * y**3, "a y³"),
        tyre("tyre that leaves the road", lambda y, p: p["a"] * torch.relu(-y - p["sag"]), "a max(-y - sag, 0)",
             {"sag": "w"}),
    ]  # fmt: skip
    return car, [*own, *tc.terms.sensor(outputs)]


def _reactor(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def rates(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        thinner = u["F"] / s["V"]
        turned = p["r"] * s["S"] / (s["V"] * (p["K"] + s["S"]))
        return {"S": thinner * (150.0 - s["S"]) - turned, "P": turned - thinner * s["P"], "V": u["F"]}

    body = tc.ODESimulator(
        rates,
        {"S": "mmol/l", "P": "mmol/l", "V": "l"},
        [positive("r", "mmol/h", 5.0), tc.Parameter("K", unit="mmol/l", low=0.05, initial=5.0)],
        observe=outputs,
    )
    laws = [
        found for found in tc.terms.kinetics("S", "P", rate="r", amount="mmol/l", time="h")
        if found.name in ("reverse reaction", "second branch", "consecutive reaction", "reversible adsorption",
                          "deactivation", "product inhibition")
    ]  # fmt: skip

    def enzyme(name: str, factor: Function, formula: str, high: float | None = None) -> Term:
        return Term(name, shifts={"r": lambda t, s, p, u: p["r"] * (factor(s, p) - 1.0)},
                    parameters=[_amplitude(0.0, high)], formula=formula)  # fmt: skip

    def together(s: Any, p: Any) -> Any:
        log = torch.log(s["S"].clamp_min(1e-6) / p["K"])
        return torch.sigmoid((1.0 + p["a"]) * log) / torch.sigmoid(log)

    own = [
        enzyme("substrate inhibition", lambda s, p: 1.0 / (1.0 + p["a"] * s["S"] ** 2 / (p["K"] + s["S"])),
               "K + S → K + S + a S²"),
        enzyme("product that competes",
               lambda s, p: 1.0 / (1.0 + p["a"] * torch.relu(s["P"]) / (1.0 + s["S"] / p["K"])), "K → K (1 + a P)"),
        enzyme("cooperative binding", together, "S/(K + S) → S^(1 + a)/(K^(1 + a) + S^(1 + a))", 3.0),
        term("feed off its label", "S", lambda t, s, p, u: p["a"] * u["F"] / s["V"], low=None,
             formula="150 mmol/l → 150 mmol/l + a"),
    ]  # fmt: skip
    return body, [*own, *laws, *tc.terms.sensor(outputs, time="h")]


def _leaf(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def limits(x: Any, p: Any) -> tuple[Any, Any]:
        """What light allows, and what carbon dioxide does."""
        return p["f"] * x["I"], p["Am"] / (1.0 + p["Kc"] / x["C"])

    def gross(x: Any, p: Any) -> Any:
        light, carbon = limits(x, p)
        return 1.0 / (1.0 / light + 1.0 / carbon)

    body = tc.Simulator(
        lambda x, p: {"A": gross(x, p) - p["R"]},
        [tc.Parameter("f", low=1e-3, initial=0.05), tc.Parameter("Am", unit="umol/m^2/s", low=1.0, initial=40.0),
         tc.Parameter("Kc", unit="ppm", low=1.0, initial=300.0), tc.Parameter("R", unit="umol/m^2/s", initial=1.5)],
    )  # fmt: skip

    def bent(x: Any, p: Any) -> Any:
        light, carbon = limits(x, p)
        total, product = light + carbon, light * carbon
        return 2.0 * product / (total + torch.sqrt(total.square() - 4.0 * p["a"] * product))

    def sharper(x: Any, p: Any) -> Any:
        light, carbon = limits(x, p)
        n = 1.0 + p["a"]
        return torch.exp(-torch.logaddexp(-n * torch.log(light), -n * torch.log(carbon)) / n)

    def drawn_down(x: Any, p: Any) -> Any:
        """G = gross(C - a (G - R)) by Newton's method, which comes from below and does not overshoot."""
        light, _ = limits(x, p)
        found = torch.zeros_like(light)
        for _ in range(12):
            there = x["C"] - p["a"] * (found - p["R"])
            below = light * (there + p["Kc"]) + p["Am"] * there
            value = light * p["Am"] * there / below
            slope = light.square() * p["Am"] * p["Kc"] / below.square()
            found = found - (found - value) / (1.0 + p["a"] * slope)
        return found

    def law(name: str, function: Function, formula: str, low: float | None = 0.0, high: float | None = None) -> Term:
        """Another gross uptake in place of the base's."""
        return Term(name, outputs={"A": lambda x, p, y: y + function(x, p) - gross(x, p)},
                    parameters=[_amplitude(low, high)], formula=formula)  # fmt: skip

    own = [
        law("curvature of the light response", bent, "a G² - (x + y) G + x y = 0 for 1/G = 1/x + 1/y", high=0.99),
        law("sharper limit", sharper, "1/G = 1/x + 1/y → G^-n = x^-n + y^-n, n = 1 + a", high=6.0),
        law("photoinhibition", lambda x, p: gross(x, p) * torch.exp(-p["a"] * x["I"] / 1000.0), "G → G exp(-a I/1000)"),
        law("photorespiration", lambda x, p: gross({**x, "C": x["C"] - p["a"]}, p),
            "C → C - a", high=70.0),
        law("optimum of temperature", lambda x, p: gross(x, p) * torch.exp(-p["a"] * ((x["T"] - 25.0) / 10.0) ** 2),
            "G → G exp(-a ((T - 25)/10)²)"),
        law("stomata that close", lambda x, p: gross({**x, "C": x["C"] / (1.0 + p["a"] * x["D"])}, p),
            "C → C/(1 + a D)"),
        law("resistance in the leaf", drawn_down, "C → C - a A", high=50.0),
        law("light wasted on oxygen", lambda x, p: gross({**x, "I": x["I"] / (1.0 + p["a"] / x["C"])}, p),
            "I → I C/(C + a)", high=500.0),
        seen("respiration that warms", "A", lambda x, p, y: y - p["R"] * torch.expm1(p["a"] * (x["T"] - 25.0) / 10.0),
             formula="R → R exp(a (T - 25)/10)"),
        seen("leak of the chamber", "A", lambda x, p, y: y + p["a"] * (x["C"] / 100.0 - 4.0), low=None,
             formula="A → A + a (C - 400)/100"),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(outputs, static=True, drift={"D": 1.5})]


def _generator(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def rates(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        sent = p["b"] * torch.sin(s["d"])
        return {"d": s["w"], "w": (p["Pm"] - p["D"] * s["w"] - u["L"] - sent) / p["M"]}

    body = tc.ODESimulator(
        rates,
        {"d": "rad", "w": "rad/s"},
        [tc.Parameter("M", unit="s^2", low=0.002, initial=0.03), positive("D", "s", 0.04), positive("b", "", 1.8),
         positive("Pm", "", 0.85)],
        observe=outputs,
    )  # fmt: skip

    def power(name: str, function: Function, formula: str, *, low: float | None = 0.0) -> Term:
        return term(name, "w", lambda t, s, p, u: function(s, p, u) / p["M"], low=low, formula=f"M dw/dt ∋ {formula}")

    gate, flux = "governor: gate", "flux that decays: flux"
    own = [
        power("salient poles", lambda s, p, u: -2.0 * p["a"] * torch.sin(s["d"]) * torch.cos(s["d"]), "-a sin 2d"),
        power("voltage that sags", lambda s, p, u: p["a"] * p["b"] * torch.sin(s["d"]) ** 3, "a b sin³ d"),
        power("losses in the line", lambda s, p, u: -p["a"] * torch.cos(s["d"]), "-a cos d", low=None),
        Term("governor",
             rates={"w": lambda t, s, p, u: -p["a"] * s[gate] / p["M"],
                    gate: lambda t, s, p, u: (s["w"] - s[gate]) / p["T"]},
             states={gate: "rad/s"}, initial={gate: 0.0}, parameters=[_amplitude(), tc.Parameter("T")],
             scales={"T": "t"}, formula="M dw/dt ∋ -a g, dg/dt = (w - g)/T, g(0) = 0"),
        Term("flux that decays",
             rates={"w": lambda t, s, p, u: p["a"] * p["b"] * torch.sin(s["d"]) * s[flux] / p["M"],
                    flux: lambda t, s, p, u: (2.0 * torch.sin(s["d"] / 2.0) ** 2 - s[flux]) / p["T"]},
             states={flux: ""}, initial={flux: 0.0}, parameters=[_amplitude(), tc.Parameter("T")], scales={"T": "t"},
             formula="b → b (1 - a e), de/dt = (1 - cos d - e)/T, e(0) = 0"),
        power("windage", lambda s, p, u: -p["a"] * s["w"] * s["w"].abs(), "-a |w| w"),
        power("damper that fades with the angle", lambda s, p, u: -p["a"] * s["w"] * torch.cos(s["d"]).square(),
              "-a w cos² d"),
        power("load that follows the frequency", lambda s, p, u: -p["a"] * s["w"] * u["L"], "-a L w"),
        power("load that follows the voltage", lambda s, p, u: p["a"] * u["L"] * (1.0 - torch.cos(s["d"])),
              "a L (1 - cos d)"),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(outputs)]


def _catchment(outputs: tuple[str, ...]) -> tuple[tc.Simulator, list[Term]]:
    def rates(t: Any, s: Any, p: Any, u: Any) -> dict[str, Any]:
        drained = s["S"] / p["T1"]
        drunk = p["e"] * u["E"] / (1.0 + 20.0 / s["S"].clamp_min(1e-6))
        return {"S": u["R"] - drunk - drained, "G": p["r"] * drained - s["G"] / p["T2"]}

    given = {
        "Q": lambda t, s, p, u: s["S"] / p["T1"] * (1.0 - p["r"]) + s["G"] / p["T2"],
        "G": lambda t, s, p, u: s["G"],
    }
    told = {name: given[name] for name in outputs}
    body = tc.ODESimulator(
        rates,
        {"S": "mm", "G": "mm"},
        [positive("e", "", 0.8), tc.Parameter("r", low=0.0, high=1.0, initial=0.45),
         tc.Parameter("T1", unit="d", low=0.3, initial=4.0), tc.Parameter("T2", unit="d", low=1.0, initial=30.0)],
        observe=told,
    )  # fmt: skip

    def quick(name: str, flow: Function, formula: str, shapes: dict[str, str] | None = None) -> Term:
        """Water that leaves the soil for the stream at once."""
        return Term(name, rates={"S": lambda t, s, p, u: -flow(s, p, u)},
                    outputs={"Q": lambda t, s, p, u, y: y + flow(s, p, u)},
                    parameters=[_amplitude(), *(tc.Parameter(shape) for shape in shapes or {})],
                    scales=shapes or {}, formula=f"dS/dt ∋ -{formula}, Q ∋ {formula}")  # fmt: skip

    deep = "deep aquifer: level"
    own = [
        quick("paved ground", lambda s, p, u: p["a"] * u["R"], "a R"),
        quick("runoff from wet soil", lambda s, p, u: p["a"] * s["S"] * u["R"] / 50.0, "a R S/50"),
        quick("overflow", lambda s, p, u: p["a"] * torch.relu(s["S"] - p["rim"]), "a max(S - rim, 0)", {"rim": "S"}),
        quick("quick flow that grows", lambda s, p, u: p["a"] * s["S"].square() / 400.0, "a (S/20)²"),
        quick("flow through macropores", lambda s, p, u: p["a"] * (s["S"] / 20.0) ** 3, "a (S/20)³"),
        term("deep leakage", "G", lambda t, s, p, u: -p["a"] * s["G"], formula="dG/dt ∋ -a G"),
        Term("deep aquifer",
             rates={"G": lambda t, s, p, u: p["a"] * (s[deep] - s["G"]),
                    deep: lambda t, s, p, u: (s["G"] - s[deep]) / p["T"]},
             states={deep: "mm"}, initial={deep: "G"}, parameters=[_amplitude(), tc.Parameter("T")], scales={"T": "t"},
             formula="dG/dt ∋ -a (G - z), dz/dt = (G - z)/T, z(0) = G(0)"),
        Term("leaves that grow", shifts={"e": lambda t, s, p, u: p["e"] * p["a"] * t / 100.0},
             parameters=[_amplitude()], formula="e → e (1 + a t/100)"),
        term("rain gauge in the wind", "S", lambda t, s, p, u: p["a"] * u["R"], formula="R → R (1 + a)"),
    ]  # fmt: skip
    return body, [*own, *tc.terms.sensor(told, time="d")]


BUILDERS: dict[str, Builder] = {
    "quarter car": _quarter,
    "enzyme reactor": _reactor,
    "leaf": _leaf,
    "power grid swing": _generator,
    "catchment": _catchment,
}
