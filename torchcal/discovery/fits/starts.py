"""Where a calibration begins: guesses of parameters and of unknown initial states."""

import torch
from torch import Tensor

from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.read_back import read_back, slopes_by
from torchcal.simulators import Trajectories
from torchcal.simulators.layout import initial_name

__all__ = ["follow_slopes", "starts"]

#: Samples that the slope at the beginning is taken from.
SLOPES = (12, 5, 24, 48)
#: How many times longer or shorter than 1 a run must be for rates to be guessed from it.
LONG = 30.0
#: Steps towards these slopes; and the share of its squared error that one leaves, where it leads there.
STEPS, NEARER = 3, 0.5
#: Share of the largest value that noise may take an amount below zero.
NOISE = 0.1


def starts(problem: Problem, count: int, seed: int, fixed: dict[int, float] | None = None) -> Tensor:
    """Starting values ``(count, P)``: first guesses, then ever wilder ones within the bounds.

    Of runs that are far from 1 long, in whatever unit, every second start guesses positive parameters of which nothing
    is known as rates: about 1 over the length. It guesses unknown initial values of states that nothing records as what
    is recorded of states in the same unit, a hidden concentration or temperature like those that are seen; and where
    outputs are functions of such states, as what gives their first readings.
    """
    length = max((float(run.time[-1] - run.time[0]) for run in problem.recording.runs or ()), default=1.0)
    rate = torch.ones(count, dtype=torch.float64)
    if not 1 / LONG < length < LONG:
        rate[1::2] = 1.0 / length
    generator = torch.Generator().manual_seed(seed)
    columns = []
    spread = torch.linspace(0.0, 1.0, count, dtype=torch.float64) if count > 1 else torch.zeros(1, dtype=torch.float64)
    alike = _alike(problem)
    for i, q in enumerate(problem.parameters):
        noise = torch.randn(count, generator=generator, dtype=torch.float64) * spread
        unit = torch.rand(count, generator=generator, dtype=torch.float64)
        positive = q.transform == "log" or (q.low is not None and q.low >= 0)
        if fixed is not None and i in fixed:
            columns.append(torch.full((count,), fixed[i], dtype=torch.float64))
            continue
        if q.initial is not None and q.initial != 0:
            guess = q.initial * noise.exp() if positive else q.initial + abs(q.initial) * noise
        elif q.low is not None and q.high is not None:
            at = 0.5 + (unit - 0.5) * spread if q.initial is None else spread * unit * 0.2
            base = q.low if q.initial is None else q.initial
            width = q.high - q.low
            guess = base + at * width
            if q.transform == "log":
                guess = q.low * (q.high / q.low) ** at
        elif positive:
            guess = (1.5 * noise).exp() * rate + (q.low or 0.0)
        else:
            guess = (q.initial or 0.0) + noise
            if i in alike:
                mean, sd, amount = alike[i]
                guess[1::2] = mean + sd * noise[1::2]
                guess[1::2] = guess[1::2].abs() if amount else guess[1::2]
        low = -torch.inf if q.low is None else q.low
        high = torch.inf if q.high is None else q.high
        columns.append(guess.clamp(low, high))
    begin = torch.stack(columns, dim=-1)
    if problem.in_time and count > 1:
        begin[1::2] = read_back(problem, begin[1::2], set(fixed or ()))
    return begin


def _alike(problem: Problem) -> dict[int, tuple[float, float, bool]]:
    """By places of unknown initial values of states that nothing records: mean and sd of what is recorded of states in
    the same unit in that run, and whether that is an amount, which is never negative but for noise."""
    bound = problem.simulator
    if not isinstance(bound, Trajectories):
        return {}
    places = {q.name: i for i, q in enumerate(problem.parameters) if q.initial is None}
    states, reads, found = bound.ode.states, bound.ode.reads, {}
    for r, run in enumerate(bound.runs):
        for state, unit in states.items():
            name = initial_name(state, r, len(bound.runs))
            if name not in bound.initial_names or name not in places or not unit:
                continue
            like = [y for one, y in run.outputs.items() if one in reads and states[reads[one]] == unit]
            values = torch.cat([y[torch.isfinite(y)] for y in like]) if like else torch.zeros(0)
            if len(values) > 1:
                amount = float(values.min()) > -NOISE * float(values.max())
                found[places[name]] = (float(values.mean()), float(values.std()), amount)
    return found


