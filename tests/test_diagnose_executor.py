"""`diagnose(executor=)`: the same diagnosis from workers, what cannot be sent to them; and Ctrl-C."""

import math
import multiprocessing
import pickle
import signal
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

import torchcal as tc
from torchcal.discovery.fits.refits import Refit
from torchcal.discovery.fits.stop import Stop
from torchcal.discovery.hypotheses import refitting
from torchcal.discovery.hypotheses.search import Search
from torchcal.errors import ConvergenceError, DomainError, InterruptionWarning
from torchcal.simulators import Trajectories

F64 = torch.float64
T = torch.linspace(0, 9, 41, dtype=F64)
FORCE = 0.8 * torch.sin(0.9 * T)


def rates(t, s, p, u):
    return {"x": s["v"], "v": -p["k"] * s["x"] - p["c"] * s["v"] + u["f"]}


def oscillator(function=rates):
    return tc.ODESimulator(
        rates=function,
        states={"x": "m", "v": "m/s"},
        parameters=[tc.Parameter("k", unit="1/s^2", low=0.0, initial=4.0),
                    tc.Parameter("c", unit="1/s", low=0.0, initial=0.1)],
        observe=("x",),
    )  # fmt: skip


def run(x):
    return tc.Run(time=T, outputs={"x": x}, inputs={"f": FORCE}, initial={"x": 1.0, "v": 0.0})


def library():
    """Terms of lambdas, which plain pickle does not send."""
    wanted = ("cubic stiffness", "bias force")
    return [term for term in tc.terms.mechanics() if term.name in wanted]


@pytest.fixture(scope="module")
def motion():
    """An oscillator with a bias force that the base does not know."""
    bias = [term for term in library() if term.name == "bias force"]
    empty = tc.Recording(runs=[run(torch.zeros_like(T))])
    whole = Trajectories(tc.terms.extend(oscillator(), bias), empty, subdivide=8)
    values = {"k": 2.0, "c": 0.2, "bias force.b": 0.1}
    row = torch.tensor([[values[q.name] for q in whole.parameters]], dtype=F64)
    x = whole.linearise(empty.x, row, empty.outputs, []).y[0]
    noise = torch.randn(len(T), generator=torch.Generator().manual_seed(5), dtype=F64)
    return tc.Recording(runs=[run(x + 0.02 * noise)], noise=0.02)


def diagnose(motion, candidates=None, **options):
    options = {"seed": 0, "progress": False, "num_starts": 4, **options}
    return tc.diagnose(oscillator(), motion, library() if candidates is None else candidates, **options)


@pytest.fixture(scope="module")
def here(motion):
    return diagnose(motion)


def check_same(d, here):
    assert d.verdict == here.verdict == "named"
    assert d.terms == here.terms == ["bias force"]
    assert d.tied == here.tied
    assert [row.terms for row in d.ranking] == [row.terms for row in here.ranking]
    close = {"rel": 1e-9, "abs": 1e-12}
    for one, other in zip(d.ranking, here.ranking, strict=True):
        assert one.log_evidence == pytest.approx(other.log_evidence, **close)
        assert one.probability == pytest.approx(other.probability, **close)
    assert len(d.final.estimates) == 3
    for one, other in zip(d.final.estimates, here.final.estimates, strict=True):
        assert one.name == other.name
        assert one.value == pytest.approx(other.value, **close)
        assert one.sd == pytest.approx(other.sd, **close)
    torch.testing.assert_close(d.final.prediction, here.final.prediction, rtol=1e-9, atol=1e-12)
    assert d.equations == here.equations
    assert d.after.held_out.rmse == pytest.approx(here.after.held_out.rmse, **close)
    assert d.improved.names == here.improved.names


class Recorder(Executor):
    """Hands everything on, and remembers what came back."""

    def __init__(self, inner):
        self.inner, self.futures = inner, []

    def submit(self, fn, /, *args, **kwargs):
        self.futures.append(self.inner.submit(fn, *args, **kwargs))
        return self.futures[-1]


def test_the_diagnosis_without_an_executor(here):
    bias = next(e for e in here.final.estimates if e.name == "bias force.b")
    assert abs(bias.value - 0.1) < 5 * bias.sd


