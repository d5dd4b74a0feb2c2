"""Figures: what is drawn equals what was given, every axis has its unit, nothing else is touched."""

import math
import pickle

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb

from torchcal import plots
from torchcal.data import Recording
from torchcal.embeddings import Gaussian, PolynomialChaos
from torchcal.errors import DomainError, ShapeError, TorchcalError
from torchcal.plots import densities, style
from torchcal.plots.selection import close
from torchcal.prediction import additive_prediction, embedded_prediction
from torchcal.propagation import NISP
from torchcal.simulators import Parameter, Simulator

F64 = torch.float64
ALPHA = torch.tensor([2.7, 0.9, -0.3, 0.2, 1.1], dtype=F64)
R = 1.9872041  # cal/mol/K


def area(y, x):
    """Under a line, whatever the version of NumPy calls it."""
    return float(torch.trapezoid(torch.as_tensor(y), torch.as_tensor(x)))


def normal(*shape, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


@pytest.fixture(scope="module")
def line():
    """A straight line on a cubic, with its unit."""
    x = torch.linspace(-1, 1, 11, dtype=F64)
    simulator = Simulator(
        lambda x, p: p["a"] + p["b"] * x, [Parameter("a", unit="m"), Parameter("b", unit="m/s")], degree=1
    )
    recording = Recording(x=x, y=2 + 2 * x + 3 * x**2 - 5 * x**3, units={"x": "s", "y": "m"})
    return NISP(simulator, Gaussian(), x), recording, ALPHA + 0.2 * normal(200, 5)


@pytest.fixture(scope="module")
def ignition():
    """A ridge in (ln A, E) at 11 temperatures and 7 equivalence ratios."""
    grid = torch.meshgrid(
        torch.linspace(1000, 1300, 11, dtype=F64), torch.linspace(0.6, 1.8, 7, dtype=F64), indexing="ij"
    )
    x = {"T0": grid[0].flatten(), "phi": grid[1].flatten()}
    simulator = Simulator(
        lambda x, p: 13.7 - p["lnA"] + p["E"] / (R * x["T0"]),
        [Parameter("lnA", low=28.5, high=36.0), Parameter("E", unit="cal/mol", low=36315.5, high=56954.0)],
        degree=1,
    )
    tau = 13.7 - 32.6 + 38000 / (R * x["T0"]) + 0.35 * x["phi"].log()
    recording = Recording(x=x, y={"ln tau": tau}, noise="none", units={"T0": "K"})
    alpha = torch.tensor([0.09, 0.055, -0.83, 0.04, 0.002], dtype=F64)
    draws = alpha + normal(300, 5) * torch.tensor([1e-4, 1e-4, 1e-4, 1e-4, 2e-5], dtype=F64)
    return NISP(simulator, Gaussian(), x), recording, alpha, draws


def curve(ax, text):
    (found,) = [item for item in ax.lines if text in str(item.get_label())]
    return found


def band(ax, text):
    (found,) = [item for item in ax.collections if text in str(item.get_label())]
    vertices = found.get_paths()[0].vertices
    return vertices[:, 1].min(), vertices[:, 1].max(), vertices


def legend_texts(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


# --- fit -------------------------------------------------------------------------------------------------


def test_fit_draws_the_numbers(line):
    propagate, recording, draws = line
    prediction = embedded_prediction(propagate, ALPHA, draws)
    ax = plots.fit(prediction, recording, multiple=2.0)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [s]", "y [m]")
    mean = curve(ax, "mean")
    np.testing.assert_allclose(mean.get_xdata(), recording.x)
    np.testing.assert_allclose(mean.get_ydata(), prediction.mean)
    for text, sd in (("posterior predictive", prediction.sd), ("model error", prediction.sd_model_error)):
        low, high, _ = band(ax, text)
        assert low == pytest.approx(float((prediction.mean - 2 * sd).min()))
        assert high == pytest.approx(float((prediction.mean + 2 * sd).max()))
    data = ax.containers[0].lines[0]
    np.testing.assert_allclose(data.get_ydata(), recording.y)
    assert len(legend_texts(ax)) == 4


def test_fit_of_the_map_alone(line):
    propagate, recording, draws = line
    alone = embedded_prediction(propagate, ALPHA, None)
    ax = plots.fit(alone, recording)
    assert band(ax, "MAP")[1] == pytest.approx(float((alone.map.mean + alone.map.sd).max()))
    both = embedded_prediction(propagate, ALPHA, draws)
    ax = plots.fit(both, recording, kind="map", legend=False)
    np.testing.assert_allclose(curve(ax, "mean").get_ydata(), alone.map.mean)
    assert ax.get_legend() is None
    with pytest.raises(DomainError, match="posterior draws"):
        plots.fit(alone, recording, kind="posterior")


def test_fit_on_given_axes_and_without_data(line):
    propagate, _, draws = line
    figure, axes = plt.subplots(1, 2)
    prediction = embedded_prediction(propagate, ALPHA, draws)
    ax = plots.fit(prediction, ax=axes[1], units={"y": "m", "x": "s"}, labels={"x": "$x$"})
    assert ax is axes[1]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$x$ [s]", "y [m]")
    assert "data" not in legend_texts(ax)
    assert plt.get_fignums() == [figure.number]


def test_fit_shows_noise_and_leaves_out_missing_data(line):
    propagate, recording, draws = line
    y = recording.y.clone()
    y[3] = math.nan
    noisy = Recording(x=recording.x, y=y, missing=True, noise=0.25)
    ax = plots.fit(embedded_prediction(propagate, ALPHA, draws), noisy)
    container = ax.containers[0]
    assert len(container.lines[0].get_xdata()) == 10
    bars = container.lines[2][0].get_segments()
    np.testing.assert_allclose([bar[1, 1] - bar[0, 1] for bar in bars], 0.5)


def test_fit_along_one_of_several_conditions(ignition):
    propagate, recording, alpha, draws = ignition
    prediction = embedded_prediction(propagate, alpha, draws)
    ax = plots.fit(prediction, recording, x_name="T0", where={"phi": 1.2}, labels={"phi": "Φ"})
    keep = torch.isclose(recording.x["phi"], torch.tensor(1.2, dtype=F64))
    assert ax.get_title("left") == "Φ = 1.2"
    np.testing.assert_allclose(curve(ax, "mean").get_ydata(), prediction.mean[keep])
    np.testing.assert_allclose(ax.containers[0].lines[0].get_ydata(), recording.y[keep])
    masked = plots.fit(prediction, recording, x_name="T0", where=keep)
    np.testing.assert_allclose(curve(masked, "mean").get_ydata(), prediction.mean[keep])
    sliced = plots.fit(prediction, recording, x_name="T0", where=slice(3, None, 7))
    np.testing.assert_allclose(curve(sliced, "mean").get_ydata(), prediction.mean[3::7])
    assert plots.fit(prediction, recording, where={"phi": 1.2}).get_xlabel() == "T0 [K]"


def test_fit_sorts_the_conditions():
    x = torch.tensor([2.0, 0.0, 1.0], dtype=F64)
    simulator = Simulator(lambda x, p: p["a"] * x, [Parameter("a")], degree=1)
    prediction = embedded_prediction(NISP(simulator, Gaussian(), x), torch.tensor([3.0, 0.1], dtype=F64), None)
    mean = curve(plots.fit(prediction), "mean")
    np.testing.assert_allclose(mean.get_xdata(), [0, 1, 2])
    np.testing.assert_allclose(mean.get_ydata(), [0, 3, 6])


def test_fit_of_one_of_several_outputs():
    x = torch.linspace(0, 1, 5, dtype=F64)
    simulator = Simulator(lambda x, p: {"u": p["a"] * x, "v": p["a"] + 0 * x}, [Parameter("a")])
    recording = Recording(x=x, y={"u": x, "v": 1 + x}, units={"v": "Pa"})
    propagate = NISP(simulator, Gaussian(), x, outputs=recording.outputs)
    prediction = embedded_prediction(propagate, torch.tensor([1.5, 0.1], dtype=F64), None)
    ax = plots.fit(prediction, recording, output="v")
    np.testing.assert_allclose(curve(ax, "mean").get_ydata(), 1.5)
    np.testing.assert_allclose(ax.containers[0].lines[0].get_ydata(), 1 + x)
    assert ax.get_ylabel() == "v [Pa]"
    np.testing.assert_allclose(curve(plots.fit(prediction, output=0), "mean").get_ydata(), 1.5 * x)
    with pytest.raises(DomainError, match="output="):
        plots.fit(prediction, recording)
    for wrong in ("w", 7, True):
        with pytest.raises(DomainError, match="Expected output"):
            plots.fit(prediction, recording, output=wrong)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "mean"}, "Expected kind"),
        ({"multiple": 0.0}, "Expected multiple"),
        ({"multiple": "2"}, "Expected multiple"),
        ({"x_name": "T"}, "Expected a condition among"),
        ({"where": {"phi": 1.2, "p": 1.0}}, "Expected a condition among"),
        ({}, "Expected x_name="),
        ({"x_name": "T0"}, "Expected one value of 'phi'"),
        ({"x_name": "T0", "where": {"phi": 1.1}}, "phi=1.1"),
        ({"x_name": "T0", "where": torch.ones(5, dtype=torch.bool)}, "Expected where"),
        ({"x_name": "T0", "where": "phi"}, "Expected where"),
        ({"x_name": "T0", "where": [3]}, "at least 2"),
        ({"x_name": "T0", "where": {"phi": 1.2}, "ax": "left"}, "matplotlib axes"),
    ],
)
def test_fit_refuses(ignition, options, message):
    propagate, recording, alpha, _ = ignition
    prediction = embedded_prediction(propagate, alpha, None)
    with pytest.raises(TorchcalError, match=message):
        plots.fit(prediction, recording, **options)


