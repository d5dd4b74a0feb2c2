"""`calibrate(target_ess=)`: draws until the sample is worth enough, and the maxima that chains begin at."""

import math
import warnings

import numpy as np
import pytest
import torch

import torchcal as tc
from examples import cubic
from torchcal.errors import ConvergenceWarning, DomainError
from torchcal.inference import sampling
from torchcal.inference.diagnostics import figures
from torchcal.results import AdditiveCalibration, Calibration

TARGET = 2000


def linear(**options):
    return cubic.estimate("linear", 11, **{"num_samples": None, "num_starts": 4, **options})


def additive(**options):
    return tc.calibrate_additive(cubic.simulator("linear"), cubic.recording(11), num_starts=4, seed=0, **options)


def listened(function, **options):
    """The result, and the texts of all warnings, each of them a ConvergenceWarning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = function(**options)
    assert all(issubclass(item.category, ConvergenceWarning) for item in caught), [str(w.message) for w in caught]
    return result, [str(item.message) for item in caught]


@pytest.fixture(scope="module")
def reached():
    """Few chains for the one and few warm-up draws: what its trees cost."""
    nuts = linear(target_ess=TARGET, num_chains=16, num_warmup=40)
    return {"nuts": nuts, "hmc": linear(target_ess=TARGET, num_chains=32, sampler="hmc")}


def check_reached(result, target):
    """By the samples, and by what the result says of them."""
    found = figures(result.samples)
    assert float(found.ess_bulk.min()) >= target
    assert float(found.ess_tail.min()) >= target
    assert float(found.r_hat.max()) < 1.01
    told = result.diagnostics.alpha
    assert list(told) == list(result.map.alpha_names)
    for i, quality in enumerate(told.values()):
        numbers = (found.r_hat[i], found.ess_bulk[i], found.ess_tail[i])
        assert (quality.r_hat, quality.ess_bulk, quality.ess_tail) == tuple(float(number) for number in numbers)
    assert result.diagnostics.converged


# --- it reaches what was wanted ------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", ["nuts", "hmc"])
def test_the_target_is_reached_and_not_by_far_passed(reached, kernel):
    samples = reached[kernel].samples
    check_reached(reached[kernel], TARGET)
    # The first look, at 100 draws of each, found too few.
    assert 100 < samples.shape[1] < 1500


def test_both_samplers_draw_from_the_same_posterior(reached):
    """Means to 5 Monte Carlo errors: one of 10 figures is past that by chance once in 200,000 times."""
    one, other = (reached[kernel].samples for kernel in ("nuts", "hmc"))
    for function in (lambda a: a, lambda a: (a - one.mean((0, 1))).square()):
        left, right = function(one), function(other)
        error = torch.zeros(one.shape[-1], dtype=torch.float64)
        for draws in (left, right):
            error += draws.flatten(0, 1).var(0) / figures(draws).ess_bulk.clamp_max(draws[..., 0].numel())
        difference = left.mean((0, 1)) - right.mean((0, 1))
        assert bool((difference.abs() < 5 * error.sqrt()).all()), difference / error.sqrt()


def test_a_target_changes_how_many_draws_and_not_which(reached):
    result = reached["hmc"]
    chains, draws = result.samples.shape[:2]
    plain = linear(num_samples=draws, num_chains=chains, num_warmup=60, sampler="hmc")
    assert torch.equal(plain.samples, result.samples)
    assert plain.map.objective == result.map.objective


@pytest.mark.slow
def test_nor_does_it_with_trees_of_any_length():
    """Chains are not equally far when the first 100 draws of each are looked at."""
    options = {"num_samples": 110, "num_chains": 4, "num_warmup": 40}
    result, _ = listened(additive, target_ess=1e6, **options)
    plain, _ = listened(additive, **options)
    assert result.samples.shape == (4, 110, 3)
    assert torch.equal(plain.samples, result.samples)


def test_chains_are_many_where_they_are_not_given():
    result = linear(target_ess=400.0, sampler="hmc")
    assert result.samples.shape[0] == 32  # the fewest that fill a core
    check_reached(result, 400.0)


@pytest.mark.parametrize(
    ("target", "cost", "chains"),
    [(1, 1, 32), (3840, 1, 32), (3841, 1, 33), (1e6, 1, 400), (1e6, 2**20, 4), (1, 2**22, 4), (1, 2**18, 16)],
)
def test_chains_follow_from_target_and_cost(target, cost, chains):
    plan = sampling.Plan(None, None, None, "nuts", 0, torch.float64, None, False, target)
    assert plan.chains(cost) == chains
    assert plan.samples == 20_000


def test_additive_calibration_takes_a_target_too():
    result, told = listened(additive, target_ess=1500, num_chains=16, sampler="hmc")
    assert told == []
    assert isinstance(result, AdditiveCalibration)
    check_reached(result, 1500)
    assert len(result.diagnostics.modes) == 1


# --- it says where it does not -------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", ["nuts", "hmc"])
def test_num_samples_caps_the_draws_and_a_warning_has_the_numbers(kernel):
    result, told = listened(linear, target_ess=50_000, num_samples=40, num_chains=4, num_warmup=20, sampler=kernel)
    assert result.samples.shape == (4, 40, 5)
    found = figures(result.samples)
    (wanted,) = (text for text in told if text.startswith("Wanted"))
    assert wanted == (
        f"Wanted an effective sample size of 50000 and R-hat below 1.01. Got {found.least_ess:.0f} and "
        f"{found.worst_r_hat:.3f} after 40 draws of each of 4 chains."
    )


def test_fewer_draws_than_any_figure_needs():
    result, told = listened(additive, target_ess=50, num_samples=3, num_chains=4, sampler="hmc")
    assert result.samples.shape == (4, 3, 3)
    assert any("effective sample size" in text for text in told)


def test_no_warning_without_a_target():
    result, told = listened(linear, num_samples=120, num_chains=4, sampler="hmc")
    assert result.samples.shape == (4, 120, 5)
    assert not any(text.startswith("Wanted") for text in told)


# --- what is refused -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(
            pytest.param(
                {"target_ess": bad}, rf"Expected target_ess as a positive number or None\. Got {text}", id=text
            )
            for bad, text in [
                (0, "0"), (-400, "-400"), (math.inf, "inf"), (math.nan, "nan"), (True, "True"), ("400", "'400'"),
                (torch.tensor(400.0), "tensor"),
            ]
        ),
        pytest.param(
            {"target_ess": 400, "sampler": "pyro"}, r"Expected sampler 'nuts' or 'hmc' with target_ess=\. Got 'pyro'",
            id="pyro",
        ),
        pytest.param(
            {"target_ess": 400, "num_samples": 0}, r"Expected num_samples of at least 1 with target_ess=\. Got 0\.",
            id="no draws",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_a_target_is_refused_before_any_work(calibrate, options, message):
    calls = []

    def model(x, p):
        calls.append(1)
        return p["a"] * x

    with pytest.raises(DomainError, match=message):
        calibrate(tc.Simulator(model, [tc.Parameter("a")]), cubic.recording(11), **options)
    assert calls == []


def test_pyro_draws_without_a_target():
    plan = sampling.Plan(5, 2, 3, "pyro", 0, torch.float64, None, False)
    assert (plan.samples, plan.chains(1), plan.warmup) == (5, 2, 3)


# --- maxima that chains begin at -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def divided():
    """Two densities of the quadratic's parameters, mirror images, fit the cubic equally well."""
    return listened(
        cubic.estimate, model="quadratic", n=11, epsilon=0.01, num_samples=40, num_chains=6, num_starts=32,
        sampler="hmc",
    )  # fmt: skip


