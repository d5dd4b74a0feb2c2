"""Polynomial surrogates: exactness, convergence, oracles, caches, failures, files."""

import functools
import itertools
import math
import multiprocessing
import os
import time
import warnings
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre

from torchcal import Recording, Term, calibrate, diagnose, polychaos
from torchcal.data import ROUNDING
from torchcal.discovery.fits import trial
from torchcal.embeddings import Gaussian
from torchcal.errors import (
    DomainError,
    ExtrapolationWarning,
    ShapeError,
    SimulatorError,
    SurrogateWarning,
    TorchcalWarning,
)
from torchcal.likelihoods import ABC
from torchcal.propagation import NISP
from torchcal.simulators import (
    Evaluations,
    ExternalSimulator,
    Parameter,
    PolynomialSurrogate,
    Simulator,
    build_surrogate,
)
from torchcal.simulators.held_out import NUMBERS
from torchcal.simulators.scattered import scatter
from torchcal.terms import extend

A, B = Parameter("a", low=1.0, high=3.0), Parameter("b", unit="K", low=-2.0, high=4.0)
BOX = {"s": (0.0, 2.0), "t": (5.0, 6.0)}
X = {"s": torch.tensor([0.0, 0.7, 2.0]).double(), "t": torch.tensor([5.0, 5.3, 6.0]).double()}
VALUES = torch.tensor([[[1.0, -2.0], [2.5, 0.3]], [[3.0, 4.0], [1.7, 1.1]]]).double()


def cubic(x, p):
    return 1 + p["a"] * x["s"] * x["t"] - p["b"] ** 2 * x["s"] + 0.5 * p["a"] ** 3


def smooth(x, p):
    return math.sin(0.5 * p["a"] * x["s"]) * math.exp(0.1 * p["b"]) + x["t"]


def smooth_in_torch(x, p):
    return torch.sin(0.5 * p["a"] * x["s"]) * torch.exp(0.1 * p["b"]) + x["t"]


def two(x, p):
    return {"y": cubic(x, p), "z": p["b"] * x["t"]}


# --- scattered points ----------------------------------------------------------------------------------


def test_a_polynomial_is_found_exactly_from_scattered_points():
    grid = build_surrogate(two, conditions=BOX, parameters=[A, B], order=3, progress=False)
    scattered = build_surrogate(two, conditions=BOX, parameters=[A, B], order=3, points=70, progress=False)
    largest = float(grid.coefficients.abs().max())
    assert float((scattered.coefficients - grid.coefficients).abs().max()) < 1e-11 * largest
    assert (scattered.outputs, scattered.nodes) == (("y", "z"), None)
    assert bool((scattered.error.relative < 1e-11).all())


def test_scattered_points_are_few_and_nearly_as_good_as_a_grid(tmp_path):
    options = {"conditions": BOX, "parameters": [A, B], "order": 5, "progress": False}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SurrogateWarning)
        grid, scattered = (build_surrogate(smooth, **options, **one) for one in ({}, {"points": 3 * 126}))
        in_torch = build_surrogate(Simulator(smooth_in_torch, [A, B]), points=3 * 126, **options)
    assert float(scattered.error.rms) < 3 * float(grid.error.rms)
    assert float((in_torch.coefficients - scattered.coefficients).abs().max()) < 1e-12
    scattered.save(tmp_path / "s.npz")
    again = PolynomialSurrogate.load(tmp_path / "s.npz")
    assert torch.equal(again.coefficients, scattered.coefficients)
    assert again.nodes is None


def test_fewer_scattered_points_are_the_first_of_more():
    indices = polychaos.multi_indices(3, 2)
    many = scatter(indices, 700, 4)
    assert torch.equal(scatter(indices, 300, 4), many[:300])
    assert not torch.equal(scatter(indices, 300, 5), many[:300])


@pytest.mark.parametrize(("dim", "order"), [(1, 10), (2, 8), (5, 3)])
def test_terms_are_told_apart_by_few_scattered_points(dim, order):
    indices = polychaos.multi_indices(dim, order)

    def condition(times, seed):
        points = scatter(indices, times * len(indices), seed)
        assert points.shape == (times * len(indices), dim)
        assert float(points.abs().max()) <= 1
        psi = polychaos.evaluate(polychaos.LEGENDRE, indices, points)
        psi = psi / polychaos.norms(polychaos.LEGENDRE, indices).sqrt()
        return float(torch.linalg.cond(psi / psi.norm(dim=1, keepdim=True)))

    assert np.median([condition(2, seed) for seed in range(11)]) < 20
    assert max(condition(5, seed) for seed in range(11)) < 20


