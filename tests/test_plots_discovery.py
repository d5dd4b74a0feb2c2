"""Figures of a diagnosis: what is drawn equals what was given, and nothing hides anything else."""

import dataclasses
import itertools
import math
import re
from types import SimpleNamespace

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from torchcal import plots, report
from torchcal.data import Recording, Run
from torchcal.discovery.fits import local
from torchcal.discovery.records import (
    Estimate,
    Experiment,
    Fit,
    Hypothesis,
    Limit,
    Location,
    MissingRate,
    NeededShift,
    NoiseModel,
    Score,
    Scores,
    Table,
)
from torchcal.errors import DomainError, ShapeError
from torchcal.plots import discovery
from torchcal.plots.discovery import pieces, residuals

F64 = torch.float64
NASTY = 'a <b>bold</b> & "quoted" $\\foo$ term of a user who writes very long names indeed'


class StandIn(SimpleNamespace):
    """Has a diagnosis's attributes, and says so."""

    def __str__(self):
        return self.words


def noise(*shape, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def fit(recording, prediction, terms=(), estimates=()):
    return Fit(tuple(terms), tuple(estimates), prediction, recording.y - prediction, 150.0, 0.4)


def scored(recording, prediction, mask):
    def score(part):
        error = (recording.y - prediction)[part & recording.observed]
        rmse = float(error.square().mean().sqrt())
        return Score(rmse, -math.log(rmse) - 1.4, 0.93, len(error))

    held = None if mask is None else score(mask)
    return Scores(score(torch.ones_like(recording.observed)), held, prediction, 0.02)


def oscillator(samples=60):
    """Two runs of two outputs; quadratic drag is named, the end of run 1 was held out."""
    t = torch.linspace(0, 10, samples, dtype=F64)
    runs, base, full = [], {"x": [], "v": []}, {"x": [], "v": []}
    for i, size in enumerate((1.0, 2.5)):
        soft, hard = torch.exp(-0.12 * t), 1 / (1 + 0.1 * size * t)
        for states, decay in ((base, soft), (full, hard)):
            states["x"].append(size * decay * torch.cos(2 * t))
            states["v"].append(-2 * size * decay * torch.sin(2 * t))
        outputs = {key: full[key][i] + 0.05 * noise(samples, seed=10 * i + j) for j, key in enumerate("xv")}
        outputs["x"][5:8] = math.nan
        runs.append(Run(t, outputs=outputs, inputs={"f": torch.sin(t)}, initial={"x": size}))
    units = {"x": "m", "v": "m/s", "time": "s"}
    recording = Recording(runs=runs, noise=0.05, missing=True, units=units)
    before, after = (torch.cat([*states["x"], *states["v"]]) for states in (base, full))
    late = (recording.x["run"] == 1) & (recording.x["time"] > 6.5)
    mask = torch.cat([late, late]) & recording.observed
    drag = Estimate("quadratic drag.c", 0.101, 0.004, "1/m")
    table = [
        Hypothesis(("quadratic drag",), 312.4, 0.93, (drag,), True, 0.97, 0.41, 0.052, 17.3, True),
        Hypothesis(("cubic drag",), 309.6, 0.056, (Estimate("cubic drag.c", 0.03, 0.002, "s/m^2"),), True, 0.94,
                   0.02, 0.08, 16.8, True),
        Hypothesis(("quadratic drag", "cubic stiffness"), 308.1, 0.012, (), True, 0.97, 0.4, 0.052, None, True),
        Hypothesis(("bias force",), 20.2, 1e-90, (), False, 0.1, 1e-9, 0.3, 2.2, False, None, ("x offset",), "sign"),
        Hypothesis((), 0.0, 1e-130, (), True, 0.0, 1e-20, 0.31),
        Hypothesis(("none of these",), 295.0, 0.002),
        Hypothesis(("Coulomb friction",), -2500.0, 0.0, (), False),
    ]  # fmt: skip
    speed = torch.linspace(-4, 4, 50, dtype=F64)
    spans = torch.linspace(0.3, 9.7, 14, dtype=F64)
    return StandIn(
        words="Something is missing (p = 2e-31): quadratic drag.\nIts coefficient is 0.101 ± 0.004 1/m.",
        verdict="named", terms=["quadratic drag"], tied=[], p_detect=2e-31, confidence=0.93, remaining=0.03,
        recording=recording, held_out=mask, base=fit(recording, before, (), (Estimate("k", 4.02, 0.01, "1/s^2"),
                                                                            Estimate("c", 0.24, 0.01, "1/s", True))),
        final=fit(recording, after, ("quadratic drag",), (Estimate("k", 4.0, 0.01, "1/s^2"), drag)),
        where=Table([Location("equation", "v", "v", ((-4.5, -2.6), (2.4, 5.0)), 0.81, 200.0),
                     Location("equation", "v", "t", ((0.0, 3.0),), 0.5, 90.0)],
                    ("kind", "target", "driver", "spans", "share", "evidence")),
        ranking=Table(table, ("terms", "log_evidence")),
        detection_limit=Table([
            Limit("quadratic drag", "c", 0.006, "1/m", 0.9, 0.101), Limit("cubic drag", "c", 0.004, "s/m^2", 0.9, 0.03),
            Limit("cubic stiffness", "k3", 0.02, "1/(m^2 s^2)", 0.9, -0.006),
            Limit("bias force", "b", 0.01, "m/s^2", 0.9),
            Limit("linear drag", "c", math.inf, "1/s", 0.9, None, "already in the base model"),
            Limit("Stribeck friction", "a", 0.5, "m/s^2", 0.9), Limit("Stribeck friction", "b", 0.25, None, 0.9),
        ], ("term", "smallest")),
        before=scored(recording, before, mask), after=scored(recording, after, mask),
        improved=None, symptoms=["c ran to its bound of 0.24 1/s"],
        noise=NoiseModel({"x": 0.05, "v": 0.05}, {"x": 0.0, "v": 0.02}, "given", 1),
        shifts=[NeededShift("c", "1/s", "t", spans, 0.3 / (1 + 0.3 * spans) - 0.15 + 0.02 * noise(14, seed=4),
                            0.02 + 0.4 * (spans > 9), -0.93)],
        missing=MissingRate("equation", "v", "v", speed, -0.1 * speed * speed.abs(), 0.05 + 0.02 * speed.abs(), "m/s^2",
                            t, torch.zeros_like(t)),
        experiment=None, equations=["dx/dt = v", "dv/dt = -k x - c v + f - c |v| v"],
        identifiability=["all base parameters are told by these data"],
        simulator=SimpleNamespace(states={"x": "m", "v": "m/s"}), library=["quadratic drag", "cubic drag"],
        settings={"seed": 0, "versions": {"torch": "2.x"}}, seconds=12.3,
    )  # fmt: skip


def ignition():
    """Static, two conditions, without noise: two hypotheses are tied, the held-out data lie scattered."""
    grid = torch.meshgrid(
        torch.linspace(1000, 1300, 11, dtype=F64), torch.linspace(0.6, 1.8, 7, dtype=F64), indexing="ij"
    )
    x = {"T0": grid[0].flatten(), "phi": grid[1].flatten()}
    truth = -18 + 19000 / x["T0"] + 1.3 * x["phi"].log()
    base = -18 + 19000 / x["T0"] + 0.1
    recording = Recording(x=x, y={"ln tau": truth}, noise="none", units={"T0": "K"})
    mask = torch.zeros(77, dtype=torch.bool)
    mask[::6] = True
    names = [("fuel order",), ("composition-dependent rate",)]
    return StandIn(
        words="Two candidates explain it equally well.", verdict="ambiguous", terms=[], tied=[list(n) for n in names],
        p_detect=0.0, confidence=0.5, remaining=0.02, recording=recording, held_out=mask,
        base=fit(recording, base), final=fit(recording, base + 1.29 * x["phi"].log() - 0.1, names[0]),
        where=Table([Location("parameter", "lnA", "phi", ((0.6, 0.9), (1.4, 1.8)), 0.99, 80.0)], ("kind",)),
        ranking=Table([Hypothesis(names[0], 80.0, 0.5), Hypothesis(names[1], 79.9, 0.49), Hypothesis((), 0.0, 0.0),
                       Hypothesis(("O2 order",), 40.0, 1e-18, (), False), Hypothesis(("none of these",), 60.0, 0.01)],
                      ("terms",)),
        detection_limit=Table([Limit("fuel order", "fuel_order", 0.01, None, 0.9, -1.3)], ("term",)),
        before=scored(recording, base, mask), after=scored(recording, truth + 0.01, mask),
        symptoms=[], noise=NoiseModel({}, {}, "none"),
        shifts=[NeededShift("lnA", None, "phi", x["phi"][:7], -1.3 * x["phi"][:7].log(), torch.full((7,), 0.1), -0.99)],
        missing=None, identifiability=[], equations=[], simulator=SimpleNamespace(), settings={}, library=[],
        experiment=Experiment("one more delay at phi = 3", 5.2, {"T0": torch.tensor([1100.0]), "phi": 3.0}),
        seconds=3.0,
    )  # fmt: skip


def cooling():
    """Static, one condition, consistent; nothing was held out."""
    x = torch.linspace(0, 120, 30, dtype=F64)
    base = 25 + 60 * torch.exp(-x / 40)
    recording = Recording(x=x, y=base + 0.3 * noise(30), units={"x": "min", "y": "°C"})
    return StandIn(
        words="The model agrees with the data.", verdict="consistent", terms=[], tied=[], p_detect=0.4, confidence=0.9,
        remaining=0.0, recording=recording, held_out=None, base=fit(recording, base), final=fit(recording, base),
        where=[], ranking=Table([Hypothesis((), 0.0, 0.9), Hypothesis(("radiation",), -1.5, 0.1)]),
        detection_limit=Table([]), before=scored(recording, base, None), after=scored(recording, base, None),
        symptoms=[], noise=NoiseModel({"y": 0.3}, {"y": 0.0}, "estimated"), shifts=[], missing=None, experiment=None,
        equations=[], identifiability=[], simulator=SimpleNamespace(), settings={}, library=["radiation"], seconds=1.0,
    )  # fmt: skip


def unexplained():
    """Long, dense, one run, names with markup; the driver is a hidden state."""
    t = torch.linspace(0, 50, 3000, dtype=F64)
    wiggle = 0.4 * torch.exp(-(((t - 30) / 3) ** 2))
    base = torch.sin(t / 3)
    recording = Recording(
        runs=[Run(t, outputs={NASTY: base + wiggle + 0.1 * noise(3000)})], units={NASTY: "US$/h", "time": "h"}
    )
    grid = torch.linspace(0, 50, 80, dtype=F64)
    late = t > 40
    return StandIn(
        words=f"Something is missing that is not among the candidates: {NASTY}.", verdict="unexplained", terms=[],
        tied=[], p_detect=0.0, confidence=0.97, remaining=0.9, recording=recording, held_out=late,
        base=fit(recording, base), final=fit(recording, base),
        where=[Location("output", NASTY, "t", ((25.0, 35.0), (-math.inf, 2.0)), 0.9, 600.0),
               Location("equation", "h", "hidden", ((0.0, 1.0),), 0.3, 20.0)],
        ranking=[Hypothesis((NASTY,), -math.inf, 0.0, (), False), Hypothesis((), 0.0, 0.0),
                 Hypothesis(("none of these",), 600.0, 1.0),
                 Hypothesis(("lag", "drift", "saturation", "second heat capacity"), 3.0, 0.0)],
        detection_limit=[Limit(NASTY, "a", 0.3, "$/h", 0.9, 0.001), Limit("lag", "tau", math.inf, "h", 0.9, math.nan)],
        before=scored(recording, base, late), after=scored(recording, base, late),
        symptoms=[f"{NASTY} wanders"], noise=NoiseModel({NASTY: 0.1}, {NASTY: 0.3}, "estimated", 3, {NASTY: 0.01}),
        shifts=[], missing=MissingRate("output", NASTY, "t", grid, 0.4 * torch.exp(-(((grid - 30) / 3) ** 2)),
                                       torch.full((80,), 0.05), "US$/h", grid, grid),
        experiment=None, equations=[], identifiability=[f"{NASTY} & drift cannot be told apart"],
        simulator=SimpleNamespace(), settings={"seed": 3}, library=[NASTY], seconds=100.0,
    )  # fmt: skip


STAND_INS = (oscillator, ignition, cooling, unexplained)


def curve(ax, name):
    (found,) = [line for line in ax.lines if line.get_label() == name]
    return found


def labels(ax):
    return ax.get_legend_handles_labels()[1]


def overlaps(first, second):
    return first.x0 < second.x1 and second.x0 < first.x1 and first.y0 < second.y1 and second.y0 < first.y1


# --- both fits -------------------------------------------------------------------------------------------


def test_each_run_and_output_has_its_panel_with_both_fits():
    d = oscillator()
    axes = plots.both_fits(d.recording, d.base, d.final, held_out=d.held_out)
    assert [(ax.get_title(loc="left"), ax.get_ylabel()) for ax in axes] == [
        ("run 0", "x [m]"), ("run 1", "x [m]"), ("run 0", "v [m/s]"), ("run 1", "v [m/s]")
    ]  # fmt: skip
    assert {ax.get_xlabel() for ax in axes} == {"time [s]"}
    for i, start in enumerate((0, 60, 120, 180)):
        for name, model in (("base model", d.base), ("with quadratic drag", d.final)):
            np.testing.assert_array_equal(curve(axes[i], name).get_ydata(), model.prediction[start : start + 60])
        data = curve(axes[i], "data") if "data" in [line.get_label() for line in axes[i].lines] else axes[i].lines[0]
        seen = d.recording.observed[start : start + 60]
        np.testing.assert_array_equal(data.get_ydata(), d.recording.y[start : start + 60][seen])
    assert ["held out" in labels(ax) for ax in axes] == [False, True, False, True]
    (span,) = [patch for patch in axes[1].patches if patch.get_label() == "held out"]
    t = d.recording.runs[1].time
    assert span.get_x() == pytest.approx(float(t[t <= 6.5].max() + t[t > 6.5].min()) / 2)


def test_one_run_or_output_can_be_chosen():
    d = oscillator()
    ax = plots.both_fits(d.recording, d.base, d.final, run=1, output="v")
    assert ax.get_title(loc="left") == "run 1"
    np.testing.assert_array_equal(curve(ax, "base model").get_ydata(), d.base.prediction[180:])
    alone = plots.both_fits(d.recording, d.base, output="x", run=0, names=("mine", ""))
    assert "mine" in labels(alone)
    assert "accepted model" not in labels(alone)


def test_a_run_without_the_output_gets_no_panel():
    t = torch.linspace(0, 1, 9, dtype=F64)
    recording = Recording(runs=[Run(t, outputs={"a": t, "b": t}), Run(t, outputs={"a": t})])
    axes = plots.both_fits(recording, torch.zeros(36, dtype=F64))
    assert [(ax.get_ylabel(), ax.get_title(loc="left")) for ax in axes] == [
        ("a", "run 0"), ("a", "run 1"), ("b", "run 0")
    ]  # fmt: skip


def test_several_conditions_are_drawn_along_the_one_that_matters():
    d = ignition()
    axes = plots.both_fits(d.recording, d.base, d.final, held_out=d.held_out, along="phi", most=4)
    assert [ax.get_title(loc="left") for ax in axes] == [f"T0 = {T} K" for T in (1000, 1090, 1210, 1300)]
    np.testing.assert_allclose(curve(axes[1], "with fuel order").get_ydata(), d.final.prediction[21:28])
    assert d.held_out[0]
    np.testing.assert_allclose(curve(axes[0], "held out").get_xdata(), [0.6, 1.8])  # scattered: ringed, not shaded
    assert not axes[0].patches


def test_several_conditions_without_a_choice_are_fitted_against_measured():
    d = ignition()
    ax = plots.both_fits(d.recording, d.base, d.final)
    np.testing.assert_array_equal(curve(ax, "base model").get_xdata(), d.recording.y)
    np.testing.assert_array_equal(curve(ax, "base model").get_ydata(), d.base.prediction)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("measured ln tau", "fitted ln tau")


def test_worst_outputs_are_kept_where_there_are_too_many():
    t = torch.linspace(0, 1, 10, dtype=F64)
    recording = Recording(x=t, y={f"y{i}": t for i in range(8)})
    wrong = torch.cat([t + 0.1 * i for i in range(8)])
    axes = plots.both_fits(recording, wrong, most=3)
    assert [ax.get_ylabel() for ax in axes] == ["y5", "y6", "y7"]


def test_long_recordings_are_thinned_but_keep_both_ends():
    d = unexplained()
    ax = plots.both_fits(d.recording, d.base)
    drawn = curve(ax, "data").get_xdata()
    assert len(drawn) == discovery.MOST_POINTS
    assert (drawn[0], drawn[-1]) == (0.0, 50.0)
    assert len(curve(ax, "base model").get_xdata()) == 3000


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"output": "z"}, DomainError, "Expected output among"),
        ({"along": "z"}, DomainError, "Expected along"),
        ({"run": 7}, DomainError, r"Expected run among \[0, 1\]"),
        ({"most": 0}, DomainError, "Expected most"),
        ({"held_out": torch.zeros(3, dtype=torch.bool)}, ShapeError, "Expected a mask"),
        ({"held_out": torch.zeros(240)}, ShapeError, "Expected a mask"),
        ({"ax": []}, ShapeError, "at least one axes"),
        ({"ax": 3}, DomainError, "Expected ax"),
    ],
)
def test_both_fits_says_what_is_wrong(options, error, match):
    d = oscillator()
    with pytest.raises(error, match=match):
        plots.both_fits(d.recording, d.base, **options)


