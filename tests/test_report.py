"""The page of a diagnosis: it holds everything, needs nothing, and is written whole or not at all."""

import base64
import re
import stat
from html.parser import HTMLParser
from types import SimpleNamespace
from xml.etree import ElementTree

import matplotlib
import matplotlib.pyplot as plt
import pytest
import torch
from test_plots_discovery import NASTY, STAND_INS, cooling, ignition, oscillator, unexplained

from torchcal.discovery.records import Hypothesis
from torchcal.errors import DomainError
from torchcal.report import diagnosis_page as report
from torchcal.report import markup

VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """Checks that tags nest; collects them, the visible text, and the cells of each table by section."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.words, self.tables = [], [], [], {}
        self.section = ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "h2":
            self.section = ""
        if tag == "tr":
            self.tables.setdefault(self.section, []).append([])
        if tag in ("td", "th"):
            self.tables[self.section][-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.section += data
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[self.section][-1][-1] += data
        if "style" not in self.open:
            self.words.append(data)

    def rows(self, section):
        """A section's table as one dict per row."""
        head, *rows = self.tables[section]
        return [dict(zip(head, row, strict=True)) for row in rows]


@pytest.fixture(scope="module")
def pages():
    return {make.__name__: report.page(make()) for make in STAND_INS}


@pytest.mark.parametrize("make", STAND_INS)
def test_the_page_is_well_formed_and_needs_nothing_else(make, pages):
    text = pages[make.__name__]
    reader = Reader(text)
    assert text.startswith("<!DOCTYPE html>")
    tags = {tag for tag, _ in reader.tags}
    assert not tags & {"script", "link", "iframe", "object", "a"}
    for tag, attributes in reader.tags:
        assert not any(name.startswith("on") for name in attributes)
        if tag == "img":
            assert attributes["src"].startswith("data:image/")
            assert attributes["alt"]
    visible = re.sub(r'src="data:[^"]*"', "", text)
    assert "http://" not in visible
    assert "https://" not in visible
    assert "url(" not in visible
    assert "@import" not in visible


@pytest.mark.parametrize(("make", "count"), [(oscillator, 8), (ignition, 7), (cooling, 3), (unexplained, 6)])
def test_every_figure_is_in_it_and_can_be_read(make, count, pages):
    sources = [attributes["src"] for tag, attributes in Reader(pages[make.__name__]).tags if tag == "img"]
    assert len(sources) == count
    for source in sources:
        kind, data = re.fullmatch(r"data:image/(svg\+xml|png);base64,(.*)", source).groups()
        raw = base64.b64decode(data, validate=True)
        if kind == "png":
            assert raw.startswith(b"\x89PNG")
        else:
            assert ElementTree.fromstring(raw).tag.endswith("svg")
            assert b"<script" not in raw
        assert len(raw) < 1.5e6


def test_the_page_says_it(pages):
    reader = Reader(pages["oscillator"])
    words = " ".join(reader.words)
    assert "Named: quadratic drag" in words
    assert str(oscillator()) in words
    for text in ("dv/dt = -k x - c v + f - c |v| v", "c ran to its bound of 0.24 1/s", "<0.001", "93 %", "3.0 %"):
        assert text in words, text
    best, *_ = rows = reader.rows("Ranking")
    assert best["hypothesis"] == "quadratic drag"
    assert best["log evidence"] == "312.4"
    assert best["probability"] == "93 %"
    assert best["estimates"] == "quadratic drag.c = 0.101 ± 0.004 1/m"
    assert best["remarks"] == "accepted"
    assert [row["hypothesis"] for row in rows[-2:]] == ["base model alone", "Coulomb friction"]
    assert "not physical; same as x offset; sign; screened only" in [row["remarks"] for row in rows]
    assert reader.rows("Where")[0] == {
        "where": "equation v", "varies with": "v", "from … to": "−4.5 … −2.6, 2.4 … 5", "unit": "m/s",
        "share of misfit": "81 %", "log evidence": "200",
    }  # fmt: skip
    assert reader.rows("Estimates") == [
        {"parameter": "k", "unit": "1/s^2", "base model": "4.02 ± 0.01", "accepted model": "4 ± 0.01"},
        {"parameter": "c", "unit": "1/s", "base model": "0.24 ± 0.01 (at its bound)", "accepted model": "–"},
        {"parameter": "quadratic drag.c", "unit": "1/m", "base model": "–", "accepted model": "0.101 ± 0.004"},
    ]
    proof = reader.rows("Proof")
    d = oscillator()
    scores = [d.before.fitted, d.after.fitted, d.before.held_out, d.after.held_out]
    assert [float(row["RMSE [spread]"]) for row in proof] == pytest.approx([score.rmse for score in scores], rel=1e-3)
    assert [row["data points"] for row in proof] == [str(score.n) for score in scores]
    limits = {row["term"]: row for row in reader.rows("Detection limits")}
    assert limits["linear drag"]["smallest"] == "∞"
    assert limits["linear drag"]["remarks"] == "already in the base model"
    assert reader.rows("Noise")[0]["sd"] == "0.05"


