"""The ignition studies: what the paper found, as numbers.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Figs. 7-22.
"""

import dataclasses
import math
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
import torch
from torch import Tensor

import torchcal as tc
from torchcal.errors import ConvergenceWarning, DomainError

pytest.importorskip("cantera")

from examples import demo
from examples.ignition import figures, study
from examples.ignition.chemistry import DOMAIN, OneStep
from examples.ignition.study import Study
from torchcal.inference.diagnostics import figures as convergence
from torchcal.results import AdditiveCalibration, Calibration

KEYS = tuple(study.STUDIES)
EPSILON = 0.001


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Study]:
    folder = tmp_path_factory.mktemp("ignition")
    return {key: study.prepare(key, folder) for key in KEYS}


@pytest.fixture(scope="module")
def estimates(prepared: dict[str, Study]) -> dict[str, list[Calibration]]:
    """Cold starts from three seeds each."""
    return {
        key: [study.calibrate(one, EPSILON, num_samples=0, seed=seed) for seed in (0, 1, 7)]
        for key, one in prepared.items()
    }


def _posterior(one: Study, epsilon: float, num_samples: int = 80) -> Calibration:
    with warnings.catch_warnings():
        # Few draws; the tolerances below allow for it.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return study.calibrate(one, epsilon, num_chains=16 if one.case == 1 else 32, num_samples=num_samples)


def _sd_with_error(calibration: Calibration) -> tuple[Tensor, Tensor]:
    """Posterior sd of every α, and its standard error relative to it, from the effective draws of the squares."""
    draws = calibration.samples
    squares = (draws - draws.mean((0, 1))).square()
    variance = squares.mean((0, 1))
    error = squares.flatten(0, 1).std(0) / convergence(squares).ess_bulk.sqrt() / variance
    return variance.sqrt(), 0.5 * error


@pytest.fixture(scope="module")
def posteriors(prepared: dict[str, Study]) -> dict[str, Calibration]:
    return {key: _posterior(one, EPSILON) for key, one in prepared.items()}


@pytest.fixture(scope="module")
def wide(prepared: dict[str, Study]) -> Calibration:
    """Case 1, N = 11, at ε = 0.01."""
    return _posterior(prepared["1a"], 0.01)


@pytest.fixture(scope="module")
def baselines(prepared: dict[str, Study]) -> dict[str, AdditiveCalibration]:
    return {key: study.calibrate_conventional(one, num_chains=16, num_samples=120) for key, one in prepared.items()}


@pytest.fixture(scope="module")
def found(
    prepared: dict[str, Study], posteriors: dict[str, Calibration], baselines: dict[str, AdditiveCalibration]
) -> dict[str, Study]:
    """The studies as the demo has them."""
    return {
        key: dataclasses.replace(one, embedded={EPSILON: posteriors[key]}, additive=baselines[key])
        for key, one in prepared.items()
    }


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


# --- data and surrogate --------------------------------------------------------------------------------


def test_recordings(prepared: dict[str, Study]) -> None:
    assert [one.recording.n for one in prepared.values()] == [11, 51, 77]
    assert [one.recording.conditions for one in prepared.values()] == [("T0",), ("T0",), ("T0", "phi")]
    for one in prepared.values():
        assert one.recording.noise == "none"
        assert one.recording.units == {"T0": "K", "ln_tau": "ln s"}
    # The stoichiometric slice of case 2 is case 1.
    two = prepared["2"].recording
    torch.testing.assert_close(two.y[two.x["phi"] == 1.0], prepared["1a"].recording.y, rtol=0, atol=0)


def test_surrogates_are_close_to_the_model(prepared: dict[str, Study]) -> None:
    # Of the reactor at 200 random points: 2.2e-5 in case 1, and 1.1e-4 in case 2, which has one dimension more.
    # The smallest model error, 0.02, is a hundred times that.
    for key, most in (("1a", 3e-5), ("2", 2e-4)):
        error = prepared[key].surrogate.error
        assert error is not None
        assert float(error.max_abs[0]) < most
    # Against the integral, at the data's conditions and over the box of the parameters.
    for one in prepared.values():
        x = one.recording.x
        model = OneStep(x["T0"].numpy(), x["phi"].numpy() if one.case == 2 else 1.0)
        low, high = torch.tensor([DOMAIN["lnA"], DOMAIN["E"]], dtype=torch.float64).T
        points = low + (high - low) * torch.rand(100, 2, dtype=torch.float64)
        difference = one.surrogate.at(x)(points) - model.log_delay(points[:, :1], points[:, 1:])
        # The ends of T0 are the worst conditions, and the data have two of them: a factor over the above.
        assert float(difference.abs().max()) < (1e-4 if one.case == 1 else 5e-4)