def test_fits_of_another_length_are_refused():
    with pytest.raises(ShapeError, match=r"Expected before of shape \(240,\)"):
        plots.both_fits(oscillator().recording, torch.zeros(239))
    with pytest.raises(ShapeError, match="Expected after"):
        plots.both_fits(oscillator().recording, torch.zeros(240), "text")


# --- where -----------------------------------------------------------------------------------------------


def test_residuals_are_data_minus_model_against_the_driver():
    d = cooling()
    ax = plots.residual_map(d.recording, d.base, d.base.prediction + 1, noise=d.noise, spans=[(40, 60)], share=0.5)
    points = curve(ax, "base model")
    np.testing.assert_array_equal(points.get_xdata(), d.recording.x)
    np.testing.assert_allclose(points.get_ydata(), d.recording.y - d.base.prediction)
    np.testing.assert_allclose(curve(ax, "accepted model").get_ydata(), d.recording.y - d.base.prediction - 1)
    shapes = {patch.get_label(): patch.get_extents().transformed(ax.transData.inverted()) for patch in ax.patches}
    located = shapes["needed change largest here (50 % of the misfit)"]
    assert (located.x0, located.x1) == (40, 60)
    assert shapes["±2 noise sd"].y1 == pytest.approx(0.6)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [min]", "data − model, y [°C]")


