"""Predictive standard deviations beside the errors that they are to cover."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from torchcal.data import Recording
from torchcal.errors import DomainError, ShapeError
from torchcal.plots import style
from torchcal.plots.selection import View, conditions_of, select
from torchcal.prediction import AdditivePrediction, Prediction

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["sd_against_error"]


def sd_against_error(
    prediction: Prediction | AdditivePrediction,
    recording: Recording,
    *,
    ax: "Axes | None" = None,
    x_name: str | None = None,
    output: str | int | None = None,
    where: Any = None,
    by: str | None = None,
    log: bool = False,
    units: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    legend: bool = True,
) -> "Axes":
    r"""Predictive sd and :math:`|\mu_i(\alpha_{MAP}) - y_i|` along one condition.

    Drawn are the sd of the MAP and posterior predictive; of a conventional calibration those of the push-forward
    and the posterior predictive, and the error of the push-forward mean.

    Args:
        prediction: At the recording's conditions.
        recording: The data.
        ax: Where to draw; a new figure by default.
        x_name: As for `torchcal.plots.fit`.
        output: As for `torchcal.plots.fit`.
        where: As for `torchcal.plots.fit`.
        by: Another condition: draw a curve of errors for each of its values (Fig. 17).
        log: Whether the ordinate is logarithmic; zeros are then left out.
        units: As for `torchcal.plots.fit`.
        labels: As for `torchcal.plots.fit`.
        legend: Whether to draw one.

    Returns:
        The axes.

    Raises:
        DomainError: If a name or value does not exist, or more than one curve is chosen.
        ShapeError: If the prediction is not at the recording's conditions.

    Source: Sargsyan, Najm & Ghanem (2015), Figs. 10, 17, 21.
    """
    if not isinstance(prediction, Prediction | AdditivePrediction):
        raise DomainError(f"Expected prediction: a Prediction or AdditivePrediction. Got {type(prediction).__name__}.")
    if not isinstance(recording, Recording):
        raise DomainError(f"Expected recording: a Recording. Got {type(recording).__name__}.")
    predicted, recorded = conditions_of(prediction.x, recording), conditions_of(recording.x, recording)
    same = list(predicted) and set(predicted) == set(recorded)
    if not same or not all(
        len(predicted[name]) == recording.n and np.allclose(
            predicted[name], recorded[name], rtol=1e-6, atol=1e-9 * np.ptp(recorded[name])
        )
        for name in recorded
    ):
        raise ShapeError(
            "Expected a prediction at the recording's conditions, in its order. Got other ones "
            "(call predict without conditions)."
        )
    view = select(
        prediction.x, len(prediction.map.mean), recording, x_name=x_name, output=output, where=where, units=units,
        labels=labels, by=by,
    )  # fmt: skip
    ax = style.new_axes(ax, (5.0, 3.6) if by is None else (6.6, 3.8))
    curves: list[tuple[str, np.ndarray, str, Any]] = []
    if isinstance(prediction, Prediction):
        center = prediction.map.mean
        curves.append(("MAP predictive sd", view.take(prediction.map.sd), style.MAP, (0, (4, 2))))
        if prediction.posterior is not None:
            sd = view.take(prediction.posterior.sd)
            curves.insert(0, ("posterior predictive sd", sd, style.POSTERIOR, "-"))
        error_name = f"|MAP mean of {view.y_name} − data|"
    else:
        center = prediction.push_forward.mean
        curves.append(("posterior predictive sd", view.take(prediction.posterior.sd), style.ADDITIVE, "-"))
        curves.append(("push-forward sd", view.take(prediction.push_forward.sd), style.MAP, (0, (4, 2))))
        error_name = f"|mean of {view.y_name} − data|"
    error = np.abs(view.take(center) - recording.y.cpu().numpy()[view.places])  # NaN where missing
    groups = _groups(predicted, view, by)
    for name, sd, color, dashes in curves:
        for i, (_, rows) in enumerate(groups):
            ax.plot(
                view.x[rows], _positive(sd[rows], log), color=color, ls=dashes, lw=1.6 if by is None else 1.0,
                label=name if i == 0 else "_" + name, zorder=4,
            )  # fmt: skip
    _draw_errors(
        ax,
        view,
        error,
        groups,
        by,
        error_name,
        log=log,
        units={**recording.units, **(units or {})},
        labels=labels,
    )
    ax.set_xlabel(view.x_label)
    ax.set_ylabel("sd and |error|" + (f" [{view.unit}]" if view.unit else ""))
    if view.title:
        ax.set_title(view.title, fontsize="medium", loc="left")
    ax.margins(x=0.03)
    if log:
        ax.set_yscale("log")
    else:
        ax.set_ylim(bottom=0)
    style.dress(ax)
    if legend:
        style.legend(ax, beside=by is not None)
    return ax


def _groups(columns: dict[str, np.ndarray], view: View, by: str | None) -> list[tuple[float, np.ndarray]]:
    """Values of ``by`` and the places among the drawn points of each; rounded to 9 digits to be told apart."""
    if by is None:
        return [(np.nan, np.arange(len(view.x)))]
    values = np.array([float(f"{value:.9g}") for value in columns[by][view.rows]])
    return [(float(value), np.flatnonzero(values == value)) for value in np.unique(values)]


def _positive(values: np.ndarray, log: bool) -> np.ndarray:
    return np.where(values > 0, values, np.nan) if log else values


def _draw_errors(
    ax: "Axes",
    view: View,
    error: np.ndarray,
    groups: list[tuple[float, np.ndarray]],
    by: str | None,
    name: str,
    *,
    log: bool,
    units: Mapping[str, str],
    labels: Mapping[str, str] | None,
) -> None:
    if by is None:
        ax.plot(
            view.x,
            _positive(error, log),
            "o",
            ms=4,
            mfc="white",
            mec=style.DATA,
            mew=0.9,
            label=name,
            zorder=5,
        )
        return
    import matplotlib

    shades = matplotlib.colormaps["cividis"](np.linspace(0.0, 0.88, len(groups)))
    shown, unit = (labels or {}).get(by, by), units.get(by)
    for i, (value, rows) in enumerate(groups):
        ax.plot(
            view.x[rows], _positive(error[rows], log), color=shades[i], lw=0.8, marker=style.MARKERS[i % 9], ms=4,
            label=f"|error|, {shown} = {style.number(value)}" + (f" {unit}" if unit else ""), zorder=5,
        )  # fmt: skip