def test_unknown_studies_are_refused(prepared: dict[str, Study]) -> None:
    with pytest.raises(DomainError, match=r"Expected one of the studies .* Got '3'"):
        study.prepare("3")
    with pytest.raises(DomainError, match="Expected case 1 or 2"):
        study.record(3)
    with pytest.raises(DomainError, match="Expected a conventional calibration"):
        _ = prepared["1a"].conventional


# --- the maximum ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", KEYS)
def test_cold_starts_agree(key: str, estimates: dict[str, list[Calibration]]) -> None:
    first, *others = estimates[key]
    spread = float(first.recording.spread[0])
    scale = first.propagation_at().scaling.scale
    expected = first.predict()
    for other in others:
        assert other.map.objective == pytest.approx(first.map.objective, rel=1e-6)
        prediction = other.predict()
        torch.testing.assert_close(prediction.map.mean, expected.map.mean, rtol=0, atol=1e-3 * spread)
        torch.testing.assert_close(prediction.map.sd, expected.map.sd, rtol=0, atol=1e-3 * spread)
        # In scaled parameters, where the box of Eq. 42 is from -1 to 1.
        torch.testing.assert_close(other.map.mean / scale, first.map.mean / scale, rtol=0, atol=1e-3)
        torch.testing.assert_close(
            other.map.covariance / scale.outer(scale), first.map.covariance / scale.outer(scale), rtol=0, atol=1e-3
        )


@pytest.mark.parametrize(("key", "rmse"), [("1a", 0.0293), ("2", 0.4533)])
def test_best_single_parameter_pair(key: str, rmse: float, baselines: dict, prepared: dict[str, Study]) -> None:
    # Under flat priors the additive MAP is the least-squares fit, and its σ the rms residual.
    result = baselines[key]
    assert study.rms_residual(prepared[key], result.predict().map.mean) == pytest.approx(rmse, abs=1e-4)
    assert float(result.map.alpha[-1].exp()) == pytest.approx(rmse, abs=1e-4)


def test_epsilon_does_not_move_the_map(prepared: dict[str, Study], estimates: dict[str, list[Calibration]]) -> None:
    for key, one in prepared.items():
        reference = study.upright(estimates[key][0]).map
        for epsilon in (0.1, 1e-4):
            other = study.upright(study.calibrate(one, epsilon, num_samples=0)).map
            # ε only divides the objective. The rest is its smoothing of |μ − y|, which is proportional to ε.
            assert other.objective * epsilon**2 == pytest.approx(reference.objective * EPSILON**2, rel=2e-5)
            torch.testing.assert_close(other.alpha, reference.alpha, rtol=0, atol=1e-5)


def test_case_1_is_a_narrow_ridge_with_a_positive_slope(estimates: dict[str, list[Calibration]]) -> None:
    for key in ("1a", "1b"):
        covariance = estimates[key][0].map.covariance
        correlation = covariance[0, 1] / (covariance[0, 0] * covariance[1, 1]).sqrt()
        # Measured: 0.9969 and 0.9961.
        assert 0.99 < float(correlation) < 1
        # ln k at one temperature is what the data see: the slope is R T of the data's middle.
        slope = float(covariance[0, 1] / covariance[0, 0])
        assert 1000 < slope / study.R_CAL < 1300


def test_case_2_spreads_ln_a_alone(estimates: dict[str, list[Calibration]]) -> None:
    result = estimates["2"][0]
    spread = result.map.sd / result.propagation_at().scaling.scale
    # Measured: 0.1016 and 0.0028.
    assert float(spread[0]) == pytest.approx(0.10, abs=0.005)
    assert float(spread[1]) < 0.01
    # ln A shifts ln τ by the same everywhere. Measured: from 0.3915 to 0.3946 over all T0 and Φ.
    sd = result.predict().map.sd
    assert float((sd.max() - sd.min()) / sd.mean()) < 0.02
    # Case 1, with its spread in E too, is far from uniform: a factor of 2.5.
    one = estimates["1a"][0].predict().map.sd
    assert float(one.max() / one.min()) > 2


@pytest.mark.parametrize("key", KEYS)
def test_rate_has_its_analytic_moments(key: str, estimates: dict, prepared: dict[str, Study]) -> None:
    # Eqs. 45-48; ln k is linear in (ln A, E), so that a first-order expansion is exact but for rounding.
    result = estimates[key][0]
    x = study.grid(prepared[key])
    moments = result.predict(x, function=study.log_rate).map
    mean, sd = study.log_rate_moments(result.map.alpha, x["T0"])
    torch.testing.assert_close(moments.mean, mean, rtol=1e-12, atol=0)
    torch.testing.assert_close(moments.sd, sd, rtol=1e-10, atol=0)


