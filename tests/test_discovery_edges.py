"""Cases at the edge of what `diagnose` is made for: names, bounds at one side, runs with nothing in them, no misfit."""

import math
import re
import warnings

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.discovery.findings import where
from torchcal.discovery.fits.problem import Problem
from torchcal.discovery.fits.ranges import Scale, sized
from torchcal.discovery.fits.shapes import shape_points
from torchcal.discovery.hypotheses import verify
from torchcal.errors import DomainError, SimulatorError

F64 = torch.float64


def diagnose(simulator, recording, terms=(), **options):
    return tc.diagnose(simulator, recording, list(terms), **{"seed": 0, "progress": False, **options})


def noise(n, seed):
    return torch.as_tensor(np.random.default_rng(seed).standard_normal(n))


def test_a_condition_may_be_called_t():
    """Only the time of differential equations is cut finer than conditions are, and has no decades."""
    x = torch.logspace(-2, 2, 160, dtype=F64)
    y = 1 + 0.5 * x.log() + 0.06 * torch.exp(-((x.log() + 1) ** 2) / 0.5) + 0.02 * noise(160, 3)
    found = []
    for name in ("t", "dose"):
        simulator = tc.Simulator(
            lambda x, p, name=name: p["a"] + p["b"] * x[name].log(), [tc.Parameter("a"), tc.Parameter("b")]
        )
        found.append(diagnose(simulator, tc.Recording(x={name: x}, y=y, noise=0.02)))
    assert found[0].verdict == found[1].verdict == "unexplained"
    assert found[0].where[0].evidence == pytest.approx(found[1].where[0].evidence)
    assert found[0].p_detect == found[1].p_detect


def test_a_run_of_which_nothing_was_seen_is_no_trouble():
    t = torch.linspace(0, 10, 60, dtype=F64)
    step = (t > 8.5).double()  # nothing before the end foretells what it does
    x = 1 + 0.5 * t + 0.3 * torch.cumsum(step, 0) + 0.05 * noise(60, 1)
    model = tc.ODESimulator(
        lambda t, s, p, u: {"x": p["a"] + p["b"] * u["f"]}, {"x": "m"}, [tc.Parameter("a"), tc.Parameter("b")]
    )
    blank = torch.full((60,), math.nan, dtype=F64)
    runs = [tc.Run(time=t, outputs={"x": y}, inputs={"f": step}, initial={"x": 1.0}) for y in (x, blank)]
    recording = tc.Recording(runs=runs, missing=True)
    assert int(verify.within(recording).sum()) > 0
    d = diagnose(model, recording)
    assert d.verdict == "consistent"
    assert not bool(d.held_out[60:].any())


@pytest.mark.parametrize(
    ("parameter", "fits"),
    [
        (tc.Parameter("n", low=3.0), lambda v: v > 3),
        (tc.Parameter("n", low=3.0, initial=4.0), lambda v: v > 3),
        (tc.Parameter("n", high=-3.0), lambda v: v < -3),
        (tc.Parameter("n", high=0.5), lambda v: v < 0.5),
        (tc.Parameter("n", low=0.0), lambda v: v > 0),
    ],
)
def test_a_shape_is_tried_within_its_only_bound(parameter, fits):
    for count in (1, 5):
        points = shape_points(parameter, count)
        assert len(points) == count
        assert all(fits(point) for point in points)
    if parameter.initial is not None:
        assert shape_points(parameter, 1) == [parameter.initial]
    assert shape_points(tc.Parameter("n", low=0.0), 3) == [0.25, 1.0, 4.0] == shape_points(tc.Parameter("n"), 3)


@pytest.mark.parametrize(
    ("given", "low", "high", "initial"),
    [
        ({}, None, None, None),
        ({"low": 2.0, "initial": 3.0}, 2.0, None, 3.0),
        ({"high": 4.0, "initial": 5.0 - 2.0}, None, 4.0, 3.0),
        ({"low": 1e6}, 1e6, None, None),
        ({"low": 0.0}, None, None, None),  # and no smaller range than without
    ],
)
def test_what_is_said_of_a_shape_holds_on_a_scale_too(given, low, high, initial):
    def ranged(**given):
        term = tc.Term(
            "onset", equation="x", rate=lambda t, s, p, u: p["k"] * torch.exp(-t / p["tau"]), scales={"tau": "t"},
            parameters=[tc.Parameter("k"), tc.Parameter("tau", **given)],
        )  # fmt: skip
        return sized(term, Scale({"t": 10.0}, {}), recording).parameters[1]

    t = torch.linspace(0, 10, 21, dtype=F64)
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"x": t})])
    plain, found = ranged(), ranged(**given)
    assert found.low == (plain.low if low is None else low)
    if low == 1e6:  # beyond all that the scale has: as many times that
        high = 1e6 * plain.high / plain.low
    assert found.high == pytest.approx(plain.high if high is None else high)
    assert found.initial == initial


