"""What watches a run: told everything in order, closed whatever happens, and unable to end it."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from torture import ANT, Run, at_step, fail_with, same

from acmr.config import ConfigError, TrackingConfig
from acmr.records import EpisodeRecord
from acmr.storage import durable
from acmr.tracking.observer import Guarded, Observer, Tracker, close_all
from acmr.tracking.watchers import tracker_class

RECORD = EpisodeRecord(10, 1.0, 10)
HERE = Path(__file__).stem
#: With what the trackers below are chosen.
TRACKED = tuple(word for word in ANT if word != "tracking=off")


class Remembering(Tracker):
    """Writes down all that it hears, beside the folder of runs."""

    def __init__(self, spec: Any, say: Any) -> None:
        self._file = (Path(spec.config.output_dir) / "heard").open("w", buffering=1)

    def on_step(self, step: int) -> None:
        self._note("step", step)

    def on_episode(self, record: EpisodeRecord) -> None:
        self._note("episode", record.global_step, record.episodic_return, record.episode_length, record.reward_terms)

    def on_metrics(self, step: int, values: Any) -> None:
        self._note("metrics", step, {name: values[name] for name in sorted(values) if name != "steps_per_second"})

    def close(self, summary: Any) -> None:
        self._note("close", summary and summary["status"])

    def _note(self, *heard: Any) -> None:
        self._file.write(json.dumps(heard) + "\n")


class Failing(Remembering):
    """Fails at its second episode, and once more when it is closed."""

    title = "the tracker that fails"
    heard = 0

    def on_episode(self, record: EpisodeRecord) -> None:
        super().on_episode(record)
        self.heard += 1
        if self.heard == 2:
            raise RuntimeError("no more\n of this")

    def close(self, summary: Any) -> None:
        super().close(summary)
        raise OSError("not even that")


class Refusing(Tracker):
    title = "the tracker that does not start"

    def __init__(self, spec: Any, say: Any) -> None:
        raise ModuleNotFoundError("nothing there")


class Failed(Observer):
    """Fails at everything but one method, and counts."""

    title = "mirror"

    def __init__(self, method: str) -> None:
        self.calls: list[str] = []
        for name in ("on_step", "on_episode", "on_metrics", "close"):
            setattr(self, name, lambda *_, name=name: self._called(name, fails=name == method))

    def _called(self, name: str, fails: bool) -> None:
        self.calls.append(name)
        if fails:
            raise ValueError(f"{name} failed")


def heard(run: Run) -> list[Any]:
    return [json.loads(line) for line in (run.output / "heard").read_text().splitlines()]


def tracked_by(kind: type[Tracker]) -> tuple[str, ...]:
    return (*TRACKED, f"tracking.tracker={HERE}.{kind.__name__}")


@pytest.mark.parametrize("method", ["on_step", "on_episode", "on_metrics", "close"])
def test_a_guarded_observer_fails_once_and_is_closed(method: str) -> None:
    said: list[str] = []
    inner = Failed(method)
    observer = Guarded(inner, said.append)
    for _ in range(2):
        observer.on_step(10)
        observer.on_episode(RECORD)
        observer.on_metrics(10, {})
    observer.close({})
    assert said == [f"mirror stopped: ValueError: {method} failed. The run goes on; its own files are complete."]
    assert inner.calls.count(method) == 1
    assert inner.calls.count("close") == 1


def test_an_observer_whose_failure_cannot_even_be_said_ends_no_run() -> None:
    def say(line: str) -> None:
        raise BrokenPipeError(line)

    inner = Failed("on_step")
    Guarded(inner, say).on_step(10)
    assert inner.calls == ["on_step", "close"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, OSError])
def test_all_are_closed_whatever_one_of_them_raises(error: type[BaseException]) -> None:
    class Interrupted(Observer):
        def close(self, summary: Any) -> None:
            raise error

    after = Failed("on_step")
    with pytest.raises(error):
        close_all([Interrupted(), after], None)
    assert after.calls == ["close"]


def test_all_are_closed_and_the_first_error_is_raised() -> None:
    observers = [Failed("on_step"), Failed("close"), Failed("close"), Failed("on_step")]
    with pytest.raises(ValueError, match="close failed") as caught:
        close_all(observers, None)
    assert [observer.calls for observer in observers] == [["close"]] * 4
    assert caught.value.__context__ is None


def test_a_tracker_hears_the_whole_run_in_order_and_a_resumed_one_what_was_before(tmp_path: Path) -> None:
    whole, killed = (Run(tmp_path / name, (*tracked_by(Remembering), "log_every=90")) for name in ("whole", "killed"))
    whole.finish()
    told = heard(whole)
    assert [entry[1] for entry in told if entry[0] == "step"] == list(range(1, 301))
    assert told[-1] == ["close", "complete"]
    # What belongs to a step comes before the step is done, and an episode before the metrics.
    steps = [entry[1] for entry in told[:-1]]
    assert steps == sorted(steps)
    assert ["episode", "metrics", "step"] in [[kind for kind, at, *_ in told if at == step] for step in steps]
    killed(at_step(245))
    killed.finish()
    again = heard(killed)
    assert [entry for entry in again if entry[0] != "step"] == [entry for entry in told if entry[0] != "step"]
    assert [entry[1] for entry in again if entry[0] == "step"] == list(range(241, 301))


def test_a_tracker_that_fails_changes_nothing_in_a_run(tmp_path: Path, untouched: Any) -> None:
    run = Run(tmp_path, tracked_by(Failing))
    ended = run()
    assert ended.code == 0, ended.said
    assert [line for line in ended.said.splitlines() if "tracker" in line and "stopped" in line] == [
        "the tracker that fails stopped: RuntimeError: no more of this. The run goes on; its own files are complete."
    ]
    assert heard(run)[-1] == ["close", None]
    left, wanted = run.outcome(), untouched(ANT)
    # How it was tracked stands in the settings.
    for name in ("config.yaml", "teacher.json"):
        del left[name], wanted[name]
    same(left, wanted)


def test_a_tracker_that_cannot_be_made_costs_one_line(tmp_path: Path) -> None:
    ended = Run(tmp_path, tracked_by(Refusing))()
    assert ended.code == 0
    line = "the tracker that does not start not started: ModuleNotFoundError: nothing there."
    assert ended.said.count(line) == 1


def test_a_disk_that_refuses_a_row_ends_the_run_and_closes_all(tmp_path: Path) -> None:
    def prepare() -> None:
        def hook(action: str, path: Path) -> None:
            if action == "write" and path.name == "episodes.csv" and path.stat().st_size > 300:
                fail_with(28)()

        durable.hook = hook

    run = Run(tmp_path, tracked_by(Remembering))
    ended = run(prepare)
    assert ended.code == 74, ended.said
    assert "free some space there" in ended.said
    told = heard(run)
    assert told[-1] == ["close", None]
    # What is not in the run's own record is shown nowhere.
    recorded = (run.folder / "episodes.csv").read_text().splitlines()[1:]
    assert [entry[1] for entry in told if entry[0] == "episode"] == [int(row.split(",")[0]) for row in recorded]
    status = json.loads((run.folder / "status.json").read_text())
    assert status["state"] == "stopped"
    assert "free some space there" in status["cause"]
    assert " error: " in (run.folder / "run.log").read_text().splitlines()[-1]


def test_a_run_that_is_stopped_has_shown_its_last_step(tmp_path: Path) -> None:
    run = Run(tmp_path, tracked_by(Remembering))
    assert run(at_step(123, lambda: os.kill(os.getpid(), signal.SIGTERM))).code == 143
    assert heard(run)[-2:] == [["step", 123], ["close", None]]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("acmr.nowhere.Tracker", "no such class (ModuleNotFoundError: No module named 'acmr.nowhere')"),
        ("acmr.tracking.observer.Nothing", "no such class (AttributeError: "),
        ("Tracker", "no such class (ValueError: "),
        ("acmr.tracking.observer.Observer", "not a subclass of acmr.tracking.observer.Tracker"),
        ("acmr.tracking.observer.close_all", "not a subclass of acmr.tracking.observer.Tracker"),
    ],
)
def test_what_is_no_tracker_is_refused(name: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        tracker_class(TrackingConfig(tracker=name))
    assert str(caught.value).startswith(f"tracking.tracker={name}: {says}")
