"""Frozen records that a diagnosis is made of, and the list that prints them as a table."""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from torch import Tensor

from torchcal.display import between, placed, with_unit
from torchcal.errors import MissingDependencyError

__all__ = [
    "Estimate",
    "Experiment",
    "Fit",
    "Hypothesis",
    "Limit",
    "Location",
    "MissingRate",
    "NeededShift",
    "NoiseModel",
    "Score",
    "Scores",
    "Table",
]

Record = TypeVar("Record")


class Table(list[Record], Generic[Record]):
    """A list of frozen records that prints as a table and turns into a pandas frame."""

    def __init__(self, records: Iterable[Record] = (), columns: tuple[str, ...] = ()) -> None:
        super().__init__(records)
        self.columns = columns

    def rows(self) -> list[dict[str, Any]]:
        """One dict per record, of the table's columns."""
        return [{name: getattr(record, name) for name in self.columns} for record in self]

    def to_frame(self) -> Any:
        """The table as a ``pandas.DataFrame``."""
        try:
            import pandas
        except ImportError as error:
            raise MissingDependencyError(
                "Expected pandas for to_frame(). Got no such package (pip install pandas)."
            ) from error
        return pandas.DataFrame(self.rows(), columns=list(self.columns))

    def __str__(self) -> str:
        if not self:
            return "(empty)"
        cells = [
            [_text(value, getattr(record, "extent", None)) for value in row.values()]
            for record, row in zip(self, self.rows(), strict=True)
        ]
        heads = [name.replace("_", " ") for name in self.columns]
        widths = [max(len(head), *(len(row[i]) for row in cells)) for i, head in enumerate(heads)]
        lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
                 for row in [heads, *cells]]  # fmt: skip
        return "\n".join(lines)

    __repr__ = __str__


def _text(value: Any, extent: float | None = None) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "-" if value == -math.inf else f"{value:.4g}"  # nothing was worked out
    if isinstance(value, tuple) and value and all(isinstance(item, tuple) for item in value):
        return ", ".join(between(value, "to", extent))
    if isinstance(value, tuple | list):
        return ", ".join(_text(item) for item in value)
    return str(value)


@dataclass(frozen=True)
class Estimate:
    """A parameter's estimate.

    Attributes:
        name: For a term's own parameter ``"term.parameter"``.
        value: In ``unit``.
        sd: Standard deviation; infinite where the data do not say.
        unit: Its unit, where known.
        at_bound: Whether the estimate lies on one of its bounds.
        interval: 95 % interval by profile likelihood where ``value ± 1.96 sd`` is none, of what is named; an end is
            infinite where the data leave it open. Else None.
    """

    name: str
    value: float
    sd: float
    unit: str | None = None
    at_bound: bool = False
    interval: tuple[float, float] | None = None

    def __str__(self) -> str:
        return f"{self.name} = {self.amount}"

    @property
    def amount(self) -> str:
        """Value, sd and unit in words."""
        spread = f" ± {self.sd:.2g}" if math.isfinite(self.sd) else "" if self.interval else " (not determined)"
        text = f"{placed(self.value, 100 * self.sd)}{spread}"  # to where the sd begins at least
        return with_unit(text, self.unit) + (" (at its bound)" if self.at_bound else "") + self.asymmetry

    @property
    def asymmetry(self) -> str:
        """The interval in words that the sd do not tell; empty where they do."""
        if self.interval is None:
            return ""
        low, high = (placed(end, 100 * self.sd) for end in self.interval)
        if math.isinf(self.interval[0]):
            return f" (95 %: below {high})"
        return f" (95 %: {low} to {high})" if math.isfinite(self.interval[1]) else f" (95 %: above {low})"


@dataclass(frozen=True)
class NoiseModel:
    """What is taken for noise, by output.

    Attributes:
        sd: Standard deviation of the noise by output, in its unit; the median where it varies from datum to datum.
        correlation: Correlation of neighbouring samples (AR(1) coefficient) by output; 0 is white.
        source: ``"given"``, ``"replicates"``, ``"estimated"`` or ``"none"`` (a detailed simulation).
        outliers: Number of samples that were set aside as outliers.
        quantisation: Step by output where the recording is quantised.
        range: Smallest and largest sd by output, where it varies.
        memory: Where runs are sampled unevenly, whether correlated noise forgets with ``"time"``, the correlation being
            that over the usual gap, or with every ``"sample"``; else empty.
        enlarged: How many times as large as given noise was taken that no arithmetic can weigh; else 1.
    """

    sd: dict[str, float]
    correlation: dict[str, float]
    source: str
    outliers: int = 0
    quantisation: dict[str, float] = dataclasses.field(default_factory=dict)
    range: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    memory: str = ""
    enlarged: float = 1.0