def follow_slopes(problem: Problem, begin: Tensor) -> Tensor:
    """Unknown initial states moved so that observed states begin with the slope that was recorded.

    An unobserved velocity, say, is then the recorded position's slope, whatever the other parameters are. The slope is
    that of a parabola through the first samples, more or fewer of them from start to start.
    """
    bound = problem.simulator
    if not isinstance(bound, Trajectories) or not bound.initial_names:
        return begin
    names = list(bound.ode.states)
    targets: list[tuple[int, int, Tensor, float]] = []
    for r, run in enumerate(bound.runs):
        for name, y in run.outputs.items():
            state = bound.ode.reads.get(name)
            if state is None or name not in problem.recording.outputs:
                continue
            every = (~torch.isnan(y)).nonzero()[:, 0]
            if len(every) < 4:
                continue
            slopes = []
            for count in SLOPES:  # few samples are noisy, many are bent
                seen = every[:count]
                t = run.time[seen] - run.time[seen[0]]
                design = torch.stack([torch.ones_like(t), t, t.square()], dim=-1)
                slopes.append(torch.linalg.lstsq(design, y[seen][:, None]).solution[1, 0])
            seen = every[: SLOPES[0]]
            length = float(run.time[seen[-1]] - run.time[seen[0]])
            scale = float((y[seen] - y[seen].mean()).abs().max()) / max(length, 1e-300)
            each = torch.stack(slopes)[torch.arange(len(begin)) % len(SLOPES)]
            targets.append((r, names.index(state), each, max(scale, 1e-12)))
    if not targets:
        return begin
    places = [i for i, q in enumerate(problem.parameters) if q.name in bound.initial_names and q.initial is None]
    if not places:
        return begin
    run_of_place = torch.tensor([bound.layout.origins[i][1] for i in places])
    run_of_target = torch.tensor([r for r, *_ in targets])
    low, high = problem.limits()
    values, before, off = begin, begin, torch.full((len(begin), len(bound.runs)), torch.inf, dtype=torch.float64)
    for step in range(STEPS + 1):
        with torch.enable_grad():
            leaf = values[:, places].clone().requires_grad_(True)
            full = values.clone()
            full[:, places] = leaf
            rates = bound.slopes(full, bound.layout.start(full))
            left = torch.stack([(rates[:, r, i] - slope) / scale for r, i, slope, scale in targets], dim=-1)
            jacobian = slopes_by(leaf, left)
        acts = (jacobian != 0).any(-1).any(0)  # others are no matter of what a run begins with
        now = torch.zeros_like(off).index_add(1, run_of_target, torch.where(acts, left.detach().square(), 0.0))
        nearer = (now <= NEARER * off)[:, run_of_place]  # what a state has no say in leads ever farther away
        values = values.index_copy(1, torch.tensor(places), values[:, places].where(nearer, before[:, places]))
        if step == STEPS:
            break
        sound = torch.isfinite(jacobian).flatten(1).all(-1) & torch.isfinite(left).all(-1)
        jacobian = torch.where(sound[:, None, None], jacobian, torch.zeros_like(jacobian))
        change = torch.linalg.pinv(jacobian, rtol=1e-6) @ torch.nan_to_num(left.detach(), 0.0, 0.0, 0.0).unsqueeze(-1)
        moved = torch.where(nearer, values[:, places] - change[..., 0], values[:, places])
        moved = torch.where(torch.isfinite(moved).all(-1, keepdim=True), moved, values[:, places])
        before, off = values, now
        values = values.index_copy(1, torch.tensor(places), moved).clamp(low, high)
    return values.clamp(low, high)
