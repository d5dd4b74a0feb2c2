"""Posteriors of `calibrate` that are known: simulation-based calibration, and exact targets on a grid.

Where a likelihood is a generative model, parameters are drawn from the prior, data from the likelihood, and the rank of
the parameters among the posterior's draws is uniform (Talts, Betancourt, Simpson, Vehtari & Gelman 2018,
arXiv:1804.06788). The ABC likelihood generates no data: its posterior of two coefficients is integrated on a grid.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal import likelihoods, models, priors
from torchcal.errors import ConvergenceWarning, IdentifiabilityWarning, ToleranceWarning
from torchcal.inference import diagnostics

stats = pytest.importorskip("scipy.stats")

ALPHA = 1e-3
"""Chance that one test fails though the posterior is right; shared out among what it looks at."""

CHAINS = 63
"""One draw of each is taken, so that draws are independent; the rank is one of 64."""

SMALL = 32
"""Trials of the small version. `test_ranks_tell_a_wrong_posterior` says what that many can see."""


# --- simulation-based calibration ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Family:
    """A calibration whose data can be drawn.

    Parameters have two bounds, so that their coordinates do not depend on the data, and simulators are polynomials of
    known degree, so that neither does the quadrature.
    """

    simulator: tc.Simulator
    x: torch.Tensor
    likelihood: likelihoods.Likelihood
    prior: Callable[[tc.NISP], priors.CoefficientPrior]
    noise: float
    draw: Callable[["Family", tc.NISP, torch.Tensor], torch.Tensor]


def marginal_normals(family, module, alpha):
    mean, variance = module.moments(alpha)
    return mean + (variance + family.noise**2).sqrt() * torch.randn(mean.shape, dtype=torch.float64)


def kernels(family, module, alpha):
    """Each datum from a kernel of its own around one of the fixed samples."""
    count = family.likelihood.num_samples
    samples = module.outputs_at(alpha, module.draw_germ(count, seed=0))
    chosen = samples.gather(0, torch.randint(count, (1, samples.shape[1])))[0]
    variance = samples.var(0) * (4 / (3 * count)) ** 0.4 + family.likelihood.floor**2 + family.noise**2
    return chosen + variance.sqrt() * torch.randn(chosen.shape, dtype=torch.float64)


def joint_kernels(family, module, alpha):
    """All data from one kernel around one of the fixed samples."""
    count = family.likelihood.num_samples
    samples = module.outputs_at(alpha, module.draw_germ(count, seed=0))
    n = samples.shape[1]
    covariance = torch.cov(samples.T) * (4 / (count * (n + 2))) ** (2 / (n + 4))
    covariance = covariance + (family.likelihood.floor**2 + family.noise**2) * torch.eye(n)
    factor = torch.linalg.cholesky(covariance)
    return samples[torch.randint(count, ())] + factor @ torch.randn(n, dtype=torch.float64)


ONE = tc.Simulator(lambda x, p: p["a"] * x + 0.1 * p["a"] ** 2, [tc.Parameter("a", low=-3.0, high=3.0)], degree=2)
TWO = tc.Simulator(
    lambda x, p: p["a"] + p["b"] * x + 0.1 * p["a"] * p["b"],
    [tc.Parameter("a", low=-2.0, high=2.0), tc.Parameter("b", low=-1.0, high=3.0)],
    degree=2,
)
FIVE = torch.linspace(0.4, 1.6, 5, dtype=torch.float64)

FAMILIES = {
    "normal marginals": Family(
        ONE, FIVE, likelihoods.GaussianMarginal(), lambda m: priors.Normal(m, scale=0.4), 0.5, marginal_normals
    ),
    "normal marginals of two parameters": Family(
        TWO, FIVE, likelihoods.GaussianMarginal(), lambda m: priors.Uniform(m, spread=0.6), 0.4, marginal_normals
    ),
    "kernel marginals": Family(
        ONE,
        FIVE,
        likelihoods.Marginal(num_samples=32, floor=0.05),
        lambda m: priors.Uniform(m, spread=0.7),
        0.5,
        kernels,
    ),
    "joint kernels": Family(
        TWO,
        torch.tensor([0.5, 1.5], dtype=torch.float64),
        likelihoods.Full(num_samples=32, floor=0.05),
        lambda m: priors.Normal(m, scale=0.4),
        0.4,
        joint_kernels,
    ),
}


def quietly(function, *arguments, **options):
    """With the warnings off that few draws of each chain, a wide tolerance, or a truth at its bound cause."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.simplefilter("ignore", ToleranceWarning)
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        return function(*arguments, **options)


