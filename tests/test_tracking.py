"""Offline mirrors, read back from the files that W&B wrote."""

from __future__ import annotations

import csv
import json
import os
import random
import shutil
from pathlib import Path

import pytest
import yaml
from tracking_tools import ID, RUN, history, inspect, records, spec, start, the_mirror

from acmr.config import ConfigError
from acmr.records import EpisodeRecord
from acmr.tracking.mirror import main, rebuild
from acmr.tracking.wandb_backend import linked_mirrors, run_id
from acmr.tracking.wandb_tracker import labels, short_name

EPISODE = EpisodeRecord(120, 71.25, 120, 0.5, {"reward_forward": 3.5, "reward_ctrl": -1.0})
EPISODE_ROW = {
    "global_step": 120,
    "episodic_return": 71.25,
    "episode_length": 120,
    "mean_forward_velocity": 0.5,
    "reward_forward": 3.5,
    "reward_ctrl": -1,
}


def test_an_offline_run_read_back(tmp_path: Path) -> None:
    warnings: list[str] = []
    state, variables = random.getstate(), dict(os.environ)
    tracker = start(tmp_path, warnings)
    tracker.on_episode(EPISODE)
    tracker.on_episode(EpisodeRecord(250, -1.0, 130))
    tracker.on_metrics(1000, {"critic_loss": 0.5, "alpha": 0.2})
    tracker.close({"status": "complete", "steps_to_threshold": None, "versions": {"torch": "2.13"}})
    assert warnings == []
    assert random.getstate() == state
    assert dict(os.environ) == variables
    mirror = the_mirror(tmp_path)
    written = records(mirror)
    (run,) = [record["run"] for record in written if record["type"] == "run"]
    config = run["config"]["update"]
    assert (run["run_id"], run["display_name"], run["project"]) == (ID, ID, "acmr")
    assert (run["run_group"], run["job_type"]) == ("quick/A2", "student")
    assert set(run["tags"]) == {"quick", "ant_three_legs", "hidden", "frozen", "seed3", "A2"}
    assert config["group"] == "quick/A2"
    assert config["job_type"] == "student"
    assert set(config["tags"]) == set(run["tags"])
    assert config["agent"] == spec(tmp_path).settings["agent"]
    assert config["seed"] == 3
    assert history(mirror) == [
        EPISODE_ROW,
        {"global_step": 250, "episodic_return": -1, "episode_length": 130},
        {"global_step": 1000, "critic_loss": 0.5, "alpha": 0.2},
    ]
    axes = [record["metric"] for record in written if record["type"] == "metric"]
    assert [axis["step_metric"] for axis in axes if axis.get("glob_name") == "*"] == ["global_step"]
    assert written[-1]["exit"]["exit_code"] == 0
    final = json.loads(inspect(mirror, "--summary"))["summary"]
    assert final["status"] == "complete"
    assert final["versions"] == {"torch": "2.13"}
    assert final["global_step"] == 1000


def test_a_repeated_run_shows_once_and_its_neighbours_stay(tmp_path: Path) -> None:
    folder, warnings = tmp_path / "wandb", list[str]()
    neighbours = [f"offline-run-20260101_000000-{ID}0", f"offline-run-20260101_000000-x-{ID}"]
    stale = [f"offline-run-20260101_000000-{ID}", f"run-20260101_000000-{ID}", f"offline-run-20260101_000000-{ID}-1"]
    for name in neighbours + stale:
        (folder / name).mkdir(parents=True)
    for value in (1.0, 2.0):  # in one process, as a worker that is used again does
        tracker = start(tmp_path, warnings)
        tracker.on_episode(EpisodeRecord(10, value, 10))
        tracker.close(None)
    assert warnings == []
    mirror = the_mirror(tmp_path)
    assert [row["episodic_return"] for row in history(mirror)] == [2]
    assert [link.resolve().parent for link in folder.glob("by_name/*/*.wandb")] == [mirror]
    assert len(list((folder / "by_name").iterdir())) == 1
    assert sorted(path.name for path in folder.glob("*run-*")) == sorted([*neighbours, mirror.name])