def test_data_set_aside_are_crosses_that_no_mean_counts():
    x = torch.linspace(0, 1, 100, dtype=torch.float64)
    y = torch.zeros_like(x)
    y[50] = 9.0
    recording = Recording(x=x, y=y)
    aside = torch.zeros(100, dtype=torch.bool)
    aside[50] = True
    ax = plots.residual_map(recording, torch.zeros_like(y), set_aside=aside)
    crosses = curve(ax, "set aside as outliers")
    assert (crosses.get_xdata().tolist(), crosses.get_ydata().tolist()) == ([float(x[50])], [9.0])
    assert np.abs(curve(ax, "base model, local mean").get_ydata()).max() == 0.0
    with pytest.raises(ShapeError, match="mask"):
        plots.residual_map(recording, torch.zeros_like(y), set_aside=aside[:3])
    two = Recording(x=x, y={"a": torch.sin(9 * x), "b": y})
    mask = torch.cat([torch.zeros_like(aside), aside])
    fitted = torch.zeros(200, dtype=torch.float64)
    assert "a" in plots.residual_map(two, fitted, set_aside=mask).get_ylabel()  # b is fitted exactly but for that
    every = torch.cat([torch.zeros_like(aside), torch.ones_like(aside)])
    assert plots.residual_map(two, fitted, set_aside=every, output="b", noise=0.1) is not None


def test_a_detailed_simulation_has_no_noise_band():
    d = cooling()
    told = plots.residual_map(d.recording, d.base, noise=NoiseModel({"y": 0.1}, {"y": 0.0}, "estimated"))
    assert "±2 noise sd" in labels(told)
    none = plots.residual_map(d.recording, d.base, noise=NoiseModel({"y": 0.1}, {"y": 0.0}, "none"))
    assert "±2 noise sd" not in labels(none)


def test_the_noise_band_is_as_wide_as_the_noise_of_each_datum():
    x = torch.logspace(-1, 2.5, 30, dtype=F64)
    sd = 0.02 * x**0.19
    recording = Recording(x={"g": x}, y={"tau": x**0.6}, noise=sd)
    model = NoiseModel({"tau": float(sd.median())}, {"tau": 0.0}, "given")
    for options in ({"noise": model}, {}, {"noise": NoiseModel({"tau": sd}, {"tau": 0.0}, "estimated")}):
        ax = plots.residual_map(recording, 1.1 * recording.y, **options)
        (band,) = [item for item in ax.collections if item.get_label() == "±2 noise sd"]
        edge = {round(float(a), 9): float(b) for a, b in band.get_paths()[0].vertices if b > 0}
        assert edge == pytest.approx({round(float(a), 9): 2 * float(b) for a, b in zip(x, sd, strict=True)})
    twice = Recording(x=torch.tensor([1.0, 1.0, 2.0]), y=[0.0, 0.1, 0.2], noise=[0.3, 0.4, 0.1])
    ax = plots.residual_map(twice, torch.zeros(3))  # of data at one place the root mean square
    assert ax.collections[0].get_datalim(ax.transData).y1 == pytest.approx(2 * math.sqrt((0.09 + 0.16) / 2))


@pytest.mark.parametrize("samples", [30, 60])
def test_residuals_are_in_units_of_a_noise_that_grows_over_decades(samples):
    x = torch.logspace(-1, 2.5, samples, dtype=F64)
    sd = 0.02 * x**0.6
    recording = Recording(x={"g": x}, y={"tau": x**0.6}, noise=sd, units={"tau": "m"})
    aside = torch.zeros(samples, dtype=torch.bool)
    aside[3] = True
    ax = plots.residual_map(recording, recording.y - 3 * sd, set_aside=aside)
    assert ax.get_ylabel() == "(data − model) / noise sd, tau"
    many = samples > 40
    np.testing.assert_allclose(curve(ax, "base model" + ", local mean" * many).get_ydata(), 3.0)
    np.testing.assert_allclose(curve(ax, "set aside as outliers").get_ydata(), [3.0])
    (band,) = [item for item in ax.patches if item.get_label() == "±2 noise sd"]
    assert (band.get_y(), band.get_height()) == (-2, 4)
    even = plots.residual_map(recording, recording.y - 3 * sd, noise=0.1 * torch.ones(samples, dtype=F64))
    assert even.get_ylabel() == "data − model, tau [m]"
    recording = Recording(x={"g": x}, y={"tau": x**0.6}, noise=0.02 * x**0.19, units={"tau": "m"})
    assert plots.residual_map(recording, recording.y).get_ylabel() == "data − model, tau [m]"


def test_a_driver_over_decades_has_a_logarithmic_axis():
    even = torch.linspace(0.1, 316, 40, dtype=F64)
    for x, scale in (
        (torch.logspace(-1, 2.5, 40, dtype=F64), "log"),
        (torch.logspace(0, 1.4, 40, dtype=F64), "linear"),  # no decades
        (torch.cat([torch.zeros(1, dtype=F64), torch.logspace(-1, 2.5, 39, dtype=F64)]), "linear"),
        (even, "linear"),  # decades, but spread evenly as it is
    ):
        recording = Recording(x={"g": x}, y={"tau": x + 1}, noise=0.1)
        shift = NeededShift("K", None, "g", x, x, torch.ones(40), 0.1)
        missing = MissingRate("output", "tau", "g", x, x, torch.ones(40), "Pa", x, x)
        late = x > x.quantile(0.75)
        axes = [
            plots.both_fits(recording, x),
            plots.residual_map(recording, x, spans=[(float(x[20]), float(x[30]))]),
            plots.held_out(recording, x, None, late),
            plots.needed_shift(shift),
            plots.missing_rate(missing),
        ]
        assert {ax.get_xscale() for ax in axes} == {scale}
        for ax in axes:
            ax.figure.canvas.draw()
    assert discovery.pieces.DECADES == local.DECADES


