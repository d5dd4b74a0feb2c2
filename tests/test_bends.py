"""Straightened ridges: what is found in draws, what the maps do to volumes and gradients, what sampling gains."""

import math

import pytest
import torch

from torchcal.inference import bends, diagnostics
from torchcal.inference.batched import run_batched
from torchcal.inference.coordinates import Laplace, Whitened
from torchcal.priors import Bounds

stats = pytest.importorskip("scipy.stats")


def white(draws):
    draws = draws - draws.mean(0)
    factor = torch.linalg.cholesky(draws.T @ draws / len(draws))
    return torch.linalg.solve_triangular(factor, draws.T, upper=False).T


def turned(draws, generator):
    size = draws.shape[1]
    return draws @ torch.linalg.qr(torch.randn(size, size, dtype=torch.float64, generator=generator)).Q


def found_in(draws, chains=None):
    """With every draw of a chain of its own where nothing else is said."""
    return bends.found_in(draws, torch.arange(len(draws)) if chains is None else chains)


def parabola(count, size, width, generator):
    """One direction follows the square of another, both turned out of the axes."""
    draws = torch.randn(count, size, dtype=torch.float64, generator=generator)
    draws[:, 0] = width * draws[:, 0] + draws[:, 1].square()
    return turned(draws, generator)


def two_drivers(count, generator):
    draws = torch.randn(count, 6, dtype=torch.float64, generator=generator)
    draws[:, 0] = 0.2 * draws[:, 0] + draws[:, 1].square() - draws[:, 2].square()
    draws[:, 3] = 0.3 * draws[:, 3] + draws[:, 1] * draws[:, 2]
    return turned(draws, generator)


@pytest.mark.parametrize("size", [2, 5, 12])
def test_a_parabola_is_straightened_whichever_way_it_lies(size):
    generator = torch.Generator().manual_seed(size)
    draws = white(parabola(600, size, 0.2, generator))
    bend, volume = found_in(draws)
    assert bend.drivers.shape == (size, 1)
    straight = draws - bend.shift(draws)
    # Of the variance 0.04 + 2 of one direction 0.04 is left: a squared volume of 0.02, 7 sd of 600 draws about it.
    assert volume == pytest.approx(float(straight.T.cov().logdet()), abs=0.02 * size)
    assert volume == pytest.approx(math.log(0.04 / 2.04), abs=7 * math.sqrt(2 / 600))
    assert float(straight.pow(4).mean(0).div(straight.square().mean(0).square()).max()) < 5  # 3 for normal ones


def test_two_drivers_and_their_product():
    generator = torch.Generator().manual_seed(1)
    draws = white(two_drivers(900, generator))
    bend, volume = found_in(draws)
    assert bend.drivers.shape == (6, 2)
    assert bend.shifts.shape == (3, 6)
    # No shift moves a driver.
    assert float((bend.shifts @ bend.drivers).abs().max()) < 1e-8
    expected = math.log(0.04 / 4.04) + math.log(0.09 / 1.09)
    assert volume == pytest.approx(expected, abs=7 * math.sqrt(4 / 900))


@pytest.mark.parametrize("size", [1, 2, *(pytest.param(size, marks=pytest.mark.slow) for size in (5, 14))])
def test_what_is_not_bent_is_left_alone(size):
    """Normal draws, skew ones and ones with heavy tails, as few as are looked at, 20 times each."""
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        draws = torch.randn(bends.DRAWS * size, size, dtype=torch.float64, generator=generator)
        waits = -torch.rand(draws.shape, dtype=torch.float64, generator=generator).log()
        heavy, cauchy = draws / waits.sqrt()[:, :1], draws / torch.randn(draws.shape, generator=generator).double()
        for sample in (draws, turned(-waits.log(), generator), heavy, cauchy):
            assert found_in(white(sample)) is None


