"""Bad input: each case is a torchcal error that says what was expected, what came and what to do, before long work."""

import math
import re

import numpy as np
import pytest
import torch

import torchcal as tc
from torchcal.errors import (
    ConvergenceError,
    DegenerateLikelihoodError,
    DomainError,
    EmbeddingError,
    ImproperPosteriorError,
    RecordingError,
    ShapeError,
    SimulatorError,
    TorchcalError,
)

X = torch.linspace(-1.0, 1.0, 6, dtype=torch.float64)
Y = 1 + X + X**2
AB = [tc.Parameter("a"), tc.Parameter("b")]
MOST_CALLS = 8
"""A check of the simulator takes three calls and the choice of nodes a few more, a least-squares fit a hundred."""


def with_value(index, value):
    y = Y.clone()
    y[index] = value
    return y


def says_what_to_do(error):
    """Expected ... Got ..., in words and not in a traceback of a library's."""
    text = str(error)
    assert isinstance(error, TorchcalError)
    assert re.search(r"Expected|expected", text), text
    assert re.search(r"Got|got|raised|Expected .* that", text), text
    assert len(text) > 40, text


# --- recordings -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        pytest.param({"x": X, "y": with_value(2, math.nan)}, RecordingError, id="nan"),
        pytest.param({"x": X, "y": with_value(2, math.inf)}, RecordingError, id="inf"),
        pytest.param({"x": X, "y": with_value(2, math.inf), "missing": True}, RecordingError, id="inf, missing"),
        pytest.param({"x": with_value(0, math.nan), "y": Y, "missing": True}, RecordingError, id="nan in x"),
        pytest.param({"x": X, "y": torch.full_like(Y, math.nan), "missing": True}, RecordingError, id="all missing"),
        pytest.param({"x": X, "y": Y[:-1]}, RecordingError, id="length"),
        pytest.param({"x": X[:, None], "y": Y}, ShapeError, id="matrix x"),
        pytest.param({"x": X, "y": Y[:, None]}, ShapeError, id="matrix y"),
        pytest.param({"x": X, "y": Y.to(torch.complex128)}, RecordingError, id="complex"),
        pytest.param({"x": X, "y": ["a"] * 6}, RecordingError, id="text"),
        pytest.param({"x": X, "y": np.array([None] * 6)}, RecordingError, id="objects"),
        pytest.param({"x": X[:1], "y": Y[:1]}, RecordingError, id="one point"),
        pytest.param({"x": X[:0], "y": Y[:0]}, RecordingError, id="no point"),
        pytest.param({"x": X}, RecordingError, id="no y"),
        pytest.param({"y": Y}, RecordingError, id="no x"),
        pytest.param({"x": X, "y": Y, "noise": 0.0}, DomainError, id="zero noise"),
        pytest.param({"x": X, "y": Y, "noise": -1.0}, DomainError, id="negative noise"),
        pytest.param({"x": X, "y": Y, "noise": math.nan}, DomainError, id="nan noise"),
        pytest.param({"x": X, "y": Y, "noise": X}, DomainError, id="noise of both signs"),
        pytest.param({"x": X, "y": Y, "noise": torch.ones(5)}, ShapeError, id="length of noise"),
        pytest.param({"x": X, "y": Y, "noise": "some"}, TorchcalError, id="noise in words"),
    ],
)
def test_recordings(arguments, error):
    with pytest.raises(error) as caught:
        tc.Recording(**arguments)
    says_what_to_do(caught.value)


def test_zero_noise_is_told_how_to_say_that_there_is_none():
    with pytest.raises(DomainError, match=r"noise=['\"]none['\"]|'none'"):
        tc.Recording(x=X, y=Y, noise=0.0)


