"""One look for every figure, set on the axes themselves so that ``rcParams`` stay as the user has them."""

import functools
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchcal.errors import DomainError, ShapeError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

__all__ = [
    "array",
    "dress",
    "label",
    "legend",
    "new_axes",
    "number",
    "per_unit",
    "pretty",
    "scale_in_label",
    "wrapped",
]

# The lightness (CIE L*, in brackets) is what is left of a colour in grey: those drawn together differ by 20.
DATA = "black"
POSTERIOR = "#0b4f8a"  # dark blue (33)
MAP = "#e07b00"  # orange (62); always dashed as well
MODEL_ERROR_BAND = "#7fb2dd"  # blue (71)
POSTERIOR_BAND = "#d3e5f4"  # pale blue (90)
ADDITIVE = "#7a3b00"  # brown (32)
PUSH_FORWARD_BAND = "#e8a04c"  # orange (72)
ADDITIVE_BAND = "#fbe6cc"  # pale orange (92)

# For several curves on one axes: dark to light, with a line style each.
CYCLE = (
    ("#0b4f8a", "-"),
    ("#e07b00", "--"),
    ("#000000", "-."),
    ("#009e73", "-"),
    ("#cc79a7", "--"),
    ("#56b4e9", "-."),
    ("#7a3b00", ":"),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")


def new_axes(ax: Any, size: tuple[float, float] = (5.0, 3.6), *, three_d: bool = False) -> Any:
    """Return ``ax``, or the axes of a new figure.

    Args:
        ax: Axes, or None.
        size: Width and height of a new figure, inches.
        three_d: Whether 3-D axes are needed.

    Raises:
        DomainError: If ``ax`` is not axes, or not of the kind that is needed.
    """
    if ax is None:
        import matplotlib.pyplot as plt

        options = {"projection": "3d", "computed_zorder": False} if three_d else None
        return plt.subplots(figsize=size, layout="constrained", subplot_kw=options)[1]
    from matplotlib.axes import Axes

    if not isinstance(ax, Axes):
        raise DomainError(
            f"Expected ax: matplotlib axes or None. Got {type(ax).__name__} "
            "(pass one of the axes that plt.subplots returns)."
        )
    if (ax.name == "3d") != three_d:
        raise DomainError(
            f"Expected {'3-D' if three_d else 'plane'} axes. Got {ax.name!r} axes "
            f"({'make them with projection=' + repr('3d') if three_d else 'make them without projection='})."
        )
    return ax


def dress(ax: "Axes") -> None:
    """Thin spines on two sides, small ticks, and what they are multiples of in the labels."""
    for side, spine in ax.spines.items():
        spine.set_linewidth(0.6)
        spine.set_visible(side in ("left", "bottom"))
    ax.tick_params(width=0.6, length=3, labelsize="small")
    scale_in_label(ax.xaxis, ax.yaxis)


def scale_in_label(*axes: "Axis") -> None:
    """Have the factor of each axis's ticks written in its label, not in a corner where other text lies."""
    from matplotlib.ticker import ScalarFormatter

    from torchcal.plots.scales import Scaled

    for axis in axes:
        if type(axis.get_major_formatter()) is ScalarFormatter:
            formatter = Scaled()
            axis.set_major_formatter(formatter)
            for event in ("xlim_changed", "ylim_changed"):  # a partial object is held; a method would be forgotten
                axis.axes.callbacks.connect(event, functools.partial(Scaled.let_go, formatter))


def legend(ax: "Axes", title: str | None = None, *, beside: bool = False) -> None:
    """A small legend where it hides no curve: in a free corner, in room made above, or beside the axes."""
    options: dict[str, Any] = {"fontsize": "small", "title": title, "title_fontsize": "small", "framealpha": 0.85}
    options |= {"edgecolor": "none", "handlelength": 1.6, "borderpad": 0.2, "labelspacing": 0.3}
    if beside:
        ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), **options)
        return
    box = ax.legend(loc="upper right", **options)
    box.set_zorder(20)
    if ax.name == "3d":
        return
    extent = box.get_window_extent().transformed(ax.transAxes.inverted())
    width, height = extent.width + 0.04, extent.height + 0.04
    _ = ax.viewLim  # reading it brings the limits up to what has been drawn
    points = _drawn(ax)
    for code, right, top in ((1, 1, 1), (2, 0, 1), (3, 0, 0), (4, 1, 0)):  # matplotlib's numbers of the corners
        across = points[:, 0] > 1 - width if right else points[:, 0] < width
        along = points[:, 1] > 1 - height if top else points[:, 1] < height
        if not (across & along).any():
            box.set_loc(code)
            return
    stretch = min(points[:, 1].max(), 1.0) / max(1 - height, 0.3)
    forward = ax.yaxis.get_transform()
    low, high = forward.transform(np.array(ax.get_ylim()))
    ax.set_ylim(top=float(forward.inverted().transform(np.array([low + stretch * (high - low)]))[0]))


