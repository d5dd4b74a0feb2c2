"""Executors whose workers die: on a real process pool and on a real Dask cluster."""

import functools
import gc
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections import Counter
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.thread import BrokenThreadPool
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from torchcal import (
    ExternalSimulator,
    ODESimulator,
    Parameter,
    Recording,
    Run,
    Simulator,
    build_surrogate,
    calibrate,
    calibrate_many,
    embeddings,
    likelihoods,
    priors,
)
from torchcal.errors import (
    ConvergenceWarning,
    DomainError,
    InterruptionWarning,
    RecordingError,
    SimulatorError,
    TorchcalError,
    WorkerWarning,
    warn,
)
from torchcal.inference import many
from torchcal.inference.fingerprint import fingerprint
from torchcal.results import Calibration
from torchcal.simulators import executor as executors
from torchcal.simulators.cluster import submit
from torchcal.simulators.executor import TaskError, run_tasks

# Workers that begin in milliseconds: copies of a process that has imported everything.
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["torchcal"])
A = Parameter("a", low=0.5, high=2.0)


def log(folder, key):
    """Leave a file for each evaluation: of what, by whom, begun when."""
    Path(folder, f"{key}_{os.getpid()}_{time.time_ns()}").touch()


def evaluations(folder):
    """(key, pid, nanoseconds) of each evaluation that was begun."""
    return [tuple(float(part) for part in path.name.split("_")) for path in Path(folder).glob("*_*_*")]


def first_time(folder, name):
    try:
        Path(folder, name).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def square(folder, seconds, task):
    log(folder, task)
    time.sleep(seconds)
    return task**2


def square_or_die(folder, deadly, task):
    """Kills its worker at each deadly task, if that is given as `once` only the first time."""
    log(folder, task)
    time.sleep(0.01)
    if task in deadly and (deadly[task] == "always" or first_time(folder, f"died{task}")):
        os._exit(1)
    return task**2


def slow(folder, x, p):
    log(folder, 1000 * x + p["a"])
    time.sleep(0.02)
    return p["a"] * x**2


def slow_or_die(folder, x, p):
    if p["a"] > 1.9 and x > 0.7 and first_time(folder, "died"):
        os._exit(1)
    return slow(folder, x, p)


def dies_at_one_point(folder, x, p):
    if 1.0 < p["a"] < 1.4 and 0.4 < x < 0.6:
        os._exit(1)
    return slow(folder, x, p)


def dies(x, p):
    os._exit(1)


@contextmanager
def killing(folder, begun):
    """Kill, from outside, the worker that began the latest evaluation, as soon as so many have begun."""
    killed = []

    def kill():
        for _ in range(6000):
            found = evaluations(folder)
            if len(found) >= begun:
                killed.append(int(max(found, key=lambda item: item[2])[1]))
                os.kill(killed[0], signal.SIGKILL)
                return
            time.sleep(0.01)

    thread = threading.Thread(target=kill)
    thread.start()
    yield killed
    thread.join()
    assert killed
    assert killed[0] != os.getpid()


def pool(workers=2, **settings):
    return ProcessPoolExecutor(workers, mp_context=SERVER, **settings)


def run_and_check(function, tasks, folder, executor):
    """Every value is handed over once, is right, and is not computed again later. How often each was begun."""
    handed = {}

    def take(index, value):
        assert index not in handed
        handed[index] = time.time_ns()
        assert value == tasks[index] ** 2

    run_tasks(function, tasks, executor=executor, on_result=take)
    assert sorted(handed) == list(range(len(tasks)))
    begun = evaluations(folder)
    assert all(when <= handed[tasks.index(int(key))] for key, _, when in begun)
    return Counter(int(key) for key, _, _ in begun)


# --- a process pool --------------------------------------------------------------------------------------


def test_a_killed_worker_loses_nothing(tmp_path):
    with pool() as executor, killing(tmp_path, begun=30) as killed:
        with pytest.warns(WorkerWarning, match="1 worker process died"):
            counts = run_and_check(functools.partial(square, tmp_path, 0.02), list(range(100)), tmp_path, executor)
    # At the most the chunks under way were repeated: 2 a worker, of 0.2 s.
    assert sum(counts.values()) - 100 <= 4 * 12
    assert len({pid for _, pid, _ in evaluations(tmp_path)} - set(killed)) >= 2