def test_one_mode(reached):
    for result in reached.values():
        (mode,) = result.diagnostics.modes
        assert mode.weight == 1.0
        torch.testing.assert_close(torch.tensor(mode.alpha).double(), result.map.alpha, rtol=1e-6, atol=1e-6)
        assert "separate maxima" not in str(result.diagnostics)


def test_no_modes_without_draws():
    assert linear(num_samples=0).diagnostics.modes == ()


def test_two_modes_of_equal_weight(divided):
    result, told = divided
    one, other = result.diagnostics.modes
    # The weights rest on Hessians by differences, good to 1e-9 of their largest entry.
    assert one.weight == pytest.approx(0.5, abs=1e-4)
    assert one.weight + other.weight == pytest.approx(1.0, abs=1e-12)
    assert one.objective == pytest.approx(other.objective, rel=1e-9)
    # The mirror image x -> -x of the odd part: mean and spread of l0 and l2 keep their size.
    first, second = torch.tensor(one.alpha).double(), torch.tensor(other.alpha).double()
    torch.testing.assert_close(first.abs(), second.abs(), rtol=1e-3, atol=1e-5)
    assert float((first - second).abs().max()) > 0.05
    assert float((result.map.alpha - first).abs().max()) < 1e-4
    (text,) = told
    assert text.startswith("The chains have not converged: R-hat of ")
    assert (
        "chains began at 2 separate maxima and have not mixed: how many draws each has rests on normal approximations "
        "(0.5, 0.5)"
    ) in text
    assert "separate maxima: 2, objectives" in str(result.diagnostics)
    assert one.started
    assert other.started
    assert result.diagnostics.converged is False


