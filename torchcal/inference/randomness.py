"""Seeds are arguments; the global random state is left as it was."""

import pyro

__all__ = ["preserve_random_state"]


class preserve_random_state:
    """Seed every random generator inside a ``with`` block and restore them all afterwards."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __enter__(self) -> None:
        self._state = pyro.util.get_rng_state()
        pyro.set_rng_seed(self.seed)

    def __exit__(self, *_: object) -> None:
        pyro.util.set_rng_state(self._state)
