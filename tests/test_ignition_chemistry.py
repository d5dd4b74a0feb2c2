"""The two ignition models: known numbers, one against the other, and what they refuse."""

import math
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from torchcal.errors import DomainError, RecordingError, ShapeError, SimulatorError

pytest.importorskip("cantera")

from examples.ignition import chemistry
from examples.ignition.chemistry import (
    C_REFERENCE,
    DOMAIN,
    R_CAL,
    T_REFERENCE,
    OneStep,
    case_1,
    case_2,
    detailed_delay,
    detailed_delays,
    one_step_delay,
)

# ln tau of GRI-Mech 3.0 at phi = 1.
KNOWN = {1000.0: 0.0928, 1150.0: -2.3562, 1300.0: -4.4597}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ignition") / "delays.csv"


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, float]]:
    """Replace the detailed model by 1/T0, which fails at phi = 1.5, and note its calls."""
    calls: list[tuple[float, float]] = []

    def fake(T0: float, phi: float) -> float:
        calls.append((T0, phi))
        if phi == 1.5:
            raise SimulatorError("no flame")
        return 1.0 / T0

    monkeypatch.setattr(chemistry, "detailed_delay", fake)
    return calls


@pytest.mark.parametrize(("T0", "known"), KNOWN.items())
def test_detailed_delay_matches_the_known_values(T0: float, known: float) -> None:
    assert math.log(detailed_delay(T0, 1.0)) == pytest.approx(known, abs=5e-5)


def test_detailed_delay_does_not_hang_on_the_step_size(monkeypatch: pytest.MonkeyPatch) -> None:
    here = math.log(detailed_delay(1150.0, 0.8))
    monkeypatch.setattr(chemistry, "DETAILED_RTOL", 1e-11)
    monkeypatch.setattr(chemistry, "DETAILED_ATOL", 1e-18)
    assert math.log(detailed_delay(1150.0, 0.8)) == pytest.approx(here, abs=1e-7)


@pytest.mark.parametrize(
    ("case", "rmse"),
    [(case_1(11), 0.0293), pytest.param(case_2(), 0.4533, marks=pytest.mark.slow)],  # the study finds it too
    ids=["1", "2"],
)
def test_best_single_parameter_pair(case: dict, rmse: float, cache: Path) -> None:
    y = detailed_delays(case["T0"], case["phi"], cache=cache, progress=False)
    model = OneStep(case["T0"], case["phi"])
    fit = least_squares(lambda z: model.log_delay(32 + z[0], 45000 + 1e4 * z[1]).numpy() - y, [0.0, 0.0])
    assert np.sqrt(np.mean(fit.fun**2)) == pytest.approx(rmse, abs=1e-4)
    assert DOMAIN["lnA"][0] < 32 + fit.x[0] < DOMAIN["lnA"][1]
    assert DOMAIN["E"][0] < 45000 + 1e4 * fit.x[1] < DOMAIN["E"][1]


def test_integral_matches_the_reactor_in_the_whole_domain() -> None:
    low, high = np.array(list(DOMAIN.values())).T
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], [0, 1])).reshape(4, -1).T
    points = low + (high - low) * np.concatenate([corners, np.random.default_rng(1).random((64, 4))])
    reactor = np.log([one_step_delay(*map(float, point)) for point in points])
    T0, phi, lnA, E = torch.from_numpy(points.T.copy())
    integral = OneStep(T0, phi).log_delay(lnA, E)
    # 1e-6 is what the reactor's tolerance of 1e-8 leaves; the quadrature is exact to 1e-12.
    np.testing.assert_allclose(integral.numpy(), reactor, rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    "exponents",
    [{}, {"fuel_order": 3.0}, {"oxidizer_order": -2.0, "temperature_exponent": 3.0}],
    ids=["paper", "fuel", "oxidizer"],
)
def test_default_nodes_are_enough(exponents: dict[str, float]) -> None:
    case = case_2()
    for E in DOMAIN["E"]:
        fine = OneStep(**case, num_nodes=100).log_delay(32.0, E, **exponents)
        torch.testing.assert_close(OneStep(**case).log_delay(32.0, E, **exponents), fine, rtol=0, atol=1e-11)