# --- parameters and embeddings --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "error"),
    [
        pytest.param(lambda: tc.Parameter("a", low=2.0, high=1.0), DomainError, id="reversed bounds"),
        pytest.param(lambda: tc.Parameter("a", low=math.nan), DomainError, id="nan bound"),
        pytest.param(lambda: tc.Parameter("a", unit=3), DomainError, id="unit that is a number"),
        pytest.param(lambda: tc.Parameter("a", low=0.0, transform="log"), DomainError, id="log of zero"),
        pytest.param(lambda: tc.Simulator(lambda x, p: x, [AB[0], AB[0]]), DomainError, id="named twice"),
        pytest.param(lambda: tc.likelihoods.ABC(epsilon=0.0), DomainError, id="zero epsilon"),
        pytest.param(lambda: tc.likelihoods.ABC(epsilon=-0.1), DomainError, id="negative epsilon"),
        pytest.param(lambda: tc.likelihoods.ABC(epsilon=0.1, gamma=0.0), DomainError, id="zero gamma"),
        pytest.param(lambda: tc.likelihoods.ABC(epsilon=0.1, gamma=-1.0), DomainError, id="negative gamma"),
        pytest.param(lambda: tc.likelihoods.ABC(epsilon=0.1, gamma=torch.ones(3)), DomainError, id="gammas"),
        pytest.param(lambda: tc.likelihoods.ABCMean(epsilon=math.nan), DomainError, id="nan epsilon"),
        pytest.param(lambda: tc.likelihoods.Marginal(bandwidth=torch.ones(3)), DomainError, id="bandwidths"),
        pytest.param(lambda: tc.likelihoods.Marginal(floor=-1.0), DomainError, id="negative floor"),
        pytest.param(lambda: tc.likelihoods.Full(floor="small"), DomainError, id="floor in words"),
    ],
)
def test_pieces(make, error):
    with pytest.raises(error) as caught:
        make()
    says = str(caught.value)
    assert "Expected" in says
    assert "Got" in says


# --- calibrations ---------------------------------------------------------------------------------


class Counted:
    """A simulator's function that counts its calls and their evaluations."""

    def __init__(self, function):
        self.function, self.calls = function, 0

    def __call__(self, x, p):
        self.calls += 1
        return self.function(x, p)


def line(x, p):
    return p["a"] + p["b"] * x


def broken(x, p):
    raise RuntimeError("no convergence in cell 7")


SIMULATORS = [
    pytest.param(broken, "no convergence in cell 7", id="raises"),
    pytest.param(lambda x, p: line(x, p) * math.nan, "finite", id="nan"),
    pytest.param(lambda x, p: line(x, p) / 0, "finite", id="inf"),
    pytest.param(lambda x, p: torch.complex(line(x, p), 0 * line(x, p)), "real", id="complex"),
    pytest.param(lambda x, p: line(x, p).to(torch.int64), "real", id="integers"),
    pytest.param(lambda x, p: line(x, p)[..., 1:], "shape", id="short"),
    pytest.param(lambda x, p: line(x, p).mean(-1), "shape", id="reduced"),
    pytest.param(lambda x, p: line(x, p).sum(), "shape", id="scalar"),
    pytest.param(lambda x, p: line(x, p)[..., None], "shape", id="an axis too many"),
    pytest.param(lambda x, p: line(x, p).detach().numpy(), "tensor", id="numpy"),
    pytest.param(lambda x, p: line(x, p).tolist(), "tensor", id="list"),
    pytest.param(lambda x, p: None, "tensor", id="nothing"),
    pytest.param(lambda x, p: {"z": line(x, p)}, "missing", id="other output"),
    pytest.param(lambda x, p: {}, "at least one output", id="no output"),
    pytest.param(lambda x, p: line(x, p).detach(), "gradient", id="no gradient"),
    pytest.param(lambda x, p: p["c"] * x, "KeyError", id="unknown parameter"),
    pytest.param(lambda x, p: line(x, p) + torch.rand_like(x), "random numbers", id="random"),
    pytest.param(
        lambda x, p: line(x, p).to(torch.float32),
        "float32|dtype|precision",
        id="float32",
    ),
]


@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
@pytest.mark.parametrize(("function", "message"), SIMULATORS)
def test_simulators(function, message, calibrate):
    counted = Counted(function)
    with pytest.raises(SimulatorError, match=message) as caught:
        calibrate(tc.Simulator(counted, AB), tc.Recording(x=X, y=Y))
    says_what_to_do(caught.value)
    assert counted.calls <= MOST_CALLS


def attempt(*, x=X, y=Y, function=line, calibrate=tc.calibrate, **options):
    counted = Counted(function)
    recording = tc.Recording(x=x, y=y)
    try:
        calibrate(tc.Simulator(counted, AB), recording, num_starts=4, **{"num_samples": 0, **options})
    finally:
        attempt.calls = counted.calls


EXACT_Y = 1 + 2 * X