def test_chains_stay_where_they_began_half_and_half(divided):
    result, _ = divided
    modes = torch.tensor([mode.alpha for mode in result.diagnostics.modes]).double()
    nearest = torch.cdist(result.samples, modes).argmin(-1)  # (chains, draws)
    assert bool((nearest == nearest[:, :1]).all())
    assert nearest[:, 0].tolist().count(0) == 3
    spread = torch.stack([result.samples[nearest[:, 0] == i].flatten(0, 1).std(0) for i in (0, 1)])
    apart = (modes[0] - modes[1]).abs()
    assert float((apart / spread.amax(0)).max()) > 10
    # Each is as wide as the other: 120 draws of each know an sd to about 10 %.
    assert float((spread[0] / spread[1]).log().abs().max()) < 0.6


def test_a_target_is_judged_within_modes_and_the_warning_tells_of_both():
    """Chains that never mix would be drawn to the cap otherwise."""
    result, told = listened(
        cubic.estimate, model="quadratic", n=11, epsilon=0.01, num_samples=None, num_chains=8, num_starts=32,
        target_ess=200, sampler="hmc",
    )  # fmt: skip
    assert result.samples.shape[1] < 2000
    (wanted,) = (text for text in told if text.startswith("Wanted"))
    assert "Wanted an effective sample size of 200" in wanted
    assert any("chains began at 2 separate maxima" in text for text in told)
    middle = result.samples.clone()
    modes = torch.tensor([mode.alpha for mode in result.diagnostics.modes]).double()
    group = torch.cdist(result.samples.mean(1), modes).argmin(-1)
    for i in (0, 1):
        middle[group == i] -= middle[group == i].mean((0, 1))
    found = figures(middle)
    assert found.least_ess >= 200
    assert found.worst_r_hat < 1.01


def test_modes_survive_saving(divided, reached, tmp_path):
    pytest.importorskip("xarray")
    for number, result in enumerate((divided[0], reached["nuts"])):
        result.save(tmp_path / f"{number}.nc")
        loaded = Calibration.load(tmp_path / f"{number}.nc")
        assert loaded.diagnostics.modes == result.diagnostics.modes
        assert str(loaded.diagnostics) == str(result.diagnostics)


def test_modes_of_an_additive_calibration_survive_saving(tmp_path):
    pytest.importorskip("xarray")
    result, _ = listened(additive, num_samples=20, num_chains=2, num_warmup=10, sampler="hmc")
    result.save(tmp_path / "result.nc")
    assert AdditiveCalibration.load(tmp_path / "result.nc").diagnostics.modes == result.diagnostics.modes
    assert len(result.diagnostics.modes) == 1


def test_numbers_of_numpys_are_numbers():
    plan = sampling.Plan(5, 2, 3, "nuts", np.int64(4), torch.float64, np.float32(0.5), False, np.int64(400))
    assert (plan.seed, plan.target_accept, plan.target_ess) == (4, 0.5, 400.0)
    with pytest.raises(DomainError, match="target_accept between 0 and 1"):
        sampling.Plan(5, 2, 3, "nuts", 0, torch.float64, "0.5", False)
