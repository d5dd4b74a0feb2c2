"""The command `torchcal`."""

import functools
import importlib.metadata
import json
import os
import subprocess
import sys
import warnings

import pytest
import torch

import torchcal as tc
from torchcal import cli
from torchcal.errors import InterruptionWarning, TorchcalError, TorchcalWarning, warn

PROBLEM = """
import torch
import torchcal as tc

x = torch.linspace(-1, 1, 11, dtype=torch.float64)
simulator = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b")], degree=1)
recording = tc.Recording(x=x, y=2 + 2 * x + 3 * x**2, noise=0.01)
candidates = [tc.Term("bend", outputs={"y": lambda x, p, y: y + p["c"] * x**2}, parameters=[tc.Parameter("c")])]
calibrate_options = {"num_samples": 0, "likelihood": tc.likelihoods.ABC(epsilon=0.1), "seed": 3}
"""


@pytest.fixture
def problem(tmp_path):
    path = tmp_path / "bent_line.py"
    path.write_text(PROBLEM)
    yield path
    sys.modules.pop("bent_line", None)
    sys.path[:] = [entry for entry in sys.path if entry != str(tmp_path)]


def test_calibrate_writes_a_result_that_show_prints(problem, tmp_path, capsys):
    out = tmp_path / "result.nc"
    assert cli.main(["calibrate", str(problem), "--out", str(out), "--quiet"]) == 0
    told = capsys.readouterr().out
    result = tc.results.Calibration.load(out)
    assert result.settings["seed"] == 3  # the file's
    assert told.strip() == str(result).strip()
    assert cli.main(["show", str(out)]) == 0
    assert capsys.readouterr().out == told
    assert cli.main(["calibrate", str(problem), "--out", str(out), "--quiet", "--seed", "5"]) == 0
    assert tc.results.Calibration.load(out).settings["seed"] == 5  # the command line's goes first