def test_fit_refuses_what_does_not_fit_together(line, ignition):
    propagate, recording, draws = line
    prediction = embedded_prediction(propagate, ALPHA, draws)
    _, other, _, _ = ignition
    with pytest.raises(ShapeError, match="conditions"):
        plots.fit(prediction, other)
    two = Recording(x=recording.x, y={"u": recording.y, "v": recording.y})
    with pytest.raises(ShapeError, match="outputs"):
        plots.fit(prediction, two, output="u")
    with pytest.raises(DomainError, match="additive_fit"):
        plots.fit("prediction", recording)
    with pytest.raises(DomainError, match=r"plots\.fit"):
        plots.additive_fit(prediction, recording)


def test_additive_fit_keeps_the_two_bands_apart(line):
    propagate, recording, _ = line
    zero = NISP(propagate.simulator, PolynomialChaos(order=0), recording.x)
    draws = torch.tensor([2.0, 1.0, 0.3], dtype=F64) + 0.1 * normal(100, 3)
    prediction = additive_prediction(zero, draws[0, :2], draws, log_sigma_map=0.3)
    ax = plots.additive_fit(prediction, recording)
    inner, outer = band(ax, "push-forward"), band(ax, "posterior predictive")
    assert inner[1] == pytest.approx(float((prediction.push_forward.mean + prediction.push_forward.sd).max()))
    assert outer[1] == pytest.approx(float((prediction.posterior.mean + prediction.posterior.sd).max()))
    assert outer[1] > inner[1]
    ax = plots.sd_against_error(prediction, recording)
    np.testing.assert_allclose(curve(ax, "push-forward sd").get_ydata(), prediction.push_forward.sd)
    error = (prediction.push_forward.mean - recording.y).abs()
    np.testing.assert_allclose(curve(ax, "data").get_ydata(), error)