def test_structure_in_less_than_noise_removes_no_misfit():
    x = torch.linspace(0, 1, 39, dtype=F64)
    y = 1 + 2 * x + 0.025 * torch.sin(4 * math.pi * x) + 0.004 * noise(39, 0)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    d = diagnose(line, tc.Recording(x=x, y=y, noise=0.02))
    assert d.base.chi2 < 37  # given too large
    assert d.verdict == "unexplained"
    assert all(place.share == 0.0 for place in d.where)
    text = " ".join(str(d).split())
    assert "though it is no larger than noise" in text
    assert "100 % of the misfit" not in text


def test_an_estimate_at_a_bound_of_zero_is_determined():
    x = torch.linspace(0, 1, 60, dtype=F64)
    y = 1 + 2 * x - 0.05 * x**2 + 0.01 * noise(60, 1)
    curve = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * x + p["c"] * x**2,
        [tc.Parameter("a"), tc.Parameter("b"), tc.Parameter("c", low=0.0)],
    )
    found = diagnose(curve, tc.Recording(x=x, y=y, noise=0.01)).base.estimates[2]
    assert (found.value, found.at_bound) == (0.0, True)
    assert 0 < found.sd < 0.1
    assert "not determined" not in str(found)


def test_equal_values_have_one_rank():
    assert where._ranks(torch.tensor([3.0, 1.0, 3.0, 2.0])).tolist() == [3.5, 1.0, 3.5, 2.0]
    assert where._ranks(torch.ones(3)).tolist() == [2.0, 2.0, 2.0]


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_a_base_that_is_constant_by_itself_has_not_got_lost(scale):
    x = torch.linspace(0, 1, 40, dtype=F64)
    wave = 0.03 * torch.sin(6.3 * x)
    y = {"one": 1 + wave + 0.01 * noise(40, 0), "other": scale * (1 + wave + 0.01 * noise(40, 1))}
    flat = tc.Simulator(
        lambda x, p: {"one": p["a"] + 0 * x, "other": p["b"] + 0 * x}, [tc.Parameter("a"), tc.Parameter("b")]
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        d = diagnose(flat, tc.Recording(x=x, y=y))
    assert not d.settings["lost"]
    assert not any("constant" in str(one.message) for one in caught)


def test_a_small_share_of_short_runs_is_held_out():
    t = torch.linspace(0, 1, 15, dtype=F64)
    recording = tc.Recording(runs=[tc.Run(time=t, outputs={"x": t + shift}) for shift in (0, 1)])
    mask = verify.choose(recording, 0.05, 1)
    assert mask.nonzero()[:, 0].tolist() == [14, 29]
    assert int(verify.choose(recording, 0.2, 1).sum()) == 6


def test_what_is_held_out_may_be_a_column_of_a_table():
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame({"x": np.linspace(0, 1, 20), "y": np.zeros(20)})
    recording = tc.Recording(x=table.x, y=table.y)
    last = table.x > 0.7  # whose numbers pandas does not let be written
    assert verify.choose(recording, last, 2).tolist() == last.tolist()


@pytest.mark.parametrize("each", [1, 3, 4])
def test_replicates_are_held_out_together(each):
    x = torch.linspace(0, 1, 14, dtype=F64).repeat(each)
    recording = tc.Recording(x=x, y=noise(len(x), 0))
    for mask in (verify.choose(recording, None, 2), verify.within(recording)):
        shares = mask.reshape(each, 14).double().mean(0)
        assert set(shares.tolist()) == {0.0, 1.0}
        assert 2 <= int(shares.sum()) <= 4
    x = torch.tensor([0.0, 1.0], dtype=F64).repeat_interleave(10)  # of two conditions neither can go
    recording = tc.Recording(x=x, y=noise(20, 0))
    assert int(verify.choose(recording, None, 2).sum()) == 5
    assert int(verify.within(recording).sum()) > 0


@pytest.mark.parametrize("missing", [False, True])
def test_whole_corners_of_a_factorial_are_held_out_in_any_order_of_the_rows(missing):
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=F64)] * 3).repeat(4, 1)
    y = noise(32, 0)
    if missing:
        y[:8] = math.nan
    found = []
    for order in (torch.arange(32), torch.randperm(32, generator=torch.Generator().manual_seed(1))):
        columns = corners[order]
        recording = tc.Recording(x=dict(zip("abc", columns.unbind(-1), strict=True)), y=y[order], missing=missing)
        mask = verify.choose(recording, None, 2)
        level = columns.unique(dim=0, return_inverse=True)[1]
        seen = ~y[order].isnan()
        assert set(level[mask].tolist()).isdisjoint(level[seen & ~mask].tolist())
        found.append(set(level[mask].tolist()))
        assert len(found[-1]) == 2
    assert found[0] == found[1]