@pytest.mark.parametrize(
    ("options", "error"),
    [
        pytest.param({"embedding": tc.embeddings.Gaussian(("z",))}, EmbeddingError, id="embedding of nothing"),
        pytest.param({"embedding": tc.embeddings.Gaussian(("a", "a"))}, EmbeddingError, id="embedded twice"),
        pytest.param(
            {"embedding": tc.embeddings.Gaussian(("a",)), "fixed": {"a": 1.0}}, EmbeddingError, id="embedded and fixed"
        ),
        pytest.param({"embedding": "gaussian"}, DomainError, id="embedding in words"),
        pytest.param({"embedding": tc.embeddings.Gaussian}, DomainError, id="embedding class"),
        pytest.param({"likelihood": "least squares"}, DomainError, id="unknown likelihood"),
        pytest.param({"likelihood": tc.likelihoods.ABC}, DomainError, id="likelihood class"),
        pytest.param({"fixed": {"z": 1.0}}, EmbeddingError, id="fixed nothing"),
        pytest.param({"fixed": {"a": 1.0, "b": 1.0}}, EmbeddingError, id="fixed all"),
        pytest.param({"fixed": {"a": math.nan}}, DomainError, id="fixed at nan"),
        pytest.param({"num_samples": -1}, DomainError, id="negative draws"),
        pytest.param({"num_samples": 10.0}, DomainError, id="draws as float"),
        pytest.param({"num_samples": 10, "num_chains": 0}, DomainError, id="no chains"),
        pytest.param({"sampler": "gibbs"}, DomainError, id="unknown sampler"),
        pytest.param({"likelihood": "additive"}, EmbeddingError, id="additive, embedded"),
        pytest.param({"likelihood": "full"}, DegenerateLikelihoodError, id="N > d"),
        pytest.param({"likelihood": "abc_mean"}, ImproperPosteriorError, id="improper"),
        pytest.param({"embedding": tc.embeddings.PolynomialChaos(order=0)}, EmbeddingError, id="no sd"),
        pytest.param({"order": 0}, DomainError, id="order 0"),
        pytest.param({"rule": "gauss"}, DomainError, id="rule in words"),
        pytest.param({"rule": 1}, DomainError, id="one node for a line in ξ"),
        pytest.param({"rule": np.int64(1)}, DomainError, id="one node of NumPy's"),
        pytest.param({"rule": True}, DomainError, id="rule as a bool"),
        pytest.param(
            {"rule": 2, "embedding": tc.embeddings.PolynomialChaos(order=2)}, DomainError, id="two nodes for a parabola"
        ),
        pytest.param({"likelihood": tc.likelihoods.ABC(epsilon=torch.ones(3))}, TorchcalError, id="epsilon"),
        pytest.param({"likelihood": tc.likelihoods.Marginal(floor=torch.ones(3))}, DomainError, id="floor"),
        pytest.param({"prior": lambda module: "flat"}, DomainError, id="prior of the wrong kind"),
        pytest.param({"prior": torch.distributions.Normal}, DomainError, id="a distribution as prior"),
        pytest.param({"prior": lambda module: tc.priors.Uniform(module, leading="a")}, DomainError, id="box in words"),
        pytest.param({"prior": lambda module: tc.priors.Normal(module, loc="a")}, DomainError, id="mean in words"),
        pytest.param({"starts": torch.zeros(3, 4)}, ShapeError, id="shape of starts"),
        pytest.param({"calibrate": tc.calibrate_additive, "x": X[:2], "y": Y[:2]}, ImproperPosteriorError, id="N = d"),
    ],
)
def test_options(options, error):
    with pytest.raises(error) as caught:
        attempt(**options)
    says_what_to_do(caught.value)
    assert attempt.calls <= MOST_CALLS


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"prior": "flat"}, id="prior in words"),
        pytest.param({"fixed": {"a": "one"}}, id="fixed in words"),
        pytest.param({"fixed": {"a": None}}, id="fixed at nothing"),
        pytest.param({"fixed": {"a": True}}, id="fixed at a bool"),
        pytest.param({"fixed": {"a": np.True_}}, id="fixed at a bool of NumPy's"),
        pytest.param({"fixed": {"a": torch.tensor(True)}}, id="fixed at a bool of torch's"),
        pytest.param({"fixed": {"a": b"1"}}, id="fixed in bytes"),
        pytest.param({"fixed": {"a": np.array("1")}}, id="fixed at a string of NumPy's"),
        pytest.param({"fixed": ["a"]}, id="fixed as a list"),
        pytest.param({"seed": 1.5}, id="seed as float"),
        pytest.param({"seed": -1}, id="negative seed"),
        pytest.param({"seed": 2**31}, id="large seed"),
        pytest.param({"starts": "here"}, id="starts in words"),
        pytest.param({"device": "abacus"}, id="unknown device"),
        pytest.param({"num_samples": 2, "dtype": torch.int64}, id="integer dtype"),
    ],
)
def test_options_that_fall_through(options):
    with pytest.raises(TorchcalError):
        attempt(**options)


