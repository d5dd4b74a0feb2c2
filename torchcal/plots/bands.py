"""Predictions with their error bars, against the data."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcal.data import Recording
from torchcal.errors import DomainError
from torchcal.plots import style
from torchcal.plots.selection import View, select
from torchcal.prediction import AdditivePrediction, Moments, Prediction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["additive_fit", "fit"]


def fit(
    prediction: Prediction,
    recording: Recording | None = None,
    *,
    ax: "Axes | None" = None,
    x_name: str | None = None,
    output: str | int | None = None,
    where: Any = None,
    kind: str | None = None,
    multiple: float = 1.0,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    r"""Data, mean, and the bands of the model error and of the whole predictive sd.

    With ``kind="posterior"`` the inner band is :math:`E[\mu] \pm k \sqrt{E[\sigma^2]}`, the outer one
    :math:`E[\mu] \pm k \sqrt{E[\sigma^2] + V[\mu]}` (Eq. A2); with ``kind="map"`` there is one band,
    :math:`\mu(\alpha_{MAP}) \pm k \sigma(\alpha_{MAP})` (Eq. 30).

    Args:
        prediction: At any conditions, n of them.
        recording: Data to draw, with error bars of k noise sd where the noise is known.
        ax: Where to draw; a new figure by default.
        x_name: The condition on the axis; needed where there are several that ``where`` does not hold.
        output: The output, by name (or number, without a recording); needed where there are several.
        where: Which conditions to draw: ``{name: value}``, for prediction and data alike, or a mask ``(n,)``, a
            slice or numbers of conditions.
        kind: ``"posterior"`` or ``"map"``; by default the first where there are draws.
        multiple: k, > 0.
        units: Units by name, beside the recording's.
        labels: How to write names on the axes, by name.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If a name, value or kind does not exist, or more than one curve is chosen.
        ShapeError: If prediction and recording do not fit.

    Source: Sargsyan, Najm & Ghanem (2015), Figs. 2, 8, 9, 16.
    """
    _expect(prediction, Prediction, "fit")
    if kind is None:
        kind = "map" if prediction.posterior is None else "posterior"
    if kind not in ("posterior", "map"):
        raise DomainError(f"Expected kind 'posterior' or 'map'. Got {kind!r}.")
    if kind == "posterior" and prediction.posterior is None:
        raise DomainError("Expected posterior draws. Got a prediction from the MAP alone (use kind='map').")
    k = _multiple(multiple)
    view = _line_view(prediction.x, prediction.map, recording, x_name, output, where, units, labels)
    ax = style.new_axes(ax)
    if kind == "map":
        mean = view.take(prediction.map.mean)
        _band(
            ax,
            view,
            mean,
            k * view.take(prediction.map.sd),
            style.MODEL_ERROR_BAND,
            f"±{_times(k)}sd, MAP predictive",
            2,
        )
        ax.plot(view.x, mean, color=style.POSTERIOR, lw=1.3, label="mean, MAP predictive", zorder=3)
    else:
        mean, sd = view.take(prediction.mean), view.take(prediction.sd)
        inner = view.take(prediction.sd_model_error)
        _band(ax, view, mean, k * sd, style.POSTERIOR_BAND, f"±{_times(k)}sd, posterior predictive", 1)
        _band(ax, view, mean, k * inner, style.MODEL_ERROR_BAND, f"±{_times(k)}sd, model error", 2)
        ax.plot(view.x, mean, color=style.POSTERIOR, lw=1.3, label="mean", zorder=3)
    return _finish(ax, view, k, legend)


def additive_fit(
    prediction: AdditivePrediction,
    recording: Recording | None = None,
    *,
    ax: "Axes | None" = None,
    x_name: str | None = None,
    output: str | int | None = None,
    where: Any = None,
    multiple: float = 1.0,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    """A conventional calibration: what the model alone predicts, and what its additive error adds.

    The inner band, the push-forward, is all that the calibrated model says about another quantity. The outer
    one, the posterior predictive, holds the additive error as well.

    Args:
        prediction: At any conditions.
        recording: Data to draw.
        ax: Where to draw; a new figure by default.
        x_name: As for `fit`.
        output: As for `fit`.
        where: As for `fit`.
        multiple: Half-width of the bands in sd, > 0.
        units: As for `fit`.
        labels: As for `fit`.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: As for `fit`.
        ShapeError: As for `fit`.

    Source: Sargsyan, Najm & Ghanem (2015), Fig. 21.
    """
    _expect(prediction, AdditivePrediction, "additive_fit")
    k = _multiple(multiple)
    view = _line_view(prediction.x, prediction.map, recording, x_name, output, where, units, labels)
    ax = style.new_axes(ax)
    outer, inner = prediction.posterior, prediction.push_forward
    _band(
        ax,
        view,
        view.take(outer.mean),
        k * view.take(outer.sd),
        style.ADDITIVE_BAND,
        f"±{_times(k)}sd, posterior predictive",
        1,
    )
    _band(
        ax,
        view,
        view.take(inner.mean),
        k * view.take(inner.sd),
        style.PUSH_FORWARD_BAND,
        f"±{_times(k)}sd, push-forward",
        2,
    )
    ax.plot(view.x, view.take(inner.mean), color=style.ADDITIVE, lw=1.0, label="mean", zorder=3)
    return _finish(ax, view, k, legend)


def _expect(prediction: Any, kind: type, function: str) -> None:
    if not isinstance(prediction, kind):
        other = "additive_fit" if function == "fit" else "fit"
        advice = "give what its predict() returns" if hasattr(prediction, "predict") else f"see also plots.{other}"
        raise DomainError(f"Expected prediction: {kind.__name__}. Got {type(prediction).__name__} ({advice}).")


def _multiple(multiple: float) -> float:
    if isinstance(multiple, bool) or not isinstance(multiple, int | float) or not 0 < multiple < np.inf:
        raise DomainError(f"Expected multiple: a number > 0 of standard deviations. Got {multiple!r}.")
    return float(multiple)


def _times(k: float) -> str:
    return "" if k == 1 else f"{k:g} "


def _line_view(
    x: Any,
    moments: Moments,
    recording: Recording | None,
    x_name: str | None,
    output: str | int | None,
    where: Any,
    units: Mapping[str, str] | None,
    labels: Mapping[str, str] | None,
) -> View:
    view = select(
        x, len(moments.mean), recording, x_name=x_name, output=output, where=where, units=units, labels=labels
    )
    if len(view.x) < 2:
        raise DomainError(
            "Expected at least 2 predicted conditions for a curve. Got 1 (choose more, or see output_density)."
        )
    return view


def _band(ax: "Axes", view: View, mean: np.ndarray, half: np.ndarray, color: str, name: str, zorder: float) -> None:
    ax.fill_between(view.x, mean - half, mean + half, color=color, lw=0, label=name, zorder=zorder)


def _finish(ax: "Axes", view: View, k: float, legend: bool) -> "Axes":
    if len(view.data_x):
        errors = None if view.data_noise is None else k * view.data_noise
        ax.errorbar(
            view.data_x, view.data_y, errors, fmt="o", ms=4, mfc="white", mec=style.DATA, mew=0.9,
            ecolor=style.DATA, elinewidth=0.8, label="data", zorder=5,
        )  # fmt: skip
    ax.set_xlabel(view.x_label)
    ax.set_ylabel(view.y_label)
    if view.title:
        ax.set_title(view.title, fontsize="medium", loc="left")
    ax.margins(x=0.03)
    style.dress(ax)
    if legend:
        style.legend(ax)
    return ax
