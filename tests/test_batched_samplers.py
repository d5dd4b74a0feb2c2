"""The batched samplers against exact targets: distributions, boundaries, kinks and other samplers."""

import math

import numpy as np
import pytest
import torch

from torchcal import Parameter, Recording, Simulator, calibrate, calibrate_additive
from torchcal.errors import ConvergenceError, InterruptionWarning
from torchcal.inference import batched, diagnostics, hmc_step, nuts_step, sampling
from torchcal.inference.arrays import Device, Host
from torchcal.inference.batched import run_batched
from torchcal.inference.bends import Bend
from torchcal.inference.coordinates import Laplace, Whitened, gathered
from torchcal.priors import Bounds

stats = pytest.importorskip("scipy.stats")

INF = math.inf
KERNELS = pytest.mark.parametrize("kernel", ["nuts", "hmc"])


def free(size):
    return Bounds(torch.full((size,), -INF, dtype=torch.float64), torch.full((size,), INF, dtype=torch.float64))


def run(log_density, size, transform=None, **options):
    factor = options.pop("scale_tril", torch.eye(size, dtype=torch.float64))
    defaults = {
        "modes": [Laplace(torch.zeros(size, dtype=torch.float64), factor)],
        "num_samples": 200,
        "num_chains": 32,
        "num_warmup": 60,
        "seed": 5,
    }
    return run_batched(log_density, transform or free(size), **{**defaults, **options})


def independent(draws, column):
    """Draws of one coordinate far enough apart to count as independent: tests of fit assume that they are."""
    ess = float(diagnostics.figures(draws).ess_bulk[column])
    every = max(1, math.ceil(2 * draws.shape[0] * draws.shape[1] / ess))
    return draws[:, ::every, column].flatten().numpy()


def test_checkpoint_tables_of_the_iterative_tree():
    tables = nuts_step.Tables.build(4, Host(0))
    closed = [row.nonzero()[0].tolist() for row in tables.check]
    # Leaf 7 = 0b111 closes the subtrees of sizes 2, 4 and 8; leaf 13 = 0b1101 closes one of size 2 only.
    assert closed[7] == [0, 1, 2]
    assert closed[13] == [2]
    # An even leaf closes nothing and opens a subtree, at a checkpoint that no open one needs; an odd one opens none.
    assert closed[::2] == [[]] * 8
    assert tables.slot[::2].tolist() == [0, 1, 1, 2, 1, 2, 2, 3]
    assert tables.slot[1::2].tolist() == [tables.depth] * 8


def test_leapfrog_conserves_energy_to_second_order():
    def potential(z):
        return 0.25 * (z**4).sum(-1) + 0.5 * (z**2).sum(-1), z**3 + z

    errors = []
    for step_size in (0.02, 0.01):
        arrays = Host(0)
        tables = nuts_step.Tables.build(10, arrays)
        state = nuts_step.init(np.ones((64, 2)), potential, step_size=step_size, tables=tables, arrays=arrays)
        start = state.start_energy
        state, _ = nuts_step.step(state, potential, step_size=step_size, tables=tables, arrays=arrays)
        position, momentum = state.cursor[:, :2], state.cursor[:, -2:]
        # After the first leaf the cursor is at an end of the tree or at a new subtree's start: use the moved ones.
        energy = potential(position)[0] + 0.5 * (momentum**2).sum(-1)
        errors.append(float(abs(energy - start).max()))
    # One leapfrog step errs by O(h^3).
    assert errors[0] / errors[1] == pytest.approx(8, rel=0.3)


class _Scripted(Device):
    """PyTorch's namespace with the random numbers of NumPy's."""

    def __init__(self, seed):
        super().__init__(seed, torch.device("cpu"))
        self.same = Host(seed)

    def normal(self, like):
        return torch.from_numpy(self.same.normal(like.numpy()))

    def uniform(self, shape, like):
        return torch.from_numpy(self.same.uniform(shape, like.numpy()))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@KERNELS