def test_workers_that_die_of_different_tasks_lose_nothing(tmp_path):
    function = functools.partial(square_or_die, tmp_path, {3: "once", 17: "once", 39: "once"})
    with pool() as executor, pytest.warns(WorkerWarning, match=r"[23] worker processes died"):
        counts = run_and_check(function, list(range(40)), tmp_path, executor)
    assert max(counts.values()) <= 4


@pytest.mark.parametrize("workers", [1, 2])
def test_a_task_that_kills_every_worker_is_named(workers, tmp_path):
    taken = []
    function = functools.partial(square_or_die, tmp_path, {5: "always"})
    with pool(workers) as executor, pytest.raises(TaskError) as caught:
        run_tasks(function, list(range(12)), executor=executor, on_result=lambda i, value: taken.append(i))
    assert (caught.value.index, caught.value.suspects) == (5, 1)
    assert set(taken) >= set(range(5))
    assert Counter(int(key) for key, _, _ in evaluations(tmp_path))[5] <= 3


def test_a_design_goes_on_when_a_worker_is_killed(tmp_path):
    settings = {"conditions": (0.0, 1.0), "parameters": [A], "order": 4, "progress": False, "holdout": 30}
    function = functools.partial(slow, tmp_path)
    expected = build_surrogate(function, **settings)
    for path in tmp_path.iterdir():
        path.unlink()
    with pool() as executor, killing(tmp_path, begun=20):
        with pytest.warns(WorkerWarning, match="1 worker process died"):
            found = build_surrogate(function, executor=executor, cache=tmp_path / "cache.npz", **settings)
    assert torch.equal(found.coefficients, expected.coefficients)
    assert torch.equal(found.error.max_abs, expected.error.max_abs)


def test_a_point_that_kills_is_named_and_the_others_are_kept(tmp_path):
    settings = {"conditions": (0.0, 1.0), "parameters": [A], "order": 2, "progress": False, "holdout": 10}
    function = functools.partial(dies_at_one_point, tmp_path)
    point = r"worker process died at x = 0.5, p = \{'a': 1.25"
    with pool() as executor, pytest.raises(SimulatorError, match=point) as caught:
        build_surrogate(function, executor=executor, **settings)
    assert "or one of" not in str(caught.value)
    assert len(caught.value.partial) >= 4  # those before it


def test_a_simulator_keeps_the_pool_that_stands_in(tmp_path):
    executor = pool()
    simulator = ExternalSimulator(functools.partial(slow_or_die, tmp_path), [A], executor=executor)
    x = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)
    values = torch.linspace(0.5, 2.0, 4, dtype=torch.float64)[:, None].requires_grad_(True)
    with pytest.warns(WorkerWarning, match="1 worker process died"):
        result = simulator.at(x)(values)
    torch.testing.assert_close(result, values * x**2, rtol=1e-15, atol=1e-15)
    result.sum().backward()  # no further warning: an error here
    torch.testing.assert_close(values.grad, (x**2).sum().expand(4, 1), rtol=1e-7, atol=0)
    simulator.at(x)(values.detach() * 0.9)
    assert len({pid for _, pid, _ in evaluations(tmp_path)}) <= 4
    spare = weakref.ref(executors._SPARES[executor])
    executor.shutdown()
    del executor, simulator, result
    gc.collect()
    assert spare() is None or spare()._shutdown_thread


def test_an_initializer_runs_in_the_fresh_pool_too(tmp_path):
    function = functools.partial(square_or_die, tmp_path, {2: "once"})
    with pool(1, initializer=functools.partial(log, tmp_path, -1)) as executor:
        with pytest.warns(WorkerWarning, match="1 worker process died"):
            run_tasks(function, list(range(4)), executor=executor, on_result=lambda i, value: None)
    assert Counter(key for key, _, _ in evaluations(tmp_path))[-1] == 2


class Homesick:
    """Pickles, and cannot be unpickled in another process: as if its module were not installed there."""

    def __reduce__(self):
        return refuse_elsewhere, (os.getpid(),)

    def __call__(self, task):
        return task