@dataclass(frozen=True, eq=False)
class Fit:
    """A model fitted to the recording.

    Attributes:
        terms: The terms that it holds beside the base.
        estimates: Every free parameter, unknown initial states among them.
        prediction: Fitted outputs ``(n_total,)``, in the order of ``recording.y``.
        residual: ``y − prediction``, NaN where not observed, ``(n_total,)``.
        chi2: Whitened squared misfit.
        p_white: Probability of so much structure in the residual by noise alone.
    """

    terms: tuple[str, ...]
    estimates: tuple[Estimate, ...]
    prediction: Tensor
    residual: Tensor
    chi2: float
    p_white: float


@dataclass(frozen=True)
class Hypothesis:
    """One row of the ranking.

    Attributes:
        terms: Names of the terms added to the base; empty for the base itself, ``("none of these",)`` for
            something that is not in the library.
        log_evidence: Relative to the base, natural logarithm, penalties included.
        probability: Among all hypotheses considered.
        estimates: Of the terms' parameters.
        physical: Whether signs and ranges are physically possible.
        misfit_removed: Share of the squared misfit beyond noise that it removes; None where nobody knows.
        p_white: Probability of so much structure in what is left by noise alone.
        held_out_rmse: RMSE on held-out data; None where it was not tried, as for what is improbable.
        score: Screening statistic z of its tangent.
        refitted: Whether base and terms were refitted together; otherwise the numbers are the screening's.
        region: Where a local term acts, in words; None where it acts everywhere.
        aliases: Other candidates with the same projected tangent.
        note: Anything that speaks against it, in words.
    """

    terms: tuple[str, ...]
    log_evidence: float
    probability: float
    estimates: tuple[Estimate, ...] = ()
    physical: bool = True
    misfit_removed: float | None = None
    p_white: float | None = None
    held_out_rmse: float | None = None
    score: float | None = None
    refitted: bool = False
    region: str | None = None
    aliases: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Location:
    """Where a share of the mismatch sits.

    Attributes:
        kind: ``"equation"``, ``"output"`` or ``"parameter"``.
        target: Name of that equation (its state), output or parameter.
        driver: What the mismatch varies with: a condition, ``"t"``, a state, an input, or ``"run"``, counted from 0.
        spans: Ranges of the driver in which it sits, as far as that is sure, ``((low, high), …)``; none along two.
        share: Share of the misfit beyond noise that a change there, varying with the driver, can remove.
        evidence: Log evidence of an unknown change there, smooth, an oscillation or in steps, against none.
        period: Of an oscillation, in units of the driver; None of any other change.
        extent: How far the driver extends in the recording; None where nobody knows.
        edges: Of a change in steps, the values of the driver where it begins or ends; none of any other change.
        terms: Where it is that some terms act, their names: the share is what they remove, and the evidence theirs.
        run: Of a change in one run of several alone, which, counted from 0.
        also: Kinds and targets of what else some terms together act on: what varies with the driver is then what they
            do together.
        at: The levels of another condition at which it changes alone, in words; empty where it does at all.
        together: The two conditions where it varies with both together, more than with each by itself; else none.
        moment: Of a change in a moment, when that is; None of any other change.
    """

    kind: str
    target: str
    driver: str
    spans: tuple[tuple[float, float], ...]
    share: float
    evidence: float
    period: float | None = None
    extent: float | None = None
    edges: tuple[float, ...] = ()
    terms: tuple[str, ...] = ()
    run: int | None = None
    also: tuple[tuple[str, str], ...] = ()
    at: str = ""
    together: tuple[str, ...] = ()
    moment: float | None = None

    @property
    def called(self) -> str:
        """What it is a place in, in words."""
        places = " and the ".join(f"{kind} {target}" for kind, target in ((self.kind, self.target), *self.also))
        return places + ("" if self.run is None else f" of run {self.run} (counted from 0)")