@pytest.mark.parametrize("size", [2, 5, 14])
def test_chains_that_hardly_move_are_not_bent(size):
    """A correlation of 0.99 from draw to draw: as many places as chains."""
    for seed in range(10 if size < 14 else 3):
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(40 * size // 64 + 9, 64, size, dtype=torch.float64, generator=generator)
        draws = [noise[0]]
        for new in noise[1:]:
            draws.append(0.99 * draws[-1] + math.sqrt(1 - 0.99**2) * new)
        assert found_in(white(torch.cat(draws)), torch.arange(64).repeat(len(draws))) is None


def test_few_draws_say_nothing_of_bends():
    generator = torch.Generator().manual_seed(0)
    stuck = white(torch.randn(8, 3, dtype=torch.float64, generator=generator)).repeat(100, 1)  # as many as chains
    assert found_in(stuck) is None
    assert found_in(white(parabola(190, 5, 0.2, generator))) is None


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_maps_are_inverse_keep_volumes_and_pull_gradients_back(dtype):
    generator = torch.Generator().manual_seed(2)
    eye = torch.eye(6, dtype=dtype)
    factor = eye + 0.2 * torch.ones(6, 6, dtype=dtype).tril(-1)
    space = Whitened(lambda u: -(u.square() * u.exp()).sum(-1), 0.3 * eye[0], factor)
    draws = space.inner(two_drivers(900, generator).to(dtype))
    bent = space.refined(draws, torch.zeros(900, dtype=torch.long), torch.arange(900))
    assert bent.bend is not None
    assert bent.scale_tril.dtype == bent.bend.drivers.dtype == dtype
    z = torch.randn(20, 6, generator=generator, dtype=torch.float64).to(dtype)
    tolerance = {"atol": 1e-10, "rtol": 1e-10} if dtype == torch.float64 else {"atol": 2e-4, "rtol": 2e-4}
    torch.testing.assert_close(bent.inner(bent.outer(z)), z, **tolerance)
    torch.testing.assert_close(bent.outer(z.reshape(4, 5, 6)).reshape(20, 6), bent.outer(z))
    jacobian = torch.func.vmap(torch.func.jacrev(lambda v: bent.outer(v[None])[0]))(z)
    volume = torch.linalg.slogdet(jacobian).logabsdet
    torch.testing.assert_close(volume, bent.scale_tril.diagonal().log().sum().expand(20), **tolerance)
    energy, slope = bent.potential(z)
    leaf = z.clone().requires_grad_(True)
    value = -bent.log_density(bent.outer(leaf))
    (expected,) = torch.autograd.grad(value.sum(), leaf)
    torch.testing.assert_close(energy, value.detach())
    torch.testing.assert_close(slope, expected, **tolerance)
    # The draws are nearly white there, and refining again goes on from what is known.
    again = bent.refined(bent.inner(space.outer(draws)), torch.zeros(900, dtype=torch.long), torch.arange(900))
    covariance = again.inner(space.outer(draws)).double().T.cov()
    assert float((covariance - torch.eye(6)).abs().max()) < 0.03
    assert again.bend is not None


def banana(u, width=0.05):
    along, off = u[..., 0], u[..., 1] - u[..., 0].square()
    return -0.5 * along.square() - 0.5 * (off / width).square() - 0.5 * u[..., 2:].square().sum(-1)


def free(size):
    bound = torch.full((size,), math.inf, dtype=torch.float64)
    return Bounds(-bound, bound)


@pytest.mark.parametrize("kernel", [pytest.param("nuts", marks=pytest.mark.slow), "hmc"])
def test_a_bent_ridge_takes_few_gradients_and_keeps_its_distribution(kernel, monkeypatch):
    def run(log_density, num_samples):
        count = 0

        def counted(u):
            nonlocal count
            count += len(u)
            return log_density(u)

        modes = [Laplace(torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64))]
        draws = run_batched(
            counted, free(3), modes=modes, num_samples=num_samples, num_chains=16, num_warmup=60, seed=1, kernel=kernel
        ).alpha
        return draws, diagnostics.figures(draws).least_ess / count

    draws, rate = run(banana, 250)
    along, across = draws[..., 0], (draws[..., 1] - draws[..., 0].square()) / 0.05
    assert float(diagnostics.figures(draws).r_hat.max()) < 1.02
    for values in (along, across, draws[..., 2]):
        ess = float(diagnostics.figures(values[..., None]).ess_bulk[0])
        every = max(1, math.ceil(2 * values.numel() / ess))
        assert stats.kstest(values[:, ::every].flatten().numpy(), "norm").pvalue > 1e-3
    monkeypatch.setattr("torchcal.inference.coordinates.found_in", lambda z, chains: None)
    assert rate > 3 * run(banana, 10)[1]


def test_several_maxima_on_one_ridge_are_seen_as_one():
    """Maxima at both ends of a parabola: about each alone there is no bend to be seen, and together there is."""
    generator = torch.Generator().manual_seed(0)
    along = torch.randn(800, dtype=torch.float64, generator=generator)
    along = torch.cat([along[:400] - 1.5, along[400:] + 1.5])
    draws = torch.randn(800, 3, dtype=torch.float64, generator=generator)
    draws[:, 0], draws[:, 1] = along, 0.1 * draws[:, 1] + along.square()
    space = Whitened(banana, torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64))
    groups = torch.arange(800) // 400
    assert space.refined(draws, groups, torch.arange(800)).bend is not None
    # Two humps far apart are no ridge: widths stay those within each.
    far = torch.randn(800, 3, dtype=torch.float64, generator=generator) + 50 * (groups[:, None] - 0.5)
    apart = space.refined(far, groups, torch.arange(800))
    assert apart.bend is None
    assert float(apart.scale_tril.diagonal().max()) < 1.2