def test_other_processes_give_the_same(motion, here):
    pytest.importorskip("cloudpickle")
    with pytest.raises((AttributeError, pickle.PicklingError, TypeError)):
        pickle.dumps(library())
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        recorder = Recorder(pool)
        check_same(diagnose(motion, executor=recorder), here)
        assert len(recorder.futures) > 0
        assert pool.submit(math.sqrt, 4.0).result() == 2.0  # left open, and in order


@pytest.mark.slow
def test_threads_give_the_same(motion, here):
    pytest.importorskip("cloudpickle")
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(2) as pool:
        recorder = Recorder(pool)
        d = diagnose(motion, executor=recorder)
        check_same(d, here)
        assert len(recorder.futures) > 0
        assert all(future.done() and future.exception() is None for future in recorder.futures)
    assert torch.get_num_threads() == threads
    assert d.improved is not None
    assert isinstance(str(d), str)


def test_a_base_without_mismatch_is_consistent_from_workers_too(motion):
    pytest.importorskip("cloudpickle")
    clean = tc.terms.extend(oscillator(), [term for term in library() if term.name == "bias force"])
    with ThreadPoolExecutor(1) as pool:
        d = tc.diagnose(clean, motion, library(), seed=0, progress=False, num_starts=4, executor=pool)
    assert d.verdict == "consistent"
    assert d.terms == []


def parabola(x, p):
    time.sleep(0.0003)  # lets another thread in
    return p["a"] + p["n"] * x**2


def fan(x, p):
    return p["m"] * torch.log(x)


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_simulators_without_time(workers):
    """Their derivatives are forward ones, of which torch keeps one level for all threads."""
    x = torch.linspace(0.5, 2, 30, dtype=F64)
    noise = 0.02 * torch.randn(30, generator=torch.Generator().manual_seed(2), dtype=F64)
    parameters = [tc.Parameter("a", low=-5.0, high=5.0), tc.Parameter("n", neutral=0.0, low=-2.0, high=2.0)]
    simulator = tc.Simulator(parabola, parameters)
    data = tc.Recording(x=x, y=1 + 0.5 * x**2 + noise, noise=0.02)
    terms = [tc.Term("square", frees=("n",)), tc.Term("slope", shifts={"a": fan}, parameters=[tc.Parameter("m")])]
    options = {"seed": 0, "progress": False, "num_starts": 4}
    plain = tc.diagnose(simulator, data, terms, **options)
    with ThreadPoolExecutor(workers) as pool:
        d = tc.diagnose(simulator, data, terms, executor=pool, **options)
    assert d.verdict == plain.verdict == "named"
    assert d.terms == plain.terms == ["square"]
    for one, other in zip(d.final.estimates, plain.final.estimates, strict=True):
        assert one.name == other.name
        assert (one.value, one.sd) == pytest.approx((other.value, other.sd), rel=1e-9)


# --- what is refused -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [2, "processes", ThreadPoolExecutor, Future(), [None], True])
def test_what_is_no_executor_is_refused_before_any_work(motion, bad):
    calls = []

    def counted(t, s, p, u):
        calls.append(1)
        return rates(t, s, p, u)

    with pytest.raises(DomainError, match=r"Expected executor as a concurrent\.futures\.Executor or None\. Got "):
        tc.diagnose(oscillator(counted), motion, library(), executor=bad, progress=False)
    assert calls == []


@pytest.mark.parametrize("kind", ["lock", "file"])
def test_what_cannot_be_sent_is_named(motion, kind, tmp_path):
    pytest.importorskip("cloudpickle")
    with (tmp_path / "log").open("w") as file:
        held = {"lock": threading.Lock(), "file": file}[kind]

        def push(t, s, p, u):
            assert held is not None
            return p["b"] + 0 * s["x"]

        term = tc.Term("push", equation="v", rate=push, parameters=[tc.Parameter("b", unit="m/s^2")])
        if kind == "lock":
            assert diagnose(motion, [term]).verdict == "named"
        with ThreadPoolExecutor(1) as pool, pytest.raises(DomainError) as caught:
            diagnose(motion, [term], executor=pool)
    text = str(caught.value)
    assert text.startswith("Expected a simulator and terms that can be sent to another process. Got one that cannot: ")
    assert text.endswith("Leave executor= away, or keep open files, locks and pools out of their functions.")
    assert {"lock": "_thread.lock", "file": "cannot"}[kind] in text


# --- interrupted -----------------------------------------------------------------------------------------------