# --- sd against error ------------------------------------------------------------------------------------


def test_sd_against_error_draws_the_numbers(line):
    propagate, recording, draws = line
    prediction = embedded_prediction(propagate, ALPHA, draws)
    ax = plots.sd_against_error(prediction, recording)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [s]", "sd and |error| [m]")
    np.testing.assert_allclose(curve(ax, "MAP predictive").get_ydata(), prediction.map.sd)
    np.testing.assert_allclose(curve(ax, "posterior").get_ydata(), prediction.posterior.sd)
    np.testing.assert_allclose(curve(ax, "data").get_ydata(), (prediction.map.mean - recording.y).abs())
    assert plots.sd_against_error(prediction, recording, log=True).get_yscale() == "log"


def test_sd_against_error_for_each_value_of_another_condition(ignition):
    propagate, recording, alpha, draws = ignition
    prediction = embedded_prediction(propagate, alpha, draws)
    ax = plots.sd_against_error(prediction, recording, x_name="T0", by="phi")
    error = (prediction.map.mean - recording.y).abs().reshape(11, 7)
    for i, value in enumerate(("0.6", "0.8", "1", "1.2", "1.4", "1.6", "1.8")):
        (drawn,) = [item for item in ax.lines if item.get_label() == f"|error|, phi = {value}"]
        np.testing.assert_allclose(drawn.get_ydata(), error[:, i])
    assert len([item for item in ax.lines if "MAP" in item.get_label()]) == 7
    assert len(legend_texts(ax)) == 9


def test_sd_against_error_refuses_other_conditions(line):
    propagate, recording, _ = line
    elsewhere = embedded_prediction(propagate.at(recording.x * 0.5), ALPHA, None)
    with pytest.raises(ShapeError, match="recording's conditions"):
        plots.sd_against_error(elsewhere, recording)
    with pytest.raises(DomainError, match="Recording"):
        plots.sd_against_error(elsewhere, recording.y)
    with pytest.raises(DomainError, match="Prediction"):
        plots.sd_against_error(recording, recording)


# --- density of the parameters ---------------------------------------------------------------------------


