"""The predictive density of an output at one condition."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchcal.data import Recording
from torchcal.errors import DomainError, ShapeError
from torchcal.plots import style
from torchcal.plots.densities import curve
from torchcal.plots.selection import conditions_of, output_part
from torchcal.propagation import NISP

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["output_density"]


def output_density(
    samples: Tensor | NISP | Mapping[str, Tensor],
    index: int = 0,
    *,
    alpha: Tensor | Mapping[str, Tensor] | None = None,
    recording: Recording | None = None,
    output: str | int | None = None,
    datum: float | None = None,
    unit: str | None = None,
    num: int = 20_000,
    seed: int = 0,
    ax: "Axes | None" = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    """Density of one output at one condition, with the datum marked.

    An output without spread is drawn as the vertical line that it is.

    Args:
        samples: Draws of the outputs, ``(S, n_total)`` or ``(S,)``; or a dict from labels to such draws; or a
            propagation, whose outputs are drawn at ``alpha``.
        index: Number of the condition, from 0.
        alpha: For a propagation: α ``(P,)``, or draws of it ``(S, P)``, or a dict from labels to them.
        recording: Gives the datum at this condition, and the units.
        output: The output, where there are several.
        datum: The datum, in place of the recording's.
        unit: The output's unit, in place of the recording's.
        num: Draws of the output from a propagation.
        seed: Of those.
        ax: Where to draw; a new figure by default.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If the condition or output does not exist, or ``alpha`` is missing or not wanted.
        ShapeError: If sizes disagree.

    Source: Sargsyan, Najm & Ghanem (2015), Eqs. 25-27 and 31.
    """
    if isinstance(index, bool) or not isinstance(index, int):
        raise DomainError(f"Expected index: the number of a condition. Got {index!r}.")
    if recording is not None and not isinstance(recording, Recording):
        raise DomainError(f"Expected recording: a Recording or None. Got {type(recording).__name__}.")
    groups, n, x = _groups(samples, alpha, recording, num, seed)
    if not 0 <= index < n:
        raise DomainError(f"Expected index of a condition from 0 to {n - 1}. Got {index}.")
    units = {**(recording.units if recording is not None else {})}
    name, columns = "y", {}
    for key, draws in groups.items():
        number, name = output_part(draws.shape[1], n, recording, output)
        columns[key] = draws[:, number * n + index]
    if unit is not None:
        units[name] = unit
    noise = None
    if recording is not None and datum is None and bool(recording.observed[number * n + index]):
        datum = float(recording.y[number * n + index])
        noise = None if recording.noise_sd is None else float(recording.noise_sd[number * n + index])
    ax = style.new_axes(ax, (4.4, 3.2))
    for i, (key, values) in enumerate(columns.items()):
        color, dashes = _look(key, i)
        found = curve(values)
        if found is None:
            ax.axvline(float(values.mean()), color=color, ls=dashes, lw=1.5, label=f"{key} (no spread)", zorder=4)
            continue
        ax.plot(*found, color=color, ls=dashes, lw=1.5, label=key, zorder=4)
        if len(columns) == 1:
            ax.fill_between(*found, color=style.POSTERIOR_BAND, lw=0, zorder=2)
    if datum is not None:
        if noise is not None:
            ax.axvspan(datum - noise, datum + noise, color="0.88", lw=0, zorder=1, label="datum ± noise sd")
        ax.axvline(datum, color=style.DATA, lw=1.2, ls=":", label=f"datum, {style.number(datum)}", zorder=5)
    ax.set_xlabel(style.label(name, units, labels))
    ax.set_ylabel(style.per_unit("probability density", units.get(name)))
    ax.set_ylim(bottom=0)
    if x is not None:
        ax.set_title(_at(conditions_of(x, recording), index, units, labels), fontsize="medium", loc="left")
    style.dress(ax)
    if legend:
        style.legend(ax)
    return ax


def _look(key: str, i: int) -> tuple[str, Any]:
    """Colour and line style; MAP and posterior look as in the other figures."""
    start = key.lower()
    if start.startswith("map"):
        return style.MAP, (0, (4, 2))
    if start.startswith("posterior"):
        return style.POSTERIOR, "-"
    return style.CYCLE[i % len(style.CYCLE)]


def _groups(
    samples: Any, alpha: Any, recording: Recording | None, num: int, seed: int
) -> tuple[dict[str, np.ndarray], int, Any]:
    """Draws ``(S, n_total)`` by label, the number of conditions, and the conditions where known."""
    if isinstance(samples, NISP):
        if alpha is None:
            raise DomainError("Expected alpha= beside a propagation: α (P,) or draws of it (S, P). Got none.")
        drawn = {
            key: _propagated(samples, value, num, seed)
            for key, value in (alpha.items() if isinstance(alpha, Mapping) else [("predictive density", alpha)])
        }
        first = next(iter(samples.x.values())) if isinstance(samples.x, Mapping) else samples.x
        return drawn, len(first), samples.x
    if alpha is not None:
        raise DomainError("Expected alpha= only beside a propagation. Got draws of the output as well.")
    given = samples if isinstance(samples, Mapping) else {"predictive density": samples}
    if not given:
        raise DomainError("Expected samples of the output. Got an empty dict.")
    drawn = {}
    for key, value in given.items():
        values = style.array(value, f"samples {key!r}", (1, 2))
        drawn[str(key)] = values[:, None] if values.ndim == 1 else values
    sizes = {values.shape[1] for values in drawn.values()}
    if len(sizes) > 1:
        raise ShapeError(f"Expected samples of one number of outputs. Got {sorted(sizes)}.")
    if recording is None:
        return drawn, sizes.pop(), None
    if sizes == {1} and recording.n * len(recording.outputs) > 1:
        raise ShapeError(
            f"Expected samples of shape (S, {recording.n * len(recording.outputs)}) beside a recording. Got one "
            "output (leave recording= out and give datum=)."
        )
    return drawn, recording.n, recording.x


def _propagated(propagate: NISP, alpha: Any, num: int, seed: int) -> np.ndarray:
    values = torch.from_numpy(style.array(alpha, "alpha", (1, 2)))
    values = values[None] if values.ndim == 1 else values
    if values.shape[1] != propagate.num_alpha:
        raise ShapeError(
            f"Expected alpha of shape ({propagate.num_alpha},) or (S, {propagate.num_alpha}). "
            f"Got {tuple(values.shape)}."
        )
    xi = propagate.draw_germ(num, seed=seed)
    with torch.no_grad():
        if len(values) == 1:
            outputs = propagate.outputs_at(values[0].to(xi), xi)
        else:
            chosen = torch.linspace(0, len(values) - 1, min(len(values), num)).round().long()
            blocks = xi.tensor_split(len(chosen))
            pairs = zip(values[chosen].to(xi), blocks, strict=True)
            outputs = torch.cat([propagate.outputs_at(a, block) for a, block in pairs])
    return outputs.cpu().double().numpy()


def _at(columns: dict[str, np.ndarray], index: int, units: Mapping[str, str], labels: Mapping[str, str] | None) -> str:
    parts = []
    for name, values in columns.items():
        unit = f" {units[name]}" if name in units else ""
        parts.append(f"{(labels or {}).get(name, name)} = {style.number(values[index])}{unit}")
    return ", ".join(parts)