def test_a_fixed_value_is_no_string():
    told = r"finite number for the fixed parameter 'a'. Got '1' \(str\). Give one, as in fixed=\{'a': 1.0\}"
    with pytest.raises(DomainError, match=told):
        attempt(fixed={"a": "1"})


@pytest.mark.parametrize("value", [1, np.float32(1), np.array(1.0), torch.tensor(1), torch.tensor([1.0])])
def test_a_fixed_value_may_be_any_real_number(value):
    held = tc.simulators.free_parameters(AB, {"a": value})[1]
    assert held == {"a": 1.0}


def test_a_prior_that_is_already_made_is_refused():
    """`prior=Flat(propagate)` for `prior=Flat` is an easy mistake."""
    module = tc.NISP(tc.Simulator(line, AB), tc.embeddings.Gaussian(), X)
    for kind in (tc.priors.Flat, tc.priors.Normal):
        with pytest.raises(DomainError, match=rf"Got an instance.*prior=torchcal\.priors\.{kind.__name__},"):
            attempt(prior=kind(module))


@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
@pytest.mark.parametrize("scale", [1e200, 1e-200])
def test_data_whose_squares_are_no_numbers_are_refused(calibrate, scale):
    with pytest.raises(DomainError, match=r"squares of others are 0 or inf.*other units, in which they are near 1\.$"):
        attempt(calibrate=calibrate, y=scale * Y)
    attempt(calibrate=calibrate, y=Y * scale**0.5)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        pytest.param((line, tc.Recording(x=X, y=Y)), DomainError, id="a function for a simulator"),
        pytest.param((tc.Simulator(line, AB), (X, Y)), RecordingError, id="a tuple for a recording"),
    ],
)
@pytest.mark.parametrize("calibrate", [tc.calibrate, tc.calibrate_additive])
def test_what_is_not_a_simulator_or_a_recording(arguments, error, calibrate):
    with pytest.raises(error) as caught:
        calibrate(*arguments)
    says_what_to_do(caught.value)


def test_additive_where_the_residuals_vanish():
    with pytest.raises(ImproperPosteriorError, match=r"noise=|calibrate"):
        attempt(calibrate=tc.calibrate_additive, y=EXACT_Y)


def test_starts_where_nothing_is_finite():
    with pytest.raises(ConvergenceError, match="starts="):
        attempt(starts=torch.full((4, 5), math.nan))


def test_a_recording_of_other_outputs():
    simulator = tc.Simulator(lambda x, p: {"u": line(x, p), "v": line(x, p)}, AB)
    with pytest.raises(SimulatorError, match=r"\['w'\] missing"):
        tc.calibrate(simulator, tc.Recording(x=X, y={"u": Y, "w": Y}))
    with pytest.raises(SimulatorError, match=r"Expected 12 output values.*2\s*outputs.*Got 6"):
        tc.calibrate(tc.Simulator(line, AB), tc.Recording(x=X, y={"u": Y, "w": Y}))


def test_other_conditions_than_the_simulator_reads():
    simulator = tc.Simulator(lambda x, p: line(x["t"], p), AB)
    with pytest.raises(SimulatorError, match=r"KeyError.*'t'.*conditions"):
        tc.calibrate(simulator, tc.Recording(x={"s": X}, y=Y))
    with pytest.raises(SimulatorError, match=r"conditions"):
        tc.calibrate(simulator, tc.Recording(x=X, y=Y))


def test_errors_have_one_base_and_fit_pythons():
    for name in tc.errors.__all__:
        kind = getattr(tc.errors, name)
        assert issubclass(kind, TorchcalError | tc.TorchcalWarning)
    assert issubclass(DomainError, ValueError)
    assert issubclass(SimulatorError, RuntimeError)


# --- terms and conditions -------------------------------------------------------------------------