@pytest.mark.parametrize("degree", [0, 1, 4, 9])
def test_scattered_points_have_the_density_of_their_term(degree):
    n = 20000
    points = scatter(torch.tensor([[degree]]), n, 3)[:, 0]
    grid, weights = (torch.from_numpy(v) for v in legendre.leggauss(40))
    value = polychaos.evaluate(polychaos.LEGENDRE, torch.tensor([[degree]]), grid[:, None])[:, 0]
    density = 0.5 * (2 * degree + 1) * value.square() * weights
    for power in (1, 2, 4):
        mean, square = float((density * grid**power).sum()), float((density * grid ** (2 * power)).sum())
        sd = math.sqrt((square - mean**2) / n)
        assert abs(float((points**power).mean()) - mean) < 4.5 * sd


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"points": 69}, "70"),
        ({"points": 100, "nodes": 5}, "Got both"),
        ({"points": "many"}, "points"),
        ({"order": 9, "points": 10**7}, "memory"),
    ],
)
def test_scattered_points_that_cannot_be(options, message):
    with pytest.raises(DomainError, match=message):
        build_surrogate(cubic, conditions=BOX, parameters=[A, B], progress=False, **{"order": 3, **options})


def fails(x, p):
    if p["a"] > 2.9:
        raise ValueError("no root")
    return smooth(x, p)


class Counted:
    """Counts its calls, and fails or is interrupted at one of them."""

    def __init__(self, function, stop=None, error=None):
        self.function, self.stop, self.error, self.calls = function, stop, error, 0

    def __call__(self, x, p):
        self.calls += 1
        if self.calls == self.stop:
            raise self.error
        return self.function(x, p)


def build(function, **settings):
    settings = {"conditions": BOX, "parameters": [A, B], "order": 3, "progress": False, "threshold": 1.0, **settings}
    return build_surrogate(function, **settings)


@pytest.fixture(scope="module")
def pool():
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        yield executor


# --- what it is ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [cubic, Simulator(cubic, [A, B]), ExternalSimulator(cubic, [A, B])])
def test_exact_for_polynomials_of_its_total_degree(model):
    surrogate = build(model)
    expected = Simulator(cubic, [A, B]).at(X)(VALUES)
    torch.testing.assert_close(surrogate.at(X)(VALUES), expected, rtol=1e-13, atol=1e-12)
    assert surrogate.error.max_abs.max() < 1e-12
    assert surrogate.error.relative.tolist() == [0.0]
    assert surrogate.degree == 3
    assert len(surrogate.indices) == math.comb(4 + 3, 3)


def test_not_exact_one_degree_below():
    with pytest.warns(SurrogateWarning):
        surrogate = build(cubic, order=2, threshold=1e-4)
    assert surrogate.error.rms > 0.01


def test_vectorized_external_simulators():
    def in_numpy(x, p):
        assert isinstance(x["s"], np.ndarray)
        return cubic(x, p)

    surrogate = build(ExternalSimulator(in_numpy, [A, B], vectorized=True))
    torch.testing.assert_close(surrogate.at(X)(VALUES), Simulator(cubic, [A, B]).at(X)(VALUES))


def test_coefficients_are_those_of_numpy():
    """Total-degree projection by an independent library: a full tensor projection, cut."""
    surrogate = build(lambda x, p: math.exp(p["a"] * x), conditions=(0.0, 1.0), parameters=[A], nodes=8)
    nodes, weights = legendre.leggauss(8)
    values = np.exp(np.outer(0.5 + 0.5 * nodes, 2 + nodes))
    vander = legendre.legvander(nodes, 3) * weights[:, None] * (np.arange(4) + 0.5)
    full = vander.T @ values @ vander
    expected = [full[i, j] for i, j in surrogate.indices.tolist()]
    np.testing.assert_allclose(surrogate.coefficients[0], expected, rtol=1e-12, atol=1e-14)
    mask = np.add.outer(np.arange(4), np.arange(4)) <= 3
    found = surrogate.at(torch.tensor([0.2], dtype=torch.float64))(torch.tensor([1.3], dtype=torch.float64))
    assert float(found) == pytest.approx(legendre.legval2d(2 * 0.2 - 1, 1.3 - 2, full * mask), rel=1e-13)


def test_error_falls_exponentially_with_the_order():
    model = Simulator(smooth_in_torch, [A, B])
    rms = [float(build(model, order=order, threshold=1.0).error.rms) for order in (2, 4, 6, 8)]
    assert all(after < 0.2 * before for before, after in itertools.pairwise(rms)), rms