def test_parameter_density_of_the_map_is_the_exact_ellipse(line):
    propagate, _, _ = line
    ax = plots.parameter_density(propagate, ALPHA, levels=(0.5, 0.9))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("a [m]", "b [m/s]")
    mean, covariance = (value.numpy() for value in propagate.parameter_moments(ALPHA))
    curves = [item for item in ax.lines if "MAP predictive" in item.get_label()]
    for item, level in zip(curves, (0.5, 0.9), strict=True):
        offset = item.get_xydata() - mean
        distance = np.einsum("ij,jk,ik->i", offset, np.linalg.inv(covariance), offset)
        np.testing.assert_allclose(distance, -2 * math.log(1 - level))


@pytest.mark.parametrize("names", [("lnA", "E"), ("E", "lnA")])
def test_parameter_density_resolves_a_narrow_ridge(ignition, names):
    """With all draws at the MAP the averaged density is the MAP's: its contours must lie on the ellipse."""
    propagate, _, alpha, _ = ignition
    ax = plots.parameter_density(propagate, alpha, alpha.expand(3, -1), names, levels=(0.5, 0.9))
    units = {"lnA": "lnA", "E": "E [cal/mol]"}
    assert (ax.get_xlabel(), ax.get_ylabel()) == tuple(units[name] for name in names)
    order = [("lnA", "E").index(name) for name in names]
    mean, covariance = (value.numpy() for value in propagate.parameter_moments(alpha))
    mean, covariance = mean[order], covariance[np.ix_(order, order)]
    assert abs(covariance[0, 1]) / math.sqrt(covariance[0, 0] * covariance[1, 1]) > 0.99
    lines = [item for item in ax.collections if type(item).__name__ == "QuadContourSet" and not item.filled]
    (contours,) = lines
    for path, level in zip(contours.get_paths(), (0.9, 0.5), strict=True):
        offset = path.vertices - mean
        distance = np.einsum("ij,jk,ik->i", offset, np.linalg.inv(covariance), offset)
        np.testing.assert_allclose(distance, -2 * math.log(1 - level), rtol=0.03)


def test_parameter_density_without_its_slope(ignition):
    propagate, _, alpha, draws = ignition
    ax = plots.parameter_density(propagate, alpha, draws, remove_slope=True)
    points = np.concatenate([item.get_xydata() for item in ax.lines if "MAP predictive" in item.get_label()])
    assert abs(np.corrcoef(points.T)[0, 1]) < 0.01
    assert ax.get_ylabel().startswith("E − ")
    assert ax.get_ylabel().endswith(" [cal/mol]")


@pytest.mark.parametrize("transform", [None, "log"])
def test_parameter_density_of_two_of_three_parameters(transform):
    x = torch.linspace(0, 1, 5, dtype=F64)
    parameters = [Parameter("k", unit="m", transform=transform, initial=1.0), Parameter("c"), Parameter("d", unit="s")]
    simulator = Simulator(lambda x, p: p["k"] * torch.exp(-p["c"] * x) + p["d"], parameters)
    propagate = NISP(simulator, Gaussian(), x)
    alpha = torch.tensor([0.1, 0.3, 0.2, 0.1, 0.1, 0.0, 0.2, 0.1, 0.3], dtype=F64)
    draws = alpha + 0.02 * normal(50, 9)
    ax = plots.parameter_density(propagate, alpha, draws, ("d", "k"), num_samples=4000)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("d [s]", "k [m]")
    assert legend_texts(ax) == ["posterior predictive", "MAP predictive"]
    with pytest.raises(DomainError, match="two of the free parameters"):
        plots.parameter_density(propagate, alpha)


def test_parameter_density_at_zero_spread(line):
    propagate, _, draws = line
    flat = torch.tensor([2.7, 0.0, -0.3, 0.0, 0.0], dtype=F64)
    for average in (None, flat.expand(5, -1), draws):
        ax = plots.parameter_density(propagate, flat, average)
        np.testing.assert_allclose(curve(ax, "_MAP mean").get_xydata(), [[2.7, -0.3]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("a", "c")}, r"\['c'\]"),
        ({"names": ("a", "a")}, "two different"),
        ({"names": "ab"}, "two different"),
        ({"levels": (0.5, 1.0)}, "probabilities"),
        ({"levels": 0.5}, "probabilities"),
        ({"grid": 3}, "grid"),
        ({"draws": ALPHA}, "draws"),
        ({"draws": ALPHA.expand(4, 5)[:, :4]}, r"\(S, 5\)"),
        ({"alpha_map": ALPHA[:3]}, "alpha_map"),
        ({"alpha_map": ALPHA * math.nan}, "finite"),
        ({"alpha_map": None}, "Got None"),
        ({"propagate": ALPHA}, r"propagation first.*Got Tensor first"),
    ],
)
def test_parameter_density_refuses(line, changes, message):
    with pytest.raises(TorchcalError, match=message):
        plots.parameter_density(**{"propagate": line[0], "alpha_map": ALPHA, **changes})


