"""The Python in the guides runs as written, and the tutorials are in the table of contents."""

import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

DOCS = Path(__file__).parents[1] / "docs"
GUIDES = sorted(path for path in (DOCS / "how_to").glob("*.md") if path.stem != "index")
#: Seconds each, and a quarter of a minute or longer.
QUICK = (
    "command_line", "diagnostics", "embeddings", "expensive", "hold_out", "noise_and_missing", "several_outputs",
    "what_is_noise", "write_a_term",
)  # fmt: skip
LONGER = (
    "diagnose_in_time", "diagnose_static", "epsilon_and_gamma", "pyro_model", "read_a_diagnosis", "samplers", "saving",
)  # fmt: skip
#: Begins workers of its own; see `test_executors`.
ELSEWHERE = ("cluster",)


def blocks(pattern: str, text: str) -> list[str]:
    return re.findall(pattern, text, flags=re.DOTALL | re.MULTILINE)


def code(page: Path) -> str:
    return "\n".join(blocks(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8")))


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in LONGER)])
def test_guide_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda *args, **kwargs: None)
    page = DOCS / "how_to" / f"{name}.md"
    names = {"__name__": "guide"}
    exec(compile(code(page), str(page), "exec"), names)
    plt.close("all")
    verdicts = {
        "diagnose_in_time": ("named", ["seepage"]),
        "diagnose_static": ("named", ["air drag"]),
        "read_a_diagnosis": ("named", ["quadratic drag"]),
        "what_is_noise": ("consistent", []),
        "hold_out": ("consistent", []),
    }
    if name in verdicts:
        found = names["diagnosis"]
        assert (found.verdict, found.terms) == verdicts[name]


@pytest.mark.parametrize("folder", ["how_to", "tutorials", "reference"])
def test_every_page_is_in_the_table_of_contents(folder):
    index = (DOCS / folder / "index.md").read_text(encoding="utf-8")
    listed = {line.strip() for block in blocks(r"```\{toctree\}\n(.*?)```", index) for line in block.splitlines()}
    pages = {path.stem for path in (DOCS / folder).glob("*.md")} - {"index"}
    assert pages <= listed


def test_guides_show_python():
    assert all(code(page) for page in GUIDES)
    assert sorted([*QUICK, *LONGER, *ELSEWHERE]) == [page.stem for page in GUIDES]