def test_function_and_torch_simulator_give_the_same_surrogate():
    first, second = build(smooth, order=4), build(Simulator(smooth_in_torch, [A, B]), order=4)
    torch.testing.assert_close(first.coefficients, second.coefficients, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(first.error.rms, second.error.rms)


def test_gradient_is_that_of_the_polynomial():
    surrogate = build(cubic)
    leaf = VALUES.clone().requires_grad_(True)
    exact = VALUES.clone().requires_grad_(True)
    surrogate.at(X)(leaf).sin().sum().backward()
    Simulator(cubic, [A, B]).at(X)(exact).sin().sum().backward()
    torch.testing.assert_close(leaf.grad, exact.grad, rtol=1e-11, atol=1e-11)
    assert torch.autograd.gradcheck(surrogate.at(X), VALUES.clone().requires_grad_(True))


def test_batches_dtypes_and_elementwise_calls():
    surrogate = build(cubic)
    evaluate = surrogate.at(X)
    assert evaluate(VALUES).shape == (2, 2, 3)
    assert evaluate(VALUES[0, 0]).shape == (3,)
    assert evaluate(VALUES.float()).dtype == torch.float32
    assert surrogate.check(X, VALUES[0]) == 3
    varying = {"a": VALUES[..., :1] * torch.tensor([1.0, 0.9, 1.0]), "b": VALUES[..., 1:]}
    torch.testing.assert_close(surrogate.function(X, varying), cubic(X, varying), rtol=1e-12, atol=1e-12)
    with pytest.raises(ShapeError, match=r"\(\*batch, 2\)"):
        evaluate(torch.ones(3))


def test_several_outputs():
    for model in (two, Simulator(two, [A, B])):
        surrogate = build(model)
        assert surrogate.outputs == surrogate.error.outputs == ("y", "z")
        expected = Simulator(two, [A, B])
        for wanted in (None, ["z", "y"], ["z"]):
            torch.testing.assert_close(surrogate.at(X, wanted)(VALUES), expected.at(X, wanted)(VALUES))
        torch.testing.assert_close(
            surrogate.function(X, {"a": VALUES[..., :1], "b": VALUES[..., 1:]})["z"], VALUES[..., 1:] * X["t"]
        )
        assert build(model, outputs=["z"]).outputs == ("z",)
        with pytest.raises(SimulatorError, match="'w'"):
            surrogate.at(X, ["w"])
        with pytest.raises(SimulatorError, match="'w'"):
            build(model, outputs=["w"])


def test_logarithmic_parameters_are_scaled_by_their_logarithm():
    k = Parameter("k", low=1e-3, high=1e3, transform="log")
    surrogate = build(lambda x, p: math.log(p["k"]) ** 2 * x, conditions=(0.0, 1.0), parameters=[k])
    assert surrogate.error.max_abs.max() < 1e-11
    found = surrogate.at(torch.tensor([1.0]).double())(torch.tensor([10.0]).double())
    assert float(found) == pytest.approx(math.log(10) ** 2, rel=1e-12)


def test_parameters_left_out_are_held_at_their_neutral_value():
    dormant = Parameter("c", neutral=2.0)

    def with_c(x, p):
        return p["c"] * cubic(x, p)

    for kind in (Simulator, ExternalSimulator):
        surrogate = build(kind(with_c, [dormant, A, B]))
        assert surrogate.names == ("a", "b")
        torch.testing.assert_close(surrogate.at(X)(VALUES), 2 * Simulator(cubic, [A, B]).at(X)(VALUES))
    with pytest.raises(DomainError, match=r"neutral.*'c'"):
        build(Simulator(with_c, [Parameter("c"), A, B]))


def test_nisp_through_the_surrogate_is_nisp_through_the_model():
    alpha = torch.tensor([0.1, 0.2, 0.3, 0.1, 0.2]).double()
    model = Simulator(cubic, [A, B], degree=3)
    exact, through = NISP(model, Gaussian(), X), NISP(build(cubic), Gaussian(), X)
    assert through.num_nodes == exact.num_nodes == 16
    for found, expected in zip(through(alpha), exact(alpha), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-11)


# --- how good it is ------------------------------------------------------------------------------------


def test_held_out_error_is_honest():
    """The same as the error at many other points, up to sampling."""
    surrogate = build(Simulator(smooth_in_torch, [A, B]), order=5)
    generator = torch.Generator().manual_seed(7)
    u = torch.rand(4000, 4, generator=generator, dtype=torch.float64)
    x = {"s": 2 * u[:, 0], "t": 5 + u[:, 1]}
    p = {"a": 1 + 2 * u[:, 2], "b": 6 * u[:, 3] - 2}
    error = (surrogate.function(x, p) - smooth_in_torch(x, p)).abs()
    assert float(surrogate.error.rms) == pytest.approx(float(error.square().mean().sqrt()), rel=0.35)
    assert float(surrogate.error.sd) == pytest.approx(float(smooth_in_torch(x, p).std()), rel=0.2)
    worst = surrogate.error.worst[0]
    there = {k: torch.tensor([worst[k]]).double() for k in ("s", "t")}
    values = torch.tensor([worst["a"], worst["b"]]).double()
    gap = surrogate.at(there)(values) - Simulator(smooth_in_torch, [A, B]).at(there)(values)
    torch.testing.assert_close(gap.abs(), surrogate.error.max_abs)


def test_error_of_every_output_and_how_it_prints():
    surrogate = build(two)
    text = repr(surrogate)
    assert "order 3" in text
    assert "error at 200 held-out points" in text
    assert all(f"  {name}: rms" in text for name in "yz")


def test_a_large_error_warns_with_the_numbers():
    with pytest.warns(SurrogateWarning, match=r"rms .* of the output's sd .*\n.*Raise order="):
        surrogate = build(lambda x, p: math.sin(9 * p["a"]), threshold=0.01)
    assert surrogate.error.relative > 0.01


def test_constant_output_is_no_reason_to_warn():
    assert build(lambda x, p: 0.1 + 1e6).error.relative.tolist() == [0.0]


@pytest.mark.parametrize("scale", [1e-300, 1e-170, 1e170, 1e300])
def test_an_error_is_measured_in_any_unit(scale):
    """Squares of such numbers are past the range of floats."""
    found = []
    for factor in (1.0, scale):
        with pytest.warns(SurrogateWarning, match=r"rms \S+ \(0\.\d+ of the output's sd"):
            step = build(lambda x, p, f=factor: f * math.copysign(1.0, p["a"] * x["s"] - 1.7), threshold=0.01)
        found.append(step.error)
    one, other = found
    for name in NUMBERS:
        torch.testing.assert_close(getattr(other, name) / scale, getattr(one, name), rtol=1e-12, atol=0)
    torch.testing.assert_close(other.relative, one.relative, rtol=1e-12, atol=0)


@pytest.mark.parametrize("offset", [2e10, 3e10])
def test_an_error_is_not_hidden_by_a_large_mean(offset):
    """The output varies by more than its last digit, the surrogate errs by a part of that or more."""
    with pytest.warns(SurrogateWarning, match="of the output's sd"):
        error = build(lambda x, p: offset + 1e-3 * math.exp(-p["a"] * x["s"]), threshold=0.01).error
    torch.testing.assert_close(error.relative, error.rms / error.sd)
    assert float(error.relative) > 0.01


def test_an_output_that_varies_by_its_rounding_alone_is_constant():
    error = build(lambda x, p: 1e6 * (p["a"] * x["s"] / p["a"] / x["s"])).error
    assert 0 < float(error.sd) <= 1e6 * ROUNDING
    assert error.relative.tolist() == [0.0]


def test_what_some_hundred_steps_conserve_is_constant():
    def total(x, p):
        masses = np.array([0.2, 0.3, 0.5])
        for _ in range(200):
            flow = 0.01 * p["a"] * x["s"] * (masses - np.roll(masses, 1))
            masses = masses - flow + np.roll(flow, -1)
        return float(masses.sum())

    error = build(total).error
    assert float(error.sd) > 0
    assert error.relative.tolist() == [0.0]


def test_conditions_outside_the_box_warn_with_the_numbers():
    surrogate = build(cubic)
    far = {"s": torch.tensor([0.0, 2.5]).double(), "t": torch.tensor([5.0, 6.0]).double()}
    with pytest.warns(ExtrapolationWarning, match=r"1 of 2 .* s from 0 to 2.5, built for 0 to 2"):
        surrogate.at(far)
    surrogate.at({"s": torch.tensor([0.0, 2.0 + 1e-12]).double(), "t": far["t"]})


@pytest.mark.parametrize("samples", [0, 8])
def test_predictions_outside_the_box_warn_once(samples):
    a, b = Parameter("a", low=0.0, high=3.0), Parameter("b", low=-1.0, high=1.0)
    surrogate = build_surrogate(
        lambda x, p: p["a"] + p["b"] * x, conditions=(0.0, 1.0), parameters=[a, b], order=2, progress=False
    )
    x = torch.linspace(0, 1, 9, dtype=torch.float64)
    data = Recording(x=x, y=1 + 0.5 * x + 0.2 * x**2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = calibrate(surrogate, data, likelihood=ABC(epsilon=0.05), num_samples=samples, num_chains=2, num_warmup=4)
    for ask in (fit.predict, lambda x: fit.sample_outputs(3, x, kind="map"), fit.predict):
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            ask([0.5, 2.0])
        far = [str(one.message) for one in given if one.category is ExtrapolationWarning]
        assert len(far) == 1
        assert "1 of 2 conditions" in far[0]


def test_leaves_box():
    surrogate = build(cubic)
    values = torch.tensor([[[1.0, 0.0], [3.0, 4.0], [0.99, 0.0]], [[2.0, 4.1], [math.nan, 0.0], [2.0, 2.0]]])
    assert surrogate.leaves_box(values).tolist() == [[False, False, True], [True, True, False]]


# --- evaluations ---------------------------------------------------------------------------------------


def test_process_pool_gives_the_same(pool):
    assert torch.equal(build(smooth, order=4, executor=pool).coefficients, build(smooth, order=4).coefficients)
    external = ExternalSimulator(smooth, [A, B], executor=pool)
    assert torch.equal(build(external, order=4).coefficients, build(smooth, order=4).coefficients)


def test_evaluations_are_counted_and_shown(capsys):
    function = Counted(cubic)
    build(function, holdout=50, progress=True)
    assert function.calls == 4**4 + 50
    assert "306/306" in capsys.readouterr().err


def test_a_failing_point_is_named_and_what_was_done_is_kept(pool, tmp_path):
    for executor in (None, pool):
        path = tmp_path / f"{executor is None}.npz"
        with pytest.raises(SimulatorError, match=r"no root.*x = \{'s': .*'t': .*\}, p = \{'a': 2.9") as caught:
            build(fails, order=4, cache=path, executor=executor)
        kept = Evaluations.load(path)
        assert len(kept) == len(caught.value.partial) > 0
        assert "pass it as cache=" in caught.value.__notes__[-1]
        assert isinstance(caught.value.__cause__, ValueError)


def test_a_function_that_raises_is_not_told_to_return_what_is_refused():
    with pytest.raises(SimulatorError, match=r"Mend it there, or narrow the bounds so that it has an answer"):
        build(fails)


def test_a_point_that_is_not_finite_is_named():
    def bad(x, p):
        return math.nan if p["a"] > 2.8 else cubic(x, p)

    def bad_in_torch(x, p):
        return torch.where(p["a"] > 2.8, math.nan, cubic(x, p))

    for model in (bad, Simulator(bad_in_torch, [A, B])):
        with pytest.raises(SimulatorError, match=r"finite.*nan.*'t': 5.*p = \{'a': 2.8"):
            build(model)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no root")])
@pytest.mark.parametrize("kind", ["file", "memory"])
def test_a_rerun_goes_on_from_what_was_kept(error, kind, tmp_path):
    path = tmp_path / "cache.npz" if kind == "file" else None
    first = Counted(smooth, stop=101, error=error)
    with pytest.raises((KeyboardInterrupt, SimulatorError)) as caught:
        build(first, cache=path)
    second = Counted(smooth)
    surrogate = build(second, cache=path or caught.value.partial)
    # All but the hundred kept ones, and one of these again.
    assert second.calls == 4**4 + 200 - 100 + 1
    assert torch.equal(surrogate.coefficients, build(smooth).coefficients)
    if path:
        third = Counted(smooth)
        build(third, cache=path)
        assert third.calls == 1
        assert os.listdir(tmp_path) == ["cache.npz"]


def full_disk(*args, **arrays):
    raise OSError(28, "No space left on device")


def test_a_disk_that_is_full_loses_no_evaluation(tmp_path, monkeypatch):
    path = tmp_path / "cache.npz"
    monkeypatch.setattr("torchcal.simulators.design.np.savez", full_disk)
    monkeypatch.setattr("torchcal.simulators.design._SAVE_SECONDS", 0.0)  # tried at every evaluation
    with pytest.warns(TorchcalWarning, match=r"could not be kept in .*No space left"):
        surrogate = build(smooth, cache=path)
    assert torch.equal(surrogate.coefficients, build(smooth).coefficients)
    with pytest.raises(SimulatorError) as caught:
        build(Counted(smooth, stop=101, error=ValueError("no root")), cache=path)
    assert len(caught.value.partial) == 100
    assert "as .partial of this error, as" in caught.value.__notes__[0]
    assert not os.listdir(tmp_path)
    monkeypatch.undo()
    again = Counted(smooth)
    build(again, cache=caught.value.partial)
    assert again.calls == 4**4 + 200 - 100 + 1


def test_a_folder_that_goes_loses_no_evaluation(tmp_path):
    folder = tmp_path / "scratch"
    folder.mkdir()

    class Removing(Counted):
        def __call__(self, x, p):
            if self.calls == 50:
                folder.rmdir()
            return super().__call__(x, p)

    with pytest.warns(TorchcalWarning, match="could not be kept in"):
        surrogate = build(Removing(smooth), cache=folder / "cache.npz")
    assert torch.equal(surrogate.coefficients, build(smooth).coefficients)


def test_a_whole_cache_may_be_where_nothing_can_be_written(tmp_path, monkeypatch):
    build(smooth, cache=tmp_path / "cache.npz")
    monkeypatch.setattr("torchcal.files.os.access", lambda *args: False)
    again = Counted(smooth)
    build(again, cache=tmp_path / "cache.npz")
    assert again.calls == 1
    with pytest.raises(DomainError, match="can be written to"):
        build(smooth, cache=tmp_path / "other.npz")


def test_an_interrupt_in_a_worker(tmp_path, pool):
    path = tmp_path / "cache.npz"
    with pytest.raises(KeyboardInterrupt) as caught:
        build(interrupted, cache=path, executor=pool)
    assert len(Evaluations.load(path)) == len(caught.value.partial) > 0


def interrupted(x, p):
    if p["a"] > 2.8:
        raise KeyboardInterrupt
    return smooth(x, p)


def twice(x, p):
    return 2 * smooth(x, p)


@pytest.mark.parametrize("where", ["here", "pool"])
@pytest.mark.parametrize("other", [{}, {"order": 4}, {"order": 4, "seed": 1}])
def test_a_complete_cache_of_another_function_is_refused(other, where, pool, tmp_path):
    path = tmp_path / "cache.npz"
    build(smooth, cache=path)
    kept = len(Evaluations.load(path))
    # With another order and seed no point is asked for that is in the file.
    with pytest.raises(SimulatorError, match=r"cache of this function's values.*Remove the cache"):
        build(twice, cache=path, executor=pool if where == "pool" else None, **other)
    assert len(Evaluations.load(path)) == kept
    assert torch.equal(build(smooth, cache=path).coefficients, build(smooth).coefficients)


def only_in_workers(pid, x, p):
    if os.getpid() == pid:
        raise ValueError("not here")
    return smooth(x, p)


def test_a_cached_point_is_repeated_where_the_others_run(pool, tmp_path):
    function, path = functools.partial(only_in_workers, os.getpid()), tmp_path / "cache.npz"
    first = build(function, cache=path, executor=pool)
    assert torch.equal(build(function, cache=path, executor=pool).coefficients, first.coefficients)
    with pytest.raises(SimulatorError, match="not here"):
        build(function, cache=path)


def test_a_cached_point_at_which_the_function_now_fails_is_named(tmp_path):
    path = tmp_path / "cache.npz"
    build(smooth, cache=path)
    with pytest.raises(SimulatorError, match=r"no root.*p = \{'a': 1") as caught:
        build(Counted(smooth, stop=1, error=ValueError("no root")), cache=path)
    assert isinstance(caught.value.__cause__, ValueError)


def test_the_cache_of_another_function_is_refused(tmp_path):
    path = tmp_path / "cache.npz"
    build(smooth, cache=path)
    with pytest.raises(SimulatorError, match="cache of this function's values"):
        build(cubic, cache=path, order=4)
    with pytest.raises(DomainError, match="evaluations over"):
        build(lambda x, p: x * p["a"], conditions=(0.0, 1.0), parameters=[A], cache=path)
    path.write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(DomainError, match="file of torchcal evaluations"):
        build(smooth, cache=path)


# --- bad input, before anything is evaluated -----------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"order": 0}, "order"),
        ({"order": 2.5}, "order"),
        ({"nodes": 3}, "cannot tell polynomials of order"),
        ({"nodes": [4, 4, 4]}, "4, one per"),
        ({"nodes": [4, 4, 4, 3]}, "cannot tell polynomials of order"),
        ({"nodes": 400}, "use fewer nodes"),
        ({"holdout": 1}, "holdout"),
        ({"seed": -1}, "seed"),
        ({"threshold": 0}, "threshold"),
        ({"conditions": {}}, "at least one condition"),
        ({"conditions": {"s": (1.0, 0.0), "t": (0, 1)}}, "low < high for condition 's'"),
        ({"conditions": {"s": 3.0}}, "bounds"),
        ({"conditions": {"s": ("0", "1")}}, "finite bounds"),
        ({"conditions": {"s": (False, True)}}, "finite bounds"),
        ({"order": 10**6}, "rows in the polynomial"),
        ({"threshold": True}, "threshold"),
        ({"outputs": "mass"}, r"list of different names. Got 'mass'"),
        ({"outputs": 3}, "list of different names"),
        ({"outputs": ["y", "y"]}, "list of different names"),
        ({"conditions": {"s": (0.0, math.inf)}}, "finite bounds"),
        ({"conditions": {"a": (0.0, 1.0)}}, "different names"),
        ({"parameters": None}, "parameters="),
        ({"parameters": [Parameter("a", low=0.0), B]}, r"both bounds.*\['a'\]"),
        ({"parameters": [A, A]}, "named once"),
        ({"executor": 2}, "executor"),
        ({"cache": "/nowhere/at/all.npz"}, "folder that exists"),
    ],
)
def test_bad_input(settings, message):
    function = Counted(cubic)
    with pytest.raises(DomainError, match=message):
        build(function, **settings)
    assert function.calls == 0