def test_a_dense_map_draws_local_means():
    d = ignition()
    ax = plots.residual_map(d.recording, d.base, driver="phi")
    line = curve(ax, "base model, local mean")
    phi = d.recording.x["phi"].unique()
    np.testing.assert_allclose(line.get_xdata(), phi)
    np.testing.assert_allclose(line.get_ydata(), 1.3 * phi.log() - 0.1, atol=1e-9)


def grey(color):
    return float(np.dot([0.2126, 0.7152, 0.0722], matplotlib.colors.to_rgb(color)))


@pytest.mark.parametrize("size", [50, 3000])
def test_points_of_a_dense_map_stand_out_from_what_is_shaded(size):
    x = torch.linspace(0, 1, size, dtype=F64)
    recording = Recording(x=x, y=noise(size), noise=1.0)
    ax = plots.residual_map(recording, torch.zeros(size), torch.zeros(size), spans=[(0.2, 0.8)])
    points = [line for line in ax.lines if line.get_label() == "_points"]
    assert len(points) == 2
    for line in points:
        contrast = grey(discovery.pieces.NOISE) - grey(line.get_markerfacecolor())
        assert line.get_alpha() * contrast > (0.25 if size == 50 else 0.08)
        assert line.get_markersize() >= 3
    means = [curve(ax, f"{name}, local mean") for name in ("base model", "accepted model")]
    assert [bool(line.get_path_effects()) for line in means] == [size > 50] * 2  # a white rim among many, hiding few


def test_residuals_of_each_level_of_another_condition_are_told_apart():
    a = torch.linspace(-12, 12, 32, dtype=F64).repeat(3)
    load = torch.tensor([2.0, 4.0, 6.0], dtype=F64).repeat_interleave(32)
    recording = Recording(x={"a": a, "load": load}, y=load - 4.0, noise=0.1, units={"load": "kN"})
    ax = plots.residual_map(recording, torch.zeros(96), torch.ones(96), driver="a")
    shades = []
    for level, height in ((2, -2.0), (4, 0.0), (6, 2.0)):
        line = curve(ax, f"base model, load = {level} kN")
        assert (set(line.get_ydata()), len(line.get_xdata())) == ({height}, 32)
        shades.append(grey(line.get_markerfacecolor()))
    assert shades == sorted(set(shades))
    np.testing.assert_allclose(curve(ax, "base model, local mean").get_ydata()[1:-1], 0.0, atol=1.0)
    assert len(curve(ax, "_points").get_xdata()) == 96  # of the accepted model, which should leave no levels
    four = Recording(x={"a": a, "load": torch.arange(96) % 4}, y=a)
    assert sum("load" in name for name in labels(plots.residual_map(four, torch.zeros(96), driver="a"))) == 4
    five = Recording(x={"a": a, "load": torch.arange(96) % 5}, y=a)
    named = [name for name in labels(plots.residual_map(five, torch.zeros(96), driver="a")) if "load" in name]
    assert named == ["base model, load = 0", "base model, load = 4"]
    d = oscillator()
    runs = plots.residual_map(d.recording, d.base, driver="t", values=d.recording.x["time"], output="v")
    np.testing.assert_array_equal(
        curve(runs, "base model, run 1").get_ydata(), (d.recording.y - d.base.prediction)[180:]
    )


@pytest.mark.parametrize(("periods", "drawn"), [(5, True), (25, True), (300, False)])
def test_local_means_of_an_oscillation_are_finer_than_its_period(periods, drawn):
    x = torch.linspace(0, 1, 600, dtype=F64)
    wave = torch.sin(2 * math.pi * periods * x)
    d = cooling()
    d.recording = Recording(x=x, y=wave, noise=0.5)
    d.base = d.final = fit(d.recording, torch.zeros(600, dtype=F64))
    d.where = [Location("output", "y", "x", ((0.0, 1.0),), 1.0, 20.0, period=1 / periods)]
    (part,) = [part for part in discovery.figure_parts(d) if part.key == "residuals"]
    figure = plt.figure()
    part.draw(figure)
    assert ("base model, local mean" in labels(figure.axes[0])) == drawn
    assert ("base model" in labels(figure.axes[0])) == (not drawn)  # then the points are named
    if drawn:
        mean = curve(figure.axes[0], "base model, local mean").get_ydata()
        assert (np.diff(np.sign(mean)) != 0).sum() in range(2 * periods - 2, 2 * periods + 1)
        assert np.sqrt((mean**2).mean()) == pytest.approx(math.sqrt(0.5), rel=0.1)


def test_where_no_place_is_known_the_residuals_that_go_together_are_drawn():
    """A wave along B in the second output, at each of three T; the first has the larger misfit, of noise alone."""
    field, other = torch.linspace(-4, 4, 30, dtype=F64).repeat(3), torch.arange(3.0, dtype=F64).repeat_interleave(30)
    noise = torch.randn(180, generator=torch.Generator().manual_seed(0), dtype=F64)
    y = {"Rxy": 0.5 * noise[:90], "Rxx": 0.2 * torch.sin(3 * field) + 0.1 * noise[90:]}
    d = cooling()
    d.recording = Recording(x={"T": other, "B": field}, y=y)
    d.base = d.final = fit(d.recording, torch.zeros(180, dtype=F64))
    d.where, d.set_aside = [], torch.zeros(180, dtype=torch.bool)
    (part,) = [part for part in discovery.figure_parts(d) if part.key == "residuals"]
    assert part.caption == "What the models leave of the data, against B."
    figure = plt.figure()
    part.draw(figure)
    assert "Rxx" in figure.axes[0].get_ylabel()
    assert figure.axes[0].get_xlabel().startswith("B")


def test_where_a_constant_change_begins_and_ends_is_marked():
    d = cooling()
    d.where = [Location("output", "y", "x", ((40.0, 60.0),), 1.0, 20.0, edges=(40.0, 60.0, 500.0))]
    (part,) = [part for part in discovery.figure_parts(d) if part.key == "residuals"]
    figure = plt.figure()
    part.draw(figure)
    lines = [line for line in figure.axes[0].lines if line.get_label() in ("change begins or ends", "_edge")]
    assert [list(line.get_xdata()) for line in lines] == [[40.0, 40.0], [60.0, 60.0]]  # 500 is beyond the data
    assert "change begins or ends" not in labels(plots.residual_map(d.recording, d.base))


def test_a_driver_is_found_where_it_is():
    d = oscillator()
    np.testing.assert_array_equal(plots.driver_values(d.recording, "t"), d.recording.x["time"])
    np.testing.assert_array_equal(plots.driver_values(d.recording, "f"), d.recording.x["time"].sin())
    np.testing.assert_array_equal(plots.driver_values(d.recording, "v", d.base), d.base.prediction[120:])
    assert plots.driver_values(d.recording, "hidden") is None
    with pytest.raises(DomainError, match=r"give its values="):
        plots.residual_map(d.recording, d.base, driver="hidden")
    ax = plots.residual_map(d.recording, d.base, driver="hidden", values=d.recording.x["time"] ** 2, output="v")
    assert ax.get_xlabel() == "hidden"
    with pytest.raises(ShapeError, match=r"Expected values of shape \(120,\)"):
        plots.residual_map(d.recording, d.base, driver="hidden", values=torch.zeros(5))


def test_spans_are_cut_to_the_data():
    d = cooling()
    ax = plots.residual_map(d.recording, d.base, spans=[(-math.inf, 10.0), (500, 600), (100.0, math.inf)])
    located = [p.get_extents().transformed(ax.transData.inverted()) for p in ax.patches]
    np.testing.assert_allclose([(box.x0, box.x1) for box in located], [(0, 10), (100, 120)], atol=1e-9)


def drawn(d, key):
    """The axes of one figure of a diagnosis."""
    (part,) = [part for part in discovery.figure_parts(d) if part.key == key]
    figure = plt.figure(figsize=(part.width, part.height), layout="constrained")
    part.place(figure)
    figure.canvas.draw()
    return figure.axes[0]