@dataclass(frozen=True)
class Limit:
    """The smallest effect that these data could have shown.

    Attributes:
        term: The candidate.
        parameter: Its amplitude.
        smallest: Smallest detectable magnitude, in ``unit``; infinite where the data cannot tell at all. As of the
            estimate, the distance from the amplitude's neutral value counts (of a reaction order of 1.2, 0.2).
        unit: Unit of the amplitude.
        power: Probability with which an effect of this size is detected.
        estimate: What the term takes up where it alone is fitted beside the base: what others do as well, so that it is
            no sign of the term where something else is missing.
        note: ``"already in the base model"`` or the like.
        sign: 1 or −1 where ``smallest`` is of effects of that sign, as calibration hides those of the other whatever
            their size; 0 where it is of any that its bounds allow.
        comparable: Whether the estimate is of the shape that ``smallest`` is of: else one is no multiple of the other.
    """

    term: str
    parameter: str
    smallest: float
    unit: str | None
    power: float
    estimate: float | None = None
    note: str = ""
    sign: int = 0
    comparable: bool = True


@dataclass(frozen=True)
class Score:
    """How well a model predicts some data.

    Attributes:
        rmse: Root mean squared error in units of each output's spread where there are several, else in its unit.
        log_score: Mean log predictive density a datum.
        coverage: Share of the data within the 95 % predictive interval.
        n: Number of data.
    """

    rmse: float
    log_score: float
    coverage: float
    n: int


@dataclass(frozen=True, eq=False)
class Scores:
    """A model's scores on the data it was fitted to and on those held out.

    Attributes:
        fitted: All data, final fit.
        held_out: Data that the fit never saw; None where none could be held out.
        prediction: What the fit without the held-out data predicts, ``(n_total,)``.
        model_error_sd: Embedded model-error sd, root mean square over the data, in the outputs' unit (of several
            outputs in their spreads).
    """

    fitted: Score
    held_out: Score | None
    prediction: Tensor | None = dataclasses.field(repr=False)
    model_error_sd: float | None = None


@dataclass(frozen=True, eq=False)
class NeededShift:
    """The shift of one parameter that each stretch of data would need.

    Attributes:
        parameter: Which parameter.
        unit: Its unit.
        driver: What it varies with most.
        values: Values of the driver, ``(m,)``.
        shift: Needed shift there, ``(m,)``.
        sd: Its standard deviation, ``(m,)``.
        correlation: Rank correlation of shift and driver.
        share: Share of the misfit beyond noise that it removes, beside what the base's own parameters do.
    """

    parameter: str
    unit: str | None
    driver: str
    values: Tensor
    shift: Tensor
    sd: Tensor
    correlation: float
    share: float = math.nan


@dataclass(frozen=True, eq=False)
class MissingRate:
    """A non-parametric estimate of what is missing, as a smooth function of one driver or an oscillation along it.

    Attributes:
        kind: ``"equation"``: a rate added to an equation; ``"output"``: a shift of an output; ``"parameter"``: a shift
            of a parameter.
        target: Name of that equation (its state), output or parameter.
        driver: What it is drawn against.
        values: Driver values, ascending, ``(m,)``.
        rate: Estimate there, ``(m,)``, in ``unit``; relative to its median where the base's own parameters make up for
            what is the same everywhere, and without what else they make up for where that is most of it.
        sd: Its standard deviation, ``(m,)``.
        unit: Unit of the rate.
        time: Times of the grid along the calibrated trajectory, ``(T,)``; the conditions' rows in the
            recording for a static one.
        along: Estimate along that grid, ``(T,)``.
        run: Of a change in one run of several alone, which, counted from 0; the grid is that run's then.
        share: Share of the misfit beyond noise that it removes, beside what the base's own parameters do.
    """

    kind: str
    target: str
    driver: str
    values: Tensor
    rate: Tensor
    sd: Tensor
    unit: str | None
    time: Tensor
    along: Tensor
    run: int | None = None
    share: float = math.nan


@dataclass(frozen=True)
class Experiment:
    """A new condition that would tell tied hypotheses apart.

    Attributes:
        description: In words.
        separation: Predicted distance of the two nearest tied models of those that it tells apart, in noise sd (root
            of the expected χ² difference).
        conditions: Ready for a new recording: in time ``{"time": (T,), "initial": {state: value}, "inputs":
            {input: (T,)}}``, otherwise ``{"x": {condition: (n,)}}``. Found for the first eight tied models.
        untold: Pairs of hypotheses that none of the experiments tried in thought tells apart.
    """

    description: str
    separation: float
    conditions: dict[str, Any] = dataclasses.field(default_factory=dict, repr=False)
    untold: list[tuple[str, str]] = dataclasses.field(default_factory=list)