@pytest.mark.parametrize("size", [0.0, 1e-9])
def test_what_leaves_rounding_alone_is_named_though_nobody_said_that_there_is_no_noise(size):
    x = torch.arange(40, dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")])
    d = diagnose(line, tc.Recording(x=x, y=1 + 0.5 * x + 0.004 * x**2 + size * noise(40, 0)), [bend])
    assert (d.terms, d.remaining) == (["bend"], 0.0)
    assert d.ranking[0].estimates[0].value == pytest.approx(0.004)


def through_numpy(values):
    return torch.as_tensor(np.exp(values.detach().numpy()))


def decay(exp, *, part=False):
    def outputs(x, p):
        return p["a"] * exp(-p["k"] * x) * (p["a"].detach() if part else 1.0)

    return tc.Simulator(outputs, [tc.Parameter("a", low=0.0, initial=2.0), tc.Parameter("k", low=0.0, initial=1.0)])


@pytest.mark.parametrize(
    ("simulator", "of"),
    [(decay(through_numpy), "'k'"), (decay(torch.exp, part=True), "'a'")],
    ids=["NumPy", "a factor that is detached"],
)
def test_a_simulator_that_loses_a_derivative_is_refused(simulator, of):
    x = torch.linspace(0, 4, 60, dtype=F64)
    recording = tc.Recording(x=x, y=3 * torch.exp(-0.7 * x) + 0.02 * noise(60, 0), noise=0.02)
    with pytest.raises(SimulatorError, match=f"Expected the simulator to depend on {of} through torch operations"):
        diagnose(simulator, recording)


@pytest.mark.parametrize("lost", ["h", "x0", None])
def test_a_term_that_loses_a_derivative_is_refused(lost):
    def bump(x, p, y):
        h, x0 = (p[name].detach() if name == lost else p[name] for name in ("h", "x0"))
        return y + h * torch.exp(-((x - x0) ** 2))

    x = torch.linspace(0, 4, 60, dtype=F64)
    y = 3 * torch.exp(-0.7 * x) + 0.3 * torch.exp(-((x - 2) ** 2)) + 0.02 * noise(60, 0)
    term = tc.Term("bump", outputs={"y": bump}, parameters=[tc.Parameter("h"), tc.Parameter("x0", low=0.0, high=4.0)])
    recording = tc.Recording(x=x, y=y, noise=0.02)
    if lost is None:
        assert diagnose(decay(torch.exp), recording, [term]).terms == ["bump"]
        return
    with pytest.raises(SimulatorError, match=f"with 'bump' to depend on 'bump.{lost}' through torch operations"):
        diagnose(decay(torch.exp), recording, [term])


def test_a_kink_is_no_lost_derivative():
    x = torch.linspace(0, 4, 60, dtype=F64)
    rest = tc.Term(
        "stop", outputs={"y": lambda x, p, y: y - p["c"].clamp_min(0.0) * (y - p["y0"]).clamp_min(0.0)},
        parameters=[tc.Parameter("c", low=0.0), tc.Parameter("y0", low=0.0, high=3.0)],
    )  # fmt: skip
    step = tc.Term(
        "step", outputs={"y": lambda x, p, y: y + p["h"] * (x > p["x0"])},
        parameters=[tc.Parameter("h"), tc.Parameter("x0", low=0.0, high=4.0)],
    )  # fmt: skip
    recording = tc.Recording(x=x, y=3 * torch.exp(-0.7 * x) + 0.02 * noise(60, 0), noise=0.02)
    assert diagnose(decay(torch.exp), recording, [rest, step]).verdict == "consistent"


def guarded(x, p):
    if bool((p["k"] < 0).any()) or bool((p["share"] > 1).any()):
        raise ValueError("no such thing")
    return p["share"] * torch.exp(-p["k"] * x)


X = torch.linspace(0, 1, 40, dtype=F64)
SOUND = {
    "odd in what starts at 0": (
        lambda x, p: p["a"] * torch.sin(86400 * p["w"] * x),
        [tc.Parameter("a", initial=1.0), tc.Parameter("w", low=-1e-4, high=1e-4)],
        torch.sin(2.6 * X),
    ),
    "single precision": (
        lambda x, p: (p["c"].float() - 1000 * torch.exp(-p["k"] * x).float()).double(),
        [tc.Parameter("c", initial=1000.0), tc.Parameter("k", initial=1.0)],
        1000 - 1000 * torch.exp(-1.1 * X),
    ),
    "guarded bounds": (
        guarded,
        [tc.Parameter("k", low=0.0, initial=0.0), tc.Parameter("share", low=0.0, high=1.0, initial=1.0)],
        0.9 * torch.exp(-0.3 * X),
    ),
    "tiny units": (
        lambda x, p: torch.tanh(p["m"] * x / 4e-21),
        [tc.Parameter("m", low=-1e-20, high=1e-20)],
        torch.tanh(0.8 * X),
    ),
}


@pytest.mark.parametrize("name", SOUND)
def test_a_sound_derivative_is_not_refused(name):
    function, parameters, y = SOUND[name]
    sd = 0.02 * float(y.max() - y.min())
    recording = tc.Recording(x=X, y=y + sd * noise(40, 1), noise=sd)
    assert diagnose(tc.Simulator(function, parameters), recording).verdict == "consistent"


@pytest.mark.slow
@pytest.mark.parametrize("given", [None, 8.0])
def test_a_shape_may_lie_beyond_the_range_that_was_recorded_unless_a_bound_was_given(given):
    x = torch.linspace(0.05, 10, 80, dtype=F64)
    y = 2 * x / (x + 0.3) + 1.5 * x / (x + 20) + 0.01 * noise(80, 2)
    one_site = tc.Simulator(
        lambda x, p: p["q"] * x / (x + p["K"]),
        [tc.Parameter("q", low=0.1, high=10, initial=2.0), tc.Parameter("K", low=0.01, high=10, initial=0.5)],
    )
    second = tc.Term(
        "second site", outputs={"y": lambda x, p, y: y + p["a"] * x / (x + p["far"])},
        parameters=[tc.Parameter("a", low=0.0), tc.Parameter("far", low=0.0, high=given)], scales={"far": "x"},
    )  # fmt: skip
    d = diagnose(one_site, tc.Recording(x=x, y=y, noise=0.01), [second])
    if given is None:
        far = next(e for e in d.final.estimates if e.name == "second site.far")
        assert d.terms == ["second site"]
        assert far.value == pytest.approx(20, abs=4 * far.sd)
        assert not far.at_bound
        assert {q.name: q for q in d.improved.parameters}["second site.far"].high == 40.0
    else:
        assert d.terms == []
        assert any(row.note == "at its bound: second site.far" for row in d.ranking)


@pytest.mark.slow
def test_a_jump_that_is_tried_at_a_datum_is_no_lost_derivative():
    jump = tc.Term(
        "jump", outputs={"y": lambda x, p, y: y + p["h"] * torch.sign(x - p["x0"])},
        parameters=[tc.Parameter("h"), tc.Parameter("x0")], scales={"x0": "x"},
    )  # fmt: skip
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    recording = tc.Recording(x=X, y=1 + X + 0.3 * torch.sign(X - 0.6) + 0.02 * noise(40, 1), noise=0.02)
    assert diagnose(line, recording, [jump]).verdict != "consistent"


def test_a_threshold_at_a_datum_is_no_lost_derivative():
    """Thresholds are tried at the data's own values, where their slope is that of one side."""
    x = torch.linspace(0, 1, 12, dtype=F64)
    recording = tc.Recording(x=x, y=(1 + x).minimum(torch.tensor(1.6)) + 0.01 * noise(12, 1), noise=0.01)
    rising = tc.Simulator(lambda x, p: p["a"] + x, [tc.Parameter("a")])
    problem = Problem.of(rising, recording)
    stop = tc.Term(
        "stop", outputs={"y": lambda x, p, y: y - p["c"] * (y - p["y0"]).clamp_min(0.0)},
        parameters=[tc.Parameter("c", low=0.0), tc.Parameter("y0", low=1.0, high=2.0)],
    )  # fmt: skip
    with_stop = problem.with_simulator(tc.terms.extend(rising, [stop]))
    for at in (10, 9):  # one or two data beyond it
        with_stop.check_slopes(torch.tensor([1.0, 0.5, float(1 + x[at])], dtype=F64), [1, 2])
    assert diagnose(rising, recording, [stop]).terms == ["stop"]


def test_inference_mode_is_refused():
    x = torch.linspace(0, 4, 20, dtype=F64)
    with torch.inference_mode(), pytest.raises(DomainError, match="inference_mode"):
        diagnose(decay(torch.exp), tc.Recording(x=x, y=torch.exp(-x)))


def test_a_table_that_was_read_twice_has_no_replicates():
    x = torch.linspace(0, 4, 40, dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    for times, differ in ((1, False), (2, False), (3, False), (2, True)):
        scatter = noise(40 * times, 2) if differ else noise(40, 2).repeat(times)
        d = diagnose(line, tc.Recording(x=x.repeat(times), y=(1 + 0.5 * x).repeat(times) + 0.1 * scatter))
        assert (d.verdict, d.noise.outliers) == ("consistent", 0)
        assert d.noise.sd["y"] == pytest.approx(0.1, rel=0.15)
        assert (d.noise.source == "replicates") is differ
        assert any("read twice" in line for line in d.symptoms) is (times > 1 and not differ)


@pytest.mark.parametrize(("held", "left"), [(slice(0, 20), 0), (slice(20, 40), 20)])
def test_what_is_there_twice_cannot_be_held_out_of_itself(held, left):
    x = torch.linspace(0, 4, 20, dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    mask = torch.zeros(40, dtype=torch.bool)
    mask[held] = True
    recording = tc.Recording(x=x.repeat(2), y=(1 + x + 0.1 * noise(20, 0)).repeat(2))
    with pytest.raises(DomainError, match=f"Got {left} left"):
        diagnose(line, recording, holdout=mask)


def test_readings_that_always_agree_tell_nothing_of_the_noise():
    x = torch.tensor([0.0, 1.0, 2.0, 3.0, 4.0], dtype=F64).repeat_interleave(6)
    y = ((1 + 0.5 * x + 0.02 * torch.sin(3 * x)) * 10).round() / 10
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")])
    d = diagnose(line, tc.Recording(x=x, y=y), [bend])
    assert (d.verdict, d.noise.source) == ("consistent", "estimated")


SQUARE, CUBE = (
    tc.Term(name, outputs={"y": lambda x, p, y, n=n: y + p["c"] * x**n}, parameters=[tc.Parameter("c")])
    for name, n in (("square", 2), ("cube", 3))
)
LINE = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])


@pytest.mark.parametrize(("size", "verdict"), [(0.02, "named"), (0.1, "ambiguous")])
def test_two_terms_that_only_show_together_are_seen_in_few_data(size, verdict):
    """Of noise that is not far below them others may do the same: that is no name."""
    x = torch.linspace(-1, 1, 11, dtype=F64)
    for seed in range(3):
        y = 2 + 2 * x + 3 * x**2 - 5 * x**3 + size * noise(11, seed)
        d = diagnose(LINE, tc.Recording(x=x, y=y), [SQUARE, CUBE])
        assert d.verdict == verdict
        assert [*d.terms, *(d.tied[0] if d.tied else [])] == ["square", "cube"]
        assert ("two terms together alone" in " ".join(str(d).split())) is (verdict == "ambiguous")


def test_noise_in_few_data_is_no_pair():
    x = torch.linspace(-1, 1, 11, dtype=F64)
    found = [diagnose(LINE, tc.Recording(x=x, y=2 + x + noise(11, seed)), [SQUARE, CUBE]) for seed in range(15)]
    # Each is an alarm with a probability of 0.01 at most: two of 15 by chance with one of 1 %.
    assert sum(d.verdict != "consistent" for d in found) < 2


@pytest.mark.parametrize(("ratio", "source"), [(1.0, "given"), (1.5, "estimated")])
def test_a_name_leaves_no_more_than_the_noise_that_is_given_or_says_so(ratio, source):
    x = torch.linspace(-1, 1, 120, dtype=F64)
    y = 1 + x + 2 * x**2 + 0.1 * ratio * noise(120, 5)
    d = diagnose(LINE, tc.Recording(x=x, y=y, noise=0.1), [SQUARE])
    assert (d.terms, d.noise.source) == (["square"], source)
    larger = re.search(r"named: square, if the noise is 1\.[3-7] times as large as given", str(d))
    assert (larger is not None) is (ratio > 1)


def test_an_output_without_noise_is_not_judged_by_its_rounding():
    x = torch.linspace(0, 4, 60, dtype=F64)
    both = tc.Simulator(
        lambda x, p: {"y": p["a"] + p["b"] * x, "level": p["c"] + 0 * x}, [tc.Parameter(name) for name in "abc"]
    )
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["q"] * x**2}, parameters=[tc.Parameter("q")])
    y = {"y": 1 + 0.5 * x + 0.2 * x**2 + 0.05 * noise(60, 0), "level": torch.full((60,), 5.3, dtype=F64)}
    d = diagnose(both, tc.Recording(x=x, y=y), [bend])
    assert (d.terms, d.remaining) == (["bend"], 0.0)


