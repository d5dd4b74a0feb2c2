"""The cubic study: three polynomial models calibrated against a cubic truth, with its figures.

Runs as ``python -m examples.cubic --out outputs/cubic``. The truth is

    g(x) = 2 + 2 x + 3 x^2 - 5 x^3 on [-1, 1]                                         (Eq. 33)

and the models are sums of Legendre polynomials up to degree 1, 2 and 3 (Eq. 34). The last is exact.

Source: Sargsyan, Najm & Ghanem (2015), Int. J. Chem. Kinet. 47, 246-276, Eqs. 33-36, Figs. 2-6.
"""

import argparse
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

import torchcal as tc
from torchcal import plots
from torchcal.plots import densities, style
from torchcal.results import AdditiveCalibration, Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Degree of each model.
MODELS = {"linear": 1, "quadratic": 2, "cubic": 3}
#: Numbers of equidistant data.
SIZES = (11, 51)
#: Legendre coefficients of the truth: the exact parameters of the cubic model.
EXACT = (3.0, -1.0, 2.0, -2.0)
#: Data at which the fans of lines that start the three searches of Fig. 6 are narrowest.
PINCHES = (0.0, 0.4, 1.0)
#: About as many draws as the paper's 20,000.
DRAWS = {"num_samples": 500, "num_chains": 32}


# --- the problem ---------------------------------------------------------------------------------------------


def truth(x: Tensor) -> Tensor:
    """g(x) (Eq. 33)."""
    return 2 + 2 * x + 3 * x**2 - 5 * x**3


def legendre(x: Tensor, degree: int) -> list[Tensor]:
    """L_0 … L_degree at x, by their three-term recurrence."""
    values = [torch.ones_like(x), x]
    for k in range(1, degree):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return values[: degree + 1]


def simulator(model: str) -> tc.Simulator:
    """One of the `MODELS` (Eq. 34), linear in its parameters l0, l1, …, which have no bounds."""
    names = [f"l{k}" for k in range(MODELS[model] + 1)]

    def polynomial(x: Tensor, p: dict[str, Tensor]) -> Tensor:
        total = 0 * x
        for name, value in zip(names, legendre(x, len(names) - 1), strict=True):
            total = total + p[name] * value
        return total

    return tc.Simulator(polynomial, parameters=[tc.Parameter(name) for name in names], degree=1)


def recording(n: int) -> tc.Recording:
    """The truth at n equidistant conditions."""
    x = torch.linspace(-1, 1, n, dtype=torch.float64)
    return tc.Recording(x=x, y=truth(x))


def grid(num: int = 201) -> Tensor:
    """Conditions to draw and compare predictions at."""
    return torch.linspace(-1, 1, num, dtype=torch.float64)


# --- calibrations --------------------------------------------------------------------------------------------


def estimate(
    model: str, n: int, *, epsilon: float = 0.1, gamma: float = 1.0, seed: int = 0, **options: Any
) -> Calibration:
    """The MAP under the ABC likelihood (Eq. 35) with a triangular normal embedding (Eq. 10)."""
    likelihood = tc.likelihoods.ABC(epsilon=epsilon, gamma=gamma)
    options = {"num_samples": 0, **options}
    return tc.calibrate(simulator(model), recording(n), likelihood=likelihood, seed=seed, **options)


def posterior(
    model: str, n: int, *, epsilon: float = 0.1, gamma: float = 1.0, seed: int = 0, **options: Any
) -> Calibration:
    """MAP and posterior draws, with the paper's signs: positive last row."""
    return estimate(model, n, epsilon=epsilon, gamma=gamma, seed=seed, **{**DRAWS, **options}).relabelled()


def conventional(model: str, n: int, *, seed: int = 0, **options: Any) -> AdditiveCalibration:
    """The same model under an additive normal discrepancy (Eq. 4)."""
    return tc.calibrate_additive(simulator(model), recording(n), seed=seed, **{**DRAWS, **options})


def estimates(*, epsilon: float = 0.1, gamma: float = 1.0, seed: int = 0) -> dict[tuple[str, int], Calibration]:
    """The MAP of every model at every N (Fig. 2)."""
    return {(m, n): estimate(m, n, epsilon=epsilon, gamma=gamma, seed=seed) for m in MODELS for n in SIZES}


