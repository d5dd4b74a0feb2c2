"""What the figures of a diagnosis share: colours, axes, legends, and numbers of what they were given."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchcal.data import Recording
from torchcal.display import DECADES, unit_of
from torchcal.errors import DomainError, ShapeError
from torchcal.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BASE, ACCEPTED = style.MAP, style.POSTERIOR
DASHES = (0, (4, 1.6))
HELD_OUT = "#e4e4e4"  # grey (91)
NOISE = "#d9d9d9"  # grey (87)
LOCATED, EDGE = style.ADDITIVE_BAND, style.ADDITIVE
DENSE = 80  # data in one panel above which each is a dot instead of a circle
LINESPACING = 1.1  # of two lines in one row
MOST_LETTERS = 44  # of a user's text on a figure
WORD = 10  # letters of a word that are left out rather than breaking it
MOST_POINTS = 2000  # drawn in one panel; more cannot be told apart


@dataclass(frozen=True)
class Look:
    """How quantities are called on the axes."""

    units: Mapping[str, str]
    labels: Mapping[str, str]

    def axis(self, name: str) -> str:
        """A quantity's name with its unit."""
        unit = self.unit(name)
        return f"{self.shown(name)} [{unit}]" if unit else self.shown(name)

    def shown(self, name: str) -> str:
        """A quantity's name; "t" is time where a recording has one."""
        if name == "t" and name not in self.units and "time" in self.units:
            name = "time"
        return self.labels.get(name, plain(name, 28, middle=True))

    def unit(self, name: str) -> str | None:
        """A quantity's unit, where it has one."""
        unit = unit_of("t" if name == "time" else name, self.units)
        return plain(unit) if unit else None

    def value(self, name: str, value: float) -> str:
        """A quantity with its value and unit."""
        unit = self.unit(name)
        return f"{self.shown(name)} = {style.number(value)}" + (f" {unit}" if unit else "")


def take_axes(
    ax: Any, count: int, size: tuple[float, float] | None = None, *, one_row: bool = False
) -> tuple[list[Any], bool]:
    """Axes to draw on, and whether they were made here."""
    if ax is None:
        import matplotlib.pyplot as plt

        across = count if one_row else min(count, 3 if count != 4 else 2)
        down = math.ceil(count / across)
        if size is None:
            size = (5.0, 3.6) if count == 1 else (3.6 * across, 2.9 * down)
        made = list(plt.subplots(down, across, figsize=size, layout="constrained", squeeze=False)[1].flat)
        for spare in made[count:]:
            spare.remove()
        return made[:count], True
    given = list(np.asarray(ax, dtype=object).flat)
    if not given:
        raise ShapeError("Expected ax: at least one axes. Got none.")
    return [style.new_axes(place) for place in given[:count]], False


def is_log(values: np.ndarray) -> bool:
    """Whether values belong on a logarithmic axis: positive, over decades, and spread more evenly there."""
    seen = values[np.isfinite(values)]
    if not len(seen) or not 0 < DECADES * seen.min() < seen.max():
        return False
    middle = []
    for v in (seen, np.log(seen)):
        middle.append(abs((np.median(v) - v.min()) / (v.max() - v.min()) - 0.5))
    return bool(middle[1] < middle[0])


def finish(ax: "Axes", x_label: str, y_label: str, title: str) -> None:
    """Label an axes and give it the common look."""
    ax.set_xlabel(x_label)
    ax.set_ylabel(style.wrapped(y_label))
    if title:
        ax.set_title(title, fontsize="small", loc="left")
    ax.margins(x=0.03)
    if x_label == "run":
        from matplotlib.ticker import MaxNLocator

        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.dress(ax)


def beside(ax: "Axes", row: int | None, points: float, text: str, side: str = "right") -> None:
    """A number beside a row, at a fixed distance from the axes so that the layout finds room; None is the head."""
    ax.annotate(
        text, (1.0, 1.0 if row is None else row), (points, 2 if row is None else 0), textcoords="offset points",
        xycoords="axes fraction" if row is None else ax.get_yaxis_transform(), ha=side, fontsize="small",
        va="bottom" if row is None else "center", color="0.35" if row is None else "black", annotation_clip=False,
        linespacing=LINESPACING,
    )  # fmt: skip


