"""Replicates that differ by blocks of rows, and rows on end that were all set aside."""

import math
import re
from types import SimpleNamespace

import pytest
import torch

import torchcal as tc
from torchcal.discovery.misfit.blocks import jumps
from torchcal.discovery.misfit.replicates import Replicates

F64 = torch.float64


def replicated(e, conditions):
    """Replicates of values that differ by ``e`` alone, in sweeps over some conditions, and what they are taken from."""
    at = torch.arange(conditions).repeat(len(e) // conditions)
    rows, count = torch.arange(len(e)), torch.bincount(at).double()
    mean = torch.zeros(conditions, dtype=F64).index_add_(0, at, e) / count
    problem = SimpleNamespace(
        index=rows, condition_of=rows, y=e, gaps=lambda places: torch.ones(len(places) - 1, dtype=F64)
    )
    return problem, Replicates(rows, at, e - mean[at], (1 - 1 / count)[at])


def remembering(n, r, generator):
    e = torch.randn(n, generator=generator, dtype=F64)
    for i in range(1, n):
        e[i] = r * e[i - 1] + math.sqrt(1 - r**2) * e[i]
    return e


@pytest.mark.parametrize(("conditions", "sweeps"), [(17, 2), (17, 3), (10, 6), (40, 3), (8, 12)])
def test_noise_with_a_memory_has_hardly_ever_blocks(conditions, sweeps):
    generator, n = torch.Generator().manual_seed(7), conditions * sweeps
    drawn = [remembering(n, r, generator) for r in (0.0, 0.5, 0.8, 0.9, 0.95, 0.98) for _ in range(25)]
    told = sum(bool(jumps(*replicated(e, conditions), torch.ones(n, dtype=F64))) for e in drawn)
    assert told <= 6  # of 150: of 1 in 100 so many come with a probability of 0.997


@pytest.mark.parametrize(("conditions", "sweeps"), [(17, 3), (10, 6), (40, 3), (8, 12)])
def test_a_sweep_with_a_level_of_its_own_is_told_with_its_rows(conditions, sweeps):
    generator, n = torch.Generator().manual_seed(3), conditions * sweeps
    for _ in range(10):
        e = torch.randn(n, generator=generator, dtype=F64)
        e[conditions : 2 * conditions] += 15.0
        up, down, *more = jumps(*replicated(e, conditions), torch.ones(n, dtype=F64))
        assert not more
        assert not up.gain
        assert not down.gain
        assert abs(up.row - conditions - 1) <= 1
        assert abs(down.row - 2 * conditions - 1) <= 1
        assert up.height == pytest.approx(15.0, rel=0.35)
        assert down.height == pytest.approx(-15.0, rel=0.35)


LIGHT = torch.tensor([0, 25, 50, 75, 100, 150, 200, 300, 400, 500, 600, 800, 1000, 1200, 1500, 1800, 2000.0], dtype=F64)


def leaf(seed, sweeps, *, add=0.0, gain=0.0):
    """A right model of a light-response curve, recorded in sweeps of which the second is of another leaf."""
    light = LIGHT.repeat(sweeps)
    noise = 0.25 * torch.randn(len(light), generator=torch.Generator().manual_seed(seed), dtype=F64)
    taken = 0.055 * light * 30 / (0.055 * light + 30) - 1.2 + noise
    taken[17:34] = taken[17:34] * (1 + gain) + add
    simulator = tc.Simulator(
        lambda x, p: p["Pm"] * p["phi"] * x["I"] / (p["Pm"] + p["phi"] * x["I"]) - p["Rd"],
        parameters=[
            tc.Parameter("Pm", low=1.0, high=100.0, initial=25.0),
            tc.Parameter("phi", low=0.005, high=0.2, initial=0.05),
            tc.Parameter("Rd", low=-5.0, high=5.0, initial=1.0),
        ],
    )
    recording = tc.Recording(x={"I": light}, y=taken)
    terms = tc.terms.sensor(outputs=recording.outputs, static=True)
    return tc.diagnose(simulator, recording, terms, seed=0, progress=False)


def test_a_sweep_that_differs_is_no_silent_noise():
    told = leaf(0, 3, add=5.0)
    assert told.verdict == "consistent"
    assert "nothing is surely missing" in str(told)
    (text,) = (one for one in told.symptoms if "blocks of rows" in one)
    assert re.search(r": up by 2\d\.\d sd from row 18 on and down by 2\d\.\d sd from row 35 on \(sd of what they", text)
    told = leaf(0, 3, gain=0.25)
    (text,) = (one for one in told.symptoms if "blocks of rows" in one)
    assert re.search(r": up by 2\d\.\d % from row 18 on and down by 2\d\.\d % from row 35 on \(% of the mean", text)
    assert not leaf(0, 3).symptoms


def test_a_drift_along_the_rows_is_no_blocks():
    generator = torch.Generator().manual_seed(5)
    for conditions, sweeps in ((40, 3), (8, 12), (17, 3)):
        n = conditions * sweeps
        at = torch.arange(n, dtype=F64)
        for drift in (10.0 * at / n, 8.0 * torch.exp(-at / 6), 6.0 * torch.sin(2 * math.pi * at / n)):
            drawn = [drift + torch.randn(n, generator=generator, dtype=F64) for _ in range(20)]
            told = sum(bool(jumps(*replicated(e, conditions), torch.ones(n, dtype=F64))) for e in drawn)
            assert told <= 3, (conditions, told)


def test_rows_on_end_that_were_set_aside_have_something_in_common():
    told = leaf(1, 6, add=5.0)
    assert told.noise.outliers == 17
    (text,) = told.symptoms
    assert text.startswith("all data in rows 18 to 34, 17 of them, were set aside as outliers, all on one side, by +2")