def test_bad_input_with_simulators(pool):
    with pytest.raises(DomainError, match="callable"):
        build(3.0)
    with pytest.raises(DomainError, match=r"among \['a'\]"):
        build(Simulator(cubic, [A]))
    with pytest.raises(DomainError, match="torch simulator"):
        build(Simulator(cubic, [A, B]), executor=pool)
    with pytest.raises(SimulatorError, match="top level of a module"):
        build(lambda x, p: 0.0, executor=pool)


def test_conditions_of_another_kind():
    surrogate, plain = build(cubic), build(lambda x, p: x * p["a"], conditions=(0, 1), parameters=[A])
    with pytest.raises(ShapeError, match="dict of conditions"):
        surrogate.at(torch.ones(3))
    with pytest.raises(ShapeError, match="'t'"):
        surrogate.at({"s": torch.ones(3)})
    with pytest.raises(ShapeError, match="plain tensor"):
        plain.at({"x": torch.ones(3)})


# --- files ---------------------------------------------------------------------------------------------


def test_save_and_load(tmp_path):
    for i, surrogate in enumerate(
        [
            build(two, nodes=[4, 5, 4, 4]),
            build(lambda x, p: x * p["a"], conditions=(0, 1), parameters=[A]),
            PolynomialSurrogate(torch.ones(1, 3), conditions={"q": (0, 1)}, parameters=[A], order=1),
        ]
    ):
        path = tmp_path / f"{i}.surrogate"
        surrogate.save(path)
        loaded = PolynomialSurrogate.load(path)
        assert torch.equal(loaded.coefficients, surrogate.coefficients)
        assert repr(loaded) == repr(surrogate)
        assert loaded.parameters == surrogate.parameters
        for name in ("conditions", "outputs", "order", "nodes", "degree"):
            assert getattr(loaded, name) == getattr(surrogate, name)
    assert len(os.listdir(tmp_path)) == 3