def interrupt_after(monkeypatch, count):
    """Ctrl-C at the refit with this number."""
    run, seen = Refit.run, []

    def interrupted(job):
        seen.append(job)
        if len(seen) > count:
            raise KeyboardInterrupt
        return run(job)

    monkeypatch.setattr(Refit, "run", interrupted)
    return seen


@pytest.mark.parametrize("threads", [False, True])
def test_an_interrupted_diagnosis_keeps_its_refits_and_names_nothing(motion, here, monkeypatch, threads):
    if threads:
        pytest.importorskip("cloudpickle")
    seen = interrupt_after(monkeypatch, 1)
    with (
        ThreadPoolExecutor(1) if threads else nullcontext() as pool,
        pytest.warns(InterruptionWarning, match="interrupted. It keeps 1 refitted"),
    ):
        d = diagnose(motion, executor=pool)
    assert len(seen) == 2
    assert d.verdict == "ambiguous"
    assert d.tied == [["bias force"], ["none of these"]]
    assert d.settings["interrupted"] == "The search was interrupted before cubic stiffness had been refitted."
    text = " ".join(str(d).split())
    assert "As the search was interrupted, that is no name." in text
    assert d.settings["interrupted"] in text
    kept, whole = (next(row for row in one.ranking if row.terms == ("bias force",)) for one in (d, here))
    assert kept.refitted
    assert "no fit" not in "".join(row.note for row in d.ranking)
    assert kept.misfit_removed == pytest.approx(whole.misfit_removed, rel=1e-6)


def test_an_interruption_before_any_refit_leaves_the_screening(motion, monkeypatch):
    interrupt_after(monkeypatch, 0)
    with pytest.warns(InterruptionWarning, match="It keeps 0 refitted"):
        d = diagnose(motion)
    assert d.verdict == "unexplained"
    assert {row.terms for row in d.ranking if not row.refitted} >= {("bias force",), ("cubic stiffness",)}
    assert d.settings["interrupted"].endswith("before cubic stiffness, bias force had been refitted.")
    assert str(d).startswith("Verdict: unexplained, as far as the search went before it was interrupted")
    assert not math.isinf(d.detection_limit[0].smallest)


def test_an_interruption_among_pairs_names_no_single_term_as_missing(motion, monkeypatch):
    terms = [term for term in tc.terms.mechanics() if term.name in ("cubic stiffness", "bias force", "linear drag")]
    interrupt_after(monkeypatch, 2)
    with pytest.warns(InterruptionWarning, match="It keeps 2 refitted"):
        d = diagnose(motion, terms)
    assert d.settings["interrupted"] == (
        "The search was interrupted before all their combinations and ranges had been compared."
    )