def test_both_namespaces_take_the_same_steps(kernel, dtype):
    """Of a density that ends, so that energies are infinite too."""
    bend = Bend(torch.tensor([[1.0], [0.0], [0.0]], dtype=dtype), torch.tensor([[0.0, 0.3, 0.1]], dtype=dtype))
    space = Whitened(
        lambda u: torch.where(u[:, 0] < 1.5, -0.25 * u.pow(4).sum(-1) - u.abs().sum(-1), -torch.inf),
        *(torch.zeros(3, dtype=dtype), torch.eye(3, dtype=dtype) + 0.2 * torch.ones(3, 3, dtype=dtype).tril(), bend),
    )
    begin = torch.zeros(8, 3, dtype=dtype)
    ends = []
    for arrays in (Host(0), _Scripted(0)):
        draws = []
        if kernel == "nuts":
            tables = nuts_step.Tables.build(5, arrays)
            state = nuts_step.init(arrays.take(begin), space.potential, step_size=0.6, tables=tables, arrays=arrays)
        else:
            state = hmc_step.init(arrays.take(begin), space.potential)
        for _ in range(40):
            if kernel == "nuts":
                state, out = nuts_step.step(state, space.potential, step_size=0.6, tables=tables, arrays=arrays)
            else:
                state, out = hmc_step.step(state, space.potential, step_size=0.6, length=1.6, arrays=arrays)
            assert out.position.dtype == torch.empty(0, dtype=dtype).numpy().dtype
            draws.append(np.concatenate([out.position[out.done].ravel(), out.accept[out.done]]))
        ends.append(np.concatenate(draws))
    assert len(ends[0]) > 100
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-9 if dtype == torch.float64 else 2e-3)


@pytest.mark.parametrize("arrays", [Host(0), Device(0, torch.device("cpu"))], ids=["NumPy", "PyTorch"])
@KERNELS
def test_a_chain_that_starts_where_the_density_is_nothing_leaves(kernel, arrays):
    def potential(z):
        xp, inside = arrays.xp, z[:, 0] < 0
        return xp.where(inside, 0.5 * (z * z).sum(-1), math.inf), xp.where(inside[:, None], z, 0.0)

    start = arrays.take(torch.full((4, 2), 0.01, dtype=torch.float64))
    tables = nuts_step.Tables.build(6, arrays)
    if kernel == "nuts":
        state = nuts_step.init(start, potential, step_size=0.3, tables=tables, arrays=arrays)
    else:
        state = hmc_step.init(start, potential)
    for _ in range(200):
        if kernel == "nuts":
            state, _ = nuts_step.step(state, potential, step_size=0.3, tables=tables, arrays=arrays)
        else:
            state, _ = hmc_step.step(state, potential, step_size=0.3, length=1.5, arrays=arrays)
    (ends,) = arrays.host(state.proposal[:, :2] if kernel == "nuts" else state.position)
    assert (ends[:, 0] < 0).all()