def test_a_value_for_each_run_is_refused_before_anything_is_computed_and_left_out_of_old_files(tmp_path):
    calls, each = [], Parameter("a", low=0.0, high=1.0, per_run=True)
    with pytest.raises(DomainError, match=r"Got per_run=True for \['a'\]"):
        build_surrogate(lambda x, p: calls.append(x), conditions=(0, 1), parameters=[each], order=2)
    assert not calls
    surrogate = build(lambda x, p: x * p["a"], conditions=(0, 1), parameters=[A])
    surrogate.parameters = (each,)  # as they once were
    surrogate.save(tmp_path / "s.npz")
    assert not PolynomialSurrogate.load(tmp_path / "s.npz").parameters[0].per_run


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(DomainError, match=r"folder that exists.*no folder '.*nowhere'"):
        build(cubic).save(tmp_path / "nowhere" / "s.npz")
    with pytest.raises(DomainError, match="name of a file"):
        build(cubic).save(tmp_path)
    assert os.listdir(tmp_path) == []


def test_files_that_are_something_else(tmp_path):
    path = tmp_path / "file.npz"
    with pytest.raises(FileNotFoundError):
        PolynomialSurrogate.load(path)
    np.savez(path, a=np.ones(3))
    with pytest.raises(DomainError, match="file of a surrogate"):
        PolynomialSurrogate.load(path)
    np.savez(path, header=np.array([{"kind": "a surrogate"}], dtype=object))
    with pytest.raises(DomainError, match="allow_pickle"):
        PolynomialSurrogate.load(path)
    path.unlink()
    build(smooth, cache=path)
    with pytest.raises(DomainError, match="torchcal evaluations"):
        PolynomialSurrogate.load(path)