def test_settings_come_with_versions_and_seed(pages):
    rows = {row["setting"]: row["value"] for row in Reader(pages["oscillator"]).rows("Settings")}
    assert rows["seed"] == "0"
    assert rows["versions.torch"] == "2.x"
    assert "version torch" not in rows
    assert rows["version matplotlib"] == matplotlib.__version__
    assert rows["recording"] == "2 runs, 120 samples; outputs x, v; 234 data"
    assert rows["library (2 candidates)"] == "quadratic drag, cubic drag"


def test_flags_among_the_settings_are_told_in_words():
    d = cooling()
    d.settings = {
        "seed": 3, "withdrawn": "", "unknown_beside": (), "pliant": False, "nearly": True, "set_aside": ("lag", "leak"),
        "region": None, "feasible": {"T": (None, 400.0)},
    }  # fmt: skip
    rows = {row["setting"]: row["value"] for row in Reader(report.page(d)).rows("Settings")}
    told = {name: value for name, value in rows.items() if not name.startswith(("version", "library"))}
    assert told == {
        "seed": "3",
        "all that is tied may stand for what is in no list": "no",
        "the name rests on the share of the misfit removed": "yes",
        "these may explain the outliers": "lag, leak",
        "feasible values of T": "–, 400",
        "run time": "1 s",
        "recording": "30 conditions; outputs y; 30 data",
    }


def test_tied_hypotheses_come_with_the_experiment(pages):
    reader = Reader(pages["ignition"])
    words = " ".join(reader.words)
    assert "Ambiguous: fuel order or composition-dependent rate" in words
    assert "one more delay at phi = 3" in words
    assert "5.2 noise sd" in words
    assert reader.rows("Experiment that would decide") == [
        {"condition": "T0", "value": "1100"}, {"condition": "phi", "value": "3"}
    ]  # fmt: skip
    assert "The recording was declared free of noise." in words


def test_what_does_not_exist_has_no_heading(pages):
    text = pages["cooling"]
    for heading in ("Equations", "Where", "Symptoms", "Detection limits", "Experiment that would decide"):
        assert f"<h2>{heading}</h2>" not in text
    assert "accepted model" not in text


def test_names_of_a_user_are_text(pages):
    text = pages["unexplained"]
    assert "<b>" not in text
    reader = Reader(text)
    assert NASTY in " ".join(reader.words)
    assert reader.rows("Detection limits")[0]["term"] == NASTY
    assert all(NASTY not in str(attributes.get("src")) for _, attributes in reader.tags)


def test_control_characters_and_lone_surrogates_do_no_harm(tmp_path):
    d = cooling()
    d.words = "a\x00b\ud800c"
    path = report.write(d, tmp_path / "page.html")
    assert "a�b&#55296;c" in path.read_text(encoding="utf-8")


def test_a_long_table_is_cut_and_says_so():
    d = cooling()
    d.ranking = [Hypothesis((f"candidate {i}",), -float(i), 0.0) for i in range(100)]
    text = report.page(d)
    assert "60 more rows are not shown." in text
    assert "candidate 39" in text
    assert "candidate 40" not in text


def test_numbers_that_are_none_or_infinite():
    assert [markup.in_digits(value) for value in (None, float("nan"), float("inf"), -float("inf"), -1e-7)] == [
        "–", "–", "∞", "−∞", "−1e−07"
    ]  # fmt: skip
    assert markup.in_words(torch.arange(9.0)) == "0 … 8 (9 values)"
    assert markup.in_words({"a": [1, True, None]}) == "a: 1, yes, –"


# --- writing ---------------------------------------------------------------------------------------------


def test_write_replaces_the_file_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")
    assert report.write(cooling(), str(path)) == path
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert list(tmp_path.iterdir()) == [path]
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_a_file_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report.write(cooling(), "report.html")
    assert (tmp_path / "report.html").exists()


def test_a_failure_leaves_the_old_page(tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old")

    def refuse(*names):
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(report.os, "replace", refuse)
        with pytest.raises(OSError, match="disk full"):
            report.write(cooling(), path)
    d = cooling()
    d.ranking = [SimpleNamespace(terms=("broken",))]
    with pytest.raises(DomainError, match="no 'log_evidence'"):
        report.write(d, path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_write_says_what_is_wrong_with_a_path(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "page", lambda diagnosis: pytest.fail("worked before it looked"))
    with pytest.raises(DomainError, match="Got the folder"):
        report.write(cooling(), tmp_path)
    with pytest.raises(DomainError, match="in a folder that exists"):
        report.write(cooling(), tmp_path / "nowhere" / "report.html")
    with pytest.raises(DomainError, match="the name of a file"):
        report.write(cooling(), 3)


def test_what_is_no_diagnosis_is_refused():
    with pytest.raises(DomainError, match=r"a result of torchcal\.diagnose"):
        report.page({"verdict": "named"})


def test_the_report_leaves_pyplot_alone():
    mine = plt.figure()
    settings = dict(matplotlib.rcParams)
    report.page(cooling())
    assert plt.get_fignums() == [mine.number]
    assert plt.gcf() is mine
    assert dict(matplotlib.rcParams) == settings


def test_the_same_diagnosis_gives_the_same_page(pages):
    def without_time(text):
        return re.sub(r" on \d{4}-\d\d-\d\d \d\d:\d\d UTC", "", text)

    assert without_time(report.page(cooling())) == without_time(pages["cooling"])