def quantities(family, module, y, alpha):
    """What is ranked, ``(S, K)``: E[λ], Cov[λ], and how well α fits. Reversing a germ changes none of it."""
    mean, covariance = module.parameter_moments(alpha)
    row, column = torch.tril_indices(*covariance.shape[-2:])
    columns = [mean, covariance[..., row, column]]
    if family.likelihood.needs == "moments":  # the fixed samples of the others are not symmetric in ξ
        noise = torch.full_like(y, family.noise)
        columns.append(models.log_likelihood(alpha, y, module, family.likelihood, noise=noise)[..., None])
    return torch.cat(columns, dim=-1)


def replicate(family, seed, num_samples=5, num_warmup=30):
    """Ranks of the true quantities among the posterior's, ``(K,)``, from 0 to the number of chains."""
    module = tc.NISP(family.simulator, tc.embeddings.Gaussian(), family.x)
    torch.manual_seed(seed)
    truth = family.prior(module).sample()
    y = family.draw(family, module, truth)
    result = quietly(
        tc.calibrate,
        family.simulator,
        tc.Recording(x=family.x, y=y, noise=family.noise),
        likelihood=family.likelihood,
        prior=family.prior,
        num_samples=num_samples,
        num_chains=CHAINS,
        num_warmup=num_warmup,
        num_starts=4,
        seed=seed,
    )
    draws = result.samples[:, -1]
    return (quantities(family, module, y, draws) < quantities(family, module, y, truth)).sum(0)