def test_momenta_are_not_the_starting_points_again():
    like = torch.zeros(8, 3, dtype=torch.float64)
    begin = torch.randn(8, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    assert not torch.equal(Device(4, torch.device("cpu")).normal(like), begin)


@KERNELS
def test_the_tensor_namespace_draws_what_the_density_is(kernel, monkeypatch):
    """That of accelerators, here on the CPU."""
    monkeypatch.setattr("torchcal.inference.batched.arrays_for", lambda device, seed: Device(seed, device))
    draws = run(lambda u: -0.5 * (u / torch.tensor([1.0, 3.0])).square().sum(-1), 2, num_samples=300, kernel=kernel)
    for i, sd in enumerate((1.0, 3.0)):
        assert stats.kstest(independent(draws.alpha, i), "norm", args=(0.0, sd)).pvalue > 1e-3


@KERNELS
def test_correlated_normal_in_the_wrong_coordinates(kernel):
    size = 5
    generator = torch.Generator().manual_seed(1)
    factor = torch.randn(size, size, dtype=torch.float64, generator=generator).tril() + 2 * torch.eye(size)
    precision = torch.linalg.inv(factor @ factor.T)
    mean = torch.arange(size, dtype=torch.float64)
    target = lambda u: -0.5 * ((u - mean) @ precision * (u - mean)).sum(-1)  # noqa: E731
    draws = run(target, size, num_warmup=150, kernel=kernel).alpha
    flat = draws.flatten(0, 1)
    ess = diagnostics.figures(draws).ess_bulk
    sd = (factor @ factor.T).diagonal().sqrt()
    # Five standard errors for five coordinates.
    assert bool(((flat.mean(0) - mean).abs() < 5 * sd / ess.sqrt()).all())
    assert float(diagnostics.figures(draws).r_hat.max()) < 1.03
    for i in range(size):
        p = stats.kstest(independent(draws, i), "norm", args=(float(mean[i]), float(sd[i]))).pvalue
        assert p > 1e-3


@pytest.mark.parametrize(
    ("name", "log_density", "distribution"),
    [
        ("student", lambda u: -3 * (1 + u.square() / 5).log().sum(-1), stats.t(5)),
        ("laplace", lambda u: -u.abs().sum(-1), stats.laplace()),
        ("logistic", lambda u: (-u - 2 * torch.nn.functional.softplus(-u)).sum(-1), stats.logistic()),
        # Two humps that a trajectory can cross.
        (
            "mixture",
            lambda u: torch.logaddexp(-0.5 * (u - 1.5).square(), -0.5 * (u + 1.5).square()).sum(-1),
            None,
        ),
    ],
)
@KERNELS
def test_shapes_that_are_not_normal(name, log_density, distribution, kernel):
    draws = run(log_density, 2, num_samples=400, kernel=kernel).alpha
    for i in range(2):
        sample = independent(draws, i)
        if distribution is not None:
            p = stats.kstest(sample, distribution.cdf).pvalue
        else:
            p = stats.kstest(
                sample, lambda v: 0.5 * (stats.norm.cdf(v, 1.5) + stats.norm.cdf(v, -1.5))
            ).pvalue
        assert p > 1e-3, name


@pytest.mark.parametrize(
    ("kernel", "low", "high"),
    [
        ("nuts", 0.0, INF),
        ("nuts", -0.2, 0.5),
        ("hmc", -INF, 0.3),
        ("hmc", -0.2, 0.5),
        pytest.param("nuts", -INF, 0.3, marks=pytest.mark.slow),
        pytest.param("hmc", 0.0, INF, marks=pytest.mark.slow),
    ],
)
def test_a_hard_boundary_cuts_the_density_and_nothing_else(kernel, low, high):
    transform = Bounds(torch.tensor([low], dtype=torch.float64), torch.tensor([high], dtype=torch.float64))

    def log_density(u):
        return -0.5 * transform.bound(u).square().sum(-1) + transform.log_slope(u)

    draws = run(log_density, 1, transform, num_samples=400, kernel=kernel).alpha
    assert float(draws.min()) >= low
    assert float(draws.max()) <= high
    exact = stats.truncnorm(low, high)
    assert stats.kstest(independent(draws, 0), exact.cdf).pvalue > 1e-3


@KERNELS
def test_the_kink_of_the_residual(kernel):
    """exp(-(σ - |μ|)² / 2ε²) has a concave kink in its exponent at μ = 0, between two humps."""
    sigma = 0.6

    def log_density(u):
        return (-0.5 * u.square() - 0.5 * (sigma - (u.square() + 1e-6).sqrt()).square() / 0.3**2).sum(-1)

    draws = run(log_density, 1, num_samples=400, kernel=kernel).alpha
    grid = np.linspace(-8, 8, 20001)
    density = np.exp(log_density(torch.tensor(grid)[:, None]).numpy())
    cdf = np.cumsum(density) / density.sum()
    assert stats.kstest(independent(draws, 0), lambda v: np.interp(v, grid, cdf)).pvalue > 1e-3


@KERNELS
def test_the_same_seed_gives_the_same_draws_and_leaves_the_global_state(kernel):
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    options = {"num_samples": 20, "num_chains": 3, "num_warmup": 20, "kernel": kernel}
    first = run(lambda u: -0.5 * u.square().sum(-1), 2, **options).alpha
    second = run(lambda u: -0.5 * u.square().sum(-1), 2, **options).alpha
    assert torch.equal(first, second)
    assert first.shape == (3, 20, 2)
    assert torch.equal(before, torch.random.get_rng_state())
    assert not torch.equal(first, run(lambda u: -0.5 * u.square().sum(-1), 2, **{**options, "seed": 4}).alpha)


def test_a_density_that_is_nowhere_finite():
    with pytest.raises(ConvergenceError, match="finite posterior"):
        run(lambda u: u.sum(-1) * math.nan, 2)


@KERNELS
def test_divergences_are_counted(kernel):
    """A wall that no slope announces: trajectories that meet it end there, and are counted."""

    def wall(u):
        return torch.where(u[..., 0] > 0.5, -math.inf, -0.5 * u.square().sum(-1))

    draws = run(wall, 2, num_samples=40, num_warmup=10, target_accept=0.8, kernel=kernel)
    assert draws.divergences > 0


@pytest.mark.slow
def test_draws_with_divergences_are_drawn_anew_with_smaller_steps():
    """A mild funnel: the warm-up, which is short, hardly meets its neck, and a long run does."""

    def funnel(u):
        neck = 0.6 * u[:, :1]
        return -0.5 * (u[:, 0].square() + ((u[:, 1:] * (-neck).exp()).square()).sum(-1)) - 3 * neck[:, 0]

    def total(**options):
        draws = run(funnel, 4, num_samples=300, num_chains=16, num_warmup=100, seed=0, **options)
        assert draws.alpha.shape == (16, 300, 4)
        return min(draws.divergences, 10)  # one chain that sticks is not the whole story

    assert total() < total(target_accept=0.8) / 3


@KERNELS
def test_r_hat_sees_separate_modes(kernel):
    def two(u):
        return torch.logaddexp(-0.5 * (u - 12).square(), -0.5 * (u + 12).square()).sum(-1)

    one = torch.eye(1, dtype=torch.float64)
    modes = [Laplace(12 * one[0], one, 0.5), Laplace(-12 * one[0], one, 0.5)]
    draws = run(two, 1, modes=modes, num_samples=100, num_chains=8, kernel=kernel).alpha
    assert float(diagnostics.figures(draws).r_hat[0]) > 1.5


def test_diagnostics_agree_with_arviz():
    arviz = pytest.importorskip("arviz")
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(4, 500, 3, dtype=torch.float64, generator=generator)
    draws = noise.clone()
    for i in range(1, 500):  # autoregressive chains, one of them shifted
        draws[:, i] = 0.7 * draws[:, i - 1] + noise[:, i]
    draws[0, :, 2] += 1.0
    for i in range(3):
        values = draws[:, :, i].numpy()
        assert float(diagnostics.figures(draws).r_hat[i]) == pytest.approx(float(arviz.rhat(values)), abs=2e-3)
        if i == 2:  # chains that disagree have next to no effective draws by either estimator
            assert float(diagnostics.figures(draws).ess_bulk[i]) < 150
            continue
        # The two estimators end the sum of autocorrelations by rules of their own.
        assert float(diagnostics.figures(draws).ess_bulk[i]) == pytest.approx(float(arviz.ess(values)), rel=0.1)
        tail = float(arviz.ess(values, method="tail"))
        assert float(diagnostics.figures(draws).ess_tail[i]) == pytest.approx(tail, rel=0.2)


def normal_with_factor(factor):
    precision = torch.linalg.inv(factor @ factor.T)
    return lambda u: -0.5 * (u @ precision * u).sum(-1)


@KERNELS
def test_chains_start_from_every_mode_with_its_weight_and_keep_to_widths_within_modes(kernel):
    """Two narrow humps 100 widths apart that hold 3/4 and 1/4."""
    def two(u):
        left, right = -0.5 * (u + 50).square().sum(-1), -0.5 * (u - 50).square().sum(-1)
        return torch.logaddexp(math.log(0.75) + left, math.log(0.25) + right)

    eye = torch.eye(2, dtype=torch.float64)
    modes = [Laplace(-50 * torch.ones(2, dtype=torch.float64), eye, 0.75)]
    modes.append(Laplace(50 * torch.ones(2, dtype=torch.float64), eye, 0.25))
    found = run_batched(
        two, free(2), modes=modes, num_samples=100, num_chains=16, num_warmup=60, seed=1, kernel=kernel
    ).alpha
    right = found[:, :, 0] > 0
    assert bool((right.all(1) | ~right.any(1)).all())
    assert int(right[:, 0].sum()) == 4
    within = found[~right[:, 0]] + 50
    ess = float(diagnostics.figures(within).ess_bulk.min())
    assert ess > 300  # 1200 draws; coordinates that were as wide as the gap would leave next to none
    assert abs(float(within.std()) - 1) < 5 / math.sqrt(2 * ess)


@KERNELS
def test_sampling_goes_on_until_there_is_enough(kernel):
    def enough(alpha, groups):
        assert groups.shape == (4,)
        sizes.append(alpha.shape[1])
        return 500 / (alpha.shape[0] * alpha.shape[1])

    sizes = []
    draws = run(
        lambda u: -0.5 * u.square().sum(-1), 2, num_samples=1000, num_chains=4, enough=enough, kernel=kernel
    ).alpha
    assert sizes[0] == 100
    assert sizes[-1] == draws.shape[1]
    assert 125 <= draws.shape[1] < 200
    sizes.clear()
    draws = run(
        lambda u: -0.5 * u.square().sum(-1), 2, num_samples=110, num_chains=4, enough=enough, kernel=kernel
    ).alpha
    assert draws.shape[1] == 110  # never more than num_samples


def test_sampling_gives_up_where_more_draws_do_not_help():
    draws = run(
        lambda u: -0.5 * u.square().sum(-1), 2, num_samples=100_000, num_chains=4, enough=lambda alpha, groups: 2.0
    ).alpha
    assert draws.shape[1] < 1000


def test_the_trajectory_length_is_that_of_the_density():
    """A quarter period in white coordinates; longer where one direction is 20 times as wide as the others."""
    def length(factor):
        eye = torch.eye(len(factor), dtype=torch.float64)
        space = Whitened(normal_with_factor(factor), 0 * eye[0], eye)
        generator = torch.Generator().manual_seed(0)
        z = torch.randn(64, len(factor), dtype=torch.float64, generator=generator) @ factor.T
        state = hmc_step.init(z.numpy(), space.potential)
        return hmc_step.tuned_length(
            state, space.potential, torch.zeros(64, dtype=torch.long), step_size=0.5, arrays=Host(0)
        )[0]

    white = length(torch.eye(5, dtype=torch.float64))
    assert 0.5 * hmc_step.QUARTER <= white <= 1.5 * hmc_step.QUARTER
    wide = length(torch.diag(torch.tensor([1, 1, 1, 1, 4], dtype=torch.float64)))
    assert wide > white


# --- starting points at bent ridges -------------------------------------------------------------------------


def bent(u):
    """A ridge of width 0.05 along a parabola: its normal approximation at (0, 0) knows nothing of the bend."""
    along, off = u[..., 0], u[..., 1] - u[..., 0].square()
    return -0.5 * along.square() - 0.5 * (off / 0.05).square() - 0.5 * u[..., 2:].square().sum(-1)


def test_starting_points_far_up_the_slopes_are_gathered():
    space = Whitened(bent, torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64))
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(64, 3, dtype=torch.float64, generator=generator)
    groups, lowest = torch.zeros(64, dtype=torch.long), torch.zeros(64, dtype=torch.float64)
    assert float(space.height(z).median()) > 100
    other, there = gathered(space, z, groups, lowest, generator)
    # Half a chi-square of three: its median is 1.2, and 99 % lie below 5.7. The points need not have settled.
    assert float(other.height(there).median()) < 4
    assert float((other.height(there) < 15).double().mean()) > 0.9
    torch.testing.assert_close(other.height(there), space.height(space.inner(other.outer(there))))