@pytest.mark.parametrize(
    ("place", "told"),
    [
        (Location("equation", "v", "v", ((2.0, 4.0),), 0.81, 9.0), "missing rate of dv/dt"),
        (Location("output", "x", "t", ((0.0, 3.0),), 0.81, 9.0), "missing shift of x"),
        (Location("parameter", "k", "x", ((0.0, 1.0),), 0.81, 9.0), "needed shift of k"),
        (Location("equation", "v", "v", ((2.0, 4.0),), 0.81, 9.0, terms=("lag",)), "effect of lag"),
        (Location("equation", "v", "v", ((2.0, 4.0),), 0.81, 9.0, terms=("lag of it", "leak of much oil")),
         "effect of lag of it + leak of much oil"),
    ],
)
def test_what_is_shaded_is_called_what_it_is(place, told):
    """Residuals may be largest elsewhere: later, say."""
    d = oscillator()
    d.where = [place]
    ax = drawn(d, "residuals")
    assert f"{told} largest here (81 % of the misfit)" in [name.replace("\n", " ") for name in labels(ax)]
    assert any(name.endswith("(81 % of the misfit)") for name in labels(ax))  # is not broken
    (part,) = [part for part in discovery.figure_parts(d) if part.key == "residuals"]
    assert f"Shaded: where the {told} is largest." in part.caption
    assert part.name.startswith(f"Mismatch in the {place.kind} {place.target}, along ")


def test_a_wave_is_everywhere_and_shaded_nowhere():
    d = oscillator()
    d.where = [Location("equation", "v", "t", ((0.0, 10.0),), 0.8, 9.0, period=2.0)]
    assert not any("largest" in name for name in labels(drawn(d, "residuals")))


def test_panels_of_one_diagnosis_tell_of_one_place_where_they_can():
    d = oscillator()
    d.where = [Location("parameter", "k", "hidden", ((0.0, 1.0),), 0.8, 9.0),
               Location("parameter", "c", "v", ((2.0, 4.0),), 0.7, 8.0)]  # fmt: skip
    first = d.shifts[0]
    other = NeededShift("k", "1/s^2", "t", first.values, first.shift, first.sd, 0.1)
    d.shifts = [other, first]
    assert drawn(d, "residuals").get_xlabel() == "v [m/s]"  # nothing is known of the other driver
    assert drawn(d, "shift").get_ylabel() == "needed shift of c [1/s], ±1 sd"


def test_two_estimates_of_what_is_missing_say_how_much_each_explains():
    """They may be of different places, and one wave where the other is any curve."""
    d = oscillator()
    d.shifts = [dataclasses.replace(d.shifts[0], share=0.99)]
    d.missing = dataclasses.replace(d.missing, share=0.914)
    assert drawn(d, "shift").get_title(loc="left") == "removes 99 % of the misfit"
    assert drawn(d, "missing").get_legend().get_title().get_text() == "removes 91 % of the misfit"
    d.missing = dataclasses.replace(d.missing, share=math.nan)
    assert drawn(d, "missing").get_legend().get_title().get_text() == ""


def test_an_output_that_changes_with_its_own_size_has_an_axis_with_its_unit():
    d = cooling()
    d.where = [Location("output", "y", "y itself", ((30.0, 40.0),), 0.8, 9.0)]
    d.missing = MissingRate("output", "y", "y itself", *torch.rand(3, 9), "°C", torch.arange(9.0), torch.zeros(9))
    residuals = drawn(d, "residuals")
    np.testing.assert_array_equal(curve(residuals, "base model").get_xdata(), d.base.prediction.sort().values)
    assert residuals.get_xlabel() == drawn(d, "missing").get_xlabel() == "y itself [°C]"


def test_a_span_of_one_level_is_as_wide_as_half_way_to_the_next():
    x = torch.tensor([1.0, 2.0, 4.0, 8.0, 9.0], dtype=F64).repeat_interleave(8)
    recording = Recording(x={"v": x}, y={"f": 2.0 * (x == 4.0) + 0.1 * noise(40)}, noise=0.1)
    ax = plots.residual_map(recording, torch.zeros(40), spans=[(1.0, 1.0), (4.0, 4.0), (8.5, 9.0)])
    located = [patch for patch in ax.patches if "noise" not in patch.get_label()]
    boxes = [patch.get_extents().transformed(ax.transData.inverted()) for patch in located]
    np.testing.assert_allclose([(box.x0, box.x1) for box in boxes], [(1.0, 1.5), (3.0, 6.0), (8.5, 9.0)])
    assert residuals._widened([(0.0, 5.0)], np.array([0.0, 5.0, 100.0])) == [(0.0, 5.0)]  # as it is told
    (wide,) = residuals._widened([(10.0, 10.0)], np.array([1.0, 10.0, 1000.0]))
    assert wide == pytest.approx((10**0.5, 100.0))  # where the axis is logarithmic


# --- ranking ---------------------------------------------------------------------------------------------


def bars(ax):
    return {ax.get_yticklabels()[round(bar.get_y() + bar.get_height() / 2)].get_text(): bar for bar in ax.patches}


def test_ranking_shows_evidence_and_marks_what_each_is():
    d = oscillator()
    ax = plots.ranking(d.ranking, accepted=d.terms, tied=[["cubic drag"]])
    found = bars(ax)
    assert list(dict.fromkeys(text.get_text() for text in ax.get_yticklabels())) == [
        "quadratic drag", "cubic drag", "quadratic drag + cubic stiffness", "none of these", "bias force",
        "base model alone", "Coulomb friction",
    ]  # fmt: skip
    assert found["quadratic drag"].get_width() == 312.4
    assert -2500 < found["Coulomb friction"].get_width() < 0  # cut, with its number beside it
    written = {text.get_text() for text in ax.texts}
    assert {"+312.4", "−2500", "93 %", "<0.1 %", "ln K", "prob."} <= written
    assert found["bias force"].get_hatch() == "xxxx"
    assert found["cubic drag"].get_hatch() == "////"
    assert found["quadratic drag"].get_hatch() is None
    assert ax.get_xlabel() == "log evidence against the base, ln K [1]\n(probabilities include priors)"


def test_the_base_and_none_of_these_stay_in_a_short_ranking():
    many = [Hypothesis((f"candidate {i}",), 300.0 - i, 0.02) for i in range(40)]
    rest = [Hypothesis((), 0.0, 0.0), Hypothesis(("none of these",), -5.0, 0.0)]
    ax = plots.ranking([*rest, *many], most=6, tied=[["candidate 30"]], value="probability")
    names = [text.get_text() for text in ax.get_yticklabels()]
    assert sorted(names) == sorted(
        ["base model alone", "none of these", "candidate 30", "candidate 0", "candidate 1", "candidate 2"]
    )
    assert "(36 weaker ones not shown)" in ax.get_xlabel()
    with pytest.raises(DomainError, match="at least one hypothesis"):
        plots.ranking([])
    with pytest.raises(DomainError, match="Expected value"):
        plots.ranking(many, value="evidence")


def test_the_same_terms_in_another_region_are_told_apart():
    rows = [
        Hypothesis(("leak",), 9.0, 0.9, region="h < 0.2"),
        Hypothesis(("leak",), 5.0, 0.1),
        Hypothesis(("leak", "lag"), 11.0, 0.0),
        Hypothesis((), 0.0, 0.0),
    ]
    names = [text.get_text() for text in plots.ranking(rows).get_yticklabels()]
    assert names == ["leak, h < 0.2", "leak", "leak + lag", "base model alone"]


def test_of_the_same_terms_the_likeliest_is_tied():
    rows = [
        Hypothesis(("drag",), 9.5, 0.5),
        Hypothesis(("leak",), 9.0, 0.4, region="h < 0.2"),
        Hypothesis(("leak",), 5.0, 0.1),
        Hypothesis((), 0.0, 0.0),
    ]
    found = bars(plots.ranking(rows, tied=[["drag"], ["leak"]]))
    assert [found[name].get_hatch() for name in ("drag", "leak, h < 0.2", "leak")] == ["////", "////", None]
    d = oscillator()
    d.verdict, d.terms, d.tied, d.ranking = "ambiguous", [], [["drag"], ["leak"]], rows
    text = report.page(d)
    assert "Ambiguous: drag or leak where h &lt; 0.2" in text
    assert text.count("<td>tied") == 2


def test_long_sets_of_terms_are_broken_between_terms():
    sets = [("fuel reaction order", "temperature exponent", "pressure error"), ("fuel reaction order", "lag"), ()]
    ax = plots.ranking([Hypothesis(terms, 9.0, 0.1) for terms in sets])
    first, second, base = ax.get_yticklabels()
    assert first.get_text() == "fuel reaction order +\ntemperature exponent + pressure error"
    assert second.get_text() == "fuel reaction order + lag"
    assert first.get_fontsize() == second.get_fontsize() == base.get_fontsize()