def refuse_elsewhere(pid):
    if os.getpid() != pid:
        raise ModuleNotFoundError("No module named 'chemistry'")
    return Homesick()


def test_a_module_that_workers_lack_is_named_and_breaks_nothing():
    with pool(1) as executor:
        with pytest.raises(TaskError) as caught:
            run_tasks(Homesick(), [1, 2], executor=executor, on_result=lambda i, value: None)
        assert isinstance(caught.value.error, ModuleNotFoundError)
        assert executor.submit(abs, -1).result() == 1


# --- other executors -------------------------------------------------------------------------------------


def refuse():
    raise RuntimeError("no licence")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_broken_executor_that_cannot_be_opened_again_is_named():
    with ThreadPoolExecutor(1, initializer=refuse) as executor, pytest.raises(TaskError) as caught:
        run_tasks(abs, [-1, -2], executor=executor, on_result=lambda i, value: None)
    assert caught.value.index == 0
    assert isinstance(caught.value.error, BrokenThreadPool)


class Forgetful(Executor):
    """Gives up each task the first `times` times, as a cluster does whose scheduler was restarted."""

    def __init__(self, times):
        self.times, self.tries = times, Counter()

    def submit(self, fn, /, function, tasks, label):
        future = Future()
        if self.tries[tuple(tasks)] < self.times:
            self.tries[tuple(tasks)] += 1
            future.cancel()
            future.set_running_or_notify_cancel()
        else:
            future.set_result(fn(function, tasks, label))
        return future


def test_work_that_an_executor_gives_up_is_sent_again():
    values = {}
    with pytest.warns(WorkerWarning, match="nothing is lost"):
        run_tasks(abs, [-1, -2, -3], executor=Forgetful(1), on_result=values.__setitem__)
    assert values == {0: 1, 1: 2, 2: 3}
    with pytest.raises(TaskError, match="gave it up"):
        run_tasks(abs, [-1], executor=Forgetful(9), on_result=values.__setitem__)


def test_an_executor_that_was_shut_down_is_named():
    with pool(1) as executor:
        pass
    with pytest.raises(DomainError, match="running"):
        run_tasks(abs, [-1], executor=executor, on_result=lambda i, value: None)


# --- Dask ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def client():
    distributed = pytest.importorskip("distributed", reason="pip install 'torchcal[dask]'")
    settings = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**settings) as cluster, distributed.Client(cluster) as client:
        yield client


def test_a_killed_dask_worker_loses_nothing(client, tmp_path):
    with killing(tmp_path, begun=30) as killed:
        counts = run_and_check(
            functools.partial(square, tmp_path, 0.02), list(range(150)), tmp_path, client.get_executor()
        )
    assert sum(counts.values()) < 2 * 150
    assert {pid for _, pid, _ in evaluations(tmp_path)} > set(killed)


def test_a_design_on_dask_goes_on_when_a_worker_is_killed(client, tmp_path):
    settings = {"conditions": (0.0, 1.0), "parameters": [A], "order": 4, "progress": False, "holdout": 30}
    with killing(tmp_path, begun=20):
        found = build_surrogate(functools.partial(slow, tmp_path), executor=client.get_executor(), **settings)
    expected = build_surrogate(functools.partial(slow, tmp_path), **settings)
    assert torch.equal(found.coefficients, expected.coefficients)


@pytest.fixture
def impatient(client):
    """A cluster that gives a task up at the first death; by default it tries four workers."""
    scheduler = client.cluster.scheduler
    before, scheduler.allowed_failures = scheduler.allowed_failures, 0
    yield client
    scheduler.allowed_failures = before


def test_work_that_dask_gives_up_is_sent_again_alone(impatient, tmp_path):
    function = functools.partial(square_or_die, tmp_path, {5: "once"})
    with pytest.warns(WorkerWarning, match="died"):
        run_and_check(function, list(range(20)), tmp_path, impatient.get_executor())