def test_starting_points_of_a_good_approximation_stay():
    unit = torch.zeros(5, dtype=torch.float64), torch.eye(5, dtype=torch.float64)
    space = Whitened(lambda u: -0.5 * u.square().sum(-1), *unit)
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(64, 5, dtype=torch.float64, generator=generator)
    same = gathered(space, z, torch.zeros(64, dtype=torch.long), torch.zeros(64, dtype=torch.float64), generator)
    assert same[0] is space
    assert same[1] is z


def test_gathering_keeps_a_distribution_and_the_modes_apart():
    def two(u):
        return torch.logaddexp(-0.5 * (u - 50).square().sum(-1), -0.5 * (u + 50).square().sum(-1))

    space = Whitened(two, torch.zeros(2, dtype=torch.float64), torch.eye(2, dtype=torch.float64))
    generator = torch.Generator().manual_seed(1)
    groups = torch.arange(400) % 2
    z = torch.randn(400, 2, dtype=torch.float64, generator=generator) + torch.where(groups == 0, 50.0, -50.0)[:, None]
    z[:60] += 30.0  # enough far ones that all are moved
    other, there = gathered(space, z, groups, torch.zeros(400, dtype=torch.float64), generator)
    u = other.outer(there)
    assert bool(((u.mean(1) > 0) == (groups == 0)).all())
    spread = u - torch.where(groups == 0, 50.0, -50.0)[:, None]
    p = stats.kstest(spread.flatten().numpy(), stats.norm.cdf).pvalue
    assert p > 1e-3