def test_diagnose_names_what_is_missing_and_writes_a_report(problem, tmp_path, capsys):
    page, out = tmp_path / "report.html", tmp_path / "diagnosis.json"
    assert cli.main(["diagnose", str(problem), "--report", str(page), "--out", str(out), "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("Verdict: named: bend")
    assert "bend" in page.read_text()
    assert json.loads(out.read_text(encoding="utf-8"))["terms"] == ["bend"]
    assert cli.main(["show", str(out)]) == 0
    assert capsys.readouterr().out.startswith("Verdict: named: bend")
    assert cli.main(["show", str(page)]) == 1


def test_bars_are_for_terminals(problem, capsys):
    assert cli.main(["diagnose", str(problem)]) == 0
    assert capsys.readouterr().err == ""


def test_show_reads_an_additive_calibration_too(tmp_path, capsys):
    line = tc.Simulator(lambda x, p: p["a"] * x, [tc.Parameter("a")], degree=1)
    result = tc.calibrate_additive(line, tc.Recording(x=[1.0, 2.0, 3.0], y=[1.0, 2.2, 2.9]), num_samples=0)
    result.save(tmp_path / "additive.nc")
    assert cli.main(["show", str(tmp_path / "additive.nc")]) == 0
    assert "additive" in capsys.readouterr().out


def test_mistakes_are_told_in_a_line_before_any_work(problem, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli, "calibrate", lambda *args, **options: pytest.fail("worked before it looked"))
    half = tmp_path / "half.py"
    half.write_text("simulator = 1")
    odd = tmp_path / "odd.py"
    odd.write_text(PROBLEM + "\ncalibrate_options = [1]")
    taken = tmp_path / "json.py"
    taken.write_text(PROBLEM)
    binary = tmp_path / "binary.py"
    binary.write_bytes(b"\0x")
    cut = tmp_path / "cut.json"
    cut.write_text('{"kind": "diagnosis", "te')
    linked = tmp_path / "linked.py"
    linked.symlink_to(problem)
    for arguments, told in [
        (["calibrate", str(tmp_path / "nothing.py")], "which is none"),
        (["calibrate", str(half)], "Got no recording"),
        (["calibrate", str(odd)], "as a dict"),
        (["calibrate", str(taken)], "rename it"),
        (["calibrate", str(problem), "--out", str(tmp_path)], "the name of a file"),
        (["calibrate", str(problem), "--out", str(tmp_path / "no" / "a.nc")], "in a folder that exists"),
        (["calibrate", str(problem), "--out", str(linked)], "the problem itself"),
        (["diagnose", str(problem), "--out", str(tmp_path / "a"), "--report", str(tmp_path / "a")], "something else"),
        (["calibrate", str(binary)], "null bytes"),
        (["show", str(problem)], "netCDF"),
        (["show", str(cut)], "or cut"),
        (["show", str(tmp_path)], "which is none"),
    ]:
        assert cli.main(arguments) == 1
        error = capsys.readouterr().err
        assert told in error
        assert error.startswith("torchcal: ")
        assert "Traceback" not in error
    assert problem.read_text() == PROBLEM
    for name in ("half", "odd"):
        sys.modules.pop(name, None)
    with pytest.raises(SystemExit) as stop:
        cli.main([])
    assert stop.value.code == 2


@pytest.fixture
def few_modules(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if hasattr(sys.modules[name], cli._MARK):
            del sys.modules[name]


@pytest.mark.usefixtures("few_modules")
def test_a_misspelt_option_is_told_before_any_work(tmp_path, capsys):
    for command, key in (("diagnose", "confidance"), ("calibrate", "num_sample"), ("diagnose", "recording")):
        path = tmp_path / f"slip_{command}_{key}.py"
        path.write_text(PROBLEM + f"\n{command}_options = {{{key!r}: 1}}")
        assert cli.main([command, str(path), "--quiet"]) == 1
        told = capsys.readouterr().err
        assert f"Expected {command}_options in {path} with keys among" in told
        assert f"Got ['{key}']" in told
        assert told.count("\n") == 1


FAILING = {
    "raises": ("x = 1\nraise ValueError('boo')", "line 2: ValueError: boo"),
    "imports": ("import no_such_module", "line 1: ModuleNotFoundError: No module named 'no_such_module'"),
    "syntax": ("x = 1\n\ndef (:", "line 3: SyntaxError: invalid syntax"),
    "recording": (PROBLEM.replace("x=x, y", "x=x[1:], y"), "line 7: RecordingError: Expected arrays of one length"),
    "calls": (PROBLEM.replace('p["a"] +', "nothing +"), "line 6: SimulatorError: Expected the simulator to return"),
}


@pytest.mark.usefixtures("few_modules")
@pytest.mark.parametrize("case", FAILING)
def test_an_error_in_the_file_is_told_with_its_line(case, tmp_path, capsys):
    source, told = FAILING[case]
    path = tmp_path / f"failing_{case}.py"
    path.write_text(source)
    assert cli.main(["diagnose", str(path), "--quiet"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"torchcal: {path}, {told}")
    assert error.count("\n") == 1


def test_a_mistake_of_its_own_keeps_its_traceback(problem, monkeypatch):
    monkeypatch.setattr(cli, "diagnose", lambda *args, **options: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli.main(["diagnose", str(problem), "--quiet"])


def test_what_was_cut_short_is_written_and_is_no_success(problem, tmp_path, monkeypatch):
    whole = cli.calibrate

    @functools.wraps(whole)
    def cut_short(*args, **options):
        warn("The sampler was interrupted.", InterruptionWarning)
        return whole(*args, **options)

    monkeypatch.setattr(cli, "calibrate", cut_short)
    shown = warnings.showwarning
    with pytest.warns(InterruptionWarning):
        assert cli.main(["calibrate", str(problem), "--quiet", "--out", str(tmp_path / "kept.nc")]) == 130
    assert (tmp_path / "kept.nc").exists()
    assert warnings.showwarning is shown
    monkeypatch.undo()
    assert cli.main(["calibrate", str(problem), "--quiet"]) == 0


def test_a_missing_package_for_the_result_is_told_before_any_work(problem, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli, "calibrate", lambda *args, **options: pytest.fail("worked before it looked"))
    monkeypatch.setitem(sys.modules, "h5netcdf", None)
    assert cli.main(["calibrate", str(problem), "--quiet", "--out", str(tmp_path / "r.nc")]) == 1
    assert "Expected h5netcdf" in capsys.readouterr().err


def test_what_cannot_be_saved_is_printed_all_the_same(problem, tmp_path, capsys, monkeypatch):
    def full(*_):
        raise TorchcalError("the disk is full")

    monkeypatch.setattr(tc.results.Calibration, "save", full)
    monkeypatch.setattr(tc.discovery.Diagnosis, "report", full)
    assert cli.main(["calibrate", str(problem), "--quiet", "--out", str(tmp_path / "r.nc")]) == 1
    told = capsys.readouterr()
    assert told.out.startswith("Calibration with embedded model error")
    assert "the disk is full" in told.err
    files = ["--report", str(tmp_path / "r.html"), "--out", str(tmp_path / "r.json")]
    assert cli.main(["diagnose", str(problem), "--quiet", *files]) == 1
    told = capsys.readouterr()
    assert told.out.startswith("Verdict: named: bend")
    assert "the disk is full" in told.err
    assert json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))["terms"] == ["bend"]


def test_it_tells_its_version(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"torchcal {importlib.metadata.version('torchcal')}\n"


def test_a_terminal_without_greek_letters_costs_nothing(problem):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "torchcal.cli", "calibrate", str(problem), "--quiet"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert r"E[\u03bb]" in done.stdout


def test_a_warning_inside_an_autograd_function_is_told_of_the_users_line():
    inner = {"__name__": "torchcal.simulators.external", "warn": warn, "Warned": TorchcalWarning}
    exec("def forward(context, x):\n    warn('a worker died', Warned)\n    return x.clone()", inner)
    function = type("Calling", (torch.autograd.Function,), {"forward": staticmethod(inner["forward"])})
    with pytest.warns(TorchcalWarning) as told:
        function.apply(torch.ones(2))
    assert [item.filename for item in told] == [__file__]


def test_an_interruption_ends_quietly(problem, capsys, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "diagnose", interrupted)
    assert cli.main(["diagnose", str(problem)]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_the_module_runs_as_a_command():
    done = subprocess.run([sys.executable, "-m", "torchcal.cli", "--help"], capture_output=True, text=True, check=True)
    assert all(command in done.stdout for command in ("calibrate", "diagnose", "show"))


def test_every_file_that_cannot_be_written_is_told_and_the_result_printed(capsys):
    def fails(what):
        def write():
            raise TorchcalError(f"no {what}")

        return write

    with pytest.raises(TorchcalError, match="no report") as told:
        cli._finish("the result", [fails("report"), lambda: None, fails("file")])
    assert told.value.__notes__ == ["TorchcalError: no file"]
    assert capsys.readouterr().out == "the result\n"


@pytest.mark.parametrize("seed", ["-1", "1.5", "many"])
def test_a_seed_that_is_none_is_a_wrong_command_line(seed, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["diagnose", "problem.py", "--seed", seed])
    assert ended.value.code == 2
    assert "argument --seed" in capsys.readouterr().err
