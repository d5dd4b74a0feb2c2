"""The command ``torchcal``: calibrate, diagnose and show, for jobs that run without a notebook.

A problem is a Python file that defines ``simulator`` and ``recording``, and where wanted ``candidates``, and dicts of
further arguments, ``calibrate_options`` and ``diagnose_options``.
"""

import argparse
import functools
import importlib.util
import inspect
import io
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from torchcal.checks import as_seed
from torchcal.discovery import diagnose
from torchcal.discovery.findings.as_json import text_of
from torchcal.display import version
from torchcal.errors import DomainError, InterruptionWarning, TorchcalError
from torchcal.files import check_target
from torchcal.inference import calibrate
from torchcal.results import AdditiveCalibration, Calibration
from torchcal.results.storage import netcdf_modules

__all__ = ["main"]

_MARK = "__torchcal_problem__"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: Of the command line; by default those of this process.

    Returns:
        The exit status: 0, 1 after an error of torchcal's or of the problem's file, 2 for a wrong command line, 130
        after Ctrl-C, also where what there was is kept.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without ± must not cost the result
            stream.reconfigure(errors="backslashreplace")
    given = _parser().parse_args(arguments)
    cut_short, shown = [], warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        cut_short.extend([message] if issubclass(category, InterruptionWarning) else [])
        shown(message, category, *where, **more)

    try:
        with warnings.catch_warnings():
            warnings.showwarning = show
            given.run(given)
        sys.stdout.flush()
    except BrokenPipeError:  # whoever reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print("torchcal: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        line = _line(error, getattr(given, "problem", None))
        if line is None and not isinstance(error, TorchcalError):  # a mistake of torchcal's own
            raise
        where = "" if line is None else f"{given.problem}, line {line}: "
        text = error.msg if isinstance(error, SyntaxError) else error
        print(f"torchcal: {where}{type(error).__name__}: {text}", file=sys.stderr)
        for note in getattr(error, "__notes__", ()):
            print(f"torchcal: {note}", file=sys.stderr)
        return 1
    return 130 if cut_short else 0


def _line(error: BaseException | None, path: Path | None) -> int | None:
    """The last line of the user's file that an error, or what caused it, came from."""
    found = None
    file = "" if path is None else str(path.resolve())
    while error is not None:
        if isinstance(error, SyntaxError) and error.filename == file:
            return error.lineno
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        found = lines[-1] if lines else found
        error = error.__cause__
    return found


def _seed(text: str) -> int:
    """A seed of the command line, where a wrong one is told as any other wrong argument is."""
    try:
        return as_seed(int(text) if text.lstrip("-").isdecimal() else text)
    except DomainError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="torchcal", description=(__doc__ or "").split("\n")[0].replace("``", ""))
    parser.add_argument("--version", action="version", version=f"torchcal {version('torchcal')}")
    commands = parser.add_subparsers(required=True, metavar="command")
    calibrating = commands.add_parser("calibrate", help="calibrate with model error embedded in the parameters")
    calibrating.set_defaults(run=_calibrate)
    calibrating.add_argument("--out", type=Path, metavar="RESULT.nc", help="where the result is written")
    calibrating.add_argument("--target-ess", type=float, metavar="N", help="draw until so many effective samples")
    diagnosing = commands.add_parser("diagnose", help="find the physics that was left out")
    diagnosing.set_defaults(run=_diagnose)
    diagnosing.add_argument("--report", type=Path, metavar="REPORT.html", help="where the report is written")
    diagnosing.add_argument("--out", type=Path, metavar="RESULT.json", help="where the result is written")
    for command in (calibrating, diagnosing):
        command.add_argument("problem", type=Path, help="a Python file that defines simulator and recording")
        command.add_argument("--seed", type=_seed, help="of every random number")
        command.add_argument("--quiet", action="store_true", help="show no progress")
    showing = commands.add_parser("show", help="print a result that was written")
    showing.set_defaults(run=_show)
    showing.add_argument("result", type=Path, metavar="RESULT", help="of calibrate (.nc) or of diagnose (.json)")
    return parser


def _calibrate(given: argparse.Namespace) -> None:
    _check_targets(given.problem, given.out)
    problem = _problem(given.problem)
    if given.out is not None:
        netcdf_modules()
    options = _options(problem, "calibrate_options", calibrate, given, target_ess=given.target_ess)
    warnings.simplefilter("always", InterruptionWarning)  # by which the status is known, whatever the file filters
    result = calibrate(problem.simulator, problem.recording, **options)
    _finish(result, [] if given.out is None else [functools.partial(result.save, given.out)])