@pytest.mark.slow
def test_two_terms_that_bend_to_a_fast_process_are_no_name():
    """A fast relaxation that no term has: a slow one, stretched and saturated, comes near it."""
    grid = np.meshgrid([20.0, 40.0, 60.0], np.geomspace(0.1, 1e4, 20), indexing="ij")
    temperature, t = (each.ravel() for each in grid)
    shifted = np.exp(0.08 * (temperature - 40)) * t / 80
    truth = 3 + 10 * np.exp(-shifted) + 5.696 * np.exp(-25 * shifted)

    def relaxing(x, p):
        slow = x["t"] / p["tau"] * torch.exp(p["H"] * 0.01 * (x["T"] - 40))
        return {"G": p["Ginf"] + p["G1"] * torch.exp(-(slow ** p["beta"]))}

    parameters = [
        tc.Parameter("Ginf", low=0.0, initial=2.0),
        tc.Parameter("G1", low=0.0, initial=8.0),
        tc.Parameter("tau", low=0.1, high=1e5, initial=50.0, transform="log"),
        tc.Parameter("H", low=0.0, high=60.0, initial=10.0),
        tc.Parameter("beta", neutral=1.0, low=0.2, high=1.5),
    ]
    candidates = [tc.Term("stretched exponential", frees=("beta",)), *tc.terms.sensor(("G",), static=True)]
    y = truth + 0.207 * np.random.default_rng(3).standard_normal(60)
    recording = tc.Recording(x={"T": temperature, "t": t}, y={"G": y}, noise=0.207)
    assert diagnose(tc.Simulator(relaxing, parameters), recording, candidates).verdict in ("unexplained", "ambiguous")


