"""Event files, read back by TensorBoard's own reader: whole after a kill, without double rows after a resume."""

from __future__ import annotations

import csv
import signal
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torture import ANT, Run, at_step
from tracking_tools import child

from acmr.settings.compose import compose_config, options, parse
from acmr.tracking.mirror import main
from acmr.tracking.watchers import tracker_class
from analysis.loading.load import load
from analysis.publish import publish

TENSORBOARD = (*(word for word in ANT if word != "tracking=off"), "tracking=tensorboard")
Scalars = dict[str, list[tuple[int, float]]]


def events(folder: Path) -> Scalars:
    """Every scalar in the event files of a run: steps and values (float32) by name."""
    reader = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    reader.Reload()
    return {tag: [(event.step, event.value) for event in reader.Scalars(tag)] for tag in reader.Tags()["scalars"]}


def recorded(folder: Path) -> Scalars:
    """What the event files must hold: every number of the run's own files."""
    found: Scalars = defaultdict(list)
    for name in ("episodes.csv", "metrics.csv"):
        with (folder / name).open(newline="") as lines:
            for row in csv.DictReader(lines):
                step = int(row.pop("global_step"))
                for key, text in row.items():
                    found[key].append((step, float(np.float32(text))))
    return dict(found)


def same_scalars(folder: Path) -> None:
    # As text, for nan is no number that equals itself.
    assert {key: str(rows) for key, rows in events(folder).items()} == {
        key: str(rows) for key, rows in recorded(folder).items()
    }


@pytest.mark.slow
def test_a_killed_run_loses_no_event_and_a_resumed_one_has_none_twice(tmp_path: Path) -> None:
    run = Run(tmp_path, TENSORBOARD)
    assert run(at_step(245)).code == -signal.SIGKILL
    assert "critic_loss" in events(run.folder)
    same_scalars(run.folder)
    (file,) = (run.folder / "tensorboard").iterdir()
    # As if some time had passed: files are named by the second.
    file.rename(file.with_name("events.out.tfevents.1.here"))
    # The checkpoint is of step 240: rows of later steps are written again.
    assert run().code == 0
    same_scalars(run.folder)
    assert len(list((run.folder / "tensorboard").iterdir())) == 1
    # What is run anew is shown anew, however that is.
    assert run(lambda: None, "force=true", "tracking=off").code == 0
    assert not (run.folder / "tensorboard").exists()


@pytest.mark.slow
def test_events_are_rebuilt_from_the_runs_own_files(tmp_path: Path) -> None:
    run = Run(tmp_path, ANT)
    assert run().code == 0
    assert main(["rebuild", "--tracking", "tensorboard", str(run.folder)]) == 0
    same_scalars(run.folder)
    assert not (tmp_path / "wandb").exists()
    # Neither the analysis nor what is published takes them for results.
    runs = run.folder.parent.parent
    assert list(load(runs).runs.index) == [str(run.folder.relative_to(runs))]
    (published,) = publish(runs, tmp_path / "published").added
    assert "tensorboard" not in {path.name for path in published.iterdir()}


def test_without_the_library_one_line_says_what_to_install(tmp_path: Path) -> None:
    run = Run(tmp_path, TENSORBOARD)
    loaded = [name for name in sys.modules if name.partition(".")[0] == "tensorboard"]
    # As Python marks modules that are not there.
    ended = run(lambda: sys.modules.update(dict.fromkeys(loaded)))
    assert ended.code == 0, ended.said
    (line,) = [line for line in ended.said.splitlines() if "TensorBoard" in line]
    assert "TensorBoard not started: ModuleNotFoundError: it is not installed; type pip install tensorboard" in line


def test_a_full_disk_costs_one_warning(tmp_path: Path) -> None:
    program = """
        import resource
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        folder = spec(sys.argv[1]).directory
        folder.mkdir(parents=True)
        tracker = start("acmr.tracking.tensorboard_tracker.TensorBoardTracker")
        for step in range(1, 2001):
            tracker.on_metrics(step, {"alpha": step / 3})
        tracker.close({"status": "complete"})
        print("trained")
    """
    out, err = child(program, tmp_path / "out", home=tmp_path).communicate(timeout=60)
    warning, trained = out.splitlines()
    assert (err, trained) == ("", "trained")
    assert warning.startswith("WARNING TensorBoard stopped: OSError: [Errno 27] File too large. The run goes on")


@pytest.mark.parametrize("name", options("tracking"))
def test_every_file_of_the_group_names_a_tracker_or_none(name: str) -> None:
    config = parse(compose_config([f"tracking={name}", "tracking.base_url=null"]))
    assert (tracker_class(config.tracking) is None) == (name == "off")
