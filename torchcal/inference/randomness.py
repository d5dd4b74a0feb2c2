"""Seeds are arguments; the global random state is left as it was."""

import os
import threading

import pyro
import torch

__all__ = ["preserve_random_state"]


class preserve_random_state:
    """Seed every random generator inside a ``with`` block and restore them all afterwards.

    The generators, and Pyro's stack of handlers, are the process's own: threads take turns.
    """

    _turn = threading.RLock()

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __enter__(self) -> None:
        self._mine = type(self)._turn
        self._mine.acquire()
        self._state = pyro.util.get_rng_state()  # which leaves out the accelerators, though the seed is theirs too
        self._cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
        try:
            pyro.set_rng_seed(self.seed)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        try:
            pyro.util.set_rng_state(self._state)
            if self._cuda:
                torch.cuda.set_rng_state_all(self._cuda)
        finally:
            self._mine.release()


def _begin_free() -> None:
    preserve_random_state._turn = threading.RLock()


if hasattr(os, "register_at_fork"):  # a child has none of the threads that may hold it
    os.register_at_fork(after_in_child=_begin_free)
