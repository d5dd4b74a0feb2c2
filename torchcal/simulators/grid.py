"""Time steps of every run of a recording, and which of their ends the samples are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcal.data import Run
from torchcal.errors import DomainError

__all__ = ["Grid"]

#: A run is first solved with at least this many steps.
MIN_STEPS = 48
#: Steps a run at most.
MOST_STEPS = 2_000_000


@dataclass(frozen=True, eq=False)
class Grid:
    """Steps of R runs, padded to one number K with steps of length zero.

    Attributes:
        t: Where steps begin, ``(R, K)``.
        h: How long they are, ``(R, K)``.
        nodes: Times of all ends of steps, ``(R, K + 1)``.
        u: Inputs at the beginning, middle and end of every step, ``{name: (3, R, K)}``.
        run_of: Run of every sample, ``(n,)``.
        node_of: Its node in that run, ``(n,)``.
        sample_t: Its time, ``(n,)``.
        sample_u: Inputs at it, ``{name: (n,)}``.
    """

    t: Tensor
    h: Tensor
    nodes: Tensor
    u: dict[str, Tensor]
    run_of: Tensor
    node_of: Tensor
    sample_t: Tensor
    sample_u: dict[str, Tensor]

    @classmethod
    def of(
        cls, runs: Sequence[Run], *, max_step: float | None, subdivide: int, denser: Sequence[Tensor] | None
    ) -> "Grid":
        """Steps that end at all samples, ``subdivide`` times shorter than the coarsest, and ``denser`` gap by gap."""
        grids, picks = [], []
        for r, run in enumerate(runs):
            gaps = run.time.diff()
            longest = float(run.time[-1] - run.time[0]) / MIN_STEPS
            if max_step is not None:
                longest = min(longest, max_step)
            counts = (gaps / (longest * (1 + 1e-9))).ceil().clamp_min(1).long() * subdivide
            if denser is not None:
                counts = counts * denser[r]
            if int(counts.sum()) > MOST_STEPS:
                raise DomainError(
                    f"Expected at most {MOST_STEPS:,} steps a run. Got {int(counts.sum()):,} (give a longer max_step)."
                )
            start = torch.repeat_interleave(run.time[:-1], counts)
            h = torch.repeat_interleave(gaps / counts, counts)
            offset = torch.arange(len(start)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
            grids.append((start + offset * h, h, run))
            picks.append(torch.cat([counts.new_zeros(1), counts.cumsum(0)]))
        most = max(len(h) for _, h, _ in grids)
        steps, starts, nodes = [], [], []
        inputs: dict[str, list[Tensor]] = {name: [] for name in runs[0].inputs}
        for start, h, run in grids:
            pad = most - len(h)
            steps.append(torch.cat([h, h.new_zeros(pad)]))
            starts.append(torch.cat([start, run.time[-1].expand(pad)]))
            nodes.append(torch.cat([starts[-1], (starts[-1][-1] + steps[-1][-1])[None]]))
            ends = torch.cat([start[1:], run.time[-1:]])
            stages = [run.inputs_at(start), run.inputs_at(0.5 * (start + ends)), run.inputs_at(ends, side="left")]
            for name, table in inputs.items():
                rows = torch.stack([stage[name] for stage in stages])
                table.append(torch.cat([rows, rows[:, -1:].expand(3, pad)], dim=1))
        return cls(
            t=torch.stack(starts),
            h=torch.stack(steps),
            nodes=torch.stack(nodes),
            u={name: torch.stack(table, dim=1) for name, table in inputs.items()},
            run_of=torch.cat([torch.full((len(run.time),), r) for r, run in enumerate(runs)]),
            node_of=torch.cat(picks),
            sample_t=torch.cat([run.time for run in runs]),
            sample_u={name: torch.cat([run.inputs[name] for run in runs]) for name in inputs},
        )

    @property
    def num_steps(self) -> int:
        """K."""
        return self.h.shape[1]

    def part(self, first: int, last: int) -> "Grid":
        """The steps from one to another, those of samples left out."""
        steps = slice(first, last)
        u = {name: table[:, :, steps] for name, table in self.u.items()}
        nodes = self.nodes[:, first : last + 1]
        return replace(self, t=self.t[:, steps], h=self.h[:, steps], nodes=nodes, u=u)

    @property
    def step_run(self) -> Tensor:
        """Run of every step of the flattened grid, ``(R K,)``."""
        return torch.arange(len(self.h)).repeat_interleave(self.num_steps)

    @property
    def flat(self) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Beginnings ``(R K,)``, lengths ``(R K,)`` and inputs ``(3, R K)`` of all steps of all runs."""
        return self.t.reshape(-1), self.h.reshape(-1), {name: u.reshape(3, -1) for name, u in self.u.items()}

    def steps_between(self, run: int) -> Tensor:
        """Number of steps between neighbouring samples of a run."""
        return self.node_of[self.run_of == run].diff()