def draw_key(ax: "Axes", *, right: bool = False, across: int | None = None) -> None:
    """A legend above the axes, where it can hide nothing; a title goes on with it.

    Args:
        ax: The axes.
        right: Whether it ends above the right edge, because the rows' names take the width on the left.
        across: How many entries stand side by side; as many as fit by default.
    """
    handles, names = _entries([ax])
    if not handles:
        return
    # The layout will take a part of the present width for the labels.
    across = across or _across(names, (0.5 if right else 0.85) * ax.get_window_extent().width / ax.figure.dpi)
    title = ax.get_title(loc="left")
    ax.set_title("", loc="left")
    ax.legend(
        handles, names, loc="lower right" if right else "lower left",
        bbox_to_anchor=(1.0 if right else 0.0, 1.0), ncols=across, title=title or None,
        alignment="left", title_fontsize="small", borderaxespad=0.2, borderpad=0.1, **KEY,
    )  # fmt: skip


def draw_figure_key(fig: Any, axes: Sequence["Axes"]) -> None:
    """One legend for several panels, above them; on the left there is room for a title."""
    handles, names = _entries(axes)
    if handles:
        across = _across(names, 0.75 * fig.bbox.width / fig.dpi)
        fig.legend(handles, names, loc="outside upper right", ncols=across, **KEY)


KEY: dict[str, Any] = {
    "fontsize": "small", "frameon": False, "handlelength": 1.8, "columnspacing": 1.2, "labelspacing": 0.3,
}  # fmt: skip


def _entries(axes: Sequence["Axes"]) -> tuple[list[Any], list[str]]:
    """What the legend of some axes holds, each name once, the data first."""
    found: dict[str, Any] = {}
    for place in axes:
        for handle, name in zip(*place.get_legend_handles_labels(), strict=True):
            found.setdefault(name, handle)
    names = sorted(found, key=lambda name: name != "data")
    return [found[name] for name in names], names


def _across(names: Sequence[str], inches: float) -> int:
    """How many entries of a legend stand side by side: about 0.07 inches a letter, 0.45 a handle."""
    for count in range(len(names), 1, -1):
        columns = [names[i::count] for i in range(count)]
        if sum(0.45 + 0.07 * max(len(name) for name in column) for column in columns) <= inches:
            return count
    return 1


def plain(text: Any, most: int = MOST_LETTERS, *, middle: bool = False) -> str:
    """A user's text on a figure: one line, no mathematics by accident, not too long.

    Args:
        text: Any.
        most: Largest number of letters.
        middle: Whether what is too much is left out of the middle: names often differ at their ends.
    """
    text = " ".join(str(text).split())
    if len(text) > most:
        end = (most - 1) // 2 if middle else 0
        text = _begin(text, most - 1 - end) + "…" + _end(text, len(text) - end)
    return text.replace("$", r"\$")


def _begin(text: str, stop: int) -> str:
    """A text up to a place, or to the end of a word shortly before."""
    space = text.rfind(" ", max(stop - WORD, 1), stop + 1)
    return text[: stop if space < 0 else space].rstrip()


def _end(text: str, start: int) -> str:
    """A text from a place on, or from the beginning of a word shortly behind."""
    space = text.find(" ", max(start - 1, 0), start + WORD)
    return text[start if space < 0 else space :].lstrip()