def test_a_bent_ridge_is_sampled_right_from_a_bad_approximation():
    wide = torch.diag(torch.tensor([1.0, 0.5, 1.0], dtype=torch.float64))
    count = []

    def counted(u):
        count.append(len(u))
        return bent(u)

    draws = run(counted, 3, scale_tril=wide, kernel="hmc", num_samples=150).alpha
    along, across = draws[:, :, 0], (draws[:, :, 1] - draws[:, :, 0].square()) / 0.05
    error = 5 / math.sqrt(float(diagnostics.figures(draws).ess_bulk.min()))
    assert float(along.mean()) == pytest.approx(0.0, abs=error)
    assert float(across.var()) == pytest.approx(1.0, abs=0.15)
    # Without gathering some 2.7 million evaluations.
    assert sum(count) < 1_800_000


def test_gathering_in_single_precision_finds_a_long_and_narrow_ridge():
    turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])

    def ridge(u):
        v = u @ turn
        return -0.5 * (v[..., 0] / 20).square() - 0.5 * (v[..., 1] / 0.02).square() - 0.5 * v[..., 2].square()

    space = Whitened(ridge, torch.zeros(3), torch.eye(3))
    generator = torch.Generator().manual_seed(2)
    z = torch.randn(64, 3, generator=generator)
    other, there = gathered(space, z, torch.zeros(64, dtype=torch.long), torch.zeros(64), generator)
    assert there.dtype == torch.float32
    assert bool(torch.isfinite(there).all())
    assert float(other.height(there).median()) < 6


