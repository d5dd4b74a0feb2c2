"""What a calibration did wrong, or said nothing of, on problems that others brought: each case once."""

import itertools
import math
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.errors import (
    ConvergenceWarning,
    DomainError,
    EmbeddingError,
    IdentifiabilityWarning,
    ImproperPosteriorError,
    PropagationWarning,
    SimulatorError,
    TorchcalWarning,
)
from torchcal.inference import estimate, tangent
from torchcal.inference.setup import check_inputs
from torchcal.simulators.static import _copied

X = np.linspace(0, 6, 25)


def line(**a) -> tc.Simulator:
    return tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a", **a), tc.Parameter("b")])


def mode(simulator, y, x=X, **options):
    return tc.calibrate(simulator, tc.Recording(x=x, y=y), **{"num_samples": 0, "seed": 0, **options})


@pytest.mark.parametrize(
    ("function", "y"),
    [
        (lambda x, p: torch.relu(x - p["c"]), np.maximum(X - 2.0, 0) + 0.3 * np.sin(X)),
        pytest.param(
            lambda x, p: (x - p["c"]).abs(), np.abs(X - 2) + 0.2 * np.sin(3 * X), marks=pytest.mark.slow
        ),
    ],
)
def test_a_kink_takes_the_most_nodes_that_there_are(function, y):
    with pytest.warns(PropagationWarning, match="With 369 quadrature nodes .* against 283 nodes"):
        found = mode(tc.Simulator(function, [tc.Parameter("c", initial=2.0)]), y)
    assert found.propagate.num_nodes == 369
    assert 1.9 < float(found.map.mean[0]) < 2.2


@pytest.mark.slow
def test_a_pole_beside_the_data_does_not_hide_the_best_density():
    simulator = tc.Simulator(lambda x, p: 1 / (p["a"] - 1) + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    x = np.linspace(0, 5, 11)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PropagationWarning)  # a density that reaches a pole has no sd
        both = mode(simulator, 1 + 0.5 * x + 0.1 * x**2, x, num_starts=8)
        one = mode(simulator, 1 + 0.5 * x + 0.1 * x**2, x, embedding=tc.embeddings.Gaussian(parameters=("b",)))
    assert both.map.objective < one.map.objective  # of which it is a special case
    assert float(both.map.mean[0]) == pytest.approx(2.7, abs=0.3)


def test_a_range_without_answers_takes_few_nodes():
    def function(x, p):
        return torch.where(p["k"] < 0.4, p["e"] - p["k"] * x, math.nan)

    x = np.linspace(0, 5, 15)
    simulator = tc.Simulator(function, [tc.Parameter("e", low=2.0, high=5.0), tc.Parameter("k", low=0.0, high=1.0)])
    found = mode(simulator, 3.4 - 0.18 * x + 0.01 * np.sin(4 * x), x)
    assert found.propagate.num_nodes <= 16
    assert float(found.map.mean[1]) == pytest.approx(0.18, abs=0.02)


@pytest.mark.filterwarnings("ignore:Only 1 of")
def test_nodes_without_an_answer_are_told_as_such():
    simulator = tc.Simulator(lambda x, p: p["a"].sqrt() * (1 + x), [tc.Parameter("a", low=0.0, high=9.0)])
    with pytest.warns(PropagationWarning, match="no finite output at some of .* Give bounds or transform='log'"):
        mode(simulator, 0.3 * (1 + X) + 1.5 * np.sin(X))


def test_a_wrong_degree_is_told_and_does_no_harm():
    parameters = [tc.Parameter("v", low=0.5, high=5.0), tc.Parameter("k", low=0.2, high=5.0)]
    simulator = tc.Simulator(lambda x, p: p["v"] * x / (p["k"] + x), parameters)
    x = np.linspace(0.5, 8, 14)
    y = 2 * x / (1 + x) * (1 - 0.02 * x)
    right = mode(simulator, y, x)
    simulator.degree = 1
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = mode(simulator, y, x)
    (warning,) = told
    assert warning.category is PropagationWarning
    assert "polynomials of degree 1 in the parameters, as degree= says. Got others" in str(warning.message)
    assert simulator.degree == 1
    torch.testing.assert_close(found.map.sd, right.map.sd, rtol=1e-3, atol=1e-6)


