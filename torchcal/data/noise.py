"""The sd of measurement noise, in the ways a user may give it."""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchcal.data.arrays import to_tensor, unit_of
from torchcal.errors import DomainError, RecordingError, ShapeError

__all__ = ["noise_sd"]


def noise_sd(noise: Any, outputs: tuple[str, ...], n: int, units: Mapping[str, str]) -> Tensor | str | None:
    """None, "none", or the sd of every output value ``(n_total,)``, from what the user gave."""
    if noise is None:
        return None
    if isinstance(noise, str):
        if noise != "none":
            raise RecordingError(
                f'Expected noise: None (unknown), "none" (there is none), or the sd. Got {noise!r} '
                '(noise="none" is how to say that there is none).'
            )
        return "none"
    total = n * len(outputs)
    if is_dict := isinstance(noise, Mapping):
        _check_noise_names(noise, outputs)
    parts = []
    for i, name in enumerate(outputs):
        label = f"noise[{name!r}]" if is_dict else "noise"
        value = noise[name] if is_dict else noise
        if unit_of(value) is not None and name not in units:
            raise RecordingError(
                f"Expected a known unit of output {name!r}, because {label} has one. Got none (give units=)."
            )
        sd, _ = to_tensor(value, label, units.get(name), difference=True)
        shapes = [(), (n,)] if is_dict else [(), (n,), (total,)]
        if tuple(sd.shape) not in shapes:
            wanted = f"a number or shape ({n},)" + ("" if is_dict or total == n else f" or ({total},)")
            raise ShapeError(
                f"Expected {label}: {wanted}. Got shape {tuple(sd.shape)} "
                "(one sd for all, one per condition, or a dict from output names to sd)."
            )
        bad = ~((sd > 0) & torch.isfinite(sd))
        if bad.any():
            index = int(bad.reshape(-1).nonzero()[0])
            where = f" at index {index}" if sd.ndim else ""
            raise DomainError(
                f"Expected {label} as finite sd > 0. Got {sd.reshape(-1)[index].item()}{where} "
                '(noise="none" is how to say that there is none; leave noise out if it is unknown).'
            )
        parts.append(sd[i * n : (i + 1) * n] if sd.shape == (total,) else sd.expand(n))
    return torch.cat(parts)


def _check_noise_names(names: Iterable[Any], outputs: tuple[str, ...]) -> None:
    if set(names) != set(outputs):
        raise RecordingError(
            f"Expected noise for exactly the outputs {list(outputs)}. Got {list(names)} "
            "(give an sd for each; noise that is known for some outputs only is not supported)."
        )
