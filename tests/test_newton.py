"""The batched minimiser: known minima, saddles, kinks, and batches of starts."""

import math

import pytest
import torch

from torchcal.inference.newton import gradient, hessian, minimise

F64 = torch.float64


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def rosenbrock(u):
    return (100 * (u[..., 1:] - u[..., :-1] ** 2) ** 2 + (1 - u[..., :-1]) ** 2).sum(-1)


def quadratic(size, condition, seed=0):
    q = torch.linalg.qr(draw(size, size, seed=seed))[0]
    matrix = q @ torch.diag(torch.logspace(0, math.log10(condition), size, dtype=F64)) @ q.T
    center = draw(size, seed=seed + 1)

    def objective(u):
        offset = u - center
        return 0.5 * torch.einsum("...i,ij,...j->...", offset, matrix, offset) - 3.0

    return objective, center, matrix


@pytest.mark.parametrize("size", [1, 2, 7])
@pytest.mark.parametrize("condition", [1.0, 1e4, 1e8])
def test_a_quadratic_takes_a_few_steps(size, condition):
    objective, center, _ = quadratic(size, condition)
    found = minimise(objective, draw(4, size, seed=9))
    # An objective good to 1e-10 leaves sqrt(2e-10) along the flattest direction, whose curvature is one.
    torch.testing.assert_close(found.points[0], center, rtol=0, atol=2e-5)
    assert float(found.values[0]) == pytest.approx(-3.0, abs=1e-9)
    assert found.iterations < 12


@pytest.mark.parametrize("size", [2, 4])
def test_rosenbrock_from_many_starts(size):
    found = minimise(rosenbrock, 2 * draw(16, size))
    assert float(found.values[0]) == pytest.approx(0.0, abs=1e-9)
    # The valley's curvature is about 0.4 per unit: values good to 1e-9 leave 1e-4.
    torch.testing.assert_close(found.points[0], torch.ones(size, dtype=F64), rtol=0, atol=2e-4)
    if size == 2:  # with more dimensions it has a second minimum
        assert float(found.values[-1]) == pytest.approx(0.0, abs=1e-8)


