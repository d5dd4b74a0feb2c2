"""The samplers, each as its own users would run it, and each at its best.

A sampler is a function of a link to the judge, the folder of the posteriors, the posterior's name and options. It
imports what it needs, starts the clock, and gives draws of α until the judge has enough.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.sampling.density import Arrays, boxed, unbounded
from benchmarks.sampling.link import Enough, Link

Sampler = Callable[..., None]


# --- torchcal and Pyro -----------------------------------------------------------------------------------------


def torchcal(link: Link, folder: Path, name: str, *, goal: int, chains: int | None = None, sampler: str = "") -> None:
    """`calibrate` from beginning to end, with everything that it does beside sampling."""
    from benchmarks.sampling import posteriors

    posterior = posteriors.make(name, folder)
    options: dict[str, Any] = {"target_ess": goal}
    if sampler:
        options["sampler"] = sampler
    if chains is not None:
        options["num_chains"] = chains
    link.start()
    result = posterior.calibrate(**options)
    link.give(result.samples.numpy(), divergences=result.diagnostics.divergences, whole=True)


def pyro_nuts(link: Link, folder: Path, name: str, *, whitened: bool, jit: bool = False, warmup: int = 300) -> None:
    """Pyro's NUTS on torchcal's Pyro model: by its own defaults, or in coordinates whitened at the maximum."""
    import torch
    from pyro.infer import MCMC, NUTS
    from pyro.util import set_rng_seed

    from benchmarks.sampling import posteriors
    from torchcal import models

    posterior = posteriors.make(name, folder)
    if not whitened:  # its scaling comes from a fit; that is not the sampler's to pay for
        problem = posteriors.problem_of(posterior.calibrate(num_samples=0))
    set_rng_seed(1)
    link.start()
    prior, start = None, None
    if whitened:
        problem, loc, scale_tril = posteriors.normal_approximation(posterior.calibrate(num_samples=0))
        prior = problem.prior.whitened(loc, scale_tril)
        start = {"alpha": 0.3 * torch.randn_like(loc)}
    prior = problem.prior if prior is None else prior
    fresh: list[torch.Tensor] = []
    wanted = 100

    def hook(kernel: NUTS, state: dict[str, torch.Tensor], stage: str, _index: int) -> None:
        nonlocal wanted
        if stage.startswith("Warmup"):
            return
        link.warmed()
        fresh.append(state["alpha"].detach().clone())
        if len(fresh) >= wanted:
            alpha = prior.transform(torch.stack(fresh))
            fresh.clear()
            wanted = link.give(alpha[None].numpy(), divergences=len(kernel._divergences))

    kernel = NUTS(models.embedded, full_mass=whitened, jit_compile=jit, ignore_jit_warnings=jit)
    mcmc = MCMC(
        kernel, num_samples=10**7, warmup_steps=warmup, initial_params=start, disable_progbar=True, hook_fn=hook
    )
    mcmc.run(problem.y, problem.propagate, problem.likelihood, prior)


# --- NumPyro ---------------------------------------------------------------------------------------------------


def numpyro_nuts(
    link: Link, folder: Path, name: str, *, chains: int, whitened: bool, warmup: int, block: int, seed: int = 0
) -> None:
    """NumPyro's NUTS with a full mass matrix in float64; chains start from the normal approximation.

    Its kernel runs in one compiled loop of ``block`` transitions for warm-up and draws alike, so that nothing is
    compiled twice. Several chains are vectorised, as by ``chain_method="vectorized"``.
    """
    import jax
    import jax.numpy as jnp
    from numpyro.infer import NUTS

    jax.config.update("jax_enable_x64", True)
    arrays = Arrays.load(folder / f"{name}.npz")
    link.start()
    bound, value = unbounded(arrays, jnp)
    loc, factor = jnp.asarray(arrays.loc), jnp.asarray(arrays.scale_tril)
    key, other = jax.random.split(jax.random.PRNGKey(seed))
    start = jax.random.normal(other, (chains, len(loc)))
    if whitened:
        outer = lambda z: loc + z @ factor.T  # noqa: E731
    else:
        start, outer = loc + start @ factor.T, lambda z: z
    kernel = NUTS(potential_fn=lambda z: -value(outer(z)), dense_mass=True)
    keys = jax.random.split(key, chains) if chains > 1 else key
    # Compiled as a whole, which takes a third of the time that its many small pieces would.
    state = jax.jit(lambda keys, z: kernel.init(keys, warmup, z, (), {}))(keys, start if chains > 1 else start[0])

    def one(state: Any, _: None) -> tuple[Any, tuple[Any, Any]]:
        state = kernel.sample(state, (), {})
        return state, (bound(outer(state.z)), state.diverging)

    run = jax.jit(lambda state: jax.lax.scan(one, state, None, length=block))
    for _ in range(-(-warmup // block)):
        state, _ = run(state)
    jax.block_until_ready(state)
    link.warmed()
    more, divergences = block, 0
    while True:
        parts = []
        for _ in range(-(-more // block)):
            state, (alpha, diverging) = run(state)
            divergences += int(np.asarray(diverging).sum())
            parts.append(np.asarray(alpha))
        draws = np.concatenate(parts)
        draws = draws.swapaxes(0, 1) if chains > 1 else draws[None]
        more = link.give(draws, divergences=divergences)


# --- gradient-free ---------------------------------------------------------------------------------------------


def pytuq_amcmc(link: Link, folder: Path, name: str, *, tuned: bool) -> None:
    """PyTUQ's adaptive Metropolis, from the maximum: by its defaults, or with the best proposal that is known."""
    from pytuq.minf.mcmc import AMCMC

    arrays = Arrays.load(folder / f"{name}.npz")
    np.random.seed(1)  # noqa: NPY002 - PyTUQ draws from the global state
    link.start()
    size = len(arrays.map)
    fresh: list[np.ndarray] = []
    wanted, done, warmup = 5000, 0, 3000

    class Recording(AMCMC):
        """Hands the chain over while it runs."""

        def sampler(self, current: np.ndarray, imcmc: int) -> Any:
            nonlocal wanted, done
            done += 1
            if done == warmup:
                link.warmed()
            if done > warmup:
                fresh.append(current)
                if len(fresh) >= wanted:
                    block = np.array(fresh)[None]
                    fresh.clear()
                    wanted = link.give(block)
            return super().sampler(current, imcmc)

    if tuned:
        spread = _covariance(arrays)
        chain = Recording(cov_ini=2.38**2 / size * spread, gamma=1.0, t0=1000, tadapt=1000)
    else:
        chain = Recording()
    chain.setLogPost(boxed(arrays), None)
    with np.errstate(all="ignore"):
        chain.run(10**9, arrays.map)


