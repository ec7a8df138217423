"""W&B's service process is stopped (SIGSTOP): the run trains on, ends in time, and leaves no process."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from pathlib import Path

import pytest
from test_faults import wait_for
from torture import SHORT, Run
from tracking_tools import child

from acmr.records import EpisodeRecord
from acmr.run import experiment
from acmr.tracking.observer import Guarded, Observer
from acmr.tracking.threaded import Threaded

#: When the service is stopped, and the least and the most seconds that the rest may take.
STOPPED = {
    "before the first row": (1, 0),
    "in mid run": (1000, 0),
    "before the end": (2000, 0),
}
PROGRAM = """
    from acmr.tracking import threaded, wandb_tracker
    wandb_tracker.PATIENCE, wandb_tracker.CLOSE_WAIT, threaded.MOST_ROWS = 2.0, 3.0, 500
    tracker = start()
    (number,) = service()
    print(number, flush=True)
    for step in range(1, 2001):
        if step == {at}:
            os.kill(number, signal.SIGSTOP)
        tracker.on_metrics(step, {{f"value_{{index}}": "x" * 900 for index in range(9)}})
    began = time.monotonic()
    tracker.close({{"status": "complete"}})
    print("closed", time.monotonic() - began < 8, flush=True)
    print("left", service(), flush=True)