@pytest.mark.slow
def test_a_run_that_was_read_twice_counts_once():
    t = np.linspace(0, 4, 41)
    decay = tc.ODESimulator(
        lambda t, s, p, u: {"h": -p["k"] * s["h"]}, {"h": "m"}, [tc.Parameter("k", low=0.0, initial=0.5)]
    )
    inflow = tc.Term("inflow", equation="h", rate=lambda t, s, p, u: p["f"], parameters=[tc.Parameter("f")])
    run = tc.Run(time=t, outputs={"h": 2 * np.exp(-0.7 * t) + 0.3 + 0.02 * np.asarray(noise(41, 0))})
    once, often = (diagnose(decay, tc.Recording(runs=[run] * count), [inflow]) for count in (1, 4))
    assert once.terms == often.terms == ["inflow"]
    one, four = (d.ranking[0].estimates[0] for d in (once, often))
    assert (four.value, four.sd) == (pytest.approx(one.value, rel=1e-3), pytest.approx(one.sd, rel=0.1))
    assert any("123 of 164 rows" in line for line in often.symptoms)
    assert "from run to run" not in str(often)


def test_what_is_wrong_with_arguments_is_told():
    x = torch.linspace(0, 4, 30, dtype=F64)
    recording = tc.Recording(x=x, y=1 + x + 0.1 * noise(30, 0))
    with pytest.raises(DomainError, match=r"a share, or a bool array .* Got 0\."):
        diagnose(LINE, recording, holdout=0)
    other = tc.Term("bump", outputs={"y": lambda t, s, p, u, y: y + p["h"]}, parameters=[tc.Parameter("h")])
    with pytest.raises(SimulatorError, match=r"given \(x, p, y\), with a, b"):
        diagnose(LINE, recording, [other])
    decay = tc.ODESimulator(lambda t, s, p, u: {"h": -p["k"] * s["h"]}, {"h": "m"}, [tc.Parameter("k", initial=0.5)])
    parameters = [tc.Parameter("f")]
    inflow = tc.Term("inflow", equation="h", rate=lambda t, s, p, u: np.sin(p["f"].numpy()), parameters=parameters)
    run = tc.Run(time=x, outputs={"h": 2 * torch.exp(-0.7 * x) + 0.02 * noise(30, 0)})
    with pytest.raises(SimulatorError, match="Use torch functions on them, without"):
        diagnose(decay, tc.Recording(runs=[run]), [inflow])