def spurious_maxima(n: int = 11, *, pinches: Sequence[float] = PINCHES, seed: int = 0) -> list[Calibration]:
    """Maxima of the normal marginalized likelihood (Eq. 17) from a start each (Fig. 6).

    Each start is a fan of lines that is narrowest at a datum near one of ``pinches``. The search ends where the sd
    vanishes there.
    """
    data = recording(n)
    # Starts are in scaled coordinates, which depend on model, data and seed alone.
    scaling = _scaling(estimate("linear", n, seed=seed))
    steep, thick = 1.0, 0.05
    found = []
    for pinch in pinches:
        place = (data.x - pinch).abs().argmin()
        dx, dy = data.x - data.x[place], data.y - data.y[place]
        slope = (dx * dy).sum() / dx.square().sum()
        mean = scaling.scaled(torch.stack([data.y[place] - slope * data.x[place], slope]))
        a01, a11, a12 = -steep * data.x[place], steep, thick
        start = torch.stack([mean[0], a01 / scaling.scale[0], mean[1], a11 / scaling.scale[1], a12 / scaling.scale[1]])
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The best density is a spike")  # which is what is shown here
            found.append(
                tc.calibrate(
                    simulator("linear"),
                    data,
                    likelihood=tc.likelihoods.GaussianMarginal(),
                    starts=start[None],
                    num_samples=0,
                    seed=seed,
                )
            )
    return found


def _scaling(calibration: Calibration) -> Any:
    if calibration.propagate is None:
        raise tc.errors.DomainError("Expected a calibration with its simulator. Got one that was loaded without.")
    return calibration.propagate.scaling


def coefficients(calibration: Calibration, alpha: Tensor | None = None) -> Tensor:
    """α in the outputs' unit, as a_jk of Eq. 36: at the MAP ``(P,)``, or of given draws ``(…, P)``."""
    scaling = _scaling(calibration)
    pattern = calibration.propagation_at().pattern
    alpha = calibration.map.alpha if alpha is None else alpha
    center = torch.where(pattern.leading, scaling.center[pattern.rows], 0.0)
    return center + scaling.scale[pattern.rows] * alpha


def coefficient_names(calibration: Calibration) -> list[str]:
    """``a_00, a_01, a_10, …`` in the order of α, as mathematics."""
    pattern = calibration.propagation_at().pattern
    # Germ number k + 1 of Eq. 10 is column k + 1 of Ψ in graded order.
    places = zip(pattern.rows.tolist(), pattern.columns.tolist(), strict=True)
    return [f"$a_{{{row}{column}}}$" for row, column in places]


def root_mean_square(sd: Tensor) -> float:
    """One number for a predictive sd over x."""
    return float(sd.square().mean().sqrt())


def summary(found: Mapping[tuple[str, int], Calibration]) -> str:
    """A table of the MAP estimates."""
    lines = [f"{'model':10s} {'N':>3s} {'objective':>12s} {'rms sd':>9s} {'starts':>9s} {'null':>5s}  E[λ]"]
    for (model, n), result in found.items():
        sd = root_mean_square(result.predict(grid()).map.sd)
        checks = result.diagnostics
        mean = ", ".join(f"{value:.4f}" for value in result.map.mean)
        starts = f"{checks.agreeing} of {checks.starts}"
        lines.append(
            f"{model:10s} {n:3d} {result.map.objective:12.5g} {sd:9.3g} {starts:>9s} "
            f"{len(checks.null_directions):5d}  {mean}"
        )
    return "\n".join(lines)


# --- figures -------------------------------------------------------------------------------------------------


def _subplots(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple["Figure", Any]:
    import matplotlib.pyplot as plt

    return plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, **options)


def _draw_truth(ax: "Axes") -> None:
    x = grid()
    ax.plot(x, truth(x), color="black", lw=0.9, ls=(0, (1, 1.5)), label="truth g(x)", zorder=4)
    ax.set_xticks([-1, -0.5, 0, 0.5, 1])