# --- density of an output --------------------------------------------------------------------------------


def test_output_density_is_a_density_and_marks_the_datum(line):
    propagate, recording, draws = line
    ax = plots.output_density(
        propagate, 3, alpha={"MAP predictive": ALPHA, "posterior predictive": draws}, recording=recording
    )
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("y [m]", "probability density [1/m]")
    assert ax.get_title("left") == "x = −0.4 s"
    mean, sd = propagate(ALPHA)
    x, density = curve(ax, "MAP").get_xydata().T
    assert area(density, x) == pytest.approx(1, abs=0.01)
    np.testing.assert_allclose(density.max(), 1 / (float(sd[3]) * math.sqrt(2 * math.pi)), rtol=0.05)
    assert area(density * x, x) == pytest.approx(float(mean[3]), abs=0.05)
    assert curve(ax, "datum").get_xdata()[0] == pytest.approx(float(recording.y[3]))


def test_output_density_of_draws():
    ax = plots.output_density(normal(500) * 0.1 + 3, datum=2.9, unit="kg/m^3")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("y [kg/m^3]", "probability density [1/(kg/m^3)]")
    assert curve(ax, "datum").get_xdata()[0] == 2.9
    ax = plots.output_density({"model": torch.full((50, 2), 1.5)}, 1)
    assert curve(ax, "no spread").get_xdata()[0] == 1.5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"index": 11}, "from 0 to 10"),
        ({"index": -1}, "from 0 to 10"),
        ({"index": 0.5}, "number of a condition"),
        ({"alpha": None}, "alpha="),
        ({"alpha": ALPHA[:2]}, "alpha of shape"),
        ({"samples": normal(10, 11)}, "only beside a propagation"),
        ({"samples": normal(10), "alpha": None}, "samples of shape"),
        ({"samples": {}, "alpha": None}, "empty"),
        ({"samples": {"a": normal(9, 11), "b": normal(9, 3)}, "alpha": None}, "one number"),
        ({"recording": 2.0}, "Recording"),
        ({"output": "z"}, "output among"),
    ],
)
def test_output_density_refuses(line, changes, message):
    propagate, recording, _ = line
    options = {"samples": propagate, "alpha": ALPHA, "recording": recording, **changes}
    with pytest.raises(TorchcalError, match=message):
        plots.output_density(**options)


# --- corner and marginals --------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 2, 5])
def test_corner_marks_the_map_and_labels_the_edge(size):
    names = [f"p{i}[xi{i + 1}]" for i in range(size)]
    point = torch.arange(size, dtype=F64)
    axes = plots.corner(point + 0.1 * normal(400, size), names, map_point=point, units={names[0]: "K"})
    assert axes.shape == (size, size)
    for j in range(size):
        shown = rf"p{j}[$\xi_{{{j + 1}}}$]" + (" [K]" if j == 0 else "")
        assert axes[-1, j].get_xlabel() == shown
        if j:
            assert axes[j, 0].get_ylabel() == shown
            assert not axes[0, j].axison
            np.testing.assert_allclose(axes[j, 0].lines[-1].get_xydata(), [[0.0, j]])
        assert axes[j, j].lines[-1].get_xdata()[0] == float(j)
        low, high = axes[-1, j].get_xlim()
        assert low < j < high
    if size > 1:
        assert [text.get_text() for text in axes[0, -1].get_legend().get_texts()] == ["posterior", "MAP"]


def test_corner_ticks_tell_close_values_apart():
    draws = torch.tensor([0.83, 45123.0, 2e-6], dtype=F64) + normal(300, 3) * torch.tensor([1e-7, 1.0, 1e-7], dtype=F64)
    axes = plots.corner(draws, ["a", "b", "c"])
    axes[0, 0].figure.canvas.draw()
    for ax in axes[-1]:
        low, high = ax.get_xlim()
        texts = [
            label.get_text()
            for label, tick in zip(ax.get_xticklabels(), ax.get_xticks(), strict=True)
            if low <= tick <= high
        ]
        assert len(texts) >= 2
        assert len(set(texts)) == len(texts)
        assert all(len(text) <= 7 for text in texts)
    assert axes[-1, 0].get_xlabel().startswith("a − 0.83 [")
    assert axes[-1, 2].get_xlabel() == "c [$10^{-6}$]"


def test_corner_with_lines_and_constants():
    draws = normal(100, 3)
    draws[:, 1] = 2 * draws[:, 0]
    draws[:, 2] = 4.0
    axes = plots.corner(draws, ["a", "b", "c"], map_point=[0.0, 0.0, 4.0])
    np.testing.assert_allclose(axes[1, 0].lines[0].get_xydata(), draws[:, :2])