"""


def is_there(process: int) -> bool:
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.slow
@pytest.mark.parametrize("when", STOPPED)
def test_a_service_that_was_stopped_costs_one_warning_and_no_process(when, tmp_path):
    process = child(PROGRAM.format(at=STOPPED[when][0]), tmp_path / "out", home=tmp_path)
    out, err = process.communicate(timeout=60)
    number, *lines = out.splitlines()
    assert (process.returncode, err) == (0, "")
    assert [line for line in lines if not line.startswith("WARNING")] == ["closed True", "left []"]
    (warning,) = (line for line in lines if line.startswith("WARNING"))
    assert warning.startswith("WARNING W&B mirror stopped: ")
    assert "The run goes on; its own files are complete." in warning
    assert not is_there(int(number))


@pytest.mark.slow
def test_a_process_that_ends_without_closing_a_stopped_service_is_not_kept_by_sigterm(tmp_path):
    process = child(PROGRAM.split("    began")[0].format(at=5) + "\n    print('on', flush=True); time.sleep(60)",
                    tmp_path / "out", home=tmp_path)  # fmt: skip
    assert process.stdout is not None
    number = int(process.stdout.readline())
    while "on" not in process.stdout.readline():
        pass
    process.terminate()
    assert process.wait(10) == -signal.SIGTERM
    # An orphaned group that holds a stopped process gets SIGHUP and SIGCONT, so the service may be gone already.
    with contextlib.suppress(ProcessLookupError):
        os.kill(number, signal.SIGKILL)
    process.communicate()


class Stuck(Observer):
    """Waits in one of its methods, until that is ended."""

    title = "stuck"

    def __init__(self, where: str, ended: threading.Event, heard: list) -> None:
        self.where, self.ended, self.heard = where, ended, heard
        self.wait("start")

    def wait(self, where: str) -> None:
        if where == self.where:
            self.ended.wait(20)
            raise ConnectionError("the service is gone")
        if where == f"fails in {self.where.removeprefix('fails in ')}":
            raise ValueError(where)

    def on_episode(self, record: EpisodeRecord) -> None:
        self.wait("episode")
        self.heard.append(record.global_step)

    def on_metrics(self, step: int, values) -> None:
        self.wait("metrics")
        self.heard.append((step, dict(values)))

    def close(self, summary) -> None:
        self.wait("close")
        self.heard.append(summary)


def made(where: str, heard: list) -> tuple[Threaded, threading.Event]:
    ended = threading.Event()
    return Threaded(lambda: Stuck(where, ended, heard), ended.set, patience=0.2, close_wait=0.3), ended


def test_everything_is_told_in_its_order():
    heard: list = []
    observer, ended = made("nowhere", heard)
    values = {"loss": 1.0}
    for step in range(500):
        observer.on_metrics(step, values)
        values["loss"] += 1.0
        observer.on_episode(EpisodeRecord(step, 1.0, 1))
    observer.close({"status": "complete"})
    wanted = [entry for step in range(500) for entry in ((step, {"loss": step + 1.0}), step)]
    assert heard == [*wanted, {"status": "complete"}]
    assert not ended.is_set()


@pytest.mark.parametrize("where", ["episode", "metrics", "close"])
def test_what_hangs_is_given_up_in_time_with_one_line(where):
    heard, said = [], []
    observer, ended = made(where, heard)
    guarded, began = Guarded(observer, said.append), time.monotonic()
    for step in range(40):
        guarded.on_metrics(step, {})
        guarded.on_episode(EpisodeRecord(step, 1.0, 1))
        time.sleep(0.01)
    guarded.close({})
    # As the program ends; nothing more is waited for.
    observer.hand_over()
    assert time.monotonic() - began < 3
    assert ended.is_set()
    assert len(said) == 1
    assert "stopped: TimeoutError: it " in said[0]


def test_rows_that_wait_are_handed_over_where_nobody_closes():
    heard: list = []
    observer, ended = made("nowhere", heard)
    for step in range(500):
        observer.on_episode(EpisodeRecord(step, 1.0, 1))
    observer.hand_over()
    assert heard == list(range(500))
    assert not ended.is_set()


def test_what_never_answers_is_not_waited_for_again():
    class Deaf(Stuck):
        def wait(self, place: str) -> None:
            if place == "episode":
                time.sleep(5)

    observer = Threaded(lambda: Deaf("", threading.Event(), []), lambda: None, patience=0.1, close_wait=0.1)
    observer.on_episode(EpisodeRecord(1, 1.0, 1))
    time.sleep(0.2)
    with pytest.raises(TimeoutError):
        observer.on_episode(EpisodeRecord(2, 1.0, 1))
    began = time.monotonic()
    observer.hand_over()
    assert time.monotonic() - began < 0.5


def test_a_full_queue_is_given_up(monkeypatch):
    monkeypatch.setattr("acmr.tracking.threaded.MOST_ROWS", 10)
    observer, ended = made("metrics", [])

    def tell() -> None:
        for step in range(100):
            observer.on_metrics(step, {})

    with pytest.raises(TimeoutError, match=r"10 rows wait for it|it has not answered"):
        tell()
    began = time.monotonic()
    observer.close(None)
    assert time.monotonic() - began < 1
    assert ended.is_set()


def test_what_does_not_start_is_given_up(monkeypatch):
    monkeypatch.setattr("acmr.tracking.threaded.START_WAIT", 0.2)
    with pytest.raises(TimeoutError, match=r"has not started within 0\.2 s"):
        made("start", [])


@pytest.mark.parametrize("where", ["start", "metrics", "close"])
def test_its_errors_are_those_of_the_observer(where):
    class Fails(Stuck):
        def wait(self, place: str) -> None:
            if place == where:
                raise ValueError(where)

    def use() -> None:
        observer = Threaded(lambda: Fails("", threading.Event(), []), lambda: None)
        for step in range(50):
            observer.on_metrics(step, {})
            time.sleep(0.002)
        observer.close({})

    with pytest.raises(ValueError, match=where):
        use()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_finished_run_that_waits_for_a_tracker_ends_at_a_signal(number, tmp_path):
    run = Run(tmp_path, SHORT)

    def prepare() -> None:
        experiment.close_all = lambda observers, summary: time.sleep(60)

    child = run.start(prepare)
    wait_for(lambda: (run.folder / "summary.json").exists())
    time.sleep(0.2)
    os.kill(child, number)
    began = time.monotonic()
    assert run.wait(child).code == -number
    assert time.monotonic() - began < 10
    ended = run()
    assert (ended.code, "complete already" in ended.said) == (0, True), ended.said
