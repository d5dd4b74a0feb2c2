"""Seeds are arguments; the global random state is left as it was."""

import pyro
import torch

__all__ = ["preserve_random_state"]


class preserve_random_state:
    """Seed every random generator inside a ``with`` block and restore them all afterwards."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __enter__(self) -> None:
        self._state = pyro.util.get_rng_state()  # which leaves out the accelerators, though the seed is theirs too
        self._cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
        pyro.set_rng_seed(self.seed)

    def __exit__(self, *_: object) -> None:
        pyro.util.set_rng_state(self._state)
        if self._cuda:
            torch.cuda.set_rng_state_all(self._cuda)