def test_those_left_behind_begin_where_others_of_their_mode_are():
    def both(u):
        near = -0.5 * (u - 100).square().sum(-1)
        return torch.logaddexp(near, bent(u))

    space = Whitened(both, torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64))
    generator = torch.Generator().manual_seed(0)
    groups = (torch.arange(64) % 10 >= 7).long()
    z = torch.randn(64, 3, dtype=torch.float64, generator=generator) + torch.where(groups == 0, 100.0, 0.0)[:, None]
    other, there = gathered(space, z, groups, torch.zeros(64, dtype=torch.float64), generator)
    assert bool((other.height(there) < 15).all())
    assert bool(((other.outer(there).mean(1) > 50) == (groups == 0)).all())


def test_points_that_are_alone_in_their_modes_stay():
    space = Whitened(bent, torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64))
    generator = torch.Generator().manual_seed(0)
    z = 5 * torch.randn(8, 3, dtype=torch.float64, generator=generator)
    other, there = gathered(space, z, torch.arange(8), torch.zeros(8, dtype=torch.float64), generator)
    assert other is space
    torch.testing.assert_close(there, z, rtol=0, atol=0)


@pytest.mark.parametrize("function", [calibrate, calibrate_additive])
@pytest.mark.parametrize("sampler", ["nuts", "pyro"])
def test_a_calibration_that_is_interrupted_before_it_draws_keeps_its_maximum(function, sampler, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    x = torch.linspace(0, 1, 8, dtype=torch.float64)
    line = Simulator(lambda x, p: p["a"] * x, [Parameter("a")])
    recording = Recording(x=x, y=2 * x + 0.1 * torch.sin(9 * x))
    want = function(line, recording, num_samples=0, seed=0, progress=False)
    monkeypatch.setattr(sampling, "run_batched", interrupted)
    monkeypatch.setattr(sampling, "_draw_with_pyro", interrupted)
    with pytest.warns(InterruptionWarning, match="maximum alone"):
        found = function(line, recording, sampler=sampler, seed=0, progress=False)
    assert found.samples is None
    assert torch.equal(found.map.alpha, want.map.alpha)


@pytest.mark.parametrize("drawn", [0, 8])
def test_an_interrupted_sampler_keeps_its_draws_and_ends_where_there_are_none(drawn, monkeypatch):
    sample = batched._sample

    def interrupted(moves, state, space, step_size, collector, num_samples, enough, bar, *, whatever):
        if drawn:
            sample(moves, state, space, step_size, collector, drawn, None, bar, whatever=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(batched, "_sample", interrupted)
    if drawn:
        with pytest.warns(InterruptionWarning, match="keeps 8 of 200 draws"):
            found = run(lambda z: -0.5 * z.square().sum(-1), 2, num_chains=4)
        assert found.alpha.shape[1] == drawn
    else:
        with pytest.raises(KeyboardInterrupt):
            run(lambda z: -0.5 * z.square().sum(-1), 2, num_chains=4)