def emcee_ensemble(link: Link, folder: Path, name: str, *, walkers: int = 64, moves: str = "stretch") -> None:
    """emcee's ensemble, all walkers of a half in one call, from draws of the normal approximation."""
    import emcee

    arrays = Arrays.load(folder / f"{name}.npz")
    rng = np.random.default_rng(1)
    link.start()
    bound, _ = unbounded(arrays)
    start = bound(arrays.loc + rng.standard_normal((walkers, len(arrays.loc))) @ arrays.scale_tril.T)
    chosen = None
    if moves == "differential":  # the mixture that its documentation advises where the stretch move is slow
        chosen = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(walkers, len(arrays.map), boxed(arrays), moves=chosen, vectorize=True)
    state = sampler.run_mcmc(start, 200, store=False)
    link.warmed()
    more = 100
    while True:
        sampler.reset()
        state = sampler.run_mcmc(state, more)
        more = link.give(sampler.get_chain().swapaxes(0, 1))


def _covariance(arrays: Arrays) -> np.ndarray:
    """Of the normal approximation in α."""
    bound, _ = unbounded(arrays)
    slope = np.diag((bound(arrays.loc + 1e-6) - bound(arrays.loc - 1e-6)) / 2e-6)
    factor = slope @ arrays.scale_tril
    return factor @ factor.T


# --- what runs -------------------------------------------------------------------------------------------------

#: Name: function, options, module that has to be there, whether it is handed torchcal's maximum and curvature.
SAMPLERS: dict[str, tuple[Sampler, dict[str, Any], str, bool]] = {
    "torchcal": (torchcal, {}, "torchcal", False),
    "torchcal-nuts": (torchcal, {"sampler": "nuts"}, "torchcal", False),
    "torchcal-hmc": (torchcal, {"sampler": "hmc"}, "torchcal", False),
    "pyro": (pyro_nuts, {"whitened": False}, "pyro", False),
    "pyro-whitened": (pyro_nuts, {"whitened": True}, "pyro", False),
    "pyro-whitened-jit": (pyro_nuts, {"whitened": True, "jit": True}, "pyro", False),
    "numpyro": (numpyro_nuts, {"chains": 1, "whitened": False, "warmup": 500, "block": 100}, "numpyro", True),
    "numpyro-16": (numpyro_nuts, {"chains": 16, "whitened": False, "warmup": 500, "block": 50}, "numpyro", True),
    "numpyro-whitened": (numpyro_nuts, {"chains": 1, "whitened": True, "warmup": 200, "block": 100}, "numpyro", True),
    "numpyro-whitened-16": (
        numpyro_nuts, {"chains": 16, "whitened": True, "warmup": 200, "block": 50}, "numpyro", True,
    ),
    "numpyro-whitened-64": (
        numpyro_nuts, {"chains": 64, "whitened": True, "warmup": 200, "block": 25}, "numpyro", True,
    ),
    "pytuq": (pytuq_amcmc, {"tuned": False}, "pytuq", True),
    "pytuq-tuned": (pytuq_amcmc, {"tuned": True}, "pytuq", True),
    "emcee": (emcee_ensemble, {}, "emcee", True),
    "emcee-differential": (emcee_ensemble, {"moves": "differential"}, "emcee", True),
}  # fmt: skip


def run(link: Link, folder: Path, sampler: str, posterior: str, **options: Any) -> None:
    """One sampler on one posterior, until the judge has enough."""
    function, settings, _, _ = SAMPLERS[sampler]
    try:
        function(link, folder, posterior, **{**settings, **options})
    except Enough:
        pass