def _one_legend(figure: "Figure", ax: "Axes", columns: int) -> None:
    """The legend of one of the axes, for all of them, below."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize="small", frameon=False)


def _fit(ax: "Axes", calibration: Calibration, title: str, *, kind: str = "map") -> None:
    plots.fit(calibration.predict(grid()), calibration.recording, ax=ax, kind=kind, legend=False)
    _draw_truth(ax)
    ax.set_title(title, fontsize="medium", loc="left")


def figure_2(found: Mapping[tuple[str, int], Calibration]) -> "Figure":
    """MAP predictions of every model at every N: more data do not narrow them, a better model does."""
    figure, axes = _subplots(len(MODELS), len(SIZES), (7.6, 8.2), sharex=True, sharey=True)
    for (model, n), result in found.items():
        ax = axes[list(MODELS).index(model), SIZES.index(n)]
        sd = root_mean_square(result.predict(grid()).map.sd)
        # A spread of 1e-8 is what the smoothing of the likelihood leaves of zero.
        _fit(ax, result, f"{model}, N = {n}: rms sd {sd if sd > 1e-4 else 0:.2f}")
    for ax in axes.flat:
        ax.label_outer()
    _one_legend(figure, axes[0, 0], 4)
    return figure


def _contours(
    ax: "Axes", groups: Iterable[tuple[str, Calibration]], pair: tuple[int, int], levels: Sequence[float] = (0.5, 0.9)
) -> None:
    """Contours of the joint posterior of two of the a_jk, a colour for each group, with the MAP marked."""
    names: list[str] = []
    reach = []
    for i, (label, result) in enumerate(groups):
        color, dashes = style.CYCLE[i % len(style.CYCLE)]
        names = coefficient_names(result)
        draws = coefficients(result, result.draws)[:, list(pair)].numpy()
        reach.append(torch.from_numpy(draws).aminmax(dim=0))
        density = densities.pair_density(draws)
        if density is not None:
            heights = densities.contour_heights(density[2], levels)
            ax.contour(*density, heights, colors=color, linestyles=dashes, linewidths=1.2)
        ax.plot([], [], color=color, ls=dashes, label=label)
        point = coefficients(result)[list(pair)]
        ax.plot(*point.tolist(), "+", color=color, ms=7, mew=1.5)
    # The grid of a density is oblique, and reaches farther than its contours.
    low = torch.stack([part.min for part in reach]).amin(0)
    high = torch.stack([part.max for part in reach]).amax(0)
    ax.set_xlim(float(low[0]), float(high[0]))
    ax.set_ylim(float(low[1]), float(high[1]))
    ax.set_xlabel(names[pair[0]])
    ax.set_ylabel(names[pair[1]])
    style.dress(ax)
    ax.locator_params(nbins=5)


def figure_3(results: Mapping[tuple[int, float], Calibration]) -> "Figure":
    """Joint posterior of (a_00, a_10) of the linear model for each (N, ε): ε scales it and leaves its MAP."""
    sizes = sorted({n for n, _ in results})
    figure, axes = _subplots(1, len(sizes), (8.0, 3.9))
    spans = []
    for ax, n in zip(axes[0], sizes, strict=True):
        _contours(ax, [(f"ε = {e:g}", result) for (m, e), result in results.items() if m == n], (0, 2))
        ax.set_title(f"N = {n}", fontsize="medium", loc="left")
        spans.append([ax.get_xlim(), ax.get_ylim()])
    # Equal widths of the axes, so that widths of the posteriors can be compared.
    half = torch.tensor(spans).diff(dim=-1)[..., 0].amax(0) / 2
    for ax, span in zip(axes[0], spans, strict=True):
        (left, right), (bottom, top) = span
        ax.set_xlim((left + right) / 2 - float(half[0]), (left + right) / 2 + float(half[0]))
        ax.set_ylim((bottom + top) / 2 - float(half[1]), (bottom + top) / 2 + float(half[1]))
        style.legend(ax)
    figure.suptitle("Contours hold 50 and 90 % of the posterior; + is the MAP", fontsize="small")
    return figure


def figure_4(results: Mapping[float, Calibration]) -> "Figure":
    """Joint posteriors of (a_00, a_10) and (a_01, a_12) for each γ: γ moves the coefficients of the spread."""
    figure, axes = _subplots(1, 2, (8.0, 3.9))
    for ax, pair in zip(axes[0], [(0, 2), (1, 4)], strict=True):
        _contours(ax, [(f"γ = {gamma:g}", result) for gamma, result in results.items()], pair)
        style.legend(ax)
    figure.suptitle("Contours hold 50 and 90 % of the posterior; + is the MAP", fontsize="small")
    return figure


def figure_5(results: Mapping[float, Calibration]) -> "Figure":
    """MAP predictions of the linear model for each γ."""
    figure, axes = _subplots(1, len(results), (7.6, 3.6), sharey=True)
    for ax, (gamma, result) in zip(axes[0], results.items(), strict=True):
        _fit(ax, result, f"γ = {gamma:g}: rms sd {root_mean_square(result.predict(grid()).map.sd):.2f}")
        ax.label_outer()
    _one_legend(figure, axes[0, 0], 4)
    return figure


def figure_6(maxima: Sequence[Calibration]) -> "Figure":
    """Spurious maxima of the normal marginalized likelihood: one datum is met exactly, the others are missed."""
    figure, axes = _subplots(1, len(maxima), (9.6, 3.6), sharey=True)
    for ax, result in zip(axes[0], maxima, strict=True):
        prediction = result.predict()
        place = int(prediction.map.sd.argmin())
        where = round(float(result.recording.x[place]), 6) + 0.0  # no negative zero
        _fit(ax, result, f"σ = 0 at x = {where:.1f}")
        ax.plot(where, float(prediction.map.mean[place]), "o", ms=11, mfc="none", mec=style.MAP, mew=1.6, zorder=6)
        ax.label_outer()
    _one_legend(figure, axes[0, 0], 4)
    return figure


def figure_conventional(embedded: Mapping[int, Calibration], additive: Mapping[int, AdditiveCalibration]) -> "Figure":
    """Embedded and conventional calibration of the linear model: only the first keeps its error bar as N grows.

    The sd in the titles are of what the calibrated model itself predicts: the push-forward.
    """
    figure, axes = _subplots(2, len(SIZES), (9.8, 6.4), sharex=True, sharey=True)
    for j, n in enumerate(SIZES):
        sd = root_mean_square(embedded[n].predict(grid()).sd)
        _fit(axes[0, j], embedded[n], f"embedded, N = {n}: rms sd {sd:.2f}", kind="posterior")
        prediction = additive[n].predict(grid())
        plots.additive_fit(prediction, additive[n].recording, ax=axes[1, j], legend=False)
        _draw_truth(axes[1, j])
        sd = root_mean_square(prediction.push_forward.sd)
        axes[1, j].set_title(f"conventional, N = {n}: rms sd {sd:.2f}", fontsize="medium", loc="left")
    for ax in axes.flat:
        ax.label_outer()
    for ax in axes[:, -1]:
        ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), fontsize="small", frameon=False)
    return figure


def figure_corner(result: Calibration) -> "Figure":
    """All five a_jk of the linear model."""
    names = coefficient_names(result)
    axes = plots.corner(coefficients(result, result.draws), names, map_point=coefficients(result))
    return axes[0, 0].figure


# --- all of it -----------------------------------------------------------------------------------------------


def figures(*, seed: int = 0, epsilons: Sequence[float] = (0.1, 0.05, 0.01)) -> dict[str, "Figure"]:
    """Run the study and draw its figures, by name."""
    found = estimates(seed=seed)
    joint = {(n, e): posterior("linear", n, epsilon=e, seed=seed) for n in SIZES for e in epsilons}
    by_gamma = {1.0: joint[11, 0.1], 0.5: posterior("linear", 11, gamma=0.5, seed=seed)}
    additive = {n: conventional("linear", n, seed=seed) for n in SIZES}
    return {
        "fig2_map_predictions": figure_2(found),
        "fig3_posterior_n_epsilon": figure_3(joint),
        "fig4_posterior_gamma": figure_4(by_gamma),
        "fig5_prediction_gamma": figure_5(by_gamma),
        "fig6_spurious_maxima": figure_6(spurious_maxima(seed=seed)),
        "conventional_and_embedded": figure_conventional({n: joint[n, 0.1] for n in SIZES}, additive),
        "corner_linear": figure_corner(joint[11, 0.1]),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the figures as PNG."""
    import matplotlib

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, default=Path("outputs/cubic"), help="folder of the figures")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    matplotlib.use("Agg")
    options.out.mkdir(parents=True, exist_ok=True)
    sys.stdout.write(summary(estimates(seed=options.seed)) + "\n")
    for name, figure in figures(seed=options.seed).items():
        path = options.out / f"{name}.png"
        figure.savefig(path, dpi=130)
        sys.stdout.write(f"wrote {path}\n")


if __name__ == "__main__":
    main()