def told_apart(texts: Sequence[str], most: int = MOST_LETTERS) -> list[str]:
    """Users' texts on one figure: different ones stay different where they are shortened."""
    texts = [" ".join(text.split()) for text in texts]
    short = [plain(text, most, middle=True) for text in texts]
    shown: list[str] = []
    for text, alike in zip(texts, short, strict=True):
        others = [other for other, name in zip(texts, short, strict=True) if name == alike and other != text]
        if others:  # they differ in the middle alone: begin shortly before that
            place = max(_alike(text, other) for other in others)
            head = _begin(text, most // 4)
            alike = plain(f"{head}…{_end(text, max(place - most // 4, len(head)))}", most)
        shown.append(alike)
    return [
        name if all(text == other for other, same in zip(texts, shown, strict=True) if same == name)
        else f"{name} ({1 + list(dict.fromkeys(texts)).index(text)})"
        for text, name in zip(texts, shown, strict=True)
    ]  # fmt: skip


def _alike(first: str, second: str) -> int:
    """How many letters two texts begin with in common."""
    differing = (i for i, (a, b) in enumerate(zip(first, second, strict=False)) if a != b)
    return next(differing, min(len(first), len(second)))


def likeliest_with(ranking: Iterable[Any], terms: Iterable[str]) -> Any:
    """The likeliest sound hypothesis with exactly these terms, wherever they act; None where none has them."""
    wanted = frozenset(terms)
    same = [item for item in ranking if frozenset(item.terms) == wanted]
    fitted = [item for item in same if getattr(item, "refitted", True)]
    sound = [item for item in fitted if item.physical and not getattr(item, "note", "")]
    named_after = [item for item in same if item not in fitted and getattr(item, "region", None)]  # another's fit
    return max([*sound, *named_after] or fitted or same, key=lambda item: finite(item.probability, -1.0), default=None)


def join_terms(terms: Iterable[str]) -> str:
    """A hypothesis by the names of its terms."""
    return plain(" + ".join(str(term) for term in terms), middle=True)


def expect(what: str, item: Any, names: Sequence[str], found_in: str) -> None:
    """Raise for something to draw that has not the attributes that are drawn.

    Raises:
        DomainError: If it has not.
    """
    if lacking := [name for name in names if not hasattr(item, name)]:
        raise DomainError(
            f"Expected {what}: {found_in} of a diagnosis, or anything with its attributes. Got {type(item).__name__}, "
            f"which has no {lacking[0]!r}."
        )


def listed(what: str, items: Any, names: Sequence[str], found_in: str) -> list[Any]:
    """Things to draw as a list, each with the attributes that are drawn.

    Raises:
        DomainError: If they are none.
    """
    if not isinstance(items, Iterable):
        raise DomainError(f"Expected {what}: {found_in} of a diagnosis. Got {type(items).__name__}.")
    found = list(items)
    for item in found:
        expect(f"each of {what}", item, names, f"a row of {found_in}")
    return found


def as_numbers(value: Any, what: str, length: int | None = None) -> np.ndarray:
    """Float64 numbers ``(length,)``, NaN allowed, of an array or of something with a ``prediction``."""
    given = getattr(value, "prediction", value)
    if isinstance(given, Tensor):
        given = given.detach().cpu().numpy()
    try:
        numbers = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"Expected {what}: an array of real numbers. Got {type(value).__name__}: {error}.") from error
    if numbers.ndim != 1 or (length is not None and len(numbers) != length):
        wanted = f"({length},)" if length is not None else "(m,)"
        raise ShapeError(f"Expected {what} of shape {wanted}. Got shape {tuple(numbers.shape)}.")
    return numbers


def as_mask(mask: Any, recording: Recording) -> np.ndarray | None:
    """A mask of all outputs, ``(n_total,)``."""
    if mask is None:
        return None
    given = mask.detach().cpu().numpy() if isinstance(mask, Tensor) else np.asarray(mask)
    if given.dtype != bool or given.shape not in {(len(recording.y),), (recording.n,)}:
        raise ShapeError(
            f"Expected a mask of dtype bool and shape ({len(recording.y)},). Got {given.dtype}, {given.shape}."
        )
    return given if len(given) == len(recording.y) else np.tile(given, len(recording.outputs))


def places_of(recording: Recording, output: str) -> np.ndarray:
    """Where an output stands among all, ``(n,)``."""
    return recording.outputs.index(output) * recording.n + np.arange(recording.n)


def thinned(count: int) -> np.ndarray:
    """Which of so many points are drawn, both ends among them."""
    if count <= MOST_POINTS:
        return np.arange(count)
    return np.linspace(0, count - 1, MOST_POINTS).round().astype(int)


def holes(spans: Iterable[tuple[float, float]]) -> list[float]:
    """Middles of what lies between runs of which none reaches over it, by the first and last times of each."""
    ordered = sorted(spans)
    reached = itertools.accumulate((last for _, last in ordered), max)
    return [0.5 * (end + first) for end, (first, _) in zip(reached, ordered[1:], strict=False) if first > end]


def broken(at: np.ndarray, there: Iterable[float], *curves: np.ndarray) -> list[np.ndarray]:
    """Abscissae in ascending order and curves, each with a break at some places that leaves two points on either side
    of it, which make a line."""
    cuts: list[int] = []
    for cut in np.searchsorted(at, list(there)).tolist():
        if cut >= 2 + (cuts[-1] if cuts else 0) and cut <= len(at) - 2:
            cuts.append(cut)
    return [np.insert(np.asarray(each, dtype=float), cuts, np.nan) for each in (at, *curves)]


def rms(values: np.ndarray) -> float:
    """Root mean square of the finite values."""
    seen = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(seen**2))) if len(seen) else 0.0


def finite(value: Any, otherwise: float) -> float:
    """A number, or another one where it is none."""
    return float(value) if value is not None and math.isfinite(value) else otherwise


def signed(value: float) -> str:
    """A number with its sign."""
    if not math.isfinite(finite(value, math.nan)):
        return "–"
    text = f"{value:+.0f}" if abs(value) >= 1000 else f"{value:+.1f}"
    return ("0" if value == 0 else text).replace("-", "−")
