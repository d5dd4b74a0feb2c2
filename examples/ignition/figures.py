"""Figures of the ignition studies, equivalent to Figs. 7-22 of the paper.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

import torchcal as tc
from examples.ignition import study as studies
from examples.ignition.study import Study
from torchcal import plots
from torchcal.plots import densities, style
from torchcal.prediction import AdditivePrediction, Moments, Prediction
from torchcal.results import Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: How names are written on axes.
LABELS = {
    "T0": "$T_0$",
    "phi": r"$\Phi$",
    "ln_tau": r"$\ln\,\tau$",
    "lnA": r"$\ln\,A$",
    "E": "$E$",
    "lnA[0]": "$a_0$",
    "lnA[xi1]": "$a_1$",
    "E[0]": "$b_0$",
    "E[xi1]": "$b_1$",
    "E[xi2]": "$b_2$",
}
#: Tolerance of the figures that show one.
EPSILON = 0.001
#: Tolerances side by side in Figs. 8-10 and 12.
SHOWN = (0.1, 0.01, 0.001)
#: Slices of case 2.
SLICES = (0.6, 1.0, 1.8)


def _subplots(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple["Figure", Any]:
    import matplotlib.pyplot as plt

    return plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, **options)


def _legend(figure: "Figure", axes: Sequence["Axes"], columns: int = 4) -> None:
    """One legend for some axes, below all of them."""
    found: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    figure.legend(
        list(found.values()), list(found), loc="outside lower center", ncols=columns, fontsize="small", frameon=False
    )


def _title(ax: "Axes", text: str) -> None:
    ax.set_title(text, fontsize="medium", loc="left")


def _shown(results: Mapping[float, Calibration], wanted: Sequence[float]) -> list[float]:
    """The tolerances that are there, largest first."""
    return sorted((e for e in results if e in wanted), reverse=True)


def _shifted(moments: Moments | None, center: Tensor) -> Moments | None:
    return None if moments is None else Moments(moments.mean - center, moments.sd)


def _relative(prediction: Prediction | AdditivePrediction, center: Tensor) -> Any:
    """A prediction less a reference curve, so that narrow bands can be seen beside wide slopes."""
    if isinstance(prediction, AdditivePrediction):
        return AdditivePrediction(
            prediction.x,
            _shifted(prediction.push_forward, center),
            _shifted(prediction.posterior, center),
            _shifted(prediction.map, center),
        )
    return dataclasses.replace(
        prediction,
        mean=prediction.mean - center,
        map=_shifted(prediction.map, center),
        posterior=_shifted(prediction.posterior, center),
        mean_predictive=_shifted(prediction.mean_predictive, center),
    )


def _residual(recording: tc.Recording, center: Tensor) -> tc.Recording:
    """The data less a reference curve at their conditions."""
    return tc.Recording(
        x=recording.x, y={"ln_tau": recording.y - center}, noise=recording.noise, units=dict(recording.units)
    )


# --- the data ------------------------------------------------------------------------------------------


def figure_7(found: Mapping[str, Study]) -> "Figure":
    """Data of case 1."""
    figure, axes = _subplots(1, 2, (7.6, 3.3), sharey=True)
    for ax, key in zip(axes[0], ("1a", "1b"), strict=True):
        recording = found[key].recording
        ax.plot(recording.x["T0"], recording.y, "o", ms=4, mfc="white", mec=style.DATA, mew=0.9)
        ax.set_xlabel(style.label("T0", recording.units, LABELS))
        ax.set_ylabel(style.label("ln_tau", recording.units, LABELS))
        _title(ax, f"GRI-Mech 3.0, Φ = 1, N = {recording.n}")
        style.dress(ax)
        ax.label_outer()
    return figure


def figure_14(two: Study) -> "Figure":
    """Data of case 2, and what Φ does to them."""
    figure, axes = _subplots(1, 2, (8.6, 3.6))
    T0, phi = two.recording.x["T0"], two.recording.x["phi"]
    reference = two.recording.y[phi == 1.0]
    for ax, change in zip(axes[0], (False, True), strict=True):
        for i, (value, color) in enumerate(_shades(phi)):
            rows = phi == value
            y = two.recording.y[rows] - (reference if change else 0)
            ax.plot(T0[rows], y, color=color, lw=1.0, marker=style.MARKERS[i], ms=4, label=f"Φ = {value:g}")
        ax.set_xlabel(style.label("T0", two.recording.units, LABELS))
        style.dress(ax)
    axes[0, 0].set_ylabel(style.label("ln_tau", two.recording.units, LABELS))
    axes[0, 1].set_ylabel(r"$\ln\,\tau - \ln\,\tau(\Phi = 1)$ [ln s]")
    _title(axes[0, 0], "GRI-Mech 3.0")
    _title(axes[0, 1], "the same, relative to Φ = 1")
    axes[0, 1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5), fontsize="small", frameon=False)
    return figure


def _shades(phi: Tensor) -> list[tuple[float, Any]]:
    """Values of Φ and a colour for each, as `plots.sd_against_error` has them."""
    import matplotlib

    values = phi.unique().tolist()
    colors = matplotlib.colormaps["cividis"](np.linspace(0.0, 0.88, len(values)))
    return list(zip(values, colors, strict=True))


# --- embedded calibration ------------------------------------------------------------------------------


def figure_fit(one: Study) -> "Figure":
    """Predictions of case 1 at each ε, whole and less the MAP mean (Figs. 8 and 9)."""
    shown = _shown(one.embedded, SHOWN)
    figure, axes = _subplots(2, len(shown), (3.3 * len(shown), 5.8), sharex=True, sharey="row")
    x = studies.grid(one)
    for column, epsilon in enumerate(shown):
        result = one.embedded[epsilon]
        prediction = result.predict(x)
        top, bottom = axes[:, column]
        plots.fit(prediction, one.recording, ax=top, multiple=2, labels=LABELS, legend=False)
        _title(top, f"ε = {epsilon:g}")
        relative = _relative(prediction, prediction.map.mean)
        residual = _residual(one.recording, result.predict().map.mean)
        plots.fit(relative, residual, ax=bottom, multiple=2, labels=LABELS, legend=False)
        _draw_map_sd(bottom, x["T0"], prediction.map.sd, 2)
        bottom.set_ylabel(r"$\ln\,\tau\,-$ MAP mean [ln s]")
        for ax in (top, bottom):
            ax.label_outer()
    _legend(figure, [axes[0, 0], axes[1, 0]])
    figure.suptitle(f"{one.title}: prediction (above), and data and bands less the MAP mean (below)", fontsize="medium")
    return figure


def _draw_map_sd(ax: "Axes", x: Tensor, sd: Tensor, multiple: float) -> None:
    look = {"color": style.MAP, "ls": (0, (4, 2)), "lw": 1.1, "zorder": 4}
    ax.plot(x, multiple * sd, **look, label=f"±{multiple:g} sd, MAP predictive")
    ax.plot(x, -multiple * sd, **look)


def _panels(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple["Figure", Any]:
    """Axes ``(rows, columns)``; a single column is laid on its side."""
    turned = columns == 1
    across, down = (rows, 1) if turned else (columns, rows)
    figure, axes = _subplots(down, across, (size[0] * across, size[1] * down + 0.4), **options)
    return figure, axes.T if turned else axes


def figure_10(found: Mapping[str, Study]) -> "Figure":
    """Predictive sd and error of the mean in case 1: with small ε, MAP and posterior agree."""
    keys = [key for key in ("1a", "1b") if key in found]
    shown = _shown(found[keys[0]].embedded, SHOWN)
    figure, axes = _panels(len(keys), len(shown), (3.3, 2.9), sharex=True)
    for row, key in zip(axes, keys, strict=True):
        for ax, epsilon in zip(row, shown, strict=True):
            one = found[key]
            plots.sd_against_error(one.embedded[epsilon].predict(), one.recording, ax=ax, labels=LABELS, legend=False)
            _title(ax, f"N = {one.recording.n}, ε = {epsilon:g}")
    for column in axes.T:
        # Each ε has a scale of its own.
        _same_limits(column)
        if len(shown) > 1:
            column[0].set_xlabel("")
    for ax in axes[:, 1:].flat:
        ax.set_ylabel("")
    _legend(figure, [axes[0, 0]])
    return figure


def figure_11(found: Mapping[str, Study]) -> "Figure":
    """Marginal posteriors of a0 and b2 for each N and ε, as they are and over ε, which scales their width."""
    keys = [key for key in ("1a", "1b") if key in found]
    shown = _shown(found[keys[0]].embedded, SHOWN)
    figure, axes = _subplots(2, 2, (9.6, 6.4))
    for (top, bottom), name in zip(axes.T, ("lnA[0]", "E[xi2]"), strict=True):
        raw, scaled = [], []
        for key in keys:
            for epsilon in shown:
                result = found[key].embedded[epsilon].relabelled()
                column = result.alpha_names.index(name)
                draws, label = result.draws[:, column], f"N = {found[key].recording.n}, ε = {epsilon:g}"
                raw.append((label, draws))
                scaled.append((label, (draws - result.map.alpha[column]) / epsilon))
        shown_name = LABELS[name].strip("$")
        plots.marginals(raw, f"${shown_name}$", ax=top, log=True, legend=False)
        plots.marginals(
            scaled, rf"$({shown_name} - {shown_name}^\mathrm{{MAP}}) / \varepsilon$", ax=bottom, legend=False
        )
        top.set_ylim(top=3 * top.get_ylim()[1])
    axes[0, 1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5), fontsize="small", frameon=False)
    return figure


def figure_density(
    found: Sequence[Study], wanted: Sequence[float], *, remove_slope: bool = False, max_draws: int = 4000
) -> "Figure":
    """MAP and posterior predictive density of (ln A, E) at each ε (Figs. 12 and 18), on the same axes."""
    shown = _shown(found[0].embedded, wanted)
    figure, axes = _panels(len(found), len(shown), (3.1, 2.9))
    for row, one in zip(axes, found, strict=True):
        for ax, epsilon in zip(row, shown, strict=True):
            result = one.embedded[epsilon]
            plots.parameter_density(
                result.propagation_at(),
                result.map.alpha,
                result.draws,
                ax=ax,
                remove_slope=remove_slope,
                max_draws=max_draws,
                labels=LABELS,
                legend=False,
            )
            _title(ax, f"N = {one.recording.n}, ε = {epsilon:g}")
    _same_limits(axes.ravel())
    if not remove_slope:
        for ax in axes.flat:
            ax.label_outer()
    _legend(figure, [axes[0, 0]])
    figure.suptitle("Contours hold 50 and 90 % of the probability; + is the MAP mean", fontsize="medium")
    return figure


def _same_limits(axes: Sequence["Axes"]) -> None:
    x = np.array([ax.get_xlim() for ax in axes])
    y = np.array([ax.get_ylim() for ax in axes])
    for ax in axes:
        ax.set_xlim(x[:, 0].min(), x[:, 1].max())
        ax.set_ylim(y[:, 0].min(), y[:, 1].max())


def figure_corner(one: Study, epsilon: float = EPSILON) -> "Figure":
    """All five coefficients, scaled (Figs. 13 and 19)."""
    result = one.embedded[epsilon]
    # In case 2 b1 is nearly zero, and the paper's signs would cut its posterior in two.
    result = result.relabelled() if one.case == 1 else studies.upright(result)
    axes = plots.corner(result.draws, result.alpha_names, map_point=result.map.alpha, labels=LABELS)
    figure = axes[0, 0].figure
    figure.suptitle(f"{one.title}, ε = {epsilon:g}", fontsize="medium", x=0.02, ha="left")
    return figure


def figure_15(two: Study, epsilon: float = EPSILON) -> "Figure":
    """The mean prediction over T0 and Φ, and the data."""
    T0 = torch.linspace(*studies.DOMAIN["T0"], 31, dtype=torch.float64)
    phi = torch.linspace(*studies.DOMAIN["phi"], 25, dtype=torch.float64)
    a, b = (part.reshape(-1) for part in torch.meshgrid(T0, phi, indexing="ij"))
    mean = two.embedded[epsilon].predict({"T0": a, "phi": b}).mean.reshape(len(T0), len(phi))
    ax = plots.surface(T0, phi, mean, two.recording, labels=LABELS)
    ax.set_title(f"{two.title}, ε = {epsilon:g}", fontsize="medium")
    return ax.figure


def figure_16(two: Study, epsilon: float = EPSILON) -> "Figure":
    """Predictions of case 2 along T0 at every Φ."""
    values = two.recording.x["phi"].unique().tolist()
    figure, axes = _subplots(2, 4, (11.0, 5.6), sharex=True, sharey=True)
    result = two.embedded[epsilon]
    for ax, value in zip(axes.flat, values, strict=False):
        prediction = result.predict(studies.grid(two, phi=value))
        where = {"phi": value}
        plots.fit(prediction, two.recording, ax=ax, x_name="T0", where=where, multiple=2, labels=LABELS, legend=False)
        ax.label_outer()
    spare = axes.ravel()[len(values)]
    spare.set_axis_off()
    spare.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="center", fontsize="small", frameon=False,
        title=f"{two.title}, ε = {epsilon:g}", title_fontsize="small",
    )  # fmt: skip
    axes[0, 3].tick_params(labelbottom=True)
    axes[0, 3].set_xlabel(axes[1, 0].get_xlabel())
    return figure


def figure_17(two: Study, epsilon: float = EPSILON) -> "Figure":
    """Predictive sd of case 2 and the error of its mean at every Φ: the sd is nearly uniform in T0."""
    ax = plots.sd_against_error(two.embedded[epsilon].predict(), two.recording, x_name="T0", by="phi", labels=LABELS)
    _title(ax, f"{two.title}, ε = {epsilon:g}")
    return ax.figure


# --- conventional calibration --------------------------------------------------------------------------


def figure_20(found: Sequence[Study]) -> "Figure":
    """Posterior of (ln A, E) and of σ under an additive discrepancy."""
    figure, axes = _subplots(len(found), 2, (8.4, 2.9 * len(found)))
    for (left, right), one in zip(axes, found, strict=True):
        result = one.conventional
        draws = result.parameters.numpy()
        density = densities.pair_density(draws)
        if density is not None:
            heights = densities.contour_heights(density[2], (0.5, 0.9))
            left.contourf(
                *density, [*heights, 1.01 * density[2].max()], colors=[style.ADDITIVE_BAND, style.PUSH_FORWARD_BAND]
            )
            left.contour(*density, heights, colors=style.ADDITIVE, linewidths=0.8)
        left.plot(*result.map.mean.tolist(), "+", color=style.DATA, ms=8, mew=1.4, label="MAP")
        for axis, values in zip(("x", "y"), draws.T, strict=True):
            low, high = np.quantile(values, [0.001, 0.999])
            getattr(left, f"set_{axis}lim")(low, high)
        units = {parameter.name: parameter.unit for parameter in studies.PARAMETERS}
        left.set_xlabel(style.label("lnA", units, LABELS))
        left.set_ylabel(style.label("E", units, LABELS))
        style.dress(left)
        _title(left, f"{one.title}: contours hold 50 and 90 %")
        plots.marginals(
            [("posterior", result.sigma)], r"$\sigma$", ax=right, unit="ln s",
            marks=[float(result.map.alpha[-1].exp())], legend=False,
        )  # fmt: skip
        _title(right, "σ of the additive discrepancy; MAP dotted")
    # The two data sets of case 1 on one scale.
    same = [row for row, one in zip(axes, found, strict=True) if one.case == 1]
    for column in range(2):
        _same_limits([row[column] for row in same])
    return figure


def figure_21(found: Sequence[Study]) -> "Figure":
    """Predictions of the conventional calibrations.

    Case 1 above: data and bands less the mean, and sd beside errors. Case 2 below: three slices.
    """
    ones = [one for one in found if one.case == 1]
    twos = [one for one in found if one.case == 2]
    figure, axes = _subplots(len(ones) + len(twos), 3, (10.6, 3.0 * len(found) + 0.4))
    for row, one in zip(axes, ones, strict=False):
        x = studies.grid(one)
        prediction = one.conventional.predict(x)
        at_data = one.conventional.predict()
        plots.additive_fit(prediction, one.recording, ax=row[0], multiple=2, labels=LABELS, legend=False)
        relative = _relative(prediction, prediction.push_forward.mean)
        residual = _residual(one.recording, at_data.push_forward.mean)
        plots.additive_fit(relative, residual, ax=row[1], multiple=2, labels=LABELS, legend=False)
        row[1].set_ylabel(r"$\ln\,\tau\,-$ mean [ln s]")
        plots.sd_against_error(at_data, one.recording, ax=row[2], labels=LABELS, legend=False)
        _title(row[0], one.title)
        _title(row[1], "less the mean")
        _title(row[2], "sd and error of the mean")
    for column in (1, 2):
        _same_limits(axes[: len(ones), column])
    for row, two in zip(axes[len(ones) :], twos, strict=True):
        for ax, value in zip(row, SLICES, strict=True):
            prediction = two.conventional.predict(studies.grid(two, phi=value))
            where = {"phi": value}
            plots.additive_fit(
                prediction, two.recording, ax=ax, x_name="T0", where=where, multiple=2, labels=LABELS, legend=False
            )
            _title(ax, f"case 2, Φ = {value:g}")
    _legend(figure, [axes[0, 0], axes[0, 2]], columns=4)
    return figure


def figure_22(found: Sequence[Study], epsilon: float = EPSILON) -> "Figure":
    """ln k(T) under the embedded calibration, and its MAP predictive sd (Eqs. 45-48)."""
    figure, axes = _subplots(2, len(found), (3.5 * len(found), 5.6), sharex=True, sharey="row")
    for (top, bottom), one in zip(axes.T, found, strict=True):
        x = studies.grid(one)
        inverse = (1000 / x["T0"]).numpy()
        moments = one.embedded[epsilon].predict(x, function=studies.log_rate).map
        mean, sd = moments.mean.numpy(), moments.sd.numpy()
        top.fill_between(
            inverse, mean - 2 * sd, mean + 2 * sd, color=style.MODEL_ERROR_BAND, lw=0, label="±2 sd, MAP predictive"
        )
        top.plot(inverse, mean, color=style.POSTERIOR, lw=1.3, label="mean, MAP predictive")
        bottom.plot(inverse, sd, color=style.MAP, ls=(0, (4, 2)), lw=1.5, label="sd, MAP predictive")
        top.set_ylabel(r"$\ln\,k$ [ln(cm³/(mol s))]")
        bottom.set_ylabel(r"sd of $\ln\,k$")
        bottom.set_xlabel("1000 K / T")
        bottom.set_yscale("log")
        bottom.set_yticks([0.02, 0.05, 0.1, 0.2, 0.4], ["0.02", "0.05", "0.1", "0.2", "0.4"])
        bottom.minorticks_off()
        bottom.set_ylim(0.01, 0.6)
        _title(top, one.title)
        for ax in (top, bottom):
            style.dress(ax)
            ax.label_outer()
    _legend(figure, list(axes[:, 0]))
    return figure


# --- why the conventional push-forward misleads --------------------------------------------------------


def embedded_vs_conventional(two: Study, epsilon: float = EPSILON) -> "Figure":
    """Case 2: what each calibrated model predicts, with its own error bar, against the detailed model."""
    figure, axes = _subplots(2, 2, (9.8, 6.8), sharey="col", width_ratios=(1.0, 1.35))
    recording = two.recording
    rows = (
        ("Conventional calibration", two.conventional, style.PUSH_FORWARD_BAND, style.ADDITIVE),
        ("Embedded model error", two.embedded[epsilon], style.MODEL_ERROR_BAND, style.POSTERIOR),
    )
    value = float(recording.x["phi"].min())
    for (left, right), (name, result, band, line) in zip(axes, rows, strict=True):
        _draw_lean(left, two, own_prediction(result.predict(studies.grid(two, phi=value))), value, band, line)
        _draw_misses(right, two, own_prediction(result.predict()), band, line)
        left.set_title(name, fontsize="medium", fontweight="bold", loc="left")
        share = studies.coverage(two, own_prediction(result.predict()), level=math.erf(math.sqrt(2)))
        text = f"all {recording.n} data: {100 * share:.0f} % within ± 2 sd of the model's prediction"
        right.set_title(text, fontsize="medium", loc="left")
        for ax in (left, right):
            style.dress(ax)
    return figure


def before_and_after(two: Study, base: Calibration, improved: Calibration, names: Sequence[str]) -> "Figure":
    """Case 2: embedded error bars of the base and of the mechanism with what was missing, both at the MAP.

    Args:
        two: Its data.
        base: Calibration of the base.
        improved: The same of the improved mechanism.
        names: What was added.
    """
    figure, axes = _subplots(2, 2, (9.8, 6.8), sharey="col", width_ratios=(1.0, 1.35))
    rows = (("Before: embedded error of the base", base), (f"After: with the {' and '.join(names)}", improved))
    band, line = style.MODEL_ERROR_BAND, style.POSTERIOR
    value = float(two.recording.x["phi"].min())
    for (left, right), (name, result) in zip(axes, rows, strict=True):
        _draw_lean(left, two, result.predict(studies.grid(two, phi=value)).map, value, band, line)
        moments = result.predict().map
        _draw_misses(right, two, moments, band, line)
        left.set_title(name, fontsize="medium", fontweight="bold", loc="left")
        sd = float(moments.sd.square().mean().sqrt())
        text = f"embedded sd {sd:.3f}, rms error {studies.rms_residual(two, moments.mean):.3f} (in ln τ)"
        right.set_title(text, fontsize="medium", loc="left")
        for ax in (left, right):
            style.dress(ax)
    return figure


def _draw_lean(ax: "Axes", two: Study, moments: Moments, phi: float, band: str, line: str) -> None:
    """Delays over T0 at one Φ, with a band of ±2 sd."""
    T0, units = studies.grid(two, phi=phi)["T0"].numpy(), two.recording.units
    mean, half = moments.mean.numpy(), 2 * moments.sd.numpy()
    ax.fill_between(T0, mean - half, mean + half, color=band, lw=0, label="one-step model ± 2 sd")
    ax.plot(T0, mean, color=line, lw=1.2)
    keep = two.recording.x["phi"] == phi
    ax.plot(two.recording.x["T0"][keep], two.recording.y[keep], **_DATA_LOOK, label="GRI-Mech 3.0")
    ax.set_xlabel(style.label("T0", units, LABELS))
    ax.set_ylabel(style.label("ln_tau", units, LABELS))
    style.legend(ax, title=f"lean mixture, Φ = {phi:g}")


_DATA_LOOK = {"marker": "o", "ls": "none", "ms": 4, "mfc": "white", "mec": style.DATA, "mew": 0.9, "zorder": 5}


def own_prediction(prediction: Prediction | AdditivePrediction) -> Moments:
    """What the calibrated model itself predicts: the push-forward of its posterior.

    For an embedded model that is the posterior predictive too.
    """
    if isinstance(prediction, AdditivePrediction):
        return prediction.push_forward
    return Moments(prediction.mean, prediction.sd)


def _draw_misses(ax: "Axes", two: Study, moments: Moments, band: str, line: str) -> None:
    """Errors of all data against Φ, over the band that the model gives itself there."""
    phi, T0 = two.recording.x["phi"], two.recording.x["T0"]
    values = phi.unique()
    half = torch.stack([2 * moments.sd[phi == value].mean() for value in values])
    # The points of one Φ stand side by side, the coldest to the left; the band reaches past them.
    width = 0.12
    ends = torch.cat([values[:1] - width, values, values[-1:] + width])
    half = torch.cat([half[:1], half, half[-1:]])
    ax.fill_between(ends, -half, half, color=band, lw=0)
    ax.plot(ends[[0, -1]], [0, 0], color=line, lw=1.2)
    shift = width * ((T0 - T0.min()) / (T0.max() - T0.min()) - 0.5)
    ax.plot(phi + shift, two.recording.y - moments.mean, **_DATA_LOOK)
    ax.set_xlabel(r"equivalence ratio $\Phi$; in each group $T_0$ = 1000 … 1300 K")
    ax.set_ylabel(r"$\ln\,\tau$: GRI-Mech − one-step [ln s]")
    ax.set_xticks(values.tolist())


# --- all of them ---------------------------------------------------------------------------------------


def figures(found: Mapping[str, Study]) -> dict[str, "Figure"]:
    """All figures that can be drawn of what was calibrated, by name.

    Args:
        found: Studies by key, all three of them.
    """
    ones, two = [found["1a"], found["1b"]], found["2"]
    every = [*ones, two]
    drawn = {
        "embedded_vs_conventional": embedded_vs_conventional(two),
        "fig07_data_case_1": figure_7(found),
        "fig08_fit_n11": figure_fit(ones[0]),
        "fig09_fit_n51": figure_fit(ones[1]),
        "fig10_sd_and_error": figure_10(found),
        "fig11_marginals": figure_11(found),
        "fig12_parameter_density": figure_density(ones, SHOWN),
        "fig12_parameter_density_flat": figure_density(ones, SHOWN, remove_slope=True),
        "fig13_corner_case_1": figure_corner(ones[0]),
        "fig14_data_case_2": figure_14(two),
        "fig15_surface": figure_15(two),
        "fig16_fit_case_2": figure_16(two),
        "fig17_sd_and_error_case_2": figure_17(two),
        "fig18_parameter_density_case_2": figure_density([two], studies.EPSILONS),
        "fig19_corner_case_2": figure_corner(two),
        "fig20_conventional_posterior": figure_20(every),
        "fig21_conventional_prediction": figure_21(every),
        "fig22_log_rate": figure_22(every),
    }
    return drawn