@pytest.mark.parametrize("rows", [3, pytest.param(16, marks=pytest.mark.slow)])
def test_names_and_notes_of_two_lines_leave_their_neighbours_alone(rows):
    terms = [(f"fuel reaction order {i}", "temperature exponent", "pressure error") for i in range(rows)]
    note = "its tangent tells nothing new: only large effects can"
    d = ignition()
    d.ranking = [Hypothesis(each, 9.0 - i, 0.1, (), i != 1) for i, each in enumerate(terms)]
    d.ranking[-1] = Hypothesis(("none of these",), 2.0, 0.5)
    d.tied = [terms[0]]  # all kinds, so that the legend is as high as it gets
    d.detection_limit = [Limit(each[0], "a", math.inf, None, 0.9, None, note) for each in terms]
    figure = plots.discovery_overview(d)
    alone = [plots.ranking(d.ranking, tied=d.tied), plots.detection_limits(d.detection_limit)]
    parts = {part._suptitle.get_text(): part.axes[0] for part in figure.subfigs}
    for ax in (parts["Ranking of the hypotheses"], parts["Detection limits"], *alone):
        ax.figure.canvas.draw()
        for texts in (ax.get_yticklabels(), [text for text in ax.texts if "\n" in text.get_text()]):
            boxes = sorted((text.get_window_extent() for text in texts), key=lambda box: box.y0)
            assert all(low.y1 < high.y0 for low, high in itertools.pairwise(boxes))


LONG = "heat that is lost through the wall of the "


@pytest.mark.parametrize(
    "names",
    [
        [(LONG + "left chamber",), (LONG + "right chamber",), (LONG + "left chamber", "lag")],
        [(LONG + f"{side} chamber, which nobody insulated",) for side in ("left", "right", "lower left")],
        [(LONG + "wall of the " * n + "chamber, which nobody insulated at all",) for n in range(4)],
        [("lag",), ("leak",)],
    ],
)
def test_long_names_are_told_apart_where_they_are_shortened(names):
    rows = [Hypothesis(terms, 9.0 - i, 0.1) for i, terms in enumerate(names)]
    rows += [Hypothesis(names[0], 2.0, 0.1, region=f"the temperature of the outer wall {sign} 281") for sign in "<>"]
    shown = [text.get_text() for text in plots.ranking(rows).get_yticklabels()]
    assert len(set(shown)) == len(rows)
    assert max(len(line) for text in shown for line in text.split("\n")) <= 42
    assert max(text.count("\n") for text in shown) <= 2
    limits = [Limit(terms[0], "c", 0.1, None, 0.9) for terms in dict.fromkeys(terms[:1] for terms in names)]
    shown = [text.get_text() for text in plots.detection_limits(limits).get_yticklabels()]
    assert len(set(shown)) == len(limits)


# --- shift, rate -----------------------------------------------------------------------------------------


def test_needed_shift_keeps_its_range_despite_a_blind_stretch():
    needed = oscillator().shifts[0]
    ax = plots.needed_shift(needed, units={"time": "s"})
    (points,) = ax.containers
    np.testing.assert_array_equal(points.lines[0].get_ydata(), needed.shift)
    assert ax.get_ylim()[1] < 0.2
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time [s]", "needed shift of c [1/s], ±1 sd")
    assert ax.get_title(loc="right") == "rank correlation −0.93"


