"""One thread where there is little to do at once: several wait for each other longer than they compute."""

import threading

import pytest
import torch

import torchcal as tc
from torchcal import threads
from torchcal.threads import SHARED, few_threads

X = torch.linspace(0, 1, 12, dtype=torch.float64)


@pytest.fixture(autouse=True)
def three():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_one_thread_but_where_there_is_much_to_do():
    with few_threads():
        assert torch.get_num_threads() == 1
        with few_threads(100 * SHARED):
            assert torch.get_num_threads() == 3
            with few_threads(SHARED - 1):
                assert torch.get_num_threads() == 1
            with few_threads(3 * SHARED - 1):  # each is to have its share
                assert torch.get_num_threads() == 2
            assert torch.get_num_threads() == 3
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3


def test_the_number_comes_back_after_an_error():
    with pytest.raises(KeyError), few_threads():
        raise KeyError
    assert torch.get_num_threads() == 3
    torch.set_num_threads(2)
    with few_threads(3 * SHARED):  # what was kept has gone
        assert torch.get_num_threads() == 2


def test_another_thread_has_its_own():
    seen = []

    def other() -> None:
        torch.set_num_threads(2)
        with few_threads(3 * SHARED):
            seen.append(torch.get_num_threads())

    with few_threads():
        one = threading.Thread(target=other)
        one.start()
        one.join()
    assert seen == [2]


@pytest.mark.filterwarnings("ignore:Only 1 of 4 starts")  # as few may end a rounding apart
@pytest.mark.parametrize("run", [tc.calibrate, tc.calibrate_additive, tc.diagnose])
def test_the_functions_that_compute_for_long_take_one(run):
    seen = set()

    def line(x, p):
        seen.add(torch.get_num_threads())
        return p["a"] + p["b"] * x

    simulator = tc.Simulator(line, [tc.Parameter("a"), tc.Parameter("b")])
    recording = tc.Recording(x=X, y=1 + X + 0.1 * torch.sin(40 * X), noise=0.1)
    options = {"num_starts": 4} if run is tc.diagnose else {"num_starts": 4, "num_samples": 0}
    run(simulator, recording, progress=False, seed=0, **options)
    assert seen == {1}
    assert torch.get_num_threads() == 3


def test_a_large_calibration_keeps_the_threads(monkeypatch):
    monkeypatch.setattr(threads, "SHARED", 8 * 100 // 3)  # a third of the outputs that starts, nodes and data make
    seen = set()

    def curve(x, p):
        seen.add(torch.get_num_threads())
        return torch.exp(p["a"] * x)

    simulator = tc.Simulator(curve, [tc.Parameter("a", low=0.0, high=2.0)])
    x = torch.linspace(0, 1, 100, dtype=torch.float64)
    recording = tc.Recording(x=x, y=torch.exp(x) + 0.1 * x**2)
    starts = torch.tensor([[0.0, 0.1]]).double().repeat(4, 1)
    tc.calibrate(simulator, recording, rule=2, num_samples=0, starts=starts, seed=0, progress=False)
    assert seen == {1, 3}