def _diagnose(given: argparse.Namespace) -> None:
    _check_targets(given.problem, given.report, given.out)
    problem = _problem(given.problem)
    options = _options(problem, "diagnose_options", diagnose, given)
    warnings.simplefilter("always", InterruptionWarning)
    result = diagnose(problem.simulator, problem.recording, getattr(problem, "candidates", ()), **options)
    wanted = [(result.report, given.report), (result.save, given.out)]
    _finish(result, [functools.partial(write, path) for write, path in wanted if path is not None])


def _check_targets(problem: Path, *targets: Path | None) -> None:
    """Raise unless files of their own can be written: neither each other's nor the problem's."""
    taken = {os.path.realpath(problem): "the problem itself"}
    for path in targets:
        if path is not None:
            place = os.path.realpath(check_target(path))
            if place in taken:
                raise DomainError(f"Expected the name of another file. Got {path}, which is {taken[place]}.")
            taken[place] = "where something else is written"


def _finish(result: object, writes: Sequence[Callable[[], object]]) -> None:
    """Write a result and print it, each whatever becomes of the others; the first error has notes of the others."""
    errors: list[BaseException] = []
    for write in writes:
        try:
            write()
        except BaseException as error:
            errors.append(error)
    print(result)
    if errors:
        for other in errors[1:]:
            errors[0].add_note(f"{type(other).__name__}: {other}")
        raise errors[0]


def _show(given: argparse.Namespace) -> None:
    if (text := text_of(given.result)) is not None:
        print(text)
        return
    if not given.result.is_file():
        raise DomainError(f"Expected a file that calibrate or diagnose wrote. Got {given.result}, which is none.")
    with given.result.open("rb") as file:
        cut = file.read(1) == b"{"
    if cut:
        raise DomainError(f"Expected a result that diagnose wrote. Got {given.result}, which is another file or cut.")
    try:
        print(Calibration.load(given.result))
    except TorchcalError as first:
        try:
            print(AdditiveCalibration.load(given.result))
        except TorchcalError:
            raise first from None


def _options(
    problem: ModuleType, name: str, function: Callable[..., Any], given: argparse.Namespace, **more: Any
) -> dict[str, Any]:
    """The file's options, over which go those of the command line."""
    own = getattr(problem, name, {})
    if not isinstance(own, dict):
        raise DomainError(f"Expected {name} in {given.problem} as a dict of arguments. Got {type(own).__name__}.")
    known = [p.name for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]
    unknown = [key for key in own if key not in known]
    if unknown:
        raise DomainError(
            f"Expected {name} in {given.problem} with keys among {known}. Got {unknown} (check the spelling)."
        )
    line = {"seed": given.seed, "progress": False if given.quiet else None, **more}
    # Bars are for a terminal; in a job's log they are pages of carriage returns.
    return {"progress": sys.stderr.isatty(), **own, **{key: value for key, value in line.items() if value is not None}}


def _problem(path: Path) -> ModuleType:
    """The user's file, run as a module."""
    if not path.is_file():
        raise DomainError(f"Expected a Python file that defines simulator and recording. Got {path}, which is none.")
    spec = importlib.util.spec_from_file_location(path.stem, path.resolve())
    if spec is None or spec.loader is None:
        raise DomainError(f"Expected a Python file, such as problem.py. Got {path}.")
    try:
        spec.loader.get_code(path.stem)  # type: ignore[attr-defined]
    except (SyntaxError, ValueError) as error:
        if isinstance(error, SyntaxError) and error.filename is not None:  # told with its line
            raise
        raise DomainError(f"Expected a Python file, such as problem.py. Got {path}: {error}.") from error
    module = importlib.util.module_from_spec(spec)
    taken = sys.modules.get(path.stem)
    if taken is not None and not hasattr(taken, _MARK):
        raise DomainError(f"Expected a name that is no other module's. Got {path}: rename it.")
    setattr(module, _MARK, True)
    sys.modules[path.stem] = module  # worker processes find its functions by this name, and in this folder
    sys.path.append(str(path.resolve().parent))
    spec.loader.exec_module(module)
    missing = [name for name in ("simulator", "recording") if not hasattr(module, name)]
    if missing:
        raise DomainError(f"Expected {path} to define simulator and recording. Got no {' and no '.join(missing)}.")
    return module


if __name__ == "__main__":
    sys.exit(main())