@pytest.mark.slow
def test_look_alikes_of_both_terms_of_a_pair_are_tried():
    """A Langmuir probe whose leakage and series resistance were left out: other terms do nearly what either does."""
    v = torch.cat([torch.linspace(-60, -15, 30, dtype=F64), torch.linspace(-14, 6, 45, dtype=F64)])
    names = ("Ii", "Ie", "Te")
    probe = tc.Simulator(
        lambda x, p: p["Ie"] * ((x - 5) / p["Te"]).exp() - p["Ii"],
        [tc.Parameter(name, low=0.3 if name == "Te" else 0.0, initial=start)
         for name, start in zip(names, (0.3, 8.0, 3.0), strict=True)],
    )  # fmt: skip

    def loss(name, function, *shapes, **ends):
        return tc.Term(name, outputs={"y": function}, parameters=[tc.Parameter("a", **ends), *shapes])

    def flat(x, p, y):
        below = p["Vp"] + (x - p["Vp"]).clamp_min(0)
        return y - p["a"] * p["Ie"] * (((below - 5) / p["Te"]).exp() - ((p["Vp"] - 5) / p["Te"]).exp())

    terms = [
        loss("sheath", lambda x, p, y: y - p["Ii"] * p["a"] * (5 - x).clamp_min(0) ** 0.75, low=0.0),
        loss("hot electrons", lambda x, p, y: y + p["a"] * ((x - 5) / p["Th"]).exp(),
             tc.Parameter("Th", low=6.0, high=60.0), low=0.0),
        loss("plasma potential", flat, tc.Parameter("Vp", low=-4.0, high=5.5), low=0.0, high=1.0),
        loss("leakage", lambda x, p, y: y + p["a"] * x),
        loss("beam", lambda x, p, y: y + p["a"] * torch.sigmoid((x - p["Vb"]) / 1.5),
             tc.Parameter("Vb", low=-50.0, high=-8.0), low=0.0),
        loss("secondary emission", lambda x, p, y: y - p["a"] * (-x - 20).clamp_min(0) / 20, low=0.0),
        loss("resistance", lambda x, p, y: y - p["a"] * (p["Ie"] * ((x - 5) / p["Te"]).exp()) ** 2 / p["Te"], low=0.0),
        *tc.terms.sensor(outputs=("y",), static=True),
    ]  # fmt: skip
    current = 12 * ((v - 5) / 4).exp()
    noise = 0.069 * torch.tensor(np.random.default_rng(2).standard_normal(75))
    y = current - 0.4 + 0.0216 * v - 0.108 * current**2 / 4 + noise
    d = tc.diagnose(probe, tc.Recording(x=v, y=y), terms, seed=0, progress=False)
    found = [d.terms] if d.verdict == "named" else d.tied
    assert ["leakage", "resistance"] in [sorted(one) for one in found], d.tied