def additive_replicate(seed):
    """With flat λ and ln σ a linear model's posterior has the pivots of t and χ²: ranks are uniform at any truth."""
    torch.manual_seed(seed)
    a, b, log_sigma = torch.tensor([1.0, 2.0, -1.0], dtype=torch.float64)
    x = torch.linspace(-1, 1, 7, dtype=torch.float64)
    y = a + b * x + log_sigma.exp() * torch.randn(7, dtype=torch.float64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    recording = tc.Recording(x=x, y=y)
    options = {"num_samples": 5, "num_chains": CHAINS, "num_warmup": 30, "num_starts": 4, "seed": seed}
    result = quietly(tc.calibrate_additive, line, recording, **options)
    last = result.samples[:, -1]
    draws = torch.cat([result.propagate.scaling.physical(last[:, :-1]), last[:, -1:]], dim=-1)
    return (draws < torch.stack([a, b, log_sigma])).sum(0)


def check_uniform(ranks, *, bins=8, level=ALPHA):
    """χ² of the ranks in bins; and mean and variance of their normal scores, which see a shift or a wrong width."""
    trials, count = ranks.shape
    grid = torch.arange(CHAINS + 1, dtype=torch.float64)
    scores_of = torch.special.ndtri((grid + 0.5) / (CHAINS + 1))
    second, fourth = float(scores_of.square().mean()), float(scores_of.pow(4).mean())
    bound = stats.norm.isf(level / (3 * count) / 2)
    for column in range(count):
        found = np.bincount(ranks[:, column].numpy() * bins // (CHAINS + 1), minlength=bins)
        p = stats.chisquare(found).pvalue
        assert p > level / (3 * count), f"quantity {column}: p = {p:.2g}, {found}"
        scores = scores_of[ranks[:, column]]
        assert abs(float(scores.mean())) < bound * math.sqrt(second / trials), f"quantity {column}: shifted"
        spread = math.sqrt((fourth - second**2) / trials)
        assert abs(float(scores.square().mean()) - second) < bound * spread, f"quantity {column}: of wrong width"


def test_ranks_are_uniform_small():
    # From a nearly normal posterior's Laplace approximation a dozen transitions lead anywhere.
    ranks = [replicate(FAMILIES["normal marginals"], seed, num_samples=3, num_warmup=12) for seed in range(SMALL)]
    check_uniform(torch.stack(ranks), bins=4)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_ranks_are_uniform(name):
    check_uniform(torch.stack([replicate(FAMILIES[name], 1000 + seed) for seed in range(200)]), bins=16)


@pytest.mark.slow
def test_ranks_of_the_additive_model_are_uniform():
    check_uniform(torch.stack([additive_replicate(seed) for seed in range(200)]), bins=16)


@pytest.mark.parametrize(
    ("shift", "width", "words"),
    [(0.0, 1.0, None), (1.0, 1.0, "quantity 0"), (0.0, 2.5, "quantity 0"), (0.0, 0.4, "quantity 0")],
)
def test_ranks_tell_a_wrong_posterior(shift, width, words):
    """The test of the test, with as many trials as its small version: N(μ, 1) from one datum."""
    truth, draws = torch.randn(SMALL, 1, dtype=torch.float64), torch.randn(SMALL, CHAINS, dtype=torch.float64)
    ranks = (shift + width * draws < truth).sum(-1, keepdim=True)
    if words is None:
        check_uniform(ranks, bins=4)
        return
    with pytest.raises(AssertionError, match=words):
        check_uniform(ranks, bins=4)


# --- exact targets on a grid ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    """One parameter a with f = a x, embedded to first order: a is normal with mean m and sd ``|s|``.

    Attributes:
        y: Data.
        epsilon: Tolerance.
        x: Conditions; 1, 2, … by default.
        gamma: Ratio.
        low: Lower bound of the parameter.
        high: Upper bound.
        prior: Prior of α.
        wall: Largest ``|s|`` under the prior, in scaled coordinates.
        reach: Half the width of the grid where there is no wall, in physical units.
    """

    y: tuple[float, ...]
    epsilon: float
    x: tuple[float, ...] = ()
    gamma: float = 1.0
    low: float | None = None
    high: float | None = None
    prior: Callable[[tc.NISP], priors.CoefficientPrior] = priors.Flat
    wall: float = math.inf
    reach: float = 6.0

    @property
    def conditions(self):
        return np.array(self.x or range(1, len(self.y) + 1), dtype=float)

    def calibrate(self, **options):
        simulator = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a", low=self.low, high=self.high)], degree=1)
        return quietly(
            tc.calibrate,
            simulator,
            tc.Recording(x=self.conditions, y=np.array(self.y)),
            likelihood=likelihoods.ABC(epsilon=self.epsilon, gamma=self.gamma),
            prior=self.prior,
            **{"num_samples": 100, "num_chains": 32, "num_warmup": 60, "num_starts": 8, "seed": 5, **options},
        )

    def log_density(self, m, s):
        """Eq. 24 with μ = m x and σ = ``|s|`` x, without any rounding of its kink."""
        total = 0.0
        for x, y in zip(self.conditions, self.y, strict=True):
            residual = np.abs(m * x - y)
            total = total - 0.5 * (residual**2 + (np.abs(s) * x - self.gamma * residual) ** 2) / self.epsilon**2
        return total

    def marginals(self, scale, count=1200):
        """Distribution functions of m and ``|s|`` by the midpoint rule, whose cells are far below either sd."""
        center = float(np.dot(self.conditions, self.y) / np.square(self.conditions).sum())
        left = center - self.reach if self.low is None else self.low
        right = center + self.reach if self.high is None else self.high
        most = min(self.wall * scale, self.gamma * self.reach + self.reach)
        edges_m, edges_s = np.linspace(left, right, count + 1), np.linspace(0.0, most, count + 1)
        m, s = 0.5 * (edges_m[1:] + edges_m[:-1]), 0.5 * (edges_s[1:] + edges_s[:-1])
        density = self.log_density(m[:, None], s[None, :])
        density = np.exp(density - density.max())
        functions = []
        for edges, weights in ((edges_m, density.sum(1)), (edges_s, density.sum(0))):
            cdf = np.concatenate([[0.0], np.cumsum(weights)]) / weights.sum()
            functions.append(lambda v, edges=edges, cdf=cdf: np.interp(v, edges, cdf))
        return functions


TARGETS = {
    "inside": Target(y=(0.7, 2.6, 2.4, 4.9), epsilon=0.4),
    "a prior that is a box": Target(
        y=(0.7, 2.6, 2.4, 4.9),
        epsilon=0.4,
        low=-1.0,
        high=3.0,
        prior=lambda m: priors.Uniform(m, spread=0.12),
        wall=0.12,
    ),
    # The mean wants to be 1.1, and the wall is at 1.
    "the mode on the upper wall": Target(
        y=(1.0, 2.3, 3.4), epsilon=0.5, low=-1.0, high=1.0, prior=lambda m: priors.Uniform(m, spread=0.5), wall=0.5
    ),
    "the mode on the lower wall": Target(y=(-0.2, 0.1, -0.3), epsilon=0.6, low=0.0),
    "the mode far outside": Target(y=(-1.0, -1.5), epsilon=0.8, low=0.0),
    "a wall above": Target(y=(0.2, 0.5), epsilon=0.7, high=0.1),
    # One datum, given twice with an ε larger by √2, as a recording has two at least: the posterior is four arms
    # s = ± γ |m − y| that meet at the kink.
    "the kink, ratio 1": Target(y=(1.0, 1.0), x=(1.0, 1.0), epsilon=0.5 * math.sqrt(2)),
    "the kink, ratio 4": Target(y=(1.0, 1.0), x=(1.0, 1.0), epsilon=0.5 * math.sqrt(2), gamma=4.0),
    "two kinks": Target(y=(1.0, 1.0), epsilon=0.3, gamma=3.0),
}


@pytest.mark.filterwarnings("ignore:The best density has")
@pytest.mark.parametrize(
    ("name", "sampler"),
    [(name, "nuts") for name in TARGETS] + [("the mode on the upper wall", "hmc"), ("the kink, ratio 4", "hmc")],
)
def test_draws_have_the_gridded_marginals(name, sampler):
    target = TARGETS[name]
    result = target.calibrate(sampler=sampler)
    scaling = result.propagate.scaling
    scale = float(scaling.scale)
    m = scaling.physical(result.samples[..., :1])
    draws = torch.cat([m, scale * result.samples[..., 1:].abs()], dim=-1)
    assert target.low is None or float(m.min()) >= target.low
    assert target.high is None or float(m.max()) <= target.high
    assert float(result.samples[..., 1].abs().max()) <= target.wall
    sizes = diagnostics.figures(draws).ess_bulk
    assert float(sizes.min()) > 200
    for column, cdf in enumerate(target.marginals(scale)):
        every = math.ceil(2 * draws[..., column].numel() / float(sizes[column]))
        sample = draws[:, ::every, column].flatten().numpy()
        p = stats.kstest(sample, cdf).pvalue
        assert p > ALPHA / 2, f"{'ms'[column]}: p = {p:.2g} of {len(sample)}"


def test_both_sides_of_the_kink_have_the_same_mass():
    target = TARGETS["the kink, ratio 4"]
    result = target.calibrate()
    m = result.propagate.scaling.physical(result.samples[..., :1])[..., 0]
    above = (m > target.y[0]).to(torch.float64)
    # Chains that stay on their side have an R-hat of 2. These have some ten effective draws each, which leaves 1.05.
    assert float(diagnostics.figures(m[..., None]).r_hat[0]) < 1.2
    size = float(diagnostics.figures(above[..., None]).ess_bulk[0])
    assert abs(float(above.mean()) - 0.5) < 4 * 0.5 / math.sqrt(size)
    # On the kink itself there is no hole: a stretch of a tenth around it has the mass that the grid says.
    near = float(((m - target.y[0]).abs() < 0.05).to(torch.float64).mean())
    cdf = target.marginals(float(result.propagate.scaling.scale))[0]
    expected = float(cdf(target.y[0] + 0.05) - cdf(target.y[0] - 0.05))
    assert abs(near - expected) < 4 * math.sqrt(expected / size)
