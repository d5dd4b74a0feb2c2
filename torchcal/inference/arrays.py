"""What the samplers' bookkeeping is done with: NumPy beside a density on the CPU, PyTorch on an accelerator.

Chains are some hundreds of numbers. An operation on so few costs its call and not its work, and a call of NumPy costs a
third of one of PyTorch. The namespaces agree in the names that samplers use, so that these are written once.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["Array", "Arrays", "Device", "Host", "Potential", "arrays_for"]

Array = Any
"""A NumPy array or a tensor."""

Potential = Callable[[Array], tuple[Array, Array]]
"""``z (C, P) -> (U (C,), dU/dz (C, P))``, the negative log-density; +inf with a zero gradient where undefined."""


class Arrays(ABC):
    """A namespace of array functions, with random numbers of its own.

    Attributes:
        xp: The module: `numpy` or `torch`.
    """

    xp: Any

    @abstractmethod
    def take(self, tensor: Tensor) -> Array:
        """A tensor as an array."""

    @abstractmethod
    def give(self, array: Array) -> Tensor:
        """An array as a tensor, where it is."""

    @abstractmethod
    def host(self, *arrays: Array) -> tuple[np.ndarray, ...]:
        """Arrays of as many rows each in NumPy."""

    @abstractmethod
    def table(self, values: Sequence[Any]) -> Array:
        """Whole numbers or truth values."""

    @abstractmethod
    def normal(self, like: Array) -> Array:
        """Standard normal numbers of the shape and dtype of an array."""

    @abstractmethod
    def uniform(self, shape: Sequence[int], like: Array) -> Array:
        """Numbers in [0, 1) of the dtype of an array."""


class Host(Arrays):
    """NumPy's."""

    xp = np

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def take(self, tensor: Tensor) -> np.ndarray:
        """The same memory."""
        return tensor.detach().numpy()

    def give(self, array: np.ndarray) -> Tensor:
        """The same memory."""
        return torch.as_tensor(array)

    def host(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        """Themselves."""
        return arrays

    def table(self, values: Sequence[Any]) -> np.ndarray:
        """An array."""
        return np.array(values)

    def normal(self, like: np.ndarray) -> np.ndarray:
        """Drawn from this namespace's generator."""
        return self._random.standard_normal(like.shape, dtype=like.dtype)

    def uniform(self, shape: Sequence[int], like: np.ndarray) -> np.ndarray:
        """Drawn from this namespace's generator."""
        return self._random.random(tuple(shape), dtype=like.dtype)


class Device(Arrays):
    """PyTorch's, on one device."""

    xp = torch

    def __init__(self, seed: int, device: torch.device) -> None:
        self._device = device
        # Other numbers than those of starting points with the same seed, of which some generators take 32 bits alone.
        self._generator = torch.Generator(device=device).manual_seed(seed ^ 2**31)

    def take(self, tensor: Tensor) -> Tensor:
        """On the device."""
        return tensor.detach().to(self._device)

    def give(self, array: Tensor) -> Tensor:
        """Itself: ``as_tensor`` would fetch it within ``torch.device("cpu")``."""
        return array

    def host(self, *arrays: Tensor) -> tuple[np.ndarray, ...]:
        """Brought from the device in one copy, since each one waits for all that is under way."""
        kind = next((array.dtype for array in arrays if array.is_floating_point()), torch.float64)
        packed = torch.cat([array.reshape(len(array), -1).to(kind) for array in arrays], dim=1).cpu()
        parts = packed.split([array[0].numel() for array in arrays], dim=1)
        return tuple(part.reshape(a.shape).to(a.dtype).numpy() for part, a in zip(parts, arrays, strict=True))

    def table(self, values: Sequence[Any]) -> Tensor:
        """On the device."""
        return torch.tensor(values, device=self._device)

    def normal(self, like: Tensor) -> Tensor:
        """Drawn on the device."""
        return torch.randn(like.shape, dtype=like.dtype, device=self._device, generator=self._generator)

    def uniform(self, shape: Sequence[int], like: Tensor) -> Tensor:
        """Drawn on the device."""
        return torch.rand(shape, dtype=like.dtype, device=self._device, generator=self._generator)


def arrays_for(device: torch.device, seed: int) -> Arrays:
    """Those that are fastest beside a density on a device."""
    return Host(seed) if device.type == "cpu" else Device(seed, device)