def test_a_result_that_is_lost_while_it_is_fetched_is_computed_again(client, monkeypatch):
    """Its task, sent to another worker, fails there too: Dask's own executor then never ends the future."""
    distributed = pytest.importorskip("distributed")
    gather, lost = client._gather, []

    async def lose_the_first(futures, *args, **options):
        if not lost:
            lost.extend(futures)
            raise distributed.KilledWorker("a task", None, 1)
        return await gather(futures, *args, **options)

    monkeypatch.setattr(client, "_gather", lose_the_first)
    values = {}
    with pytest.warns(WorkerWarning, match="nothing is lost"):
        run_tasks(abs, [-1, -2, -3], executor=client.get_executor(), on_result=values.__setitem__)
    assert lost
    assert values == {0: 1, 1: 2, 2: 3}


def test_a_dask_executor_that_was_shut_down_is_named_and_a_cancelled_future_ends(client):
    executor = client.get_executor()
    future = submit(executor, time.sleep, 3)  # cancelled or not, a worker sleeps on
    assert future.cancel()
    assert wait([future], timeout=20).done == {future}
    executor.shutdown()
    with pytest.raises(DomainError, match="running"):
        run_tasks(abs, [-1], executor=executor, on_result=lambda i, value: None)


@pytest.mark.slow
def test_a_task_that_kills_every_dask_worker_is_named(impatient):
    simulator = ExternalSimulator(dies, [A], executor=impatient.get_executor())
    with pytest.raises(SimulatorError, match=r"worker process died at x = 2.0, p = \{'a': 1.0\} .*Attempted to run"):
        simulator.at(torch.tensor([2.0]).double())(torch.tensor([1.0]).double())


# --- many calibrations -----------------------------------------------------------------------------------

X = torch.linspace(-1.0, 1.0, 9, dtype=torch.float64)
SETTINGS = {"likelihood": likelihoods.ABC(epsilon=0.1), "num_samples": 5, "num_chains": 2, "num_warmup": 5, "seed": 3}
MAP_ALONE = {"likelihood": likelihoods.ABC(epsilon=0.1), "num_samples": 0, "num_starts": 4}


def line(x, p):
    return p["a"] + p["b"] * x


def bent_line(x, p):
    return p["a"] + p["b"] * x + 0.01 * x**2


def line_with_traps(folder, x, p):
    """Logs each calibration's process and threads; the recordings at x < -5 kill, those at x > 5 fail."""
    if x[0] > 5:
        raise ValueError("out of range")
    if x[0] < -5 and (float(x[0]) < -50 or first_time(folder, "died")):
        os._exit(1)
    Path(folder, f"{os.getpid()}-{torch.get_num_threads()}").touch()
    return line(x, p)


def linear(function=line):
    return Simulator(function, [Parameter("a"), Parameter("b")], degree=1)


def trapped(folder):
    return linear(functools.partial(line_with_traps, folder))


def records(offsets=(0.0, 0.0, 0.0)):
    shapes = (X**2, X**3, X + X**4)
    return {name: Recording(x=X + dx, y=1 + shape) for name, dx, shape in zip("uvw", offsets, shapes, strict=True)}


def same(a, b):
    samples = a.samples is b.samples is None or torch.equal(a.samples, b.samples)
    return torch.equal(a.map.alpha, b.map.alpha) and samples and a.map.objective == b.map.objective


@pytest.mark.filterwarnings("ignore::torchcal.errors.ConvergenceWarning")  # so few draws
def test_many_calibrations_are_those_made_one_by_one(client):
    recordings = {name: item for name, item in records().items() if name != "w"}
    expected = {name: calibrate(linear(), item, **SETTINGS) for name, item in recordings.items()}
    with pool() as processes, ThreadPoolExecutor(3) as threads:
        for executor in (processes, client.get_executor()):
            found = calibrate_many(linear(), recordings, executor=executor, **SETTINGS)
            assert list(found) == ["u", "v"]
            assert all(same(found[name], expected[name]) for name in expected)
            assert torch.equal(found["u"].predict(X).mean, expected["u"].predict(X).mean)
        expected = [calibrate(linear(), item, **MAP_ALONE) for item in records().values()]
        for executor in (None, threads):
            listed = calibrate_many(linear(), list(records().values()), executor=executor, **MAP_ALONE)
            assert all(same(a, b) for a, b in zip(listed, expected, strict=True))


def decay(t, s, p, u):
    return {"y": -p["k"] * s["y"]}


