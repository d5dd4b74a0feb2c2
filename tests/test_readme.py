"""The Python in README.md runs as written, and prints what README.md says."""

import contextlib
import io
import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

README = Path(__file__).parents[1] / "README.md"
NUMBER = re.compile(r"(?<![\w.])-?\d+\.?\d*(?:e-?\d+)?")


@pytest.fixture(scope="module")
def text() -> str:
    return README.read_text(encoding="utf-8")


def test_readme_code_runs_and_prints_what_is_said(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda *args, **kwargs: None)
    blocks = re.findall(r"^```(python|text)\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    assert [kind for kind, _ in blocks] == ["python", "text"] * (len(blocks) // 2)
    names = {"__name__": "readme"}
    for (_, code), (_, said) in zip(blocks[::2], blocks[1::2], strict=True):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, str(README), "exec"), names)
        shown = printed.getvalue()
        assert NUMBER.sub("#", shown).split() == NUMBER.sub("#", said).split()
        for number, stated in zip(NUMBER.findall(shown), NUMBER.findall(said), strict=True):
            # An sd in one or two digits is rough; estimates are not.
            digits = len(stated.partition("e")[0].replace(".", "").lstrip("-0"))
            assert float(number) == pytest.approx(float(stated), rel=0.3 if digits <= 2 else 0.01)


def test_readme_pictures_exist(text):
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert len(pictures) == 2
    assert all((README.parent / picture).is_file() for picture in pictures)