def test_an_output_expansion_shorter_than_the_embeddings_is_refused():
    embedding = tc.embeddings.PolynomialChaos(parameters=("b",), order=3, germ="legendre")
    with pytest.raises(DomainError, match=r"Expected order= of at least the embedding's, 3.* Got 1"):
        mode(line(), X, embedding=embedding, order=1)


def test_a_density_without_a_mean_is_refused():
    simulator = tc.Simulator(
        lambda x, p: x / (p["k"] + x), [tc.Parameter("k", low=0.05, high=5.0, transform="log")]
    )
    with pytest.raises(EmbeddingError, match=r"order 2 at most in normal germs for k .* Got order 3"):
        mode(simulator, X / (1 + X), embedding=tc.embeddings.PolynomialChaos(order=3))
    mode(simulator, X / (1 + X) + 0.1 * X, embedding=tc.embeddings.PolynomialChaos(order=3, germ="legendre"))


def test_a_bound_that_decides_is_told():
    with pytest.warns(IdentifiabilityWarning, match=r"upper bound 0\.5: the bound decides it, and the spreads make up"):
        found = mode(line(low=0.0, high=0.5), 1 + X + 0.2 * np.sin(X))
    assert float(found.map.mean[0]) == pytest.approx(0.5, abs=1e-3)
    with pytest.warns(IdentifiabilityWarning, match=r"best estimate has a at .*: the bound decides it, and sigma"):
        tc.calibrate_additive(
            line(low=0.0, high=0.5), tc.Recording(x=X, y=1 + X + 0.2 * np.sin(X)), num_samples=0, seed=0
        )


@pytest.mark.parametrize("simulator", [line(low=0.0, high=1e6), line(low=0.98, high=5.0)])
def test_a_bound_that_is_only_near_is_not(simulator):
    y = 1 + X + 0.05 * np.sin(4 * X)
    with warnings.catch_warnings():
        warnings.simplefilter("error", IdentifiabilityWarning)
        mode(simulator, y)


def test_a_small_output_is_no_spike():
    simulator = tc.Simulator(lambda x, p: p["a"] * (x**3 + 1e-3), [tc.Parameter("a")])
    x, rng = np.linspace(0, 1, 15), np.random.default_rng(2)
    y = 2 * (x**3 + 1e-3) * (1 + 0.2 * rng.standard_normal(15))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        mode(simulator, y, x, likelihood=tc.likelihoods.GaussianMarginal())
    assert not [w for w in told if "is a spike" in str(w.message)]


def spikes_told(simulator, y, x, **options):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        tc.calibrate(simulator, tc.Recording(x=x, y=y), num_samples=0, seed=0, progress=False, **options)
    return [str(w.message) for w in told if "is a spike" in str(w.message)]


def test_a_datum_at_which_every_spread_vanishes_is_told():
    # At x = 0 the output depends on one parameter alone, which has no spread.
    x = np.linspace(-1, 1, 15)
    (said,) = spikes_told(line(), 1 + 0.7 * x + 0.4 * x**2, x, likelihood="gausmarg")
    assert "the output's sd vanishes at 1 of 15 data" in said


@pytest.mark.parametrize("prior", [tc.priors.Flat, tc.priors.Uniform])
def test_an_exact_model_is_told_to_be_a_spike_of_a_likelihood_without_tolerance(prior):
    x = np.linspace(0, 1, 9)
    (said,) = spikes_told(line(), 1 + x, x, likelihood="gausmarg", prior=prior)
    assert "the output's sd vanishes at 9 of 9 data" in said


def test_the_maximum_of_the_full_likelihood_is_told_to_be_a_spike():
    x = np.array([0.0, 1.0])
    (said,) = spikes_told(line(), 1 + x, x, likelihood="full", prior=tc.priors.Uniform)
    assert "the full likelihood grows without limit" in said


def test_data_that_depend_on_no_parameter_are_no_spike():
    simulator = tc.Simulator(lambda x, p: p["a"] * x**2, [tc.Parameter("a")])
    x, rng = np.linspace(0, 1, 15), np.random.default_rng(2)
    assert not spikes_told(simulator, 2 * x**2 * (1 + 0.2 * rng.standard_normal(15)), x, likelihood="gausmarg")