def _drawn(ax: "Axes") -> np.ndarray:
    """Points along everything drawn, ``(M, 2)``, in shares of the axes."""
    paths, dense = [], [np.full((1, 2), 0.5)]
    for line in ax.lines:
        points = line.get_transform().transform(np.asarray(line.get_xydata()))
        if line.get_linestyle() == "None":
            dense.append(ax.transAxes.inverted().transform(points))
        else:
            paths.append(points)
    for collection in ax.collections:
        paths += [collection.get_transform().transform(path.vertices) for path in collection.get_paths()]
    share = np.linspace(0, 1, 21)[:, None, None]
    for path in paths:
        points = ax.transAxes.inverted().transform(path)
        dense.append((points[:-1] + share * np.diff(points, axis=0)).reshape(-1, 2))
        dense.append(points)
    found = np.concatenate(dense)
    return found[np.isfinite(found).all(-1)]


def number(value: float) -> str:
    """A number in a text, four digits."""
    return f"{value:.4g}".replace("-", "−")


def pretty(name: str) -> str:
    r"""Write the germs in the name of an α as mathematics.

    >>> pretty("lnA[xi1^2*xi2]")
    'lnA[$\\xi_{1}^{2}\\xi_{2}$]'
    """
    factor = r"xi\d+(?:\^\d+)?"

    def germs(match: re.Match[str]) -> str:
        parts = re.findall(r"xi(\d+)(?:\^(\d+))?", match[1])
        return "[$" + "".join(rf"\xi_{{{i}}}" + (f"^{{{k}}}" if k else "") for i, k in parts) + "$]"

    return re.sub(rf"\[({factor}(?:\*{factor})*)\]$", germs, name)


def label(name: str, units: Mapping[str, str] | None = None, labels: Mapping[str, str] | None = None) -> str:
    """A quantity's axis label: its name, and its unit where one is known.

    >>> label("T0", {"T0": "K"})
    'T0 [K]'
    """
    shown = (labels or {}).get(name, pretty(name))
    unit = (units or {}).get(name)
    return f"{shown} [{unit}]" if unit else shown


def wrapped(text: str) -> str:
    """An upright axis label, in lines that a small panel has room for; units and mathematics are not broken."""
    if len(text) <= 30 or "\n" in text or "$" in text.replace(r"\$", ""):
        return text
    held = re.sub(r"\[[^\[\]]*\]|±\d+ sd", lambda unit: re.sub(r"\s", "\xa0", unit[0]), text)
    return textwrap.fill(held, 30).replace("\xa0", " ")


def per_unit(what: str, unit: str | None) -> str:
    """The axis label of a density.

    >>> per_unit("density", "cal/mol")
    'density [1/(cal/mol)]'
    """
    if not unit:
        return what
    return f"{what} [1/({unit})]" if re.search(r"[\s*/·]", unit) else f"{what} [1/{unit}]"


def array(value: Any, what: str, ndim: int | Sequence[int]) -> np.ndarray:
    """Finite float64 numbers with one of the given numbers of dimensions.

    Raises:
        ShapeError: If it is no array of real numbers, or has another number of dimensions.
        DomainError: If a number is not finite.
    """
    if value is None:
        why = " (without samples, num_samples=0, a calibration has no draws)" if "draws" in what else ""
        raise ShapeError(f"Expected {what}: an array of real numbers. Got None{why}.")
    allowed = (ndim,) if isinstance(ndim, int) else tuple(ndim)
    try:
        given = value if isinstance(value, Tensor) else torch.as_tensor(np.array(value))
        if given.is_complex():
            raise TypeError("complex numbers")
        numbers = given.detach().to(device="cpu", dtype=torch.float64).numpy()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ShapeError(f"Expected {what}: an array of real numbers. Got {type(value).__name__}: {error}.") from error
    if numbers.ndim not in allowed:
        wanted = " or ".join(str(number) for number in allowed)
        raise ShapeError(f"Expected {what} with {wanted} dimension(s). Got shape {tuple(numbers.shape)}.")
    if not numbers.size:
        raise ShapeError(f"Expected {what} with at least one number. Got shape {tuple(numbers.shape)}.")
    if not np.isfinite(numbers).all():
        count = int((~np.isfinite(numbers)).sum())
        raise DomainError(f"Expected finite numbers in {what}. Got {count} of {numbers.size} that are NaN or infinite.")
    return numbers