@pytest.mark.parametrize("own", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_positive_scale_stays_positive(own):
    """What would need a negative value of a parameter on a logarithmic scale is no effect of it."""
    x = torch.linspace(0, 10, 40, dtype=F64)
    noise = 0.3 * torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=F64)
    q = tc.Parameter("q", neutral=1.0, transform="log")
    bases = [tc.Parameter("a"), tc.Parameter("b")]
    if own:
        base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, bases)
        term = tc.Term("bend", shifts={"a": lambda x, p: (p["q"] - 1) * x**2}, parameters=[q])
    else:
        base = tc.Simulator(lambda x, p: p["a"] + p["b"] * x + (p["q"] - 1) * x**2, [*bases, q])
        term = tc.Term("bend", frees=("q",))
    for c, verdict in ((-3.0, "unexplained"), (2.0, "named")):
        d = tc.diagnose(base, tc.Recording(x=x, y=1 + 2 * x + c * x**2 + noise), [term], seed=0, progress=False)
        assert d.verdict == verdict
        row = next(row for row in d.ranking if row.terms == ("bend",) or list(row.terms) == ["bend"])
        assert all(one.value > 0 for one in row.estimates)
    told = {one.name: one.value for one in row.estimates}
    assert told["bend.q" if own else "q"] == pytest.approx(3.0, abs=0.05)
    improved = next(p for p in d.improved.parameters if p.name in ("q", "bend.q"))
    assert improved.initial == pytest.approx(3.0, abs=0.05)
    d = tc.diagnose(base, tc.Recording(x=x, y=1 + 2 * x + 100 * noise, noise=30.0), [term], seed=0, progress=False)
    (limit,) = d.detection_limit
    assert "hides negative effects of 1, the largest within its bounds" in limit.note


def test_what_the_base_calibrates_is_no_effect_of_a_term_that_frees_it_too():
    x = torch.linspace(0, 10, 40, dtype=F64)
    base = tc.Simulator(
        lambda x, p: p["a"] + p["b"] * x + p["q"] * x**2,
        [tc.Parameter("a"), tc.Parameter("b", low=2.5, high=9.0), tc.Parameter("q", neutral=0.0)],
    )
    noise = 0.3 * torch.randn(40, generator=torch.Generator().manual_seed(0), dtype=F64)
    rows = []
    for frees in (("b", "q"), ("q",)):  # b = 2 lies beyond its bound
        d = tc.diagnose(base, tc.Recording(x=x, y=1 + 2 * x + noise), [tc.Term("curve", frees=frees)], seed=0,
                        progress=False)  # fmt: skip
        rows.append(next(row for row in d.ranking if list(row.terms) == ["curve"]))
        assert [one.name for one in rows[-1].estimates] == ["q"]
        assert "neutral" not in rows[-1].note
    assert rows[0].note == rows[1].note
    assert rows[0].log_evidence == pytest.approx(rows[1].log_evidence, abs=1e-3)


BODY = tc.ODESimulator(
    lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * s["x"]},
    states={"x": "m", "v": "m/s"},
    parameters=[tc.Parameter("k", low=0.0, initial=1.0)],
    observe={"x": lambda t, s, p, u: s["x"], "sum": lambda t, s, p, u: s["x"] + s["v"]},
)


@pytest.mark.parametrize(
    ("term", "told"),
    [
        ({"equation": "v", "rate": lambda t, s, p, u: p["g"] * s["w"]}, "KeyError: 'w'"),
        ({"equation": "v", "rate": lambda t, s, p: p["g"] * s["v"]}, "takes 3 positional arguments"),
        ({"equation": "v", "rate": lambda t, s, p, u: p["g"] * s["v"].sine()}, "no attribute 'sine'"),
        ({"outputs": {"x": lambda t, s, p, u, y: y + p["g"] * s["w"]}}, "KeyError: 'w'"),
        ({"shifts": {"k": lambda t, s, p, u: p["g"] * u["f"]}}, "KeyError: 'f'"),
        ({"states": {"h": ""}, "initial": {"h": lambda s, p: p["g"] * s["w"]},
          "rates": {"h": lambda t, s, p, u: -s["h"], "v": lambda t, s, p, u: s["h"]}}, "KeyError: 'w'"),
    ],
)  # fmt: skip
def test_a_term_that_asks_for_what_there_is_not_is_told_before_anything_is_calibrated(monkeypatch, term, told):
    monkeypatch.setattr("torchcal.discovery.hypotheses.search.calibrate_base", None)
    t = torch.linspace(0, 4, 40, dtype=F64)
    run = tc.Run(time=t, outputs={"x": t.cos(), "sum": t.cos() - t.sin()}, initial={"x": 1.0, "v": 0.0})
    with pytest.raises(SimulatorError, match=told):
        diagnose(BODY, tc.Recording(runs=[run]), [tc.Term("wrong", parameters=[tc.Parameter("g")], **term)])