@pytest.fixture
def terminal():
    """Python's own handler, which a process begun in the background may lack."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("place", ["calibrate_base", "screen_all"])
def test_an_interruption_outside_of_refits_keeps_what_there_is(motion, monkeypatch, place):
    """As the terminal sends it, while the base is calibrated or candidates are screened."""
    work = getattr(Search, place)

    def interrupted(search):
        signal.raise_signal(signal.SIGINT)
        return work(search)

    monkeypatch.setattr(Search, place, interrupted)
    with pytest.warns(InterruptionWarning, match="It keeps 0 refitted"):
        d = diagnose(motion)
    assert d.verdict == "unexplained"
    assert d.settings["interrupted"].endswith("before cubic stiffness, bias force had been refitted.")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("terminal")
def test_an_interruption_of_a_finished_search_changes_nothing(motion, monkeypatch):
    module = sys.modules["torchcal.discovery.diagnose"]  # whose name is that of its function, too
    work = module.conclude

    def interrupted(*args, **options):
        signal.raise_signal(signal.SIGINT)
        return work(*args, **options)

    monkeypatch.setattr(module, "conclude", interrupted)
    d = diagnose(motion, library()[-1:])
    assert (d.verdict, d.terms, d.settings["interrupted"]) == ("named", ["bias force"], "")


@pytest.mark.usefixtures("terminal")
def test_a_second_interruption_ends_all(motion, monkeypatch):
    def impatient(search):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Search, "screen_all", impatient)
    with pytest.raises(KeyboardInterrupt):
        diagnose(motion)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("terminal")
def test_a_signal_among_refits_ends_the_one_under_way():
    stop = Stop()
    with stop.listening():
        with stop.refitting():
            signal.raise_signal(signal.SIGINT)
            raise AssertionError("went on")
        assert stop.is_set()


@pytest.mark.usefixtures("terminal")
def test_nobody_elses_handler_is_replaced():
    def own(number, frame):
        pass

    stop = Stop()
    with ThreadPoolExecutor(1) as pool:  # where no handler can be set
        pool.submit(lambda: stop.listening().__enter__()).result()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    for other in (own, signal.SIG_IGN):
        signal.signal(signal.SIGINT, other)
        with stop.listening():
            assert signal.getsignal(signal.SIGINT) is other


@pytest.mark.slow
def test_windows_are_refitted_together_and_are_the_same_from_workers(monkeypatch):
    pytest.importorskip("cloudpickle")
    x = torch.linspace(0, 4, 80, dtype=F64)
    noise = 0.02 * torch.randn(80, generator=torch.Generator().manual_seed(2), dtype=F64)
    y = 2 * x - 0.3 * (x - 1) ** 2 * (x > 2.5) + noise
    base = tc.Simulator(lambda x, p: p["m"] * x["x"], [tc.Parameter("m")])
    terms = [
        tc.Term(f"power {k}", outputs={"y": lambda x, p, y, k=k: y + p["a"] * (x["x"] - 1) ** k},
                parameters=[tc.Parameter("a", neutral=0.0)])
        for k in (2, 3)
    ]  # fmt: skip
    data = tc.Recording(x={"x": x}, y=y, noise=0.02)
    sizes = []

    def spy(search, wanted):
        sizes.append(len([one for one in wanted if one.window is not None]))
        return refitting.refit_together(search, wanted)

    monkeypatch.setattr("torchcal.discovery.windows.refit_together", spy)
    with ThreadPoolExecutor(2) as pool:
        here, there = (
            tc.diagnose(base, data, terms, seed=0, progress=False, num_starts=4, executor=one) for one in (None, pool)
        )
    assert any(row.region is not None for row in here.ranking)
    assert [(row.terms, row.region) for row in there.ranking] == [(row.terms, row.region) for row in here.ranking]
    assert [row.probability for row in there.ranking] == pytest.approx([row.probability for row in here.ranking])
    assert max(sizes) > 1


def test_no_long_refit_is_gone_on_with_after_ctrl_c(monkeypatch, terminal):
    stages = []

    def refits(jobs, take, executor):
        stages.append([job.begun is not None for job in jobs])
        take(0, SimpleNamespace(leads_to=lambda aim: True))
        if len(stages) == 1 and pressed:
            signal.raise_signal(signal.SIGINT)
        for number in range(1, len(jobs)):
            take(number, SimpleNamespace(leads_to=lambda aim: True))

    monkeypatch.setattr("torchcal.discovery.hypotheses.refitting.refit_all", refits)
    problem = SimpleNamespace(guess=lambda warm, begin: None)
    candidate = SimpleNamespace(problem=problem, shape_places=[], free=[], terms=[SimpleNamespace(name="a")])
    wanted = [SimpleNamespace(candidate=candidate, begin=None) for _ in range(3)]
    for pressed in (False, True):
        stages.clear()
        ticks: list[str] = []
        search = SimpleNamespace(
            stop=Stop(), models=[], executor=None, tick=ticks.append, base=SimpleNamespace(warm=None),
            noise=SimpleNamespace(whitening=lambda problem: None), aim=lambda models: math.inf,
            model=lambda one, fitted: None,
        )  # fmt: skip
        with search.stop.listening():
            found = refitting._fits(search, wanted)
        assert stages == ([[False] * 3] if pressed else [[False] * 3, [True] * 3])
        assert len(ticks) == (1 if pressed else 6)  # a bar that stands still looks hung
        assert [one is not None for one in found] == ([True, False, False] if pressed else [True] * 3)


def test_what_a_black_box_raises_at_all_parameters_is_told():
    def divides(x, p):
        return p["a"] * x if x < 0.5 else 1 / 0

    outside = tc.ExternalSimulator(divides, [tc.Parameter("a", low=0.0, high=5.0)])
    recording = tc.Recording(x=torch.linspace(0, 1, 10, dtype=torch.float64), y=torch.linspace(0, 2, 10))
    with pytest.raises(ConvergenceError, match=r"raised ZeroDivisionError: division by zero\. Give") as raised:
        tc.diagnose(outside, recording, [], progress=False)
    assert "runs" not in str(raised.value)