def test_a_file_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "file.npz"
    build(cubic).save(path)
    before = path.read_bytes()

    def torn(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", torn)
    with pytest.raises(OSError, match="disk full"):
        build(smooth).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["file.npz"]


@pytest.mark.slow
def test_a_posterior_that_leaves_the_box_is_told_though_the_maximum_does_not():
    """The box is held against what predictions average over: the polynomial explodes where tanh does not."""
    x = torch.linspace(0, 1, 4, dtype=torch.float64)
    bent = Simulator(lambda x, p: torch.tanh(2 * p["a"]) * (1 + x), [Parameter("a", low=-1.0, high=1.0)])
    surrogate = build_surrogate(bent, conditions=(0.0, 1.0), order=9, progress=False)
    recording = Recording(x=x, y=0.1 * (1 + x))
    options = {"num_starts": 8, "num_warmup": 60, "seed": 0, "progress": False}
    for epsilon, told in ((0.1, False), (3.0, True)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = calibrate(surrogate, recording, likelihood=ABC(epsilon=epsilon), num_samples=200, **options)
        assert float((found.sample_parameters(2000, kind="map").abs() > 1).double().mean()) == 0
        texts = [str(one.message) for one in caught if one.category is ExtrapolationWarning]
        assert [("of the posterior of the parameters lies outside the box" in text) for text in texts] == [True] * told


@pytest.mark.parametrize(("noise", "told"), [(0.01, True), (1.0, False), (None, False)])
def test_a_diagnosis_is_told_that_a_surrogate_is_coarser_than_the_noise(noise, told):
    a = Parameter("a", low=0.5, high=2.0)
    with pytest.warns(SurrogateWarning, match="held-out"):
        surrogate = build_surrogate(
            lambda x, p: math.tanh(8 * p["a"] * x), conditions=(-1.0, 1.0), parameters=[a], order=4, progress=False
        )
    x = torch.linspace(-1, 1, 30, dtype=torch.float64)
    recording = Recording(x=x, y={"u": torch.tanh(8 * x)}, noise=noise)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        diagnose(surrogate, recording, holdout=False, num_starts=2, progress=False)
    texts = [str(w.message) for w in caught if w.category is SurrogateWarning]
    assert len(texts) == told
    assert all("large beside the noise" in text for text in texts)


def test_a_diagnosis_says_how_long_a_slow_simulation_will_take(monkeypatch):
    calls = []

    def begins_slowly(x, p):
        calls.append(1)
        time.sleep(0.3 if len(calls) == 1 else 0.0)
        return p["a"] * x

    x = torch.linspace(0, 1, 12, dtype=torch.float64)
    y = 2 * x + 0.1 * torch.sin(40 * x)
    with warnings.catch_warnings():  # what the first call takes is no measure
        warnings.simplefilter("error", TorchcalWarning)
        model, recording = ExternalSimulator(begins_slowly, [A]), Recording(x=x, y=y, noise=0.1)
        diagnose(model, recording, holdout=False, num_starts=2, progress=False)
    monkeypatch.setattr(trial, "LONG", 0.0)
    slow = ExternalSimulator(lambda x, p: p["a"] * x, [A])
    more = extend(slow, [Term("b", outputs={"y": lambda x, p, y: y + p["b"]}, parameters=[Parameter("b")])])
    with warnings.catch_warnings():  # it comes before the work begins, of which nothing is wanted here
        warnings.simplefilter("error", TorchcalWarning)
        with pytest.raises(TorchcalWarning, match=r"1,000 to 10,000 times: that is .* to .*build_surrogate.*executor="):
            diagnose(slow, Recording(x=x, y=y, noise=0.1), holdout=False, num_starts=2, progress=False)
        with pytest.raises(TorchcalWarning, match="1,000 to 10,000 times"):
            diagnose(more, Recording(x=x, y=y, noise=0.1), holdout=False, num_starts=2, progress=False)
    with warnings.catch_warnings():  # what is written in torch is evaluated in batches
        warnings.simplefilter("error", TorchcalWarning)
        diagnose(Simulator(lambda x, p: p["a"] * x, [A]), Recording(x=x, y=y, noise=0.1), holdout=False, progress=False)
    assert [trial._span(s) for s in (600.0, 9000.0, 4e5)] == ["10 min", "2 h", "5 days"]
