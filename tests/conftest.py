"""Settings that every test runs under."""

import os
import random
from collections.abc import Iterator

import matplotlib
import numpy as np
import pytest
import torch

matplotlib.use("Agg")

# The tensors of the tests are small: more threads only get in the way of the other workers.
if "OMP_NUM_THREADS" not in os.environ:
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _isolated() -> Iterator[None]:
    """Start from the same random state, and leave no figure, Pyro parameter or default dtype behind."""
    import matplotlib.pyplot as plt
    import pyro

    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - third-party code draws from the global state
    torch.manual_seed(0)
    pyro.clear_param_store()
    yield
    plt.close("all")
    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    assert dtype == torch.float32, f"the test changed the global default dtype to {dtype}"