def level(t, s, p, u):
    return s["y"]


def test_many_calibrations_in_time():
    rate = Parameter("k", unit="1/s", low=0.0, initial=1.0)
    body = ODESimulator(rates=decay, states={"y": "m"}, parameters=[rate], observe={"level": level})
    t = torch.linspace(0.0, 2.0, 9, dtype=torch.float64)
    runs = [Run(time=t, outputs={"level": torch.exp(-k * t) + 0.02 * t}, initial={"y": 1.0}) for k in (0.5, 1.5)]
    recordings = [Recording(runs=[run]) for run in runs]
    with pool() as executor:
        found = calibrate_many(body, recordings, executor=executor, **MAP_ALONE)
    assert all(same(fit, calibrate(body, item, **MAP_ALONE)) for fit, item in zip(found, recordings, strict=True))


def many_threads():
    torch.set_num_threads(3)


def test_workers_use_one_thread(tmp_path):
    with pool(initializer=many_threads) as executor:
        calibrate_many(trapped(tmp_path), records(), executor=executor, **MAP_ALONE)
    found = [path.name.split("-") for path in tmp_path.iterdir()]
    assert {threads for _, threads in found} == {"1"}
    assert str(os.getpid()) not in {pid for pid, _ in found}


def test_warnings_come_back_with_the_name_of_the_recording():
    with pool(1) as executor, pytest.warns(ConvergenceWarning, match="recording 'u': The chains have not converged"):
        calibrate_many(linear(), {"u": records()["u"]}, executor=executor, **{**SETTINGS, "num_samples": 4})


def test_a_failed_calibration_is_named_and_the_others_are_kept(tmp_path):
    recordings = records(offsets=(0.0, 10.0, 0.0))
    folder = tmp_path / "results"
    for settings in ({}, {"folder": folder}):
        failed = pytest.raises(TorchcalError, match=r"1 that failed: recording 'v': .*out of range")
        with pool() as executor, failed as caught:
            calibrate_many(trapped(tmp_path), recordings, executor=executor, **settings, **MAP_ALONE)
        assert list(caught.value.partial) == ["u", "w"]
        assert same(caught.value.partial["w"], calibrate(linear(), recordings["w"], **MAP_ALONE))
    assert sorted(path.name for path in folder.iterdir()) == ["u.nc", "w.nc"]
    with pytest.raises(TorchcalError, match="recording 'v'"):
        calibrate_many(trapped(tmp_path), recordings, **MAP_ALONE)


def test_calibrations_survive_a_worker_and_name_the_one_that_kills(tmp_path):
    recordings = records(offsets=(-10.0, 0.0, 0.0))
    with pool() as executor, pytest.warns(WorkerWarning, match="died"):
        found = calibrate_many(trapped(tmp_path), recordings, executor=executor, **MAP_ALONE)
    assert same(found["u"], calibrate(linear(), recordings["u"], **MAP_ALONE))
    recordings = records(offsets=(-100.0, 0.0, 0.0))
    failed = pytest.raises(TorchcalError, match="recording 'u': a worker process died of it")
    with pool() as executor, failed as caught:
        calibrate_many(trapped(tmp_path), recordings, executor=executor, **MAP_ALONE)
    assert sorted(caught.value.partial) == ["v", "w"]


@pytest.mark.filterwarnings("ignore::torchcal.errors.ConvergenceWarning")
def test_a_rerun_takes_what_is_in_the_folder(tmp_path, monkeypatch):
    folder = tmp_path / "a" / "results"
    first = calibrate_many(linear(), records(), folder=folder, **SETTINGS)
    assert sorted(path.name for path in folder.iterdir()) == ["u.nc", "v.nc", "w.nc"]
    (folder / "v.nc").unlink()
    calls = []

    @functools.wraps(calibrate)
    def counted(simulator, recording, **settings):
        calls.append(recording)
        return calibrate(simulator, recording, **settings)

    monkeypatch.setattr("torchcal.inference.many.calibrate", counted)
    again = calibrate_many(linear(), records(), folder=folder, **SETTINGS)
    assert len(calls) == 1
    assert list(again) == ["u", "v", "w"]
    assert all(same(again[name], first[name]) for name in first)
    assert torch.equal(again["u"].predict(2 * X).mean, first["u"].predict(2 * X).mean)
    assert same(Calibration.load(folder / "w.nc"), first["w"])