def test_the_dashboard_lists_short_names(tmp_path: Path) -> None:
    folder, links = tmp_path / "wandb", tmp_path / "wandb" / "by_name"
    start(tmp_path, []).close(None)
    mirror = the_mirror(tmp_path)
    started = mirror.name.split("-")[2]
    (shown,) = links.iterdir()
    assert shown.name == f"run-{started}-A2-s3-quick"
    assert (shown / "run-A2-s3-quick.wandb").samefile(mirror / f"run-{ID}.wandb")
    assert records(shown)[-1]["type"] == "exit"  # by the reader that the dashboard uses
    # A run that came from elsewhere, and one that is gone.
    copied = folder / f"offline-run-20260101_000000-{ID}0"
    shutil.copytree(mirror, copied)
    (copied / f"run-{ID}.wandb").rename(copied / f"run-{ID}0.wandb")
    shutil.rmtree(mirror)
    assert [path.name for path in linked_mirrors(folder).iterdir()] == [f"run-20260101_000000-{ID}0"]


def make_run(run_dir: Path) -> list[dict[str, float]]:
    """A run's files; returns the rows that its mirror must hold."""
    run_dir.mkdir(parents=True)
    (run_dir / "config.yaml").write_text(yaml.safe_dump(spec("elsewhere").settings))
    rng = random.Random(0)
    episodes = [
        {
            "global_step": 70 * i,
            "episodic_return": rng.gauss(0, 100),
            "episode_length": 70,
            "reward_ctrl": -rng.random(),
        }
        for i in range(1, 31)
    ]
    metrics = [{"global_step": 500 * i, "steps_per_second": 700.5, "alpha": rng.random()} for i in range(1, 5)]
    for name, rows in (("episodes", episodes), ("metrics", metrics)):
        with (run_dir / f"{name}.csv").open("w", newline="") as lines:
            writer = csv.DictWriter(lines, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    return sorted([*episodes, *metrics], key=lambda row: (row["global_step"], "alpha" in row))


def test_a_mirror_is_rebuilt_from_the_runs_own_files(tmp_path: Path) -> None:
    run_dir = tmp_path / "quick" / RUN / "seed_3"
    expected = make_run(run_dir)
    warnings: list[str] = []
    rebuild(run_dir, "offline", warnings.append)
    first = the_mirror(tmp_path)
    assert history(first) == expected
    assert records(first)[-1]["exit"]["exit_code"] == 1  # unfinished: killed, or still running
    with (run_dir / "episodes.csv").open("a") as lines:
        lines.write("2170,12.5,70,-0.25\n2240,99")  # torn by a kill
    (run_dir / "summary.json").write_text(json.dumps({"status": "complete", "cell": "A2"}))
    assert main(["rebuild", str(run_dir)]) == 0
    again = the_mirror(tmp_path)
    last = {"global_step": 2170, "episodic_return": 12.5, "episode_length": 70, "reward_ctrl": -0.25}
    assert history(again) == [*expected, last]
    (run,) = [record["run"] for record in records(again) if record["type"] == "run"]
    assert run["run_group"] == "quick/A2"
    assert warnings == []


def test_rebuild_of_what_is_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="is no run's directory"):
        rebuild(tmp_path, "offline", print)
    (tmp_path / "config.yaml").write_text("just text")
    assert main(["rebuild", str(tmp_path)]) == 2
    assert main(["dashboard", str(tmp_path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert all(line.startswith("error: ") for line in lines)


def test_run_ids_are_readable_stable_and_distinct(tmp_path: Path) -> None:
    assert run_id(spec(tmp_path)) == "quick-ant_three_legs-hidden-frozen-s3"
    names = ["ant-none-q_lr=0.0001", "ant-none-a[1]", "ant-none-a(1)", "x" * 300, "x" * 301]
    ids = [run_id(spec(tmp_path, name)) for name in names]
    assert len(set(ids)) == len(names)
    assert all(len(name) <= 128 and not set(name) & set("/\\#?%:[]()") for name in ids)
    shared = {run_id(spec(tmp_path / folder, dir=str(tmp_path / "all"))) for folder in ("runs", "more")}
    assert len(shared) == 2


def test_a_run_that_stops_at_its_threshold_is_of_its_cell_but_not_averaged_with_full_ones() -> None:
    name = f"{RUN}-stop=threshold"
    full, stopped = spec("runs"), spec("runs", name, stop="threshold")
    assert labels(full)["group"] == "quick/A2"
    assert labels(stopped)["group"] == f"quick/{name}"
    assert labels(stopped)["tags"] == [*labels(full)["tags"], "stopped"]
    assert short_name(stopped) == "A2-s3-quick-stopped"