def test_an_instrument_of_an_output_that_is_no_state_is_told_before_anything_is_calibrated(monkeypatch):
    monkeypatch.setattr("torchcal.discovery.hypotheses.search.calibrate_base", None)
    t = torch.linspace(0, 4, 40, dtype=F64)
    run = tc.Run(time=t, outputs={"x": t.cos(), "sum": t.cos() - t.sin()}, initial={"x": 1.0, "v": 0.0})
    with pytest.raises(DomainError, match="Expected 'sum' to be a state"):
        diagnose(BODY, tc.Recording(runs=[run]), tc.terms.sensor(outputs=("sum",)))


def test_a_static_term_that_asks_for_what_there_is_not_is_told_before_anything_is_calibrated(monkeypatch):
    monkeypatch.setattr("torchcal.discovery.hypotheses.search.calibrate_base", None)
    x = torch.linspace(0, 1, 20, dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x["x"], [tc.Parameter("a"), tc.Parameter("b")])
    term = tc.Term("wrong", shifts={"a": lambda x, p: p["g"] * x["X"]}, parameters=[tc.Parameter("g")])
    with pytest.raises(SimulatorError, match="KeyError: 'X'"):
        diagnose(line, tc.Recording(x={"x": x}, y=x + 0.01 * noise(20, 0)), [term])


@pytest.mark.parametrize("trouble", [ValueError("not here"), RuntimeError("not here")])
def test_what_a_term_raises_at_one_value_alone_does_not_stop_a_diagnosis_before_it_begins(monkeypatch, trouble):
    """Where the base has not been calibrated its values may be any."""

    def begun(*given, **options):
        raise ArithmeticError("begun")

    monkeypatch.setattr("torchcal.discovery.hypotheses.search.calibrate_base", begun)

    def picky(x, p, y):
        raise trouble

    x = torch.linspace(0, 1, 20, dtype=F64)
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    term = tc.Term("picky", outputs={"y": picky}, parameters=[tc.Parameter("g")])
    with pytest.raises(ArithmeticError, match="begun"):
        diagnose(line, tc.Recording(x=x, y=x + 0.01 * noise(20, 0)), [term])


@pytest.mark.parametrize(
    "rate",
    [
        lambda s, p: np.exp(s["T"]) * -p["k"],
        lambda s, p: -p["k"] * s["T"] if s["T"] > 0.5 else 0 * s["T"],
    ],
)
def test_rates_that_are_no_torch_code_are_told_what_to_use(rate):
    t = torch.linspace(0, 4, 60, dtype=F64)
    cooling = tc.ODESimulator(
        lambda t, s, p, u: {"T": rate(s, p)}, {"T": "K"}, [tc.Parameter("k", low=0.0, initial=1.0)]
    )
    run = tc.Run(time=t, outputs={"T": (-t).exp()}, initial={"T": 1.0})
    with pytest.raises(SimulatorError, match=r"Use torch functions on t, s, p and u, and torch\.where for if"):
        diagnose(cooling, tc.Recording(runs=[run]))


@pytest.mark.parametrize(
    ("terms", "told"),
    [
        (lambda: tc.terms.sensor(("T",), static=True), "for a static one with static=True alone"),
        (lambda: tc.terms.thermal("T", ambient="Tamb"), "^Expected the ambient temperature among the inputs"),
    ],
)
def test_a_library_that_does_not_fit_is_told_as_such(terms, told):
    t = torch.linspace(0, 4, 60, dtype=F64)
    cooling = tc.ODESimulator(
        lambda t, s, p, u: {"T": -p["k"] * s["T"]}, {"T": "K"}, [tc.Parameter("k", low=0.0, initial=1.0)]
    )
    run = tc.Run(time=t, outputs={"T": (-t).exp()}, initial={"T": 1.0})
    with pytest.raises((SimulatorError, DomainError), match=told):
        diagnose(cooling, tc.Recording(runs=[run]), terms())


def test_a_key_that_is_no_name_may_be_missing_where_nothing_is_calibrated_yet(monkeypatch):
    def begun(*given, **options):
        raise ArithmeticError("begun")

    monkeypatch.setattr("torchcal.discovery.hypotheses.search.calibrate_base", begun)
    table = {0: 0.0, 1: 1.0}
    term = tc.Term(
        "table", equation="v", rate=lambda t, s, p, u: p["g"] * table[int(p["k"].mean())] * s["x"],
        parameters=[tc.Parameter("g")],
    )  # fmt: skip
    t = torch.linspace(0, 4, 40, dtype=F64)
    fast = tc.ODESimulator(BODY.rates, states=BODY.states, parameters=[tc.Parameter("k", low=5.0, high=9.0)])
    run = tc.Run(time=t, outputs={"x": t.cos(), "v": -t.sin()}, initial={"x": 1.0, "v": 0.0})
    with pytest.raises(ArithmeticError, match="begun"):
        diagnose(fast, tc.Recording(runs=[run]), [term])