def test_results_of_other_inputs_are_refused(tmp_path):
    calibrate_many(linear(), records(), folder=tmp_path, **MAP_ALONE)

    def refused(match, simulator=None, recordings=None, **settings):
        with pytest.raises(DomainError, match=match):
            calibrate_many(
                simulator or linear(), recordings or records(), folder=tmp_path, **{**MAP_ALONE, **settings}
            )

    refused("another recording", recordings={**records(), "v": Recording(x=X, y=2 + X**3)})
    refused("another seed", seed=1)
    refused("another likelihood", likelihood=likelihoods.ABC(epsilon=0.2))
    refused("another embedding", embedding=embeddings.IndependentGaussian())
    refused("another simulator", simulator=Simulator(line, [Parameter("a"), Parameter("b", low=0.0)], degree=1))
    refused("predicts something else", simulator=linear(bent_line))
    calibrate_many(linear(), records(), folder=tmp_path, **MAP_ALONE)
    (tmp_path / "w.nc").write_bytes(b"not netCDF")
    refused("Got another file")


SCALE = 1.0


class Scaled:
    def __init__(self, scale):
        self.scale = scale

    def prior(self, propagate):
        return priors.Normal(propagate, scale=self.scale)


CALLS = 0
TABLE = {}


def counted(propagate):
    global CALLS
    CALLS += 1
    return TABLE["itself"], priors.Flat(propagate)


def test_what_functions_are_is_told_once_though_they_hold_each_other(monkeypatch):
    TABLE["itself"] = TABLE
    TABLE.update({k: (lambda q, k=k: TABLE[(k + 1) % 12](q)) for k in range(12)})
    numbers = [torch.ones(2, dtype=torch.bfloat16), torch.eye(2).to_sparse()]
    told = [fingerprint([counted, TABLE[3], numbers])]
    monkeypatch.setitem(globals(), "CALLS", 7)
    assert told == [fingerprint([counted, TABLE[3], numbers])]
    assert fingerprint(TABLE[3]) != fingerprint(counted)


def normal(scale):
    return lambda propagate: priors.Normal(propagate, scale=scale)


def test_results_of_another_prior_of_the_same_name_are_refused(tmp_path, monkeypatch):
    """Functions in one file have one name if they are lambdas, and may take values from elsewhere."""
    for number, (first, second) in enumerate([
        (lambda propagate: priors.Normal(propagate, scale=1.0), lambda propagate: priors.Normal(propagate, scale=2.0)),
        (normal(1.0), normal(2.0)),
        (lambda q, s=1.0: priors.Normal(q, scale=s), lambda q, s=2.0: priors.Normal(q, scale=s)),
        (functools.partial(priors.Normal, scale=1.0), functools.partial(priors.Normal, scale=2.0)),
    ]):  # fmt: skip
        folder = tmp_path / str(number)
        one = {"u": records()["u"]}
        found = calibrate_many(linear(), one, folder=folder, prior=first, **MAP_ALONE)
        assert same(calibrate_many(linear(), one, folder=folder, prior=first, **MAP_ALONE)["u"], found["u"])
        with pytest.raises(DomainError, match="another prior"):
            calibrate_many(linear(), one, folder=folder, prior=second, **MAP_ALONE)

    def chosen(kind):
        return lambda propagate: kind(propagate)

    for first, second in [
        (priors.Flat, priors.Normal),
        (functools.partial(priors.Normal, scale=1.0), functools.partial(priors.Normal, scale=2.0)),
        (normal(1.0), normal(2.0)),
        (Scaled(1.0).prior, Scaled(2.0).prior),
    ]:
        assert fingerprint(chosen(first)) != fingerprint(chosen(second))
        assert fingerprint(chosen(first)) == fingerprint(chosen(first))

    def of_the_file(propagate):
        return priors.Normal(propagate, scale=SCALE)

    calibrate_many(linear(), one, folder=tmp_path / "file", prior=of_the_file, **MAP_ALONE)
    monkeypatch.setitem(globals(), "SCALE", 2.0)
    with pytest.raises(DomainError, match="another prior"):
        calibrate_many(linear(), one, folder=tmp_path / "file", prior=of_the_file, **MAP_ALONE)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"recordings": Recording(x=X, y=X)}, DomainError, "sequence or a dict"),
        ({"recordings": [X]}, RecordingError, "recording 0"),
        ({"simulator": line}, DomainError, "Simulator"),
        ({"executor": 3}, DomainError, "executor"),
        ({"num_sample": 3}, DomainError, "num_sample"),
    ],
)
def test_bad_input(arguments, error, message):
    with pytest.raises(error, match=message):
        calibrate_many(**{"simulator": linear(), "recordings": records(), **arguments})