def test_terms_say_what_they_need():
    bend = {"outputs": {"y": lambda x, p, y: y + p["q"]}}
    for parameters in (["q"], "q", [AB[0], None]):
        with pytest.raises(DomainError, match=r"Expected torchcal\.Parameter .* 'bend'\. Got (str|NoneType)"):
            tc.Term("bend", parameters=parameters, **bend)
    push = {"equation": "v", "rate": lambda t, s, p, u: p["q"], "parameters": [tc.Parameter("q")]}
    with pytest.raises(DomainError, match=r"hidden states \[\] of the term 'push'\. Got 'w'"):
        tc.Term("push", initial={"w": 0.0}, **push)


IN_TIME = tc.Recording(runs=[tc.Run(time=X + 1, outputs={"y": Y})])


@pytest.mark.parametrize("run", [tc.diagnose, tc.calibrate_additive])
@pytest.mark.parametrize(
    ("function", "recording", "message"),
    [
        pytest.param(
            lambda x, p: p["a"] + p["b"] * x["d"], tc.Recording(x={"T": X}, y=Y),
            r"KeyError: 'd'.*x holds \['T'\], the recording's conditions, and p holds \['a', 'b'\]", id="name",
        ),
        pytest.param(
            lambda x, p: p["a"] + p["A"] * x, tc.Recording(x=X, y=Y), r"p holds \['a', 'b'\] \(check", id="parameter"
        ),
        pytest.param(
            lambda x, p: p["a"] + p["b"] * x["d"], tc.Recording(x=X, y=Y), r"x is a tensor.*x=\{name: values\}",
            id="plain", marks=pytest.mark.filterwarnings("ignore:Using a non-tuple sequence"),
        ),
        pytest.param(line, tc.Recording(x={"T": X, "d": X}, y=Y), r"x is a dict.*use x\['T'\], x\['d'\]", id="dict"),
        pytest.param(line, IN_TIME, r"recording is one in time.*x\['time'\].*ODESimulator", id="in time"),
    ],
)  # fmt: skip
def test_conditions_of_another_kind_are_explained(run, function, recording, message):
    with pytest.raises(SimulatorError, match=message) as caught:
        run(tc.Simulator(function, AB), recording)
    says_what_to_do(caught.value)


# --- an answer on a bound -------------------------------------------------------------------------


def test_known_noise_that_suffices_is_no_direction_that_the_data_do_not_see(tmp_path):
    x = torch.linspace(-1.0, 1.0, 40, dtype=torch.float64)
    wiggle = 0.01 * torch.cos(9 * x)
    simulator = tc.Simulator(line, AB, degree=1)
    enough, short = (
        tc.calibrate_additive(simulator, tc.Recording(x=x, y=1 + x + wiggle, noise=sd), num_samples=0)
        for sd in (0.02, 0.003)
    )
    assert (enough.noise_suffices, short.noise_suffices) == (True, False)
    assert "sigma is at zero: the noise that was given suffices" in str(enough)
    assert "sigma is at zero" not in str(short)
    assert len(enough.diagnostics.null_directions) == 0
    enough.save(tmp_path / "enough.nc")
    assert "sigma is at zero" in str(tc.results.AdditiveCalibration.load(tmp_path / "enough.nc"))
    unknown = tc.calibrate_additive(simulator, tc.Recording(x=x, y=1 + x + wiggle), num_samples=0)
    assert not unknown.noise_suffices


def test_additive_with_known_noise_takes_as_many_data_as_bounded_parameters():
    """The likelihood is bounded then, and falls with σ to the power of −N."""
    x, y = [0.0, 1.0], [1.0, 2.0]
    parameters = [tc.Parameter("a", low=0.0, high=3.0), tc.Parameter("b", low=-3.0, high=3.0)]
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, parameters)
    found = tc.calibrate_additive(line, tc.Recording(x=x, y=y, noise=0.1), num_samples=0, seed=0, progress=False)
    assert found.map.mean.tolist() == pytest.approx([1.0, 1.0], abs=1e-3)
    free = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")])
    with pytest.raises(ImproperPosteriorError, match="without two bounds"):
        tc.calibrate_additive(free, tc.Recording(x=x, y=y, noise=0.1), num_samples=0, seed=0, progress=False)


# --- pieces that users put together themselves ----------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"fixed": ["a"]}, TorchcalError),
        ({"scaling": 3}, DomainError),
        ({"max_nodes": "a"}, DomainError),
        ({"sd_floor": "a"}, DomainError),
        ({"sd_floor": -1.0}, DomainError),
        ({"trial_spread": "a"}, DomainError),
        ({"trial_spread": -1}, DomainError),
    ],
)
def test_propagations(options, error):
    with pytest.raises(error, match="Expected"):
        tc.NISP(tc.Simulator(line, AB), tc.embeddings.Gaussian(), X, **options)


