"""The result of `torchcal.diagnose`."""

import html
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchcal.data import Recording
from torchcal.discovery.findings import as_json, words
from torchcal.discovery.misfit.embedded import Embedded
from torchcal.discovery.records import (
    Experiment,
    Fit,
    Hypothesis,
    Limit,
    Location,
    MissingRate,
    NeededShift,
    NoiseModel,
    Scores,
    Table,
)
from torchcal.simulators import Simulator

__all__ = ["Diagnosis"]


@dataclass(frozen=True, repr=False, eq=False)
class Diagnosis:
    """What was left out of a simulation, as far as a recording can tell.

    Attributes:
        verdict: ``"consistent"``: no more than noise; ``"named"``: ``terms`` were left out; ``"ambiguous"``: one of
            ``tied``, and these data cannot tell which; ``"unexplained"``: something is missing that is not in the
            library.
        terms: Names of the accepted terms, in order of acceptance.
        tied: Hypotheses that the data cannot tell apart, each a list of terms; the last is ``["none of these"]`` where
            the best of the library is not probable enough for a name. Beside a name, the hypotheses that hold it, where
            those with something more are likelier than it alone.
        where: Where the mismatch sits: equations, parameters or outputs, with spans and share of the misfit.
        ranking: All hypotheses, the best first.
        detection_limit: By candidate, the smallest effect that these data could have shown.
        remaining: Share of the squared misfit beyond noise that the accepted terms leave; at least what the likeliest
            hypothesis with more terms removes beyond them.
        before: Scores of the base.
        after: Scores with the accepted terms; None where nothing was accepted.
        improved: The simulator with the accepted terms; the simulator as it was where there are none.
        symptoms: Calibrated values, noise and initial values that give the mismatch away, in words.
        noise: What was taken for noise.
        base: The base's fit.
        final: The fit with the accepted terms (the base's where there are none).
        embedded: Model error embedded in one parameter of the base at a time, to first order; the likeliest first.
        shifts: The shift of each parameter that each stretch of data would need.
        missing: Non-parametric estimate of what is missing in the base.
        experiment: What would separate the tied hypotheses.
        equations: Formulas of the accepted terms with their estimates.
        identifiability: What these data cannot tell, in words.
        recording: The data.
        simulator: The base.
        held_out: Which outputs were held out, bool ``(n_total,)``; None where none were.
        set_aside: Which outputs were set aside as outliers, bool ``(n_total,)``.
        p_detect: Probability of so much misfit by noise alone.
        confidence: Asked for.
        library: Names of all candidates.
        settings: What else is behind the verdict: ``withdrawn`` and ``doubt`` (why there is no name, in words, or
            empty), ``depends`` (which estimate rests on what acts beside it, in words, or empty), ``pliant`` (whether
            all that is tied may stand for what is in no list), ``nearly`` (whether the name rests on the share of the
            misfit removed), ``set_aside`` (terms that may explain the outliers),
            ``feasible`` (as given),
            ``unknown_beside`` (terms beside which something unknown is likelier than alone),
            ``interrupted`` (what had not been refitted then, in words, or empty), ``region`` of a named local term;
            and ``seed`` and ``solver``.
        seconds: How long it took.
        drivers: Conditions, or time, states and inputs of the calibrated base, at every condition of the recording.
    """

    verdict: str
    terms: list[str]
    tied: list[list[str]]
    where: Table[Location]
    ranking: Table[Hypothesis]
    detection_limit: Table[Limit]
    remaining: float
    before: Scores
    after: Scores | None
    improved: Simulator
    symptoms: list[str]
    noise: NoiseModel
    base: Fit
    final: Fit
    embedded: Table[Embedded]
    shifts: list[NeededShift]
    missing: MissingRate | None
    experiment: Experiment | None
    equations: list[str]
    identifiability: list[str]
    recording: Recording
    simulator: Simulator
    held_out: Tensor | None
    set_aside: Tensor
    p_detect: float
    confidence: float
    library: list[str]
    settings: Mapping[str, Any]
    seconds: float
    drivers: Mapping[str, Tensor]

    def __str__(self) -> str:
        return words.paragraph(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"

    def plot(self, fig: Any = None) -> Any:
        """Draw data with both fits, where the mismatch sits, the ranking, what is needed, held-out data before and
        after, and detection limits: what there is of them."""
        from torchcal import plots

        return plots.discovery_overview(self, fig=fig)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything but the simulators, which are code, into one JSON file, whole or not at all.

        The keys are the names of the attributes, tables are lists of records, and what is infinite or no number is
        null. ``text`` is what ``print`` shows.

        Args:
            path: The file; an older one is replaced. Its folder must exist.

        Raises:
            DomainError: If the folder does not exist, or the path is a folder.
        """
        as_json.write(self, path)

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write everything into one self-contained HTML page.

        Args:
            path: The file; an older one is replaced. Its folder must exist.

        Raises:
            DomainError: If the folder does not exist, or the path is a folder.
        """
        from torchcal import report

        report.write(self, path)