def test_results_come_best_first_and_belong_together():
    found = minimise(rosenbrock, 2 * draw(16, 4))
    assert (found.values.diff() >= 0).all()
    torch.testing.assert_close(rosenbrock(found.points), found.values, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("start", [(0.0, 0.0), (0.5, 0.0), (0.0, 1e-12), (1e-9, 0.0)])
def test_a_saddle_is_left(start):
    """u² + (v² − 1)²: the origin is a saddle, with no gradient along v where a germ's column would be zero."""

    def objective(w):
        return w[..., 0] ** 2 + (w[..., 1] ** 2 - 1) ** 2

    found = minimise(objective, torch.tensor([start], dtype=F64))
    assert float(found.values[0]) == pytest.approx(0.0, abs=1e-9)
    assert float(found.points[0, 1].abs()) == pytest.approx(1.0, abs=1e-4)


def test_two_basins_are_both_kept():
    def objective(w):
        return (w[..., 0] ** 2 - 1) ** 2 + 0.3 * w[..., 0]

    found = minimise(objective, torch.tensor([[-2.0], [-0.9], [0.9], [2.0]], dtype=F64))
    left = [w for w in found.points[:, 0].tolist() if w < 0]
    right = [w for w in found.points[:, 0].tolist() if w > 0]
    assert len(left) + len(right) == 4
    assert left
    assert right
    assert found.points[0, 0] < 0  # the lower one
    for w in left + right:
        assert 4 * w**3 - 4 * w + 0.3 == pytest.approx(0.0, abs=1e-4)


def test_a_kink_rounded_at_a_thousandth_is_followed():
    """The shape of the ABC objective: a narrow valley along σ = |r|."""
    delta, epsilon = 1e-4, 0.1

    def objective(w):
        r, s = w[..., 0], w[..., 1]
        return ((r - 0.5) ** 2 + (s - (r**2 + delta**2).sqrt()) ** 2) / (2 * epsilon**2) + 0.1 * r**2

    found = minimise(objective, 3 * draw(8, 2))
    expected = 0.5 * (1 / epsilon**2) / (1 / epsilon**2 + 0.2)
    assert float(found.points[0, 0]) == pytest.approx(expected, abs=1e-4)
    assert float(found.points[0, 1].abs()) == pytest.approx(expected, abs=1e-4)


def test_each_start_of_a_batch_goes_its_own_way():
    objective, _, _ = quadratic(3, 100.0)
    starts = torch.cat([draw(5, 3), torch.full((1, 3), math.nan, dtype=F64)])
    found = minimise(lambda u: torch.where(u.isnan().any(-1), math.nan, objective(u)), starts)
    assert found.points.shape == (6, 3)
    torch.testing.assert_close(found.values[:5], torch.full((5,), -3.0, dtype=F64), rtol=0, atol=1e-8)
    assert found.values[5] == math.inf


def test_walls_of_infinity_and_nan_are_not_crossed():
    def objective(u):
        value = (u[..., 0] - 0.5) ** 2 + u[..., 1] ** 2
        return torch.where(u[..., 0] > 2, torch.nan, torch.where(u[..., 1] > 3, torch.inf, value)) - u.log().sum(-1)

    found = minimise(objective, torch.tensor([[1.9, 2.9], [0.01, 0.01], [1.0, 1.0]], dtype=F64))
    assert torch.isfinite(found.values).all()
    torch.testing.assert_close(found.values, found.values[:1].expand(3), rtol=1e-7, atol=1e-7)


def test_nothing_finite_is_reported_as_such():
    found = minimise(lambda u: u.sum(-1) * math.nan, draw(3, 2))
    assert (found.values == math.inf).all()


def test_starts_are_left_as_they_were():
    starts = draw(3, 2)
    before = starts.clone()
    minimise(rosenbrock, starts)
    torch.testing.assert_close(starts, before, rtol=0, atol=0)


def test_more_iterations_are_not_taken_than_allowed():
    calls = []
    start = torch.tensor([[-1.2, 1.0]], dtype=F64)
    found = minimise(rosenbrock, start, max_iterations=2, progress=lambda i, v: calls.append(i))
    assert found.iterations <= 2
    assert calls == [1, 2]


def test_a_flat_objective_ends_at_once():
    found = minimise(lambda u: 0 * u.sum(-1) + 2.0, draw(3, 2))
    assert (found.values == 2.0).all()
    assert found.iterations < 10


def test_objectives_of_any_size_reach_their_minimum():
    for factor in (1e-3, 1.0, 1e6, 1e12):
        found = minimise(lambda u, f=factor: f * rosenbrock(u), draw(8, 2))
        assert float(found.values[0]) / factor < 1e-9 * max(1.0, 1 / factor)


# --- derivatives ----------------------------------------------------------------------------------


def test_gradient_and_hessian_of_a_quadratic():
    objective, center, matrix = quadratic(4, 1e3)
    points = draw(5, 4)
    values, slopes = gradient(objective, points)
    torch.testing.assert_close(values, objective(points), rtol=0, atol=0)
    torch.testing.assert_close(slopes, (points - center) @ matrix, rtol=1e-11, atol=1e-10)
    # Differences over 2e-5 of gradients good to 1e-13 of 1e3.
    torch.testing.assert_close(hessian(objective, points), matrix.expand(5, 4, 4), rtol=0, atol=1e-4)


def test_hessian_agrees_with_autograd():
    points = draw(3, 3)
    expected = torch.stack([torch.autograd.functional.hessian(rosenbrock, p) for p in points])
    # Central differences over 1e-5: an error of h²/6 times the fourth derivative (2400), and rounding of 1e-8.
    torch.testing.assert_close(hessian(rosenbrock, points), expected, rtol=1e-6, atol=1e-5)


def test_what_is_not_finite_has_no_gradient():
    values, slopes = gradient(lambda u: u.log().sum(-1), torch.tensor([[-1.0], [0.0], [2.0]], dtype=F64))
    assert values[0] == math.inf
    assert (slopes[:2] == 0).all()
    assert slopes[2, 0] == 0.5


def test_minima_of_one_height_are_kept_apart_where_their_places_count():
    """A double well: whichever start is ahead by a rounding error, the other well is found too."""

    def wells(u):
        return (u[..., 0] ** 2 - 1).square() + u[..., 1].square()

    starts = torch.tensor([[0.6, 0.3], [-0.6, 0.3], [0.6, -0.3], [-0.6, -0.3]], dtype=torch.float64)
    joined = minimise(wells, starts)
    assert len(joined.points[:, 0].sign().unique()) == 1
    apart = minimise(wells, starts, places=torch.tensor([0]))
    assert sorted(apart.points[:, 0].round(decimals=6).tolist()) == [-1.0, -1.0, 1.0, 1.0]