def test_a_jump_in_time_takes_the_most_nodes_that_there_are():
    t = np.linspace(0, 4, 30)
    simulator = tc.ODESimulator(
        lambda t, s, p, u: {"x": -s["x"] * torch.where(p["k"] > 1.0, 1.5, 0.5) + 0.1 * p["k"]},
        {"x": None},
        [tc.Parameter("k", initial=1.1)],
        max_step=0.2,
    )
    run = tc.Run(time=t, outputs={"x": np.exp(-t) + 0.05 * np.sin(3 * t)}, initial={"x": 1.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = tc.calibrate(simulator, tc.Recording(runs=[run]), num_samples=0, num_starts=4, seed=0)
    assert found.propagate.num_nodes <= 369


def test_a_spike_of_a_likelihood_without_noise_is_told():
    y = 1 + 0.5 * X + 0.1 * X**2
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        mode(line(), y, likelihood=tc.likelihoods.GaussianMarginal())
    spike = [str(w.message) for w in told if "is a spike" in str(w.message)]
    assert len(spike) == 1
    assert "Give the recording's noise=, or use ABC()." in spike[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tc.calibrate(
            line(),
            tc.Recording(x=X, y=y, noise=0.1),
            likelihood=tc.likelihoods.GaussianMarginal(),
            num_samples=0,
            seed=0,
        )


@pytest.mark.parametrize("additive", [False, True])
def test_parameters_that_are_known_as_a_product_alone_are_told(additive):
    x = torch.linspace(0, 5, 11, dtype=torch.float64)
    product = tc.Simulator(lambda x, p: p["a"] * p["c"] + p["b"] * x, [tc.Parameter(name) for name in "abc"])
    recording = tc.Recording(x=x, y=1 + 0.5 * x + 0.1 * x**2)
    calibrate = tc.calibrate_additive if additive else tc.calibrate
    with pytest.warns(IdentifiabilityWarning, match="The data determine a, c only together"):
        calibrate(product, recording, num_samples=0)


def test_a_line_that_is_seen_far_from_its_origin_is_determined():
    """Intercept and slope make up for each other over hundreds of their scaled units, as against Julian days."""
    origin = 2460000.5
    z = torch.linspace(-15, 15, 9, dtype=torch.float64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    y = 1 + z / 30 + (z / 30) ** 2
    with warnings.catch_warnings():
        warnings.simplefilter("error", IdentifiabilityWarning)
        near, far = (tc.calibrate(line, tc.Recording(x=z + at, y=y), num_samples=0) for at in (0.0, origin))
        draws = [tc.calibrate_additive(line, tc.Recording(x=z + at, y=y), num_samples=400) for at in (0.0, origin)]
    assert far.map.objective == pytest.approx(near.map.objective, abs=1e-5)
    torch.testing.assert_close(far.predict().map.sd, near.predict().map.sd, rtol=1e-3, atol=0)
    first, second = (fit.predict().push_forward for fit in draws)
    torch.testing.assert_close(second.mean, first.mean, rtol=0, atol=0.3 * float(first.sd.mean()))
    torch.testing.assert_close(second.sd, first.sd, rtol=0.25, atol=0)


def test_a_product_is_told_of_a_code_whose_starts_all_end_at_one_point():
    """Where starts that end alike share one end, and others are given up, no two ends show the ridge."""
    product = tc.ExternalSimulator(lambda x, p: p["a"] * p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    x = np.linspace(0, 2, 6)
    simplest = tc.embeddings.PolynomialChaos(order=0)
    with pytest.warns(IdentifiabilityWarning, match="The data determine a, b only together"):
        mode(product, 3 * x, x, embedding=simplest, likelihood="abc_mean", starts=torch.tensor([[0.5, 0.0]]))


@pytest.mark.parametrize(
    ("ends", "given_up", "told"),
    [
        ([1.0, 2.0], 0, "Only 1 of 2 starts reached the best objective 1; the next ended at 2."),
        ([1.0, 2.0, math.inf], 1, "Only 1 of 2 starts that were followed to the end reached the best objective 1; the "
         "next ended at 2, and 1 other was given up on the way, behind it."),
        ([1.0, math.inf], 0, "Only 1 of 2 starts reached the best objective 1; no other ended at a finite one."),
        ([1.0, math.inf, math.inf], 2, "Only 1 of 3 starts was followed to the end, to the objective 1; the 2 others "
         "were given up on the way, behind it."),
    ],
)  # fmt: skip
def test_how_many_starts_agree_is_told_of_those_that_were_followed(ends, given_up, told):
    problem = SimpleNamespace(propagate=SimpleNamespace(simulator=SimpleNamespace(dear=False)))
    said = estimate._lonely(problem, torch.tensor(ends), given_up)
    assert said.startswith(told)
    assert "Raise num_starts=" in said


def test_a_product_is_told_where_the_maximum_of_it_lies_at_a_bound():
    bounded = [tc.Parameter(name, low=0.1, high=10.0) for name in "ab"]
    product = tc.Simulator(lambda x, p: p["a"] * p["b"] * x, bounded)
    x = np.linspace(0, 2, 12)
    y = 3 * x**1.1 + 0.1 * torch.randn(12, generator=torch.Generator().manual_seed(0), dtype=torch.float64).numpy()
    with pytest.warns(IdentifiabilityWarning, match="The data determine a, b only together"):
        mode(product, y, x, embedding=tc.embeddings.Gaussian(("a",)))


def test_starts_that_were_given_up_are_not_held_against_the_best(monkeypatch):
    monkeypatch.setattr(tangent, "_DISTINCT", 1)
    monkeypatch.setattr(tangent, "_SAME", -1.0)  # each start counts as one that ends elsewhere on the tangents
    code = tc.ExternalSimulator(lambda x, p: p["a"] * x, [tc.Parameter("a")])
    told = (
        r"Only 1 of 4 starts was followed to the end, to the objective .*; the 3 others were given up on the way, "
        r"behind it\. The maximum may not be the global one\. Give the parameters bounds or initial= near"
    )
    with pytest.warns(ConvergenceWarning, match=told):
        mode(code, 0.5 * X + 0.1 * np.sin(X), num_starts=4)


def test_places_of_one_ridge_are_one_maximum():
    """Of a coefficient of the second order the data see no more than what it adds to the variance."""
    x = np.linspace(-1, 1, 11)
    recording = tc.Recording(x=x, y=2 * x - 5 * x**3)
    slope = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # few draws
        found = tc.calibrate(
            slope, recording, embedding=tc.embeddings.PolynomialChaos(), likelihood=tc.likelihoods.ABC(epsilon=0.3),
            num_samples=20, num_warmup=30, num_chains=2, num_starts=8, seed=0,
        )  # fmt: skip
    assert len(found.diagnostics.null_directions) == 1
    assert found.diagnostics.ties == 1
    assert len(found.diagnostics.modes) == 1


@pytest.mark.parametrize("seed", [2, 3])
def test_separate_maxima_on_long_ridges_are_two(seed):
    """Of a and b the data see the sum, of c the square: c = 1 and c = -1 are two maxima, each a ridge along a - b."""
    x = np.linspace(-1, 1, 21)
    y = 2 * x + 1 + 0.7 * x**2 + 0.05 * np.random.default_rng(seed).normal(size=21)
    model = tc.Simulator(
        lambda x, p: (p["a"] + p["b"]) * x + p["c"] ** 2 + p["d"] * x**2,
        [tc.Parameter("a", low=-20, high=20), tc.Parameter("b", low=-20, high=20), tc.Parameter("c", low=-3, high=3),
         tc.Parameter("d", low=-3, high=3)],
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = tc.calibrate(
            model, tc.Recording(x=x, y=y), embedding=tc.embeddings.Gaussian(parameters=("d",)),
            likelihood=tc.likelihoods.ABC(epsilon=0.05), num_samples=20, num_warmup=20, num_chains=4, seed=seed,
        )  # fmt: skip
    signs = {math.copysign(1.0, mode.alpha[found.alpha_names.index("c[0]")]) for mode in found.diagnostics.modes}
    assert signs == {1.0, -1.0}


def test_parameters_that_no_datum_sees_together_are_one_ridge():
    """Each half of the data depends on a parameter of its own: how the two vary together turns the second row of the
    triangle in a circle, and leaves every mean and sd as it is."""
    t = np.linspace(0, 1, 21)
    rng = np.random.default_rng(0)
    first = 2 * t + 0.3 * np.sin(6 * t) + 0.02 * rng.normal(size=21)
    second = -3 * t + 0.5 * t**2 + 0.02 * rng.normal(size=21)
    half = np.repeat([0.0, 1.0], 21)
    recording = tc.Recording(x={"t": np.tile(t, 2), "half": half}, y=np.concatenate([first, second]))
    lines = tc.Simulator(
        lambda x, p: (p["a"] * (1 - x["half"]) + p["b"] * x["half"]) * x["t"], [tc.Parameter("a"), tc.Parameter("b")]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # few draws
        found = tc.calibrate(
            lines, recording, embedding=tc.embeddings.Gaussian(), likelihood=tc.likelihoods.ABC(epsilon=0.02),
            num_samples=20, num_warmup=20, num_chains=4, seed=1,
        )  # fmt: skip
    assert len(found.diagnostics.null_directions) == 1
    objectives = [mode.objective for mode in found.diagnostics.modes]
    assert len(objectives) > 1  # the second half alone has two fits, of which one is the better
    assert min(b - a for a, b in itertools.pairwise(objectives)) > 0.1


@pytest.mark.parametrize(("draws", "chains"), [(8, 4), (20, 1)])
def test_a_few_draws_never_count_as_converged(draws, chains):
    with pytest.warns(ConvergenceWarning, match=r"threshold 100"):
        found = mode(line(), 1 + 0.5 * X + 0.05 * X**2, num_samples=draws, num_chains=chains, num_warmup=5, seed=1)
    assert not found.diagnostics.converged


def test_warnings_are_told_of_the_users_line():
    with pytest.warns(ConvergenceWarning) as told:
        mode(line(), 1 + 0.5 * X + 0.05 * X**2, num_samples=8, num_chains=2, num_warmup=5)
    assert {item.filename for item in told} == {__file__}


def test_no_spread_but_for_rounding_has_no_log_score():
    """Where the initial state is given, the first output is that, whatever the parameters are."""
    decay = tc.ODESimulator(lambda t, s, p, u: {"c": -p["k"] * s["c"]}, ["c"], [tc.Parameter("k", initial=0.5)])
    t = np.linspace(0, 2, 12)
    y = 0.8 * np.exp(-0.8 * t) + 0.02 * np.random.default_rng(1).standard_normal(12)
    found = tc.calibrate(decay, tc.Recording(runs=[tc.Run(t, {"c": y}, initial={"c": 0.8})]), num_samples=0, seed=0)
    moments = found.predict().map
    assert float(moments.sd[0]) < 1e-12
    with pytest.raises(DomainError, match="0 but for rounding"):
        tc.scores(y, moments)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"embedding": tc.embeddings.Gaussian}, r"write Gaussian\(\), with brackets"),
        ({"embedding": "gaussian"}, r"such as Gaussian\(\)\. Got 'gaussian'"),
        ({"likelihood": tc.likelihoods.ABC}, r"write ABC\(\), with brackets"),
        ({"order": 0}, r"whole number >= 1, or None\. Got order=0"),
    ],
)
def test_what_to_write_instead_is_said(wrong, message):
    with pytest.raises(DomainError, match=message):
        mode(line(), X, **wrong)


def test_numpy_in_a_simulator_is_told_what_to_use():
    with pytest.raises(tc.errors.SimulatorError, match="Use torch functions on p and x"):
        mode(tc.Simulator(lambda x, p: np.exp(p["a"]) * x, [tc.Parameter("a")]), X)


def test_plots_come_when_they_are_asked_for():
    assert tc.plots.fit is not None
    with pytest.raises(AttributeError, match="no attribute 'plot'"):
        tc.plot  # noqa: B018


def test_a_table_that_was_read_twice_is_told():
    twice = tc.Recording(x=np.tile(X, 2), y=np.tile(1 + X + 0.1 * np.sin(7 * X), 2))
    with pytest.warns(TorchcalWarning, match="25 of 50 rows are others once more"):
        check_inputs(line(), twice, None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_inputs(line(), twice.subset(~twice.copies), None)


FEW = {"num_samples": 2, "num_warmup": 2, "num_chains": 2, "seed": 0}


@pytest.mark.filterwarnings("ignore::torchcal.errors.TorchcalWarning")
@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
def test_a_ridge_without_an_end_is_not_drawn_from(calibrate):
    """A product is known on a hyperbola."""
    parameters = [tc.Parameter(name) for name in "abc"]
    recording = tc.Recording(x=X, y=1 + 0.5 * X + 0.1 * X**2)
    with pytest.raises(ImproperPosteriorError, match="does not change along a, c"):
        calibrate(tc.Simulator(lambda x, p: p["a"] * p["c"] + p["b"] * x, parameters), recording, **FEW)


@pytest.mark.filterwarnings("ignore::torchcal.errors.TorchcalWarning")
@pytest.mark.parametrize("square", [1, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("calibrate", [tc.calibrate, pytest.param(tc.calibrate_additive, marks=pytest.mark.slow)])
def test_a_ridge_that_closes_is_drawn_from(calibrate, square):
    """The sum of two squares is known on a circle."""
    circle = tc.Simulator(
        lambda x, p: p["a"] ** 2 + p["c"] ** 2 + p["b"] * x, [tc.Parameter(name) for name in "abc"]
    )
    found = calibrate(circle, tc.Recording(x=X, y=square + 0.5 * X + 0.1 * X**2), **FEW)
    assert found.samples is not None


@pytest.mark.filterwarnings("ignore::torchcal.errors.ConvergenceWarning", "ignore::torchcal.errors.PropagationWarning")
@pytest.mark.parametrize(("count", "told"), [(4, True), (5, False)])
def test_a_marginal_posterior_without_a_variance_is_told(count, told):
    """Two flat coefficients: the density falls as the radius to the power of −N, over a plane."""
    x = np.linspace(1, 2, count)
    proportional = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", IdentifiabilityWarning)
        tc.calibrate(
            proportional, tc.Recording(x=x, y=2 * x + 0.1 * np.cos(9 * x), noise=0.2), likelihood="gausmarg",
            num_samples=2, num_warmup=2, num_chains=2, seed=0,
        )  # fmt: skip
    assert any("no finite variance" in str(each.message) for each in caught) is told


@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
def test_gradients_are_taken_whatever_is_around_the_call(calibrate):
    recording = tc.Recording(x=X, y=1 + 0.5 * X + 0.1 * np.sin(3 * X))
    plain = calibrate(line(), recording, num_samples=0, seed=0, progress=False)
    with torch.no_grad():
        found = calibrate(line(), recording, num_samples=0, seed=0, progress=False)
        assert not torch.is_grad_enabled()
    assert found.map.objective == plain.map.objective
    with torch.inference_mode(), pytest.raises(DomainError, match="inference_mode"):
        calibrate(line(), recording, num_samples=0, seed=0, progress=False)


def test_another_default_device_is_refused():
    recording = tc.Recording(x=X, y=1 + 0.5 * X + 0.1 * np.sin(3 * X))
    run = {"time": X - X[0], "outputs": {"y": 1 + 0.5 * X}}
    with torch.device("meta"):
        for call in (
            lambda: tc.Recording(x=X, y=1 + X),
            lambda: tc.Run(**run),
            lambda: tc.NISP(line(), tc.embeddings.Gaussian(), x=recording.x),
            lambda: tc.calibrate(line(), recording, num_samples=0),
            lambda: tc.calibrate_additive(line(), recording, num_samples=0),
            lambda: tc.diagnose(line(), recording, []),
        ):
            with pytest.raises(DomainError, match=r"default device. Got meta .*device='cuda'"):
                call()


def test_conditions_stay_on_their_device_where_the_default_is_given():
    with torch.device("cpu"):
        assert _copied(torch.ones(3, device="meta")).device.type == "meta"


def test_a_tensor_of_another_device_is_told():
    held = torch.ones(len(X), dtype=torch.float64, device="meta")
    apart = tc.Simulator(lambda x, p: p["a"] * x + held, [tc.Parameter("a")])
    with pytest.raises(SimulatorError, match=r"must be on the device of x and p: tensor.to\(x.device\)"):
        tc.calibrate(apart, tc.Recording(x=X, y=1 + X**2), num_samples=0)


def test_the_default_dtype_changes_nothing():
    def fit():
        return mode(line(), 1 + 0.5 * X + 0.1 * np.sin(3 * X)).map.alpha

    single = fit()
    torch.set_default_dtype(torch.float64)
    try:
        double = fit()
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(single, double)


def test_seeds_that_follow_each_other_share_no_chain():
    x = torch.linspace(0, 1, 12, dtype=torch.float64)
    y = 1 + x + 0.1 * torch.randn(12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])

    def chains(seed):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # so few draws converge nowhere
            return tc.calibrate_additive(
                line, tc.Recording(x=x, y=y), sampler="pyro", num_samples=8, num_chains=2, num_warmup=20, seed=seed,
                progress=False,
            ).samples  # fmt: skip

    first, second = chains(0), chains(1)
    assert not any(torch.allclose(a, b, atol=1e-3) for a in first for b in second)
    torch.testing.assert_close(chains(0), first)
