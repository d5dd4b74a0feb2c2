"""How fast NISP propagates, against the matrix product that it cannot do without: ``python -m benchmarks.propagation``.

A density's outputs at Q nodes and n data are, for a simulator linear in M functions of its parameters, one product of
(chains · Q × M) and (M × n). The time of that product alone, twice more for the gradient, is the bound. Work is counted
in nodes × data × chains. ``--device cpu cuda`` measures both in one run, and whole calibrations on each.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import torchcal as tc
from torchcal.embeddings import Gaussian

CHAINS = (1, 16, 64)
MANY = 1024
"""Chains that only a device with thousands of lanes is asked for."""
SIZES = (100, 1_000, 10_000)
"""Data of the calibrations."""


@dataclass(frozen=True)
class Case:
    """A simulator, its conditions and the number of functions that its outputs are linear in."""

    name: str
    propagate: tc.NISP
    features: int


def _parameters(count: int) -> list[tc.Parameter]:
    return [tc.Parameter(f"p{i}", low=-1.0, high=1.0) for i in range(count)]


def _line(x: Tensor, p: dict[str, Tensor]) -> Tensor:
    return p["p0"] + p["p1"] * x


def _polynomial(x: Tensor, p: dict[str, Tensor]) -> Tensor:
    return sum((value * x ** (i + 1) + (value * x) ** 2 + value**3) for i, value in enumerate(p.values()))


def _function(x: Tensor, p: dict[str, Tensor]) -> Tensor:
    return torch.exp(-(p["p0"] + 1.5) * x) * torch.cos(p["p1"] * x)


def cases() -> list[Case]:
    def x(n: int) -> Tensor:
        return torch.linspace(0, 1, n, dtype=torch.float64)

    def nisp(function: Callable[..., Tensor], d: int, n: int, degree: int | None, **options: object) -> tc.NISP:
        return tc.NISP(tc.Simulator(function, _parameters(d), degree=degree), Gaussian(), x(n), **options)

    return [
        Case("line, 2 parameters, N = 11", nisp(_line, 2, 11, 1), 3),
        Case("the same, degree not told", nisp(_line, 2, 11, None, rule=2), 3),
        Case("cubic in 4 parameters, N = 1000, expansion of order 3", nisp(_polynomial, 4, 1000, 3, order=3), 35),
        Case("the same, degree not told", nisp(_polynomial, 4, 1000, None, order=3, rule=4), 35),
        Case("cubic in 4 parameters, N = 1000, order 1", nisp(_polynomial, 4, 1000, 3, order=1), 35),
        Case("exp(-a x) cos(b x), N = 100, 12² nodes", nisp(_function, 2, 100, None, rule=12), 0),
    ]


def seconds(function: Callable[[], object], device: torch.device, least: float = 0.3) -> float:
    """Median time of a call, once warm, until the device has done it."""

    def done() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    function()
    times: list[float] = []
    began = done()
    while time.perf_counter() - began < least or len(times) < 5:
        start = done()
        function()
        times.append(done() - start)
    return statistics.median(times)


def row(case: Case, chains: int, device: torch.device) -> str:
    propagate = case.propagate.copy().to(device=device)
    generator = torch.Generator().manual_seed(0)
    alpha = (0.1 * torch.randn(chains, propagate.num_alpha, dtype=torch.float64, generator=generator)).to(device)
    n = len(propagate.mean(alpha[0]))
    work = propagate.num_nodes * n * chains

    def forward() -> None:
        with torch.no_grad():
            propagate(alpha)

    def gradient() -> None:
        leaf = alpha.clone().requires_grad_(True)
        mean, sd = propagate(leaf)
        (mean.sum() + sd.sum()).backward()

    bound = ""
    if case.features:
        left = torch.randn(chains * propagate.num_nodes, case.features, dtype=torch.float64, generator=generator)
        right = torch.randn(case.features, n, dtype=torch.float64, generator=generator)
        factors = left.to(device), right.to(device)
        bound = f"{work / seconds(lambda: factors[0] @ factors[1], device):.2g}"
    figures = [f"{work / seconds(function, device):.2g}" for function in (forward, gradient)]
    return (
        f"| {device.type} | {case.name} | {propagate.num_nodes} | {chains} | {figures[0]} | {figures[1]} "
        f"| {bound or '–'} |"
    )


def calibration(n: int, device: torch.device) -> str:
    """A calibration of a model that lacks something, from nothing to draws, and what it gave."""
    x = torch.linspace(0, 1, n, dtype=torch.float64)
    truth = torch.exp(-1.2 * x) * torch.cos(1.3 * x) + 0.1 * x.square()
    noise = 0.01 * torch.randn(n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    start = time.perf_counter()
    result = tc.calibrate(
        tc.Simulator(_function, [tc.Parameter("p0", low=-1.4, high=2.0), tc.Parameter("p1", low=0.0, high=3.0)]),
        tc.Recording(x=x, y=truth + noise),
        likelihood=tc.likelihoods.ABC(epsilon=0.05, gamma=1.0),
        num_samples=50,
        num_chains=32,
        num_warmup=150,
        seed=0,
        device=device,
    )
    took = time.perf_counter() - start
    mean = ", ".join(f"{float(value):.3f}" for value in result.samples.mean((0, 1)))
    return f"| {device.type} | {n:,} | {result.propagate.num_nodes} | {took:.1f} | {mean} |"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.propagation", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("outputs/propagation"))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", nargs="+", type=torch.device, default=[torch.device("cpu")])
    given = parser.parse_args(arguments)
    torch.set_num_threads(given.threads)
    given.out.mkdir(parents=True, exist_ok=True)
    where = ", ".join(torch.cuda.get_device_name(it) for it in given.device if it.type == "cuda")
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        print(line, flush=True)

    say(f"float64, {given.threads} thread(s), torch {torch.__version__}{where and f', {where}'}.")
    say("")
    say("Nodes × data × chains a second:")
    say("")
    say("| device | simulator | nodes | chains | mean and sd | with gradient | matrix product alone |")
    say("|---|---|---|---|---|---|---|")
    for case in cases():
        for device in given.device:
            for chains in CHAINS if device.type == "cpu" else (*CHAINS, MANY):
                say(row(case, chains, device))
    if len(given.device) > 1:
        say("")
        say("Calibrations, 32 chains of 200 iterations:")
        say("")
        say("| device | data | nodes | seconds | mean of the coefficients |")
        say("|---|---|---|---|---|")
        for n in SIZES:
            for device in given.device:
                say(calibration(n, device))
    (given.out / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