def test_other_slips_are_told_and_not_raised_by_what_lies_below():
    module = tc.NISP(tc.Simulator(line, AB), tc.embeddings.Gaussian(), X)
    with pytest.raises(DomainError, match="num to be a whole number"):
        module.draw_germ(-1, seed=0)
    with pytest.raises(EmbeddingError, match="triangular"):
        tc.embeddings.PolynomialChaos(triangular="yes")
    simulator, recording = tc.Simulator(line, AB), tc.Recording(x=X, y=Y)
    baseline = tc.calibrate_additive(simulator, recording, num_samples=0, seed=0)
    with pytest.raises(DomainError, match=r"Got AdditivePrediction \(give one of its parts, \.posterior or"):
        tc.scores(Y, baseline.predict())
    with pytest.raises(DomainError, match="Got int"):
        tc.scores(Y, 3)
    found = tc.calibrate(simulator, recording, num_samples=0, num_starts=4, seed=0)
    with pytest.raises(ShapeError, match="points"):
        found.parameter_density("a", kind="map")
    with pytest.raises(DomainError, match=r"give what its predict\(\) returns"):
        tc.plots.fit(found, recording)


def test_a_file_that_cannot_be_written_is_told_before_anything_is_predicted(tmp_path, monkeypatch):
    found = tc.calibrate(tc.Simulator(line, AB), tc.Recording(x=X, y=Y), num_samples=0, num_starts=4, seed=0)
    monkeypatch.setattr(type(found), "to_datatree", lambda self: pytest.fail("the tree was built first"))
    with pytest.raises(DomainError, match="nowhere"):
        found.save(tmp_path / "nowhere" / "found.nc")


@pytest.mark.filterwarnings("ignore:Only 1 of 4 starts")
def test_what_is_small_beside_an_offset_is_not_drawn_from():
    y = 1e13 + Y
    recording = tc.Recording(x=X, y=y)
    with pytest.raises(DomainError, match=r"told in torch\.float64.*large offset"):
        tc.calibrate(tc.Simulator(line, AB), recording, num_samples=10, num_starts=4, seed=0, progress=False)


def _root(below, **options):
    """An oscillator whose force has no value where x lies ``below``."""
    return tc.ODESimulator(
        lambda t, s, p, u: {"x": s["v"], "v": -p["k"] * torch.sqrt(s["x"] - below)},
        {"x": "m", "v": "m/s"},
        [tc.Parameter("k", low=0.0, initial=1.0)],
        observe=("x",),
        **options,
    )


def _swing():
    t = torch.linspace(0.0, 4.0, 41, dtype=torch.float64)
    return tc.Recording(runs=[tc.Run(time=t, outputs={"x": torch.cos(2 * t)}, initial={"x": 1.0, "v": 0.0})])


def test_rates_without_a_value_are_told_before_any_step_is_tried(monkeypatch):
    solved = []
    monkeypatch.setattr(tc.simulators.Trajectories, "solve", lambda *arguments: solved.append(arguments))
    message = r"Got nan for the rate of 'v' at t=0, with states \{'x': 1.0, 'v': 0.0\} and parameters \{'k': 1.0\}"
    for calibrate in (tc.calibrate, tc.calibrate_additive):
        with pytest.raises(SimulatorError, match=message):
            calibrate(_root(100.0), _swing(), num_samples=0, progress=False)
    assert not solved


def test_no_steps_are_sought_where_rates_have_no_value():
    bound = _root(100.0).bind(_swing())
    values = torch.ones(1, 1, dtype=torch.float64)
    assert not bound.begins(values).all()
    assert tc.simulators.workable(bound, values, torch.full((41,), 1e-3, dtype=torch.float64)) is bound
    assert _root(0.0).bind(_swing()).begins(values).all()


@pytest.mark.parametrize("flag", [True, np.True_, torch.tensor(True)])
def test_a_flag_is_no_number(flag):
    for make in (
        lambda: tc.likelihoods.ABC(epsilon=flag),
        lambda: tc.NISP(tc.Simulator(line, AB), tc.embeddings.Gaussian(), x=X, trial_spread=flag),
    ):
        with pytest.raises(DomainError, match=r"> 0 and finite|as a positive number"):
            make()