def test_rate_is_less_certain_in_case_2(estimates: dict, prepared: dict[str, Study]) -> None:
    sd = {
        key: estimates[key][0].predict(study.grid(one), function=study.log_rate).map.sd for key, one in prepared.items()
    }
    # Fig. 22. Measured: 0.018 to 0.058 and 0.39.
    assert float(sd["2"].min()) > 5 * float(sd["1a"].max())


# --- the posterior -------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", KEYS)
def test_map_and_posterior_coincide_at_small_epsilon(key: str, posteriors: dict[str, Calibration]) -> None:
    prediction = posteriors[key].predict()
    # V[μ] is 2e-4 of E[σ²] in case 1, where it is largest; 1 % of the sd is far more than that.
    torch.testing.assert_close(prediction.mean, prediction.map.mean, rtol=0, atol=0.01 * float(prediction.sd.min()))
    torch.testing.assert_close(prediction.sd, prediction.map.sd, rtol=0.01, atol=0)
    assert _rms(prediction.sd_posterior) < 0.02 * _rms(prediction.sd_model_error)


@pytest.mark.slow
def test_densities_of_lambda_coincide_at_small_epsilon(posteriors: dict[str, Calibration], wide: Calibration) -> None:
    # Total variation distance of posterior and MAP predictive density (Fig. 12). Measured: 0.001, and 0.24 at ε = 0.01.
    assert _distance(posteriors["1a"]) < 0.01
    assert _distance(posteriors["1b"]) < 0.01
    assert _distance(wide) > 0.1


def _distance(result: Calibration) -> float:
    points = result.sample_parameters(1000, kind="map")
    ratio = result.parameter_density(points) / result.parameter_density(points, kind="map")
    return 0.5 * float((ratio - 1).abs().mean())


@pytest.mark.slow
def test_posterior_predictive_of_lambda_is_narrower_along_the_ridge(wide: Calibration) -> None:
    """What the paper saw at ε = 0.01, N = 11, and did not expect."""
    mean, covariance = wide.propagation_at().parameter_moments(wide.draws)
    total = covariance.mean(0) + torch.cov(mean.T, correction=0)
    slope = wide.map.covariance[0, 1] / wide.map.covariance[0, 0]
    turn = torch.tensor([[1.0, 0.0], [-float(slope), 1.0]], dtype=torch.float64)
    ratio = ((turn @ total @ turn.T).diagonal() / (turn @ wide.map.covariance @ turn.T).diagonal()).sqrt()
    # Measured with 4000 draws: 0.81 along the ridge and 1.22 across it. About 800 effective draws leave some 2 %.
    assert float(ratio[0]) == pytest.approx(0.81, abs=0.08)
    assert float(ratio[1]) == pytest.approx(1.22, abs=0.10)


def test_coefficients_are_correlated_as_in_the_paper(posteriors: dict[str, Calibration]) -> None:
    result = posteriors["1a"].relabelled()
    assert (result.map.alpha[3:] > 0).all()
    r = torch.corrcoef(result.draws.T)
    # Fig. 13. Measured: 0.997, 0.996, -0.62 and -0.60; some 1000 effective draws leave 0.03.
    assert float(r[0, 2]) > 0.98
    assert float(r[1, 3]) > 0.98
    assert float(r[3, 4]) == pytest.approx(-0.62, abs=0.12)
    assert float(r[1, 4]) == pytest.approx(-0.60, abs=0.12)


@pytest.mark.parametrize("key", ["1a", pytest.param("2", marks=pytest.mark.slow)])
def test_epsilon_scales_the_posterior_of_alpha(key: str, posteriors: dict, prepared: dict[str, Study]) -> None:
    (wide, wide_error), (narrow, narrow_error) = (
        _sd_with_error(study.upright(one)) for one in (posteriors[key], _posterior(prepared[key], 1e-4, 60))
    )
    ratio, error = wide / narrow, (wide_error.square() + narrow_error.square()).sqrt()
    assert ((ratio.log() - math.log(10)).abs() < 4.5 * error).all(), (ratio, error)  # ten, as ε
    assert (error < 0.1).all(), error


def test_more_data_narrow_alpha_and_not_the_prediction(posteriors: dict[str, Calibration]) -> None:
    few, many = posteriors["1a"], posteriors["1b"]
    change = _rms(many.predict().map.sd) / _rms(few.predict().map.sd)
    # Measured: 13 % less.
    assert abs(change - 1) < 0.25
    ratio = many.relabelled().draws.std(0) / few.relabelled().draws.std(0)
    # √(11/51) = 0.46. Measured: 0.48, 0.54, 0.48, 0.54, 0.46; the MAP moves a little as well.
    assert ((ratio > 0.38) & (ratio < 0.62)).all(), ratio


# --- the conventional calibration beside it ------------------------------------------------------------


