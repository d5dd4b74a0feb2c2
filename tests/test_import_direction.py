"""Who may import whom: each room of torchcal imports only from the rooms above it in `ROOMS`.

The sources are parsed, not run, so that an import inside a function counts like one at the top.
"""

import ast
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import torchcal

ROOMS = (
    "errors",
    "checks",
    "files",
    "threads",
    "display",
    "data",
    "polychaos",
    "simulators",
    "embeddings",
    "propagation",
    "priors",
    "likelihoods",
    "models",
    "prediction",
    "plots",
    "results",
    "inference",
    "terms",
    "report",
    "discovery",
    "cli",
)
DISCOVERY = ("records", "fits", "misfit", "hypotheses", "verdicts", "findings")
"""The rooms within discovery, likewise; what lies beside them is the search itself, and imports from all of them."""
PYRO_ROOMS = {"priors", "models", "inference"}
OPTIONAL = {"arviz", "cantera", "dask", "distributed", "h5netcdf", "pandas", "pint", "scipy", "xarray"}

PACKAGE = Path(torchcal.__file__).parent
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE or path.stem[:2] != "__")


@dataclass(frozen=True)
class Import:
    """One imported module, absolute, and whether importing the file already imports it."""

    target: str
    line: int
    eager: bool


def module_name(path: Path) -> str:
    """`.../torchcal/polychaos/basis.py` -> `torchcal.polychaos.basis`; a package ends in `.__init__`."""
    return ".".join(("torchcal", *path.relative_to(PACKAGE).with_suffix("").parts))


def room_of(module: str) -> str:
    """The room a module of torchcal belongs to; empty for `torchcal` itself."""
    return [*module.split("."), ""][1]


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in {"TYPE_CHECKING", "typing.TYPE_CHECKING"}


def imports(source: str, module: str) -> Iterator[Import]:
    """Every import in the source of `module`, relative and `import_module("...")` ones too."""

    def visit(node: ast.AST, eager: bool) -> Iterator[Import]:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, node.lineno, eager)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = ".".join(module.split(".")[: -node.level])
                base = f"{package}.{base}".rstrip(".")
            for alias in node.names:
                yield Import(f"{base}.{alias.name}", node.lineno, eager)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = ast.unparse(node.func).rsplit(".", 1)[-1]
            if called in {"import_module", "__import__"} and isinstance(node.args[0].value, str):
                yield Import(node.args[0].value, node.lineno, eager)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            # Decorators and defaults run at import, but are expressions: only the body can hold an import.
            eager = False
        if is_type_checking(node):
            for child in node.body:
                yield from visit(child, False)
            for child in node.orelse:
                yield from visit(child, eager)
            return
        for child in ast.iter_child_nodes(node):
            yield from visit(child, eager)

    yield from visit(ast.parse(source), True)


def below(module: str, target: str) -> bool:
    """Whether a room within discovery would import from one below it, or from beside them."""
    mine, its = ([*name.split("."), "", ""][1:3] for name in (module, target))
    if mine[0] != "discovery" or its[0] != "discovery" or mine[1] not in DISCOVERY:
        return False
    return its[1] not in DISCOVERY or DISCOVERY.index(its[1]) > DISCOVERY.index(mine[1])


def violations(source: str, module: str) -> list[str]:
    """What the imports of `module` do against the rules, one sentence each."""
    room = room_of(module)
    if room not in ROOMS:
        return [f"{module}: {room!r} is not one of the rooms; add it to ROOMS where it belongs"]
    found = []
    for item in imports(source, module):
        where = f"{module}:{item.line}"
        top = item.target.split(".")[0]
        if top == "torchcal":
            target = room_of(item.target)
            if target not in ROOMS:
                found.append(
                    f"{where} imports {item.target} from the package's top, which imports everything"
                )
            elif ROOMS.index(target) > ROOMS.index(room):
                found.append(f"{where}: {room} imports {item.target}, but {target} stands below {room}")
            elif below(module, item.target):
                found.append(f"{where} imports {item.target}, which stands below it in discovery")
        if top == "pyro" and room not in PYRO_ROOMS:
            found.append(f"{where} imports {item.target}; Pyro is for {sorted(PYRO_ROOMS)} alone")
        if top in OPTIONAL and item.eager:
            found.append(f"{where} imports {item.target} at the top; it is optional: import where used")
    return found


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_module_imports_only_from_above(path):
    found = violations(path.read_text(encoding="utf-8"), module_name(path))
    assert not found, "\n".join(found)


def test_importing_torchcal_imports_no_optional_package():
    code = f"import sys, torchcal; print(*sorted({OPTIONAL!r} & sys.modules.keys()))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []


@pytest.mark.parametrize(
    ("module", "source", "count"),
    [
        ("torchcal.data", "from torchcal.errors import DomainError", 0),
        ("torchcal.errors", "from torchcal.data import Recording", 1),
        ("torchcal.errors", "from torchcal import data", 1),
        ("torchcal.errors", "import torchcal.data as d", 1),
        ("torchcal.errors", "def f():\n    from torchcal.data import Recording", 1),
        ("torchcal.errors", "if TYPE_CHECKING:\n    from torchcal.data import Recording", 1),
        ("torchcal.errors", "from .data import Recording", 1),
        ("torchcal.errors", "from . import data", 1),
        ("torchcal.errors", "importlib.import_module('torchcal.data')", 1),
        ("torchcal.data", "from torchcal import Parameter", 1),
        ("torchcal.data", "import torchcal", 1),
        ("torchcal.polychaos.__init__", "from .basis import Basis\nfrom torchcal.polychaos import rules", 0),
        ("torchcal.polychaos.basis", "from ..errors import DomainError\nfrom . import rules", 0),
        ("torchcal.polychaos.basis", "from ..embeddings import Gaussian", 1),
        ("torchcal.discovery.fits.fitting", "from torchcal.discovery.records import Table", 0),
        ("torchcal.discovery.fits.fitting", "from torchcal.discovery.misfit.noise import Noise", 1),
        ("torchcal.discovery.misfit.noise", "from ..verdicts import verdict", 1),
        ("torchcal.discovery.findings.words", "from torchcal.discovery.windows import refit_windows", 1),
        ("torchcal.discovery.windows", "from torchcal.discovery.findings.words import say", 0),
        ("torchcal.nowhere", "import math", 1),
        ("torchcal.models", "import pyro\nfrom pyro.infer import NUTS", 0),
        ("torchcal.likelihoods", "def f():\n    from pyro import sample", 1),
        ("torchcal.results", "import xarray", 1),
        ("torchcal.results", "try:\n    import arviz\nexcept ImportError:\n    arviz = None", 1),
        ("torchcal.results", "class A:\n    import pandas", 1),
        ("torchcal.results", "def f():\n    import xarray", 0),
        ("torchcal.results", "if TYPE_CHECKING:\n    import xarray", 0),
        ("torchcal.results", "import numpy, torch, tqdm", 0),
    ],
)
def test_the_rules_see_what_they_should(module, source, count):
    assert len(violations(textwrap.dedent(source), module)) == count