def test_needed_shift_keeps_its_range_where_the_parameter_is_dead_nearly_everywhere():
    needed = oscillator().shifts[0]
    m = len(needed.values)
    sd = torch.full((m,), 1e4, dtype=torch.float64)
    sd[: m // 3] = 0.01
    shift = torch.full((m,), 3e3, dtype=torch.float64)
    shift[: m // 3] = 0.1
    shift[-1], sd[-1] = 0.5, 0.2  # less well known, but clear
    told = SimpleNamespace(**{**vars(needed), "shift": shift, "sd": sd})
    low, high = plots.needed_shift(told).get_ylim()
    assert -0.1 < low <= 0
    assert 0.7 < high < 0.8


def test_missing_rate_has_a_band_of_two_sd():
    missing = oscillator().missing
    ax = plots.missing_rate(missing, units={"v": "m/s"})
    np.testing.assert_array_equal(curve(ax, "estimate").get_ydata(), missing.rate)
    top = ax.collections[0].get_paths()[0].vertices
    assert top[:, 1].max() == pytest.approx(float((missing.rate + 2 * missing.sd).max()))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("v [m/s]", "missing rate of dv/dt [m/s^2]")
    with pytest.raises(ShapeError, match="Expected sd"):
        plots.missing_rate(SimpleNamespace(**{**vars(missing), "sd": missing.sd[1:]}))


@pytest.mark.parametrize(("sd", "drawn"), [(0.2, ["estimate"]), (0.01, ["run 0", "run 1", "run 2"])])
def test_runs_that_differ_by_less_than_an_sd_are_one_curve(sd, drawn):
    t = torch.linspace(0, 1, 20, dtype=F64)
    time, along = t.repeat(3), torch.cat([t + shift for shift in (-0.1, 0.0, 0.1)])
    order = time.argsort(stable=True)
    missing = MissingRate("equation", "v", "t", time[order], along[order], torch.full((60,), sd), "1/s", time, along)
    ax = plots.missing_rate(missing)
    lines = [line for line in ax.lines if not line.get_label().startswith("_")]
    assert [line.get_label() for line in lines] == drawn
    np.testing.assert_allclose(lines[len(lines) // 2].get_xydata(), torch.stack([t, t], -1))


def test_no_line_is_drawn_from_one_run_to_a_later_one():
    first, second = torch.linspace(0, 10, 80, dtype=F64), torch.linspace(20, 30, 80, dtype=F64)
    time = torch.cat([first, second])
    missing = MissingRate("equation", "v", "t", time, time.sin(), torch.full((160,), 0.1), "1/s", time, time.sin())
    (curve,) = [line for line in plots.missing_rate(missing).lines if line.get_label() == "estimate"]
    assert np.isnan(curve.get_xdata()).nonzero()[0].tolist() == [80]
    recording = Recording(runs=[Run(t, {"v": t.sin()}, initial={"v": 0.0}) for t in (first, second)])
    ax = plots.residual_map(recording, torch.zeros(160, dtype=F64), driver="t", values=time)
    (means,) = [line for line in ax.lines if "local mean" in line.get_label()]
    (gap,) = np.isnan(means.get_xdata()).nonzero()[0]
    assert means.get_xdata()[gap - 1] < 10 < 20 < means.get_xdata()[gap + 1]


@pytest.mark.parametrize(
    ("spans", "found"),
    [([], []), ([(0, 9)], []), ([(20, 30), (0, 10)], [15.0]), ([(0, 10), (9, 30), (1, 5), (32, 40)], [31.0])],
)
def test_a_hole_is_where_no_run_reaches(spans, found):
    assert pieces.holes(spans) == found


@pytest.mark.parametrize(
    "times",
    [
        torch.logspace(-2, 2, 120, dtype=F64),
        torch.cat([torch.linspace(0, 1, 80, dtype=F64), torch.linspace(2, 80, 79, dtype=F64)]),
    ],
)
def test_one_run_of_uneven_samples_is_one_line(times):
    missing = MissingRate("equation", "v", "t", times, times.sin(), torch.full_like(times, 0.1), "1/s", times, times)
    (curve,) = [line for line in plots.missing_rate(missing).lines if line.get_label() == "estimate"]
    assert np.isfinite(curve.get_xdata()).all()
    recording = Recording(runs=[Run(times, {"v": times.sin()}, initial={"v": 0.0})])
    ax = plots.residual_map(recording, torch.zeros_like(times), driver="t", values=times)
    (means,) = [line for line in ax.lines if "local mean" in line.get_label()]
    assert np.isfinite(means.get_xdata()).all()


@pytest.mark.parametrize(
    ("there", "cuts"),
    [([], []), ([1.5], [2]), ([0.5], []), ([3.5], []), ([1.5, 2.5], [2])],
)
def test_a_line_is_broken_where_both_sides_are_lines_still(there, cuts):
    at = np.arange(5.0)
    x, y = pieces.broken(at, there, at**2)
    assert np.isnan(y).nonzero()[0].tolist() == cuts
    np.testing.assert_array_equal(x[~np.isnan(x)], at)


def test_runs_are_whole_numbers():
    d = oscillator()
    d.where = [Location("equation", "v", "run", ((0.0, 0.0),), 0.81, 9.0)]
    d.drivers = {"run": d.recording.x["run"]}
    ax = drawn(d, "residuals")
    assert {text.get_text() for text in ax.get_xticklabels()} <= {"−1", "0", "1", "2"}
    box = next(patch for patch in ax.patches if "largest" in patch.get_label()).get_extents()
    assert box.transformed(ax.transData.inverted()).x1 == pytest.approx(0.5)


# --- proof -----------------------------------------------------------------------------------------------


def test_held_out_draws_the_predictions_of_the_scores():
    d = oscillator()
    ax = plots.held_out(d.recording, d.before, d.after, d.held_out)
    np.testing.assert_array_equal(curve(ax, "base model").get_ydata(), d.before.prediction[180:])  # farther off
    assert "held out" in labels(ax)
    d = ignition()
    ax = plots.held_out(d.recording, d.before, d.after, d.held_out)
    np.testing.assert_array_equal(curve(ax, "accepted model").get_xdata(), d.recording.y[d.held_out])
    assert ax.get_ylabel() == "predicted ln tau"
    with pytest.raises(DomainError, match="Got none"):
        plots.held_out(d.recording, d.before, d.after, torch.zeros(77, dtype=torch.bool))


def test_of_several_runs_the_one_that_differs_most_is_drawn():
    t = torch.linspace(0, 1, 40, dtype=F64)
    recording = Recording(runs=[Run(t, outputs={"a": t, "b": 9.0 * t}) for _ in range(4)])
    mask = (recording.x["time"] > 0.7).repeat(2)
    before, after = torch.zeros(320, dtype=F64), torch.zeros(320, dtype=F64)
    after[80:120], after[280:320] = 0.3, 0.4  # of b, in its spread, less
    before[40:60] = 5.0  # not held out
    ax = plots.held_out(recording, before, after, mask)
    assert ax.get_ylabel() == "a"
    assert ax.get_legend().get_title().get_text() == "run 2 (one of 4 with held-out data)"
    before = recording.y.clone()
    before[155] += 0.1
    alone = plots.held_out(recording, before, None, mask, legend=False)
    assert alone.get_title(loc="left") == "run 3 (one of 4 with held-out data)"
    after[:] = before[:] = torch.inf  # as of a model that has blown up
    after[mask] = before[mask] = torch.inf
    assert plots.held_out(recording, before, after, mask, legend=False) is not None
    mask[:40] = mask[80:160] = mask[160:200] = mask[240:] = False
    only = plots.held_out(recording, before, None, mask, legend=False)
    assert only.get_title(loc="left") == "run 1"


def test_the_axes_of_scores_have_ticks_that_do_not_overlap():
    for ratio in (6.0, 13.0, 25.0, 1e4):
        parts = [Score(0.0193 * scale, 2.0, 0.5, 9) for scale in (1.0, ratio)]
        ax = plots.held_out_scores(Scores(parts[1], None, None, None), Scores(parts[0], None, None, None))[0]
        ax.figure.canvas.draw()
        low, high = ax.get_xlim()
        shown = [text for text in ax.get_xticklabels() if low <= text.get_position()[0] <= high]
        assert len(shown) >= 2
        boxes = [text.get_window_extent() for text in shown]
        assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))


def test_scores_are_drawn_before_and_after():
    d = oscillator()
    axes = plots.held_out_scores(d.before, d.after, unit="m")
    assert [ax.get_xlabel() for ax in axes] == ["RMSE [m]", "log score [nat]", "coverage [1]"]
    for ax, field in zip(axes, ("rmse", "log_score", "coverage"), strict=True):
        for name, scores in (("before", d.before), ("after", d.after)):
            (first,) = curve(ax, name).get_xdata()
            (second,) = curve(ax, "_" + name).get_xdata()
            assert first == getattr(scores.fitted, field)
            assert second == getattr(scores.held_out, field)
    only = plots.held_out_scores(cooling().before)
    assert [text.get_text() for text in only[0].get_yticklabels()] == ["fitted"]
    with pytest.raises(ShapeError, match="three axes"):
        plots.held_out_scores(d.before, ax=axes[:2])


# --- limits ----------------------------------------------------------------------------------------------


def test_detection_limits_are_ratios():
    d = oscillator()
    ax = plots.detection_limits(d.detection_limit)
    names = [text.get_text() for text in ax.get_yticklabels()]
    assert names[:3] == ["quadratic drag", "cubic drag", "cubic stiffness"]
    assert {"Stribeck friction.a", "Stribeck friction.b"} <= set(names)
    dots = {int(line.get_ydata()[0]): line.get_xdata()[0] for line in ax.lines if len(line.get_xdata()) == 1}
    assert dots == pytest.approx({0: 0.101 / 0.006, 1: 7.5, 2: 0.3})
    assert ax.get_xscale() == "log"
    assert {"0.006 1/m", "already in the base model"} <= {text.get_text() for text in ax.texts}
    with pytest.raises(DomainError, match="at least one candidate"):
        plots.detection_limits([])


@pytest.mark.parametrize("estimate", [2.3, 30.0, 1e4])
def test_ticks_of_detection_limits_do_not_overlap(estimate):
    rows = [Limit("non-linearity of Fy", "c", 1.0, None, 0.9, estimate, "calibration hides negative effects")]
    ax = plots.detection_limits(rows, ax=plt.subplots(figsize=(5.4, 3.2), layout="constrained")[1])
    ax.figure.canvas.draw()
    low, high = ax.get_xlim()
    every = [text for text in ax.get_xticklabels(which="both") if text.get_text()]
    shown = [text for text in every if low <= text.get_position()[0] <= high]
    assert len(shown) >= 2
    assert "1" in {text.get_text() for text in shown}
    boxes = sorted((text.get_window_extent() for text in shown), key=lambda box: box.x0)
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))


def test_detection_limits_show_the_number_beside_what_there_is_to_say():
    rows = [
        Limit("yield stress", "tau0", 0.283, "Pa", 0.9, 1.5, "also: offset of tau"),
        Limit("hidden", "a", math.inf, "Pa", 0.9, None, "calibration hides effects of 310, the largest that was tried"),
        Limit("blind", "a", math.inf, None, 0.9, None, "its tangent tells nothing new: only large effects can"),
        Limit("lag", "a", math.inf, "s", 0.9),
        Limit("loss", "h", 2.83e-5, "W/(m^2 K)", 0.9, None, "also: some other loss of heat"),
        Limit("price", "c", 2.0, "$", 0.9),
    ]
    ax = plots.detection_limits(rows)
    told = dict(zip([name.get_text() for name in ax.get_yticklabels()], ax.texts, strict=False))
    assert {name: text.get_text() for name, text in told.items()} == {
        "yield stress": "0.28 Pa, also: offset of tau",
        "hidden": "calibration hides effects of 310, the largest that was\ntried",
        "blind": "its tangent tells nothing new: only large effects can",
        "lag": "∞",
        "loss": "2.8e−05 W/(m^2 K), also: some other loss of heat",
        "price": r"2 \$",
    }
    note = "also: " + "some other loss of heat, " * 5 + "end"
    ax = plots.detection_limits([Limit("lag", "a", 1.0, "s", 0.9, None, note)])
    assert ax.texts[0].get_text().endswith("end")  # one row has room for more than two lines


@pytest.mark.parametrize("width", [5.5, 6.4, 11.0])
def test_names_and_notes_of_detection_limits_stand_on_the_figure_in_whole_words(width):
    name = "adsorption that follows Freundlich instead of Henry"
    rows = [Limit(name, "m", 0.11, "mol/(m^3 s)", 0.9, 2.3, "at y0 = 0.569 mol/(m^3 s); also: offset of the rate")]
    rows.append(Limit("lag", "tau", 1.0, "s", 0.9))
    figure = plt.figure(figsize=(width, 3.2), layout="constrained")
    ax = plots.detection_limits(rows, ax=figure.subplots())
    figure.canvas.draw()
    box = ax.get_tightbbox()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1
    assert ax.bbox.width > 1.2 * figure.dpi
    shown = ax.get_yticklabels()[0].get_text()
    assert shown.replace("\n", " ") == name
    note = max((text.get_text() for text in ax.texts), key=len)
    assert all(unit in note for unit in ("0.11 mol/(m^3 s)", "y0 = 0.569 mol/(m^3 s)"))