def test_quadrature_converges_geometrically() -> None:
    fine, *coarse = (float(OneStep(1000.0, 1.0, num_nodes=q).log_delay(32.0, 46000.0)) for q in (60, 4, 6, 8))
    errors = [abs(value - fine) for value in coarse]
    assert errors[0] > 20 * errors[1] > 400 * errors[2]


def test_exponents_have_their_meaning_where_the_integrand_is_flat() -> None:
    # From 1499 to 1500 K concentrations hardly change: the logs of the delays differ by known amounts.
    T0, phi, c = 1499.0, 0.8, 101325.0 / (8.314462618 * 1499.5) * 1e-6
    total = phi + 9.52
    model = OneStep(T0, phi)
    base = model.log_delay(30.0, 45000.0)
    for exponents, expected in [
        ({"fuel_order": 1.5}, -0.5 * math.log(phi / total * c / C_REFERENCE)),
        ({"oxidizer_order": 0.5}, 0.5 * math.log(2.0 / total * c / C_REFERENCE)),
        ({"temperature_exponent": 2.0}, -2.0 * math.log(1499.5 / T_REFERENCE)),
    ]:
        change = float(model.log_delay(30.0, 45000.0, **exponents) - base)
        assert change == pytest.approx(expected, abs=1e-3)
    assert float(model.log_delay(30.0, 46000.0) - base) == pytest.approx(1000.0 / (R_CAL * 1499.5), abs=1e-5)
    assert float(model.log_delay(31.0, 45000.0) - base) == pytest.approx(-1.0, abs=1e-13)


def test_one_step_shapes_precision_and_gradients() -> None:
    model = OneStep([1000.0, 1150.0, 1300.0], [0.6, 1.0, 1.8])
    lnA = torch.linspace(29, 35, 4, dtype=torch.float64).reshape(2, 2, 1)
    E = torch.tensor(45879.123456789, dtype=torch.float64)
    assert model.log_delay(32.0, 45000.0).shape == (3,)
    assert model.log_delay(lnA, E).shape == (2, 2, 3)
    assert model.log_delay(lnA, E, fuel_order=torch.ones(2, 1, 3, dtype=torch.float64)).shape == (2, 2, 3)
    assert model.log_delay(32.0, 45000.0, fuel_order=torch.ones(5, 1, dtype=torch.float64)).shape == (5, 3)
    torch.testing.assert_close(model.log_delay(32, 45879.123456789), model.log_delay(32.0, E), rtol=0, atol=0)
    arguments = [
        torch.tensor([[v], [w]], dtype=torch.float64, requires_grad=True)
        for v, w in [(31, 33), (4.4, 4.8), (0, 1), (1, -0.5), (1, 2)]
    ]
    assert torch.autograd.gradcheck(
        lambda lnA, E, n, a, b: model.log_delay(
            lnA, 1e4 * E, temperature_exponent=n, fuel_order=a, oxidizer_order=b
        ),
        arguments,
    )
    with pytest.raises(ShapeError, match=r"Expected lnA of shape .* Got \(2,\)"):
        model.log_delay(torch.zeros(2), 45000.0)


def test_models_can_be_sent_to_other_processes() -> None:
    for function in (one_step_delay, detailed_delay):
        assert pickle.loads(pickle.dumps(function)) is function
    model = OneStep(1100.0, 1.0)
    copy = pickle.loads(pickle.dumps(model))
    torch.testing.assert_close(copy.log_delay(32.0, 45000.0), model.log_delay(32.0, 45000.0), rtol=0, atol=0)


def test_threads_do_not_share_a_mixture() -> None:
    points = [(1000.0 + 10 * i, 0.6 + 0.04 * i, 32.0, 46000.0) for i in range(30)]
    with ThreadPoolExecutor(4) as pool:
        parallel = list(pool.map(one_step_delay, *zip(*points, strict=True)))
    assert parallel == [one_step_delay(*point) for point in points]


