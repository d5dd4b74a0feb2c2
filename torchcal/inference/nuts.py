"""The reference sampler: Pyro's No-U-Turn Sampler on the Pyro model, in coordinates whitened at the mode."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from pyro.infer import MCMC, NUTS
from torch import Tensor
from tqdm.auto import tqdm

from torchcal.display import PATIENCE
from torchcal.errors import InterruptionWarning, warn
from torchcal.inference.draws import Draws
from torchcal.inference.randomness import preserve_random_state
from torchcal.priors import CoefficientPrior

__all__ = ["run_nuts"]


def run_nuts(
    model: Callable[..., None],
    arguments: tuple[Any, ...],
    prior: CoefficientPrior,
    *,
    num_samples: int,
    num_chains: int,
    num_warmup: int,
    seed: int,
    target_accept: float,
    max_tree_depth: int = 10,
    progress: bool = False,
) -> Draws:
    """Draw from a model whose one latent site is ``"alpha"``.

    Args:
        model: A Pyro model.
        arguments: What it is called with.
        prior: The whitened prior inside the arguments: its coordinates are the sampler's.
        num_samples: Draws a chain.
        num_chains: Chains, one after another, begun around the mode.
        num_warmup: Draws thrown away while step size and metric adapt.
        seed: Chain c is seeded with ``seed + c``; the global state is restored.
        target_accept: Mean acceptance that the step size aims at.
        max_tree_depth: Largest depth of a trajectory, 2**depth steps.
        progress: Whether to show a bar.

    An interruption keeps the chains that are finished, or the unfinished first one, with a warning.
    """
    chains: list[Tensor] = []
    divergences = 0
    transform = prior.transform
    size = prior.low.shape[0]
    total = num_chains * (num_warmup + num_samples)
    bar = tqdm(total=total, desc="NUTS", disable=not progress, delay=PATIENCE, leave=False)
    current: list[Tensor] = []

    def hook(_kernel: NUTS, state: dict[str, Tensor], stage: str, _index: int) -> None:
        bar.update(1)
        if not stage.startswith("Warmup"):
            current.append(state["alpha"].detach().clone())

    interrupted = False
    try:
        for chain in range(num_chains):
            current.clear()
            # Seeds that follow each other shall not share chains.
            own = int(np.random.SeedSequence([seed, chain]).generate_state(1)[0])
            with preserve_random_state(own):
                start = 0.3 * torch.randn(size, dtype=prior.low.dtype, device=prior.low.device)
                kernel = NUTS(
                    model, full_mass=True, target_accept_prob=target_accept, max_tree_depth=max_tree_depth
                )
                mcmc = MCMC(
                    kernel,
                    num_samples=num_samples,
                    warmup_steps=num_warmup,
                    initial_params={"alpha": start},
                    disable_progbar=True,
                    hook_fn=hook,
                )
                mcmc.run(*arguments)
                if num_samples >= 4:  # Pyro judges no shorter chain
                    divergences += sum(len(found) for found in mcmc.diagnostics()["divergences"].values())
            chains.append(transform(torch.stack(current)))
    except KeyboardInterrupt:
        interrupted = True
        if not chains and len(current) >= 4:
            chains.append(transform(torch.stack(current)))
        if not chains:
            raise
    finally:
        bar.close()
    if interrupted:
        warn(
            f"The sampler was interrupted. It keeps {len(chains)} of {num_chains} chains with "
            f"{len(chains[0])} draws.",
            InterruptionWarning,
        )
    return Draws(torch.stack(chains).detach().to(device="cpu", dtype=torch.float64), divergences)