def test_what_cannot_be_sent_is_refused_before_any_work(tmp_path):
    with pool(1) as executor:
        with pytest.raises(DomainError, match="the simulator as something that can be sent"):
            calibrate_many(linear(lambda x, p: p["a"]), records(), executor=executor, folder=tmp_path / "new")
        with pytest.raises(DomainError, match="prior as something that can be sent"):
            calibrate_many(linear(), records(), executor=executor, prior=lambda propagate: None)
        assert not executor._processes
    assert not (tmp_path / "new").exists()


def test_the_folder_needs_names_and_embeddings_that_can_be_read_back(tmp_path):
    class Mine(embeddings.Gaussian):
        pass

    with pytest.raises(DomainError, match="Mine, which cannot be read back"):
        calibrate_many(linear(), records(), folder=tmp_path, embedding=Mine())
    with pytest.raises(DomainError, match="two of one name"):
        calibrate_many(linear(), {1: records()["u"], "1": records()["v"]}, folder=tmp_path)
    calibrate_many(linear(), {"a/b": records()["u"]}, folder=tmp_path, **MAP_ALONE)
    assert [path.name for path in tmp_path.iterdir()] == ["a%2Fb.nc"]


def test_an_interrupt_keeps_what_ended(tmp_path):
    def interrupted(x, p):
        if x[0] > 5:
            raise KeyboardInterrupt
        return line(x, p)

    with pytest.raises(KeyboardInterrupt) as caught:
        calibrate_many(linear(interrupted), records(offsets=(0.0, 0.0, 10.0)), **MAP_ALONE)
    assert list(caught.value.partial) == ["u", "v"]


@pytest.mark.filterwarnings("ignore::torchcal.errors.ConvergenceWarning")  # of so few starts
@pytest.mark.parametrize("executor", [None, "threads"])
def test_a_calibration_that_was_cut_short_is_no_result(executor, tmp_path, monkeypatch):
    whole, calls = many.calibrate, []

    @functools.wraps(whole)
    def cut_short(simulator, recording, **settings):
        calls.append(recording)
        if len(calls) == 2:
            warn("The sampler was interrupted.", InterruptionWarning)
        return whole(simulator, recording, **settings)

    monkeypatch.setattr(many, "calibrate", cut_short)
    items = records()
    with ThreadPoolExecutor(1) as threads, pytest.raises(KeyboardInterrupt) as caught:
        calibrate_many(linear(), items, folder=tmp_path, executor=threads if executor else None, **MAP_ALONE)
    assert "v" not in caught.value.partial
    assert len(calls) == (3 if executor else 2)
    assert {path.stem for path in tmp_path.iterdir()} == set(caught.value.partial)
    assert list(calibrate_many(linear(), items, folder=tmp_path, **MAP_ALONE)) == ["u", "v", "w"]
    assert len(calls) == 4


@pytest.mark.slow
@pytest.mark.parametrize(("part", "shown"), [("on_this_machine", "day 4"), ("on_dask", "order 5")])
def test_the_guide_to_clusters_runs(part, shown, tmp_path):
    pytest.importorskip("distributed", reason="pip install 'torchcal[dask]'")
    text = Path(__file__).parents[1].joinpath("docs", "how_to", "cluster.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    (tmp_path / "pendulums.py").write_text("\n".join(blocks), encoding="utf-8")
    command = [sys.executable, "pendulums.py", part]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert shown in done.stdout
    assert (tmp_path / "results" / "runs.npz").exists()