@pytest.mark.parametrize(("T0", "phi"), [(1000.0, 0.1), (1000.0, 20.0)], ids=["lean", "rich"])
def test_a_mixture_that_stays_cold_is_refused(T0: float, phi: float) -> None:
    with pytest.raises(DomainError, match="used up"):
        one_step_delay(T0, phi, 32.0, 46000.0)
    with pytest.raises(DomainError, match="used up"):
        OneStep([T0, T0], [1.0, phi])
    with pytest.raises(SimulatorError, match="Expected a mixture that ignites"):
        detailed_delay(T0, phi)


@pytest.mark.parametrize(("T0", "phi"), [(1500.0, 1.0), (math.nan, 1.0), (1000.0, 0.0), (1000.0, math.inf)])
def test_meaningless_conditions_are_refused(T0: float, phi: float) -> None:
    for call in (
        lambda: detailed_delay(T0, phi),
        lambda: detailed_delays(T0, phi),
        lambda: one_step_delay(T0, phi, 32.0, 46000.0),
        lambda: OneStep(T0, phi),
    ):
        with pytest.raises(DomainError, match="Expected 200 <= T0"):
            call()
    with pytest.raises(DomainError, match="finite lnA"):
        one_step_delay(1000.0, 1.0, math.nan, 46000.0)
    with pytest.raises(ShapeError, match="broadcast"):
        detailed_delays([1000.0, 1100.0], [1.0, 1.0, 1.0])


def test_cache_holds_what_was_run(counted: list, tmp_path: Path) -> None:
    path = tmp_path / "outputs" / "delays.csv"
    first = detailed_delays([[1000.0], [1100.0]], [0.8, 1.0], cache=path, progress=False)
    assert first.shape == (2, 2)
    assert len(counted) == 4
    np.testing.assert_allclose(first, -np.log([[1000.0] * 2, [1100.0] * 2]))
    again = detailed_delays([1100.0, 1100.0, 1200.0], 1.0, cache=path, progress=False)
    assert counted[4:] == [(1200.0, 1.0)]
    assert again[0] == again[1] == first[1, 1]
    assert [p.name for p in path.parent.iterdir()] == ["delays.csv"]
    path.write_text(path.read_text().replace("cantera ", "cantera 0."))
    detailed_delays(1100.0, 1.0, cache=path, progress=False)
    assert counted[5:] == [(1100.0, 1.0)]
    assert len(path.read_text().splitlines()) == 3


@pytest.mark.parametrize("damage", ["", "T0\n", "1000,1\n", "a,b,c\n", "1000,1,nan\n"])
def test_a_damaged_cache_is_not_used(damage: str, counted: list, tmp_path: Path) -> None:
    path = tmp_path / "delays.csv"
    detailed_delays(1100.0, 1.0, cache=path, progress=False)
    path.write_text(path.read_text() + damage if "," in damage else damage)
    with pytest.raises(RecordingError, match="delete it"):
        detailed_delays(1200.0, 1.0, cache=path, progress=False)
    assert len(counted) == 1
    with pytest.raises(RecordingError, match=r"\.csv"):
        detailed_delays(1200.0, 1.0, cache=tmp_path / "delays.npz", progress=False)


@pytest.mark.parametrize("parallel", [False, True])
def test_a_failed_run_names_its_point_and_keeps_the_others(
    parallel: bool, counted: list, tmp_path: Path
) -> None:
    path = tmp_path / "delays.csv"
    executor = ThreadPoolExecutor(1) if parallel else None
    with pytest.raises(SimulatorError, match=r"T0 = 1100 K, phi = 1\.5: no flame"):
        detailed_delays([1000.0, 1100.0], [1.0, 1.5], executor=executor, cache=path, progress=False)
    if executor is not None:
        executor.shutdown()
    else:
        assert path.read_text().count("\n") == 3