@pytest.mark.parametrize("middle", [False, True])
def test_what_is_left_out_of_a_text_are_whole_words(middle):
    text = "heat that is lost through the wall of the left chamber, which nobody insulated"
    for most in range(20, len(text)):
        short = discovery.pieces.plain(text, most, middle=middle)
        head, tail = short.split("…")
        assert len(short) <= most
        assert text.startswith(head + " ")
        assert not tail or text.endswith(" " + tail)
    assert discovery.pieces.plain("x" * 50, 9, middle=middle) == ("xxxx…xxxx" if middle else "xxxxxxxx…")


def test_an_sd_in_an_upright_label_is_not_broken():
    needed = NeededShift("k", "1/s^2", "t", *torch.rand(3, 5), 0.1)
    assert plots.needed_shift(needed).get_ylabel().endswith("±1 sd")


# --- overview --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", STAND_INS)
def test_overview_shows_what_there_is(make, monkeypatch):
    monkeypatch.setattr(plt, "show", lambda *args, **options: pytest.fail("a figure was shown"))
    settings, state = dict(matplotlib.rcParams), torch.get_rng_state()
    figure = plots.discovery_overview(make())
    figure.canvas.draw()
    keys = {
        "oscillator": ["fits", "residuals", "ranking", "shift", "missing", "held out", "scores", "limits"],
        "ignition": ["fits", "residuals", "ranking", "shift", "held out", "scores", "limits"],
        "cooling": ["fits", "residuals", "ranking"],  # nothing accepted: no scores to compare
        "unexplained": ["fits", "residuals", "ranking", "missing", "held out", "limits"],
    }
    parts = discovery.figure_parts(make())
    assert [part.key for part in parts] == keys[make.__name__]
    assert len(figure.subfigs) == len(parts)
    assert dict(matplotlib.rcParams) == settings
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("make", STAND_INS)
def test_nothing_is_cut_off_or_hidden(make):
    figure = plots.discovery_overview(make())
    figure.canvas.draw()
    page = figure.bbox
    for part in figure.subfigs:
        title = part._suptitle.get_window_extent()
        legends = [ax.get_legend() for ax in part.axes if ax.get_legend()] + list(part.legends)
        for legend in legends:
            box = legend.get_window_extent()
            assert not overlaps(box, title)
            for ax in part.axes:
                assert not overlaps(box.padded(-1), ax.bbox), part._suptitle.get_text()
                for text in ax.texts:
                    assert not overlaps(box.padded(-1), text.get_window_extent()), text.get_text()
        for ax in part.axes:
            box = ax.get_tightbbox()
            assert box.x0 >= page.x0 - 1
            assert box.x1 <= page.x1 + 1
            assert box.y0 >= page.y0 - 1
            assert box.y1 <= page.y1 + 1
            assert min(ax.bbox.width, ax.bbox.height) > 0.9 * figure.dpi
    for i, one in enumerate(figure.axes):
        for other in figure.axes[:i]:
            assert not overlaps(one.get_tightbbox().padded(-1.5), other.get_tightbbox().padded(-1.5))


@pytest.mark.parametrize("factor", [1e-18, 1e11])
def test_the_factor_of_the_ticks_is_in_the_label_and_under_no_legend(factor):
    d = cooling()
    unit = {name: "Pa" for name in d.recording.outputs}
    small = Recording(x=d.recording.x, y={name: factor * y for name, y in d.recording.split(d.recording.y).items()},
                      noise=factor * 0.1, units={**d.recording.units, **unit})  # fmt: skip
    base = factor * d.base.prediction
    late = torch.arange(len(small.y)) > 0.8 * len(small.y)
    for draw in (plots.both_fits, plots.residual_map, lambda *args: plots.held_out(*args, None, late)):
        ax = draw(small, base)
        ax.figure.canvas.draw()
        assert ax.yaxis.get_offset_text().get_text() == ""
        power = re.search(r"\[1e(−?\d+) Pa\]$", ax.get_ylabel())
        tick = ax.get_yticklabels()[-2]
        told = float(tick.get_text().replace("−", "-")) * 10.0 ** int(power[1].replace("−", "-"))
        assert told == pytest.approx(tick.get_position()[1], rel=1e-6)


def test_the_factor_of_the_scores_is_in_their_label():
    part = Score(1.0, -7.89e11, 0.0, 4)
    axes = plots.held_out_scores(Scores(part, None, None, None))
    axes[0].figure.canvas.draw()
    assert axes[1].get_xlabel() == "log score [1e11 nat]"
    assert axes[1].xaxis.get_offset_text().get_text() == ""


def test_overview_draws_in_a_given_figure():
    figure = plt.figure(figsize=(11, 9))
    (part,) = figure.subfigures(1, 1, squeeze=False).flat
    assert plots.discovery_overview(cooling(), figure) is figure
    assert part is not plots.discovery_overview(cooling(), plt.figure())
    with pytest.raises(DomainError, match="Expected fig"):
        plots.discovery_overview(cooling(), fig=3)
    with pytest.raises(DomainError, match="Expected diagnosis"):
        plots.discovery_overview(SimpleNamespace())


def test_values_of_a_hidden_driver_come_from_the_diagnosis():
    d = oscillator()
    d.where = [Location("equation", "v", "hidden", ((0.1, 0.2),), 0.4, 9.0)]
    (part,) = [part for part in discovery.figure_parts(d) if part.key == "residuals"]
    assert part.name == "Residuals"
    d.drivers = {"hidden": torch.linspace(0, 1, 120, dtype=F64)}
    (part,) = [part for part in discovery.figure_parts(d) if part.key == "residuals"]
    assert part.name == "Mismatch in the equation v, along hidden"
    figure = plt.figure()
    part.draw(figure)
    assert figure.axes[0].get_xlabel() == "hidden"


def test_a_dollar_in_a_name_is_no_mathematics():
    ax = plots.ranking([Hypothesis((name,), 1.0, 1.0) for name in (NASTY[25:], NASTY)])
    ax.figure.canvas.draw()
    shown = [name.get_text() for name in ax.get_yticklabels()]
    assert r"\$" in shown[0]
    assert max(len(line) for text in shown for line in text.split("\n")) <= 42
    assert max(text.count("\n") for text in shown) <= 2


@pytest.mark.parametrize("pair", [(discovery.BASE, discovery.ACCEPTED), (discovery.HELD_OUT, discovery.ACCEPTED)])
def test_colours_differ_in_grey(pair):
    assert abs(grey(pair[0]) - grey(pair[1])) > 0.2


@pytest.mark.parametrize(
    ("draw", "told"),
    [
        (plots.missing_rate, "missing"),
        (plots.needed_shift, "needed"),
        (plots.held_out_scores, "before"),
        (plots.ranking, "hypotheses"),
        (plots.detection_limits, "limits"),
    ],
)
@pytest.mark.parametrize("item", [3, ["a"]])
def test_what_has_not_what_is_drawn_is_told(draw, told, item):
    with pytest.raises(DomainError, match=rf"Expected (each of )?{told}: .* of a diagnosis.*Got (int|list|str)"):
        draw(item)


def test_residuals_over_two_conditions_point_to_the_side_of_the_data():
    a, b = (one.flatten() for one in torch.meshgrid(torch.arange(3.0), torch.logspace(0, 3, 4), indexing="ij"))
    y = torch.zeros(12, dtype=torch.float64)
    y[0], y[5], y[11] = 1.0, -0.5, float("nan")
    recording = Recording(x={"a": a, "b": b}, y={"y": y}, noise=0.1, missing=True)
    aside = torch.arange(12) == 7
    ax = plots.joint_map(recording, torch.full_like(y, 0.05), ("a", "b"), set_aside=aside)
    drawn = {one.get_label(): one.get_offsets().tolist() for one in ax.collections}
    assert drawn["data above the base"] == [[0.0, 1.0]]
    assert drawn["data below the base"] == [[1.0, pytest.approx(10.0)]]
    assert len(drawn["data below the base, within 2 noise sd"]) == 8
    assert ax.lines[0].get_xydata().tolist() == [[1.0, pytest.approx(1000.0)]]
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "log")
    assert "0.95" in ax.get_title(loc="right")
    for wrong, options in ((("a", "c"), {}), (("a", "b"), {"output": "z"})):
        with pytest.raises(DomainError, match="check the spelling"):
            plots.joint_map(recording, torch.zeros_like(y), wrong, **options)