def test_corner_on_given_axes():
    _, given = plt.subplots(2, 2)
    assert plots.corner(normal(50, 2), ["a", "b"], axes=given)[1, 0] is given[1, 0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ["a"]}, "2 names"),
        ({"names": "ab"}, "2 names"),
        ({"draws": normal(4, 10, 2)}, "dimension"),
        ({"draws": normal(2, 2)}, "at least 3 draws"),
        ({"draws": None}, r"Got None \(without samples, num_samples=0, a calibration has no draws\)\.$"),
        ({"draws": normal(9, 2) / 0}, "finite"),
        ({"map_point": [0.0]}, "map_point"),
        ({"axes": "all"}, "axes"),
        ({"levels": ()}, "levels"),
    ],
)
def test_corner_refuses(changes, message):
    with pytest.raises(TorchcalError, match=message):
        plots.corner(**{"draws": normal(50, 2), "names": ["a", "b"], **changes})


def test_marginals_are_densities_with_units():
    groups = [("wide", normal(2000)), ("narrow", 0.01 * normal(2000))]
    ax = plots.marginals(groups, "E", unit="cal/mol", marks=[0.0, None])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("E [cal/mol]", "probability density [1/(cal/mol)]")
    for name in ("wide", "narrow"):
        (item,) = [item for item in ax.lines if item.get_label() == name]
        assert area(item.get_ydata(), item.get_xdata()) == pytest.approx(1, abs=0.01)
    assert curve(ax, "_mark wide").get_xdata()[0] == 0
    assert plots.marginals(dict(groups), "E", log=True).get_yscale() == "log"


@pytest.mark.parametrize(
    ("groups", "options", "message"),
    [
        ([], {}, "Expected groups"),
        (normal(5), {}, "Expected groups"),
        ([("a", normal(5, 2))], {}, "dimension"),
        ([("a", normal(5))], {"marks": [1.0, 2.0]}, "one mark"),
        ([("a", torch.tensor([]))], {}, "at least one number"),
        ([("a", ["x"])], {}, "real numbers"),
    ],
)
def test_marginals_refuse(groups, options, message):
    with pytest.raises(TorchcalError, match=message):
        plots.marginals(groups, "a", **options)


# --- surface ---------------------------------------------------------------------------------------------


def test_surface_draws_data_and_labels(ignition):
    propagate, recording, alpha, _ = ignition
    mean = embedded_prediction(propagate, alpha, None).mean
    ax = plots.surface(recording.x["T0"], recording.x["phi"], mean, recording, units={"phi": "1"})
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()) == ("T0 [K]", "phi [1]", "ln tau")
    np.testing.assert_allclose(curve(ax, "data").get_data_3d()[2], recording.y)
    errors = [item.get_data_3d()[2] for item in ax.lines if item.get_label() == "_error"]
    np.testing.assert_allclose(errors, np.stack([mean, recording.y], -1))
    x1, x2 = recording.x["T0"].unique(), recording.x["phi"].unique()
    other = plots.surface(x1, x2, mean.reshape(11, 7), names=("u", "v"))
    np.testing.assert_allclose(other.collections[0].get_array() is None, True)
    assert other.get_zlabel() == "y"
    scattered = plots.surface(recording.x["T0"][:-2], recording.x["phi"][:-2], mean[:-2], recording)
    assert len(scattered.collections) == 1


@pytest.mark.parametrize(
    ("args", "options", "message"),
    [
        ((torch.ones(3), torch.ones(4), torch.ones(4, 3)), {}, r"\(3, 4\)"),
        ((torch.ones(3), torch.ones(4), torch.ones(4)), {}, "one length"),
        ((torch.ones(3), torch.arange(3.0), torch.ones(3)), {}, "at least 2 values"),
        ((torch.arange(2.0), torch.arange(2.0), torch.eye(2), (torch.ones(2), torch.ones(2))), {}, "three arrays"),
        ((torch.arange(2.0), torch.arange(2.0), torch.eye(2)), {"names": ("a",)}, "names"),
    ],
)
def test_surface_refuses(args, options, message):
    with pytest.raises(TorchcalError, match=message):
        plots.surface(*args, **options)


def test_surface_needs_fitting_axes_and_recording(line):
    grid = (torch.arange(2.0), torch.arange(2.0), torch.eye(2))
    with pytest.raises(DomainError, match="3-D"):
        plots.surface(*grid, ax=plt.subplots()[1])
    with pytest.raises(DomainError, match="two of the recording's conditions"):
        plots.surface(*grid, line[1])
    with pytest.raises(DomainError, match="plane"):
        plots.marginals([("a", normal(9))], "a", ax=plt.figure().add_subplot(projection="3d"))


