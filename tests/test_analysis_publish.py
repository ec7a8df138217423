"""What is published of finished runs is analyzed like the runs themselves."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from analysis_runs import rows_reaching, run_directory, seal, write_run

from acmr.run_folders import changes
from analysis.evaluations import adds_up
from analysis.loading.load import load
from analysis.publish import PublishError, _resealed, publish


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    root = tmp_path / "runs" / "paper"
    for cell, steps in (("H0", 9000), ("A0", 8000)):
        folder = write_run(root, cell, 1, rows_reaching(steps, 20_000), total=20_000)
        for name in ("run.log", "evaluation.json"):
            (folder / name).write_text(name)
        (folder / "checkpoint").mkdir()
    # Long enough to be compressed.
    write_run(root, "A1", 1, rows_reaching(None, 1_000_000, length=50), total=1_000_000)
    write_run(root, "A2", 1, rows_reaching(None, 20_000), summary=False)
    return root


def test_what_is_published_is_analyzed_as_the_runs_are(runs, tmp_path):
    out = tmp_path / "results" / "paper"
    done = publish(runs, out)
    assert len(done.added) == 3
    assert done.there == []
    shutil.rmtree(run_directory(runs, "A2", 1))
    ours, theirs = load(out), load(runs)
    pd.testing.assert_frame_equal(ours.runs, theirs.runs)
    pd.testing.assert_frame_equal(ours.episodes, theirs.episodes)
    assert ours.configs == theirs.configs


def test_only_what_others_need_is_published(runs, tmp_path):
    publish(runs, tmp_path)
    names = {
        cell: sorted(path.name for path in run_directory(tmp_path, cell, 1).glob("*")) for cell in ("H0", "A0", "A1")
    }
    assert names["A0"] == names["H0"] == ["config.yaml", "episodes.csv", "metrics.csv", "summary.json"]
    assert names["A1"] == ["config.yaml", "episodes.csv.gz", "metrics.csv", "summary.json"]
    assert not run_directory(tmp_path, "A2", 1).exists()


def test_later_runs_are_added_and_others_stay(runs, tmp_path):
    out = tmp_path / "results"
    publish(runs, out)
    write_run(runs, "A0", 2, rows_reaching(7000, 20_000), total=20_000)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    done = publish(runs, out)
    assert [path.name for path in done.added] == ["seed_2"]
    assert len(done.there) == 3
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_another_result_of_a_run_is_not_overwritten(runs, tmp_path):
    publish(runs, tmp_path)
    path = run_directory(tmp_path, "A0", 1) / "summary.json"
    path.write_text(json.dumps({"other": 1}))
    write_run(runs, "A0", 2, rows_reaching(7000, 20_000), total=20_000)
    with pytest.raises(PublishError, match=r"seed_1: summary.json of another run there; remove"):
        publish(runs, tmp_path)
    assert json.loads(path.read_text()) == {"other": 1}
    assert not run_directory(tmp_path, "A0", 2).exists()


def test_a_damaged_summary_is_named(runs, tmp_path):
    (run_directory(runs, "A0", 1) / "summary.json").write_text("{")
    with pytest.raises(PublishError, match=r"armless_humanoid-none/seed_1/summary.json: cannot be read"):
        publish(runs, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("make", [True, False])
def test_nothing_to_publish_is_said_in_one_line(make, tmp_path):
    if make:
        write_run(tmp_path / "runs", "A0", 1, rows_reaching(None, 20_000), summary=False)
    command = [sys.executable, "-m", "analysis.publish", str(tmp_path / "runs"), str(tmp_path / "out")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    said = "no run has come to its end there; make status says how far they are"
    assert ended.stderr == f"analysis.publish: {tmp_path / 'runs'}: {said}\n"
    assert not (tmp_path / "out").exists()


def test_published_runs_tell_what_their_published_files_hold(runs, tmp_path):
    # A1's table is compressed; of A0 nothing can be known, as it is older.
    folders = [seal(run_directory(runs, cell, 1)) for cell in ("H0", "A1")]
    out = tmp_path / "results"
    publish(runs, out)
    assert publish(runs, out).added == []
    for folder in folders:
        there = out / folder.relative_to(runs)
        assert changes(there, json.loads((there / "summary.json").read_text())) == {}
    summary = json.loads((folders[0] / "summary.json").read_text())
    files = {path.name: path.read_bytes() for path in folders[0].iterdir() if path.is_file()}
    assert _resealed(summary, files) == files["summary.json"]
    # Whatever is left out of what is published, the published summary is of that.
    there = tmp_path / "other"
    there.mkdir()
    files["config.yaml"] = files["config.yaml"].replace(b"threads: 1\n", b"")
    files["summary.json"] = _resealed(summary, files)
    for name, data in files.items():
        (there / name).write_bytes(data)
    assert changes(there, json.loads((there / "summary.json").read_text())) == {}
    assert json.loads(files["summary.json"])["episodes"] == summary["episodes"]


@pytest.mark.parametrize("name", ["episodes.csv", "metrics.csv", "config.yaml", "summary.json"])
def test_a_changed_run_is_not_published(name, runs, tmp_path):
    folder = seal(run_directory(runs, "A0", 1))
    path = folder / name
    path.write_text(path.read_text().replace("1", "2", 1))
    with pytest.raises(PublishError, match=f"{folder}: {name} was changed since"):
        publish(runs, tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_every_changed_digit_of_an_evaluation_is_found():
    files = sorted((Path(__file__).parents[1] / "results").rglob("evaluation.json"))
    assert len(files) > 20
    for path in files:
        assert adds_up(json.loads(path.read_text())), path
    text = files[0].read_text()
    missed = []
    # The last digits of a sum are no other number.
    for match in re.finditer(r"(?<=: )-?\d[\d.]*", text):
        for place in range(match.start(), min(match.end(), match.start() + 10)):
            if text[place].isdigit():
                changed = text[:place] + ("7" if text[place] != "7" else "3") + text[place + 1 :]
                content = json.loads(changed) if not re.search(r": -?0\d", changed) else {}
                if adds_up(content):
                    missed.append(text[match.start() - 30 : match.end()])
    assert missed == []
