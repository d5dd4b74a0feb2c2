"""Piecewise polynomials through samples: constant, linear, and a cubic spline."""

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["HOLDS", "evaluate_pieces", "pieces"]

HOLDS = ("linear", "zero", "cubic")
"""How an input may go on between two of its samples."""


def pieces(time: Tensor, values: Tensor, hold: str) -> Tensor:
    r"""Coefficients of the polynomial that holds from each sample on, :math:`\sum_k c_k (t - t_i)^k`.

    Args:
        time: Strictly increasing, shape ``(T,)``.
        values: Shape ``(K, T)``.
        hold: ``"zero"`` keeps each sample's value up to the next sample; ``"linear"`` joins the samples by lines;
            ``"cubic"`` is the cubic spline with "not-a-knot" ends, whose error is :math:`O(h^4)` up to the ends.

    Returns:
        Shape ``(degree + 1, K, pieces)``, lowest degree first; ``T`` pieces for ``"zero"``, else ``T - 1``.

    Source: de Boor (1978), A Practical Guide to Splines, chapter IV.
    """
    if hold == "zero":
        return values[None]
    width = time.diff()
    chord = values.diff(dim=-1) / width
    if hold == "linear":
        return torch.stack([values[:, :-1], chord])
    slope = _spline_slopes(width, chord)
    second = (3 * chord - 2 * slope[:, :-1] - slope[:, 1:]) / width
    third = (slope[:, :-1] + slope[:, 1:] - 2 * chord) / width**2
    return torch.stack([values[:, :-1], slope[:, :-1], second, third])


def evaluate_pieces(coefficients: Tensor, time: Tensor, at: Tensor, side: str) -> Tensor:
    """Values of the pieces at times inside the span.

    Args:
        coefficients: From `pieces`, shape ``(degree + 1, K, pieces)``.
        time: The samples' times, shape ``(T,)``.
        at: Times of any shape, within ``time``.
        side: ``"right"``: on a sample the piece that begins there; ``"left"``: the one that ends there.

    Returns:
        Shape ``(K, *at.shape)``.
    """
    index = torch.searchsorted(time, at.detach().contiguous(), right=side == "right") - 1
    index = index.clamp(0, coefficients.shape[-1] - 1)
    past = at - time[index]
    value = coefficients[-1][:, index]
    for coefficient in coefficients[:-1].flip(0):
        value = value * past + coefficient[:, index]
    return value


def _spline_slopes(width: Tensor, chord: Tensor) -> Tensor:
    """First derivatives ``(K, T)`` of the not-a-knot spline at the samples, from the slopes of its chords."""
    if len(width) == 1:
        return chord.expand(-1, 2)
    first, last = width[:-1], width[1:]
    between = (last * chord[:, :-1] + first * chord[:, 1:]) / (first + last)  # of the parabola through three
    if len(width) == 2:
        return torch.cat([2 * chord[:, :1] - between, between, 2 * chord[:, 1:] - between], dim=-1)
    # Second derivatives agree at every inner sample; third derivatives at the first and the last of them.
    lower = torch.cat([last, (width[-1] + width[-2])[None]])
    diagonal = torch.cat([width[1:2], 2 * (first + last), width[-2:-1]])
    upper = torch.cat([(width[0] + width[1])[None], first])
    right = torch.cat(
        [
            _end(width[0], width[1], chord[:, 0], chord[:, 1])[:, None],
            3 * (first + last) * between,
            _end(width[-1], width[-2], chord[:, -1], chord[:, -2])[:, None],
        ],
        dim=-1,
    )
    bands = lower.tolist(), diagonal.tolist(), upper.tolist()
    return width.new_tensor([_tridiagonal(*bands, row) for row in right.tolist()]).reshape(len(chord), -1)


def _end(outer: Tensor, inner: Tensor, outer_chord: Tensor, inner_chord: Tensor) -> Tensor:
    """Right-hand side of the end condition: one cubic over the two intervals at an end."""
    both = outer + inner
    return ((outer + 2 * both) * inner * outer_chord + outer**2 * inner_chord) / both


def _tridiagonal(
    lower: Sequence[float], diagonal: Sequence[float], upper: Sequence[float], right: Sequence[float]
) -> list[float]:
    """Solve a tridiagonal system by elimination; a spline's pivots are positive without an exchange of rows."""
    pivots, values = [diagonal[0]], [right[0]]
    for low, middle, high, wanted in zip(lower, diagonal[1:], upper, right[1:], strict=True):
        factor = low / pivots[-1]
        pivots.append(middle - factor * high)
        values.append(wanted - factor * values[-1])
    solved = [values[-1] / pivots[-1]]
    for pivot, high, value in zip(pivots[-2::-1], upper[::-1], values[-2::-1], strict=True):
        solved.append((value - high * solved[-1]) / pivot)
    return solved[::-1]
