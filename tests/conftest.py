"""Settings that every test runs under."""

import os
import random
from collections.abc import Iterator

import matplotlib
import numpy as np
import pytest
import torch

import torchcal as tc

matplotlib.use("Agg")

# The tensors of the tests are small: more threads only get in the way of the other workers.
if "OMP_NUM_THREADS" not in os.environ:
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _isolated() -> Iterator[None]:
    """Start from the same random state, and leave no figure, Pyro parameter or default dtype behind."""
    import matplotlib.pyplot as plt
    import pyro

    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - third-party code draws from the global state
    torch.manual_seed(0)
    pyro.clear_param_store()
    yield
    plt.close("all")
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    assert dtype == torch.float32, f"the test changed the global default dtype to {dtype}"


@pytest.fixture
def star():
    """A body in the plane around a star; μ is 1 unless it is calibrated."""

    def rates(t, s, p, u):
        pull = -p["mu"] * (s["x"] ** 2 + s["y"] ** 2) ** -1.5
        return {"x": s["vx"], "y": s["vy"], "vx": pull * s["x"], "vy": pull * s["y"]}

    states = {"x": None, "y": None, "vx": None, "vy": None}
    return tc.ODESimulator(rates, states, [tc.Parameter("mu", low=0.0, initial=1.0)], observe=("x", "y"))


@pytest.fixture
def battery() -> tuple[tc.Simulator, tc.Term]:
    """A battery's time of discharge by its current (Peukert), and a loss in the cold."""
    base = tc.Simulator(
        lambda x, p: p["C"] * x["I"] ** -p["k"],
        parameters=[tc.Parameter("C", low=0.0, initial=8.0), tc.Parameter("k", low=0.8, high=1.6, initial=1.1)],
    )
    cold = tc.Term(
        "loss in the cold", outputs={"y": lambda x, p, y: y * (1 - p["a"] * (25 - x["T"]).clamp_min(0))},
        parameters=[tc.Parameter("a", low=0.0, high=0.03)],
    )  # fmt: skip
    return base, cold


@pytest.fixture
def binding() -> tuple[tc.Simulator, list[tc.Term]]:
    """Response to a dose by saturation, and terms that a recording at several doses and ages may need."""
    base = tc.Simulator(
        lambda x, p: p["top"] * x["dose"] / (p["half"] + x["dose"]),
        parameters=[tc.Parameter("top", low=0.1, high=5.0), tc.Parameter("half", low=0.05, high=20.0)],
    )
    terms = [
        tc.Term("effect of age", outputs={"y": lambda x, p, y: y * (1 + p["a"] * (x["age"] / 25 - 1.8))},
                parameters=[tc.Parameter("a")]),
        tc.Term("offset", outputs={"y": lambda x, p, y: y + p["a"]}, parameters=[tc.Parameter("a")]),
        tc.Term("unspecific binding", outputs={"y": lambda x, p, y: y + p["a"] * x["dose"]},
                parameters=[tc.Parameter("a", low=0.0)]),
    ]  # fmt: skip
    return base, terms
