"""Files are written whole or not at all."""

import json
import math
import os
import stat

import pytest
import torch

import torchcal as tc
from torchcal.discovery.findings.as_json import plain
from torchcal.errors import DomainError
from torchcal.files import check_target, replacing


def test_a_file_appears_when_it_is_whole(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with replacing(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_what_fails_leaves_the_old_one_and_nothing_else(tmp_path, kind):
    target = tmp_path / "a.txt"
    target.write_text("old")

    def fail():
        with replacing(target) as temporary:
            temporary.write_text("half")
            raise kind

    with pytest.raises(kind):
        fail()
    assert target.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_path_that_cannot_be_written_is_told(tmp_path):
    for path, told in [(tmp_path, "Got the folder"), (tmp_path / "no" / "a.txt", "no folder"), (3, "Got int")]:
        with pytest.raises(DomainError, match=told):
            check_target(path)
    assert check_target(str(tmp_path / "a.txt")) == tmp_path / "a.txt"


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_a_link_is_written_through(tmp_path):
    (tmp_path / "store").mkdir()
    for name, old in [("there.txt", True), ("not_yet.txt", False)]:
        target, link, second = tmp_path / "store" / name, tmp_path / name, tmp_path / f"second_{name}"
        if old:
            target.write_text("old")
        link.symlink_to(target)
        second.symlink_to(name)
        with replacing(second) as temporary:
            assert temporary.parent == target.parent  # on the same disk, or it could not be replaced at once
            temporary.write_text("new")
        assert link.is_symlink()
        assert second.is_symlink()
        assert target.read_text() == "new"
    (tmp_path / "lost.txt").symlink_to(tmp_path / "no" / "a.txt")
    with pytest.raises(DomainError, match="no folder"):
        check_target(tmp_path / "lost.txt")


@pytest.mark.skipif(os.name == "nt", reason="no pipes with names there")
def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    (tmp_path / "round").symlink_to("round")
    for path in (tmp_path / "pipe", tmp_path / "link", tmp_path / "round"):
        with pytest.raises(DomainError, match="would be replaced"), replacing(path):
            pass
    with pytest.raises(DomainError, match="would be replaced"):
        check_target(os.devnull)
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)


def test_a_diagnosis_is_saved_as_numbers(tmp_path):
    x = torch.linspace(-1, 1, 41, dtype=torch.float64)
    y = 1 + 2 * x + 0.5 * x**3 + 0.02 * torch.randn(41, dtype=torch.float64)
    y[3] = math.nan
    line = tc.Simulator(lambda x, p: p["a"] + p["b"] * x, [tc.Parameter("a"), tc.Parameter("b", unit="m")], degree=1)
    bend = tc.Term("bend", outputs={"y": lambda x, p, y: y + p["c"] * x**3}, parameters=[tc.Parameter("c")])
    diagnosis = tc.diagnose(line, tc.Recording(x=x, y=y, noise=0.02, missing=True), [bend])
    diagnosis.save(tmp_path / "d.json")
    with (tmp_path / "d.json").open(encoding="utf-8") as file:
        found = json.load(file, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert found["verdict"] == "named"
    assert found["terms"] == ["bend"]
    assert found["text"] == str(diagnosis)
    assert found["recording"]["y"][3] is None
    torch.testing.assert_close(torch.tensor(found["recording"]["x"], dtype=torch.float64), x, rtol=0, atol=0)
    estimates = {one["name"]: one["value"] for one in found["final"]["estimates"]}
    assert estimates["bend.c"] == next(e.value for e in diagnosis.final.estimates if e.name == "bend.c")
    assert found["after"]["held_out"]["rmse"] < found["before"]["held_out"]["rmse"]
    assert [row["terms"] for row in found["ranking"]] == [list(row.terms) for row in diagnosis.ranking]
    assert not {"simulator", "improved"} & set(found)


def test_a_recording_in_time_is_saved_with_its_runs():
    run = tc.Run([0.0, 1.0, 3.0], outputs={"x": [0, 1, 2]}, inputs={"f": [0, 2, 6]}, initial={"x": 0})
    found = plain(tc.Recording(runs=[run, run], units={"x": "m"}))
    assert len(found["runs"]) == 2
    assert found["runs"][0]["inputs"] == {"f": [0.0, 2.0, 6.0]}
    assert found["runs"][1]["initial"] == {"x": 0.0}
    assert found["units"]["x"] == "m"
    assert json.loads(json.dumps(found, allow_nan=False)) == found