# --- what all share --------------------------------------------------------------------------------------


def test_settings_and_random_state_stay_and_nothing_is_shown(line, monkeypatch, tmp_path):
    propagate, recording, draws = line
    monkeypatch.setattr(plt, "show", lambda *args, **options: pytest.fail("a figure was shown"))
    settings, state = dict(matplotlib.rcParams), torch.get_rng_state()
    prediction = embedded_prediction(propagate, ALPHA, draws)
    made = [
        plots.fit(prediction, recording),
        plots.sd_against_error(prediction, recording, log=True),
        plots.parameter_density(propagate, ALPHA, draws),
        plots.output_density(propagate, alpha=ALPHA, recording=recording),
        plots.corner(draws, propagate.alpha_names, map_point=ALPHA)[0, 0],
        plots.marginals([("a", draws[:, 0])], "a", log=True),
        plots.surface(torch.arange(3.0), torch.arange(2.0), torch.rand(3, 2, generator=torch.Generator())),
    ]
    for i, ax in enumerate(made):
        ax.figure.savefig(tmp_path / f"{i}.png")
        assert (tmp_path / f"{i}.png").stat().st_size > 2000
    assert dict(matplotlib.rcParams) == settings
    assert torch.equal(torch.get_rng_state(), state)


def test_the_legend_hides_no_curve(line):
    propagate, _, _ = line
    for ax in (
        plots.parameter_density(propagate, ALPHA),
        plots.output_density({"a": normal(500), "b": normal(500) + 2, "c": normal(500) - 2}),
    ):
        ax.figure.canvas.draw()
        box = ax.get_legend().get_window_extent()
        for item in ax.lines:
            points = item.get_transform().transform(item.get_xydata())
            inside = (points > [box.x0, box.y0]).all(-1) & (points < [box.x1, box.y1]).all(-1)
            assert not inside.any()


def test_the_factor_of_the_ticks_follows_the_limits_and_the_label():
    ax = style.new_axes(None)
    ax.plot([0, 1], [0, 2e9])
    ax.set_xlabel("t [s]")
    ax.set_ylabel("y [m]")
    style.dress(ax)
    draw = ax.figure.canvas.draw
    draw()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t [s]", "y [1e9 m]")
    ax.set_ylim(0, 2e12)
    draw()
    draw()
    assert ax.get_ylabel() == "y [1e12 m]"
    ax.set_ylabel("density of what flows out [1/Pa]")
    draw()
    assert ax.get_ylabel() == "density of what flows out\n[1e12/Pa]"
    ax.set_ylabel("y")
    style.dress(ax)
    draw()
    assert ax.get_ylabel() == "y [1e12]"
    ax.set_ylim(0, 2)
    draw()
    assert ax.get_ylabel() == "y"
    ax.set_ylim(101325, 101325.02)
    ax.set_ylabel("p [Pa], ±1 sd")
    draw()
    assert ax.get_ylabel() == "p − 101325 [Pa], ±1 sd"
    ax.set_ylabel("")
    draw()
    assert ax.get_ylabel() == ""
    assert ax.yaxis.get_offset_text().get_text().endswith("1.01325e5")  # there is no label to tell it
    ax.set_ylim(0, 1e9)
    ax.set_ylabel("y [m]")
    again = pickle.loads(pickle.dumps(ax.figure))
    again.canvas.draw()
    assert again.axes[0].get_ylabel() == "y [1e9 m]"


def test_axes_that_share_their_ticks_all_tell_the_factor():
    _, axes = plt.subplots(1, 2, sharey=True)
    for ax in axes:
        ax.plot([0, 1], [0, 1e9])
        ax.set_ylabel("y [m]")
        style.dress(ax)
    axes[0].figure.canvas.draw()
    assert [ax.get_ylabel() for ax in axes] == ["y [1e9 m]"] * 2


def test_a_surface_tells_the_factor_of_its_ticks():
    grid = torch.linspace(0, 1, 6, dtype=F64)
    ax = plots.surface(1e-9 * grid, grid, 1e12 * (grid[:, None] + grid), names=("p", "q", "w"), units={"w": "W"})
    ax.figure.canvas.draw()
    assert [ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()] == ["p [1e−9]", "q", "w [1e12 W]"]


@pytest.mark.parametrize(
    "pair",
    [
        (style.POSTERIOR, style.MAP),
        (style.POSTERIOR_BAND, style.MODEL_ERROR_BAND),
        (style.MODEL_ERROR_BAND, style.POSTERIOR),
        (style.ADDITIVE_BAND, style.PUSH_FORWARD_BAND),
        (style.PUSH_FORWARD_BAND, style.ADDITIVE),
    ],
)
def test_colours_differ_in_grey(pair):
    def lightness(color):
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(color)]
        return 116 * float(np.dot([0.2126, 0.7152, 0.0722], linear)) ** (1 / 3) - 16

    assert abs(lightness(pair[0]) - lightness(pair[1])) > 18


