"""Runs behind symbolic links, and runs whose summary is in other words: none vanishes, none counts twice."""

from __future__ import annotations

import json
import os
import tempfile
import traceback
from pathlib import Path

import pytest
from analysis_runs import csv_text, rows_reaching, write_run

from acmr.run_folders import run_folders
from analysis.cli import main
from analysis.loading.load import load
from analysis.publish import publish
from sweeps.estimate import _finished
from sweeps.status import main as status

ROWS = rows_reaching(6000, 20_000)
NAME = "armless_humanoid-none"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder with seed 1 of A0, and seed 2 of it elsewhere."""
    for place, seed in (("runs/paper", 1), ("elsewhere", 2)):
        write_run(tmp_path / place, "A0", seed, ROWS, total=20_000)
    return tmp_path / "runs" / "paper"


def link_run(root: Path) -> None:
    (root / NAME / "seed_2").symlink_to(root.parent.parent / "elsewhere" / NAME / "seed_2")


def link_run_under_another_name(root: Path) -> None:
    (root / "best").symlink_to(root.parent.parent / "elsewhere" / NAME / "seed_2")


def link_cell(root: Path) -> None:
    (root / "more").symlink_to(root.parent.parent / "elsewhere" / NAME)


def link_folder(root: Path) -> None:
    (root / "disk").symlink_to("../../elsewhere")


def link_through_links(root: Path) -> None:
    (root.parent / "first").symlink_to(root.parent.parent / "elsewhere")
    (root / "second").symlink_to(root.parent / "first" / NAME)


LINKS = [link_run, link_run_under_another_name, link_cell, link_folder, link_through_links]


@pytest.mark.parametrize("link", LINKS)
def test_runs_behind_links_are_found(root, tmp_path, capsys, link):
    link(root)
    runs = load(root).runs
    assert sorted(runs.loc[runs["counted"], "seed"]) == [1, 2]
    assert set(runs["cell"]) == {"A0"}
    assert status([str(root.parent)]) == 0
    assert "2 runs: 2 complete" in capsys.readouterr().out
    assert len(publish(root, tmp_path / "published").added) == 2
    assert len(_finished(root)) == 2


def test_the_runs_folder_may_be_a_link(root, tmp_path, capsys, monkeypatch):
    (tmp_path / "linked").symlink_to(root)
    (tmp_path / "all").symlink_to(root.parent)
    assert load(tmp_path / "linked").runs.index.tolist() == [f"{NAME}/seed_1"]
    assert len(publish(tmp_path / "linked", tmp_path / "published").added) == 1
    monkeypatch.chdir(tmp_path)
    assert status(["all"]) == 0
    assert f"paper/{NAME}" in capsys.readouterr().out


def test_a_run_may_itself_be_the_folder(root, monkeypatch, capsys):
    (root / "one").symlink_to(Path(NAME) / "seed_1")
    for place in (root / NAME / "seed_1", root / "one"):
        assert load(place).runs["counted"].tolist() == [True]
        assert load(place).runs["seed"].tolist() == [1]
    monkeypatch.chdir(root / NAME)
    assert status(["seed_1"]) == 0
    assert "1 runs: 1 complete" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("link", "target"),
    [
        ("self", "self"),
        ("up", ".."),
        (f"{NAME}/here", "."),
        (f"{NAME}/seed_1/inner", "../.."),
        ("one", "two"),
    ],
)
def test_links_in_a_circle_end_and_nothing_counts_twice(root, capsys, link, target):
    (root / link).symlink_to(target)
    if link == "one":
        (root / "two").symlink_to("one")
    runs = load(root).runs
    assert runs.index[runs["counted"]].tolist() == [f"{NAME}/seed_1"]
    assert status([str(root.parent)]) == 0
    assert "1 runs: 1 complete" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("link", "target", "other"),
    [
        (f"{NAME}/seed_9", "seed_1", f"{NAME}/seed_9"),
        ("a_copy", NAME, "a_copy/seed_1"),
        ("A", f"../paper/{NAME}/seed_1", "A"),
    ],
)
def test_two_ways_to_one_run_are_one_run_under_its_own_path(root, tmp_path, capsys, link, target, other):
    (root / link).symlink_to(target)
    runs = load(root).runs
    assert runs.index.tolist() == [f"{NAME}/seed_1"]
    assert runs["reason"].tolist() == [f"also found as {other}"]
    assert runs["counted"].all()
    assert status([str(root.parent)]) == 0
    assert "1 runs: 1 complete" in capsys.readouterr().out
    assert len(publish(root, tmp_path / "published").added) == 1


def test_many_folders_that_lead_to_each_other_are_searched_quickly(tmp_path):
    for number in range(12):
        (tmp_path / f"x{number}" / f"seed_{number}").mkdir(parents=True)
    for number in range(12):
        for other in range(12):
            (tmp_path / f"x{number}" / f"to_{other}").symlink_to(tmp_path / f"x{other}")
    assert len(run_folders(tmp_path)) == 12


@pytest.mark.parametrize("link", [f"{NAME}/seed_3", "A2", f"{NAME}/seed_3/episodes.csv"])
def test_a_link_that_leads_nowhere_is_listed(root, capsys, link):
    (root / link).parent.mkdir(exist_ok=True)
    (root / link).symlink_to("/gone/with/the/disk")
    runs = load(root).runs
    assert sorted(runs["counted"]) == [False, True]
    reason = runs.loc[~runs["counted"], "reason"].item()
    assert "leads nowhere: /gone/with/the/disk" in reason or reason == "episodes.csv: a link that leaves its folder"
    status([str(root.parent)])
    assert ("leads nowhere" in capsys.readouterr().out) == (not link.endswith(".csv"))


@pytest.mark.parametrize("locked", ["A2", "A2/seed_1"])
def test_a_folder_that_cannot_be_read_is_listed(locked):
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "paper"
        write_run(root, "A0", 1, ROWS, total=20_000)
        write_run(root / "A2", "A0", 1, ROWS, total=20_000).rename(root / "A2" / "seed_1")
        Path(folder).chmod(0o755)
        # All that is loaded late, for the user below may not read Python itself.
        assert main([str(root), "--summary"]) == 0
        (root / locked).chmod(0)
        child = os.fork()
        if not child:
            try:
                # Root may read every folder.
                if os.geteuid() == 0:
                    os.setuid(65534)
                runs = load(root).runs
                assert runs.loc[locked, "reason"].startswith("cannot be read: Permission denied")
                assert runs.loc[f"{NAME}/seed_1", "counted"]
                assert status([str(root)]) == 0
                assert main([str(root), "--summary"]) == 0
                os._exit(0)
            except BaseException:
                traceback.print_exc()
                os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        (root / locked).chmod(0o755)


def test_files_beside_the_seeds_hide_none_of_them(root):
    (root / "summary.json").write_text("{}")
    (root / NAME / "episodes.csv").write_text(csv_text(ROWS))
    assert load(root).runs.loc[f"{NAME}/seed_1", "counted"]


@pytest.mark.parametrize("word", ["completed", "finished", "done", "success", "COMPLETE", " Done ", "Diverged", None])
def test_other_words_for_a_run_at_its_end_are_understood(root, tmp_path, capsys, word):
    write_run(root, "A0", 3, ROWS, total=20_000, summary={"status": word})
    run = load(root).runs.loc[f"{NAME}/seed_3"]
    assert (run["state"], run["counted"]) == ("diverged" if word == "Diverged" else "complete", True)
    assert len(publish(root, tmp_path / "published").added) == 2
    status([str(root.parent)])
    assert "stopped" not in capsys.readouterr().out


@pytest.mark.parametrize("word", ["xyz", "failed", "", 7, True, ["complete"], "\x1b[2J"])
def test_a_word_that_is_not_known_is_listed_with_what_to_write(root, capsys, word):
    write_run(root, "A0", 3, ROWS, total=20_000, summary={"status": word})
    run = load(root).runs.loc[f"{NAME}/seed_3"]
    reason = f"summary.json: status {str(word)!r} is not known; write one of complete, diverged, running, stopped"
    assert (run["state"], run["counted"], run["reason"]) == ("unknown", False, reason)
    assert main([str(root), "--summary"]) == 0
    assert f"not used: {NAME}/seed_3 (unknown): {reason}" in capsys.readouterr().out
    status([str(root.parent)])
    assert reason in capsys.readouterr().out


@pytest.mark.parametrize("word", ["running", "stopped"])
def test_a_summary_of_a_run_under_way_says_so(root, word):
    write_run(root, "A0", 3, ROWS, total=20_000, summary={"status": word})
    run = load(root).runs.loc[f"{NAME}/seed_3"]
    assert (run["state"], run["reason"]) == ("unfinished", f"summary.json says that it is {word}")


def test_every_run_that_does_not_count_is_named_where_it_is_no_cell(root, capsys):
    for name in ("mine", "yours"):
        (root / name / "seed_1").mkdir(parents=True)
        (root / name / "seed_1" / "config.yaml").write_text(json.dumps({"seed": 1}))
    assert main([str(root), "--summary"]) == 0
    said = capsys.readouterr().out
    for name in ("mine", "yours"):
        assert f"not used: {name}/seed_1 (unfinished): no episodes.csv; no summary.json" in said


@pytest.mark.parametrize("target", ["/", "..", "../.."])
def test_a_link_to_what_it_lies_in_is_not_followed(target, root):
    before = run_folders(root)
    (root / "all").symlink_to(target)
    (root.parent / "elsewhere-run" / "seed_9").mkdir(parents=True)
    assert run_folders(root) == before


def test_a_link_to_a_whole_disk_is_said_and_left(root, tmp_path, monkeypatch):
    monkeypatch.setattr("acmr.run_folders._MOST_BEHIND", 50)
    for number in range(60):
        (tmp_path / "disk" / str(number)).mkdir(parents=True)
    before = run_folders(root)
    (root / "disk").symlink_to(tmp_path / "disk")
    (found,) = [folder for folder in run_folders(root) if folder not in before]
    assert found.problem == "more than 50 folders behind this link; not all were looked into"


def test_links_of_processes_stop_nothing(root, capsys):
    """Where a link can be seen but not be read, as those of other users' processes and, here, of the first."""
    (root / "processes").symlink_to("/proc/1")
    assert "seed_1" in [folder.path.name for folder in run_folders(root) if not folder.problem]
    assert status([str(root)]) in (0, 1)
    assert "Traceback" not in capsys.readouterr().err