def test_conventional_push_forward_shrinks(baselines: dict, prepared: dict[str, Study]) -> None:
    width, expected = [], []
    for key in ("1a", "1b"):
        result, n = baselines[key], prepared[key].recording.n
        prediction = result.predict()
        width.append(_rms(prediction.push_forward.sd))
        # A linear model with d = 2 and flat ln σ: V = E[σ²] d / n on average, with E[σ²] = SS / (n − d − 2).
        square_sum = n * study.rms_residual(prepared[key], prediction.map.mean) ** 2
        expected.append(math.sqrt(square_sum / (n - 4) * 2 / n))
    # Measured: 0.0157 and 0.0054. It falls faster than √(11/51) = 0.46 because E[σ²] of eleven data has a heavy tail.
    assert width == pytest.approx(expected, rel=0.12)
    assert width[1] / width[0] < 0.46


def test_conventional_push_forward_misses_the_data(found: dict[str, Study]) -> None:
    two = found["2"]
    conventional, embedded = two.conventional.predict(), two.embedded[EPSILON].predict()
    # Of 77 data in the 95 % band; measured: 17 and 71. Half a dozen lie near an edge.
    assert study.coverage(two, conventional.push_forward) < 0.35
    assert study.coverage(two, embedded.posterior) > 0.85
    ends = (two.recording.x["phi"] == 0.6) | (two.recording.x["phi"] == 1.8)
    miss = (two.recording.y - conventional.push_forward.mean).abs()[ends] / conventional.push_forward.sd[ends]
    assert float(miss.min()) > 4
    # Only with the additive error, which is no part of the model, do they come in.
    assert study.coverage(two, conventional.posterior) > 0.9


def test_embedded_push_forward_is_the_posterior_predictive(found: dict[str, Study]) -> None:
    two = found["2"]
    result = two.embedded[EPSILON]
    # The surrogate at draws of λ, without any further error. 4000 draws: sd to 1.1 %, and 0.8 % that the
    # first-order expansion leaves out.
    pushed = result.sample_outputs(4000)
    prediction = result.predict()
    torch.testing.assert_close(pushed.std(0), prediction.sd, rtol=0.06, atol=0)
    torch.testing.assert_close(pushed.mean(0), prediction.mean, rtol=0, atol=0.08 * float(prediction.sd.min()))
    conventional = two.conventional.predict()
    assert float((conventional.push_forward.sd / conventional.posterior.sd).max()) < 0.4


# --- the programs --------------------------------------------------------------------------------------


def test_report_says_what_was_measured(found: dict[str, Study]) -> None:
    text = demo.report(found)
    assert "case 1, N = 51" in text
    assert "9941485" in text
    assert "after the conventional calibration" in text
    for one in found.values():
        result = one.embedded[EPSILON]
        assert bool(result.diagnostics.converged) or f"NOT CONVERGED, {one.title}, embedded" in text


def test_main_figure(found: dict[str, Study], tmp_path: Path) -> None:
    figure = figures.embedded_vs_conventional(found["2"])
    assert len(figure.axes) == 4
    assert all(ax.get_xlabel() and ax.get_ylabel() for ax in figure.axes)
    figure.savefig(tmp_path / "figure.png")
    # Small enough to be kept in the repository.
    assert (tmp_path / "figure.png").stat().st_size < 300_000
    plt.close(figure)


def test_results_survive_a_file(found: dict[str, Study], tmp_path: Path) -> None:
    demo.save(found, tmp_path)
    assert len(list(tmp_path.glob("*.nc"))) == 6
    loaded = tc.results.Calibration.load(tmp_path / "case_2_embedded.nc", simulator=found["2"].surrogate)
    torch.testing.assert_close(loaded.predict().sd, found["2"].embedded[EPSILON].predict().sd)


def test_demo_names_what_is_missing_and_the_error_bars_collapse(found: dict[str, Study], tmp_path: Path) -> None:
    two = found["2"]
    story = demo.explain(two, tmp_path, seed=0, progress=False)
    assert (story.diagnosis.verdict, story.diagnosis.terms) == ("named", ["fuel reaction order"])
    (location, *_) = story.diagnosis.where
    assert location.driver == "phi"
    before, after = (result.predict().map.sd for result in (story.base, story.improved))
    assert _rms(after) < 0.1 * _rms(before)
    # At Φ = 1 the order of the fuel is an alias of A.
    assert demo.FUEL[0] not in [*story.alone.terms, *(name for names in story.alone.tied for name in names)]
    text = demo.physics(two, story)
    assert "it is not named" in text
    paths = demo.draw(two, story, tmp_path, readme=False)
    assert all(path.stat().st_size > 10_000 for path in [*paths, tmp_path / "report.html"])