def test_contours_hold_their_share_of_the_draws():
    draws = (normal(20_000, 2) @ torch.tensor([[1.0, 0.0], [0.0, 0.01]], dtype=F64)).numpy()
    draws[:, 1] += 3000 * draws[:, 0]
    x, y, z = densities.pair_density(draws)
    (height,) = densities.contour_heights(z, [0.9])
    _, axes = plt.subplots()
    path = axes.contour(x, y, z, [height]).get_paths()[0]
    assert path.contains_points(draws).mean() == pytest.approx(0.9, abs=0.015)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_density_ends_where_a_coefficient_whose_sign_means_nothing_does(sign):
    draws = sign * normal(4000).abs().numpy()
    points, density = densities.curve(draws)
    assert (sign * points).min() == 0.0
    assert area(density, points) == pytest.approx(1.0, abs=2e-3)
    at_zero = density[np.abs(points).argmin()]
    assert at_zero == pytest.approx(math.sqrt(2 / math.pi), rel=0.05)  # a half-normal's; unreflected it would be half
    far, few = densities.curve(draws + 30.0 * sign), densities.curve(draws[:20])
    assert np.abs(far[0]).min() > 20
    assert (sign * few[0]).min() < 0  # so few may lie on one side by chance
    assert densities.side_of_zero(np.append(draws, -sign)) == 0
    inside = normal(4000, 1)[:, 0].numpy() + 2.5  # a normal density that has its draws on one side by chance
    assert densities.side_of_zero(sign * inside[inside > 0][:200]) == 0


def test_contours_end_where_a_coefficient_does():
    z = normal(20_000, 3)
    draws = torch.stack([z[:, 0].abs(), 2 + 0.3 * z[:, 1] + z[:, 0].abs(), -z[:, 2].abs()], -1)
    axes = plots.corner(draws, ["a", "b", "c"], levels=(0.6,))
    assert axes[-1, 0].get_xlim()[0] == 0.0
    assert axes[-1, 1].get_xlim()[0] > 0.0
    assert axes[-1, -1].get_xlim()[1] == 0.0
    for row, column in ((1, 0), (2, 0), (2, 1)):
        lines = axes[row, column].collections[-1].get_paths()[0]
        pair = draws[:, [column, row]].numpy()
        assert lines.contains_points(pair).mean() == pytest.approx(0.6, abs=0.02)
        nearest = np.abs(pair).min(0) < 1e-2  # those that end at 0
        assert (np.sign(lines.vertices) != np.sign(pair[0])).any(0)[nearest].all()  # no line along the bound


def test_a_factor_leaves_the_label_with_its_ticks():
    figure, ax = plt.subplots()
    ax.plot([0, 1, 2], [0, 1e9, 3e9])
    ax.set_ylabel("y [m]")
    style.dress(ax)
    figure.canvas.draw()
    assert ax.get_ylabel() == "y [1e9 m]"
    ax.set_ylabel(ax.get_ylabel().replace("y", "Y"))  # set anew from what is there
    figure.canvas.draw()
    assert ax.get_ylabel() == "Y [1e9 m]"
    ax.set_yscale("log")
    figure.canvas.draw()
    assert ax.get_ylabel() == "Y [m]"
    ax.set_yscale("linear")
    style.dress(ax)
    figure.canvas.draw()
    assert ax.get_ylabel() == "Y [1e9 m]"
    plt.close(figure)


def test_an_axis_without_a_label_keeps_the_corner_of_the_one_it_shares_ticks_with():
    figure, (bare, told) = plt.subplots(1, 2, sharey=True)
    told.plot([0, 1], [0, 3e7])
    told.set_ylabel("k [1 / second]")
    style.dress(told)
    figure.canvas.draw()
    assert told.get_ylabel() == "k [1e7/second]"
    assert bare.yaxis.get_major_formatter().get_offset() == "1e7"
    plt.close(figure)


def test_instants_of_a_clock_are_told_apart():
    times = np.array([1.7e9, 1.7e9 + 600, 1.7e9 + 3600])
    assert close(times, 1.7e9).tolist() == [True, False, False]
    assert close(np.array([1050.0, 1050.0]), 1050.0001).tolist() == [True, True]
    assert close(np.linspace(0, 1, 4), 0.3333333).tolist() == [False, True, False, False]
    assert close(np.logspace(-9, -2, 8), 1e-9).tolist() == [True] + [False] * 7
