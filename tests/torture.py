"""Real runs in processes of their own that are killed, stopped and starved, and what they leave, to be compared.

A process is forked from the one that runs the tests, so that it need not load torch again; everything else in it is
what ``run.py`` does.
"""

import csv
import hashlib
import json
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import acmr.run.experiment as experiment
from acmr.agent.replay_buffer import ReplayBuffer
from acmr.config import ConfigError
from acmr.run import reproducibility, summary, trainer
from acmr.run.checkpointing import Checkpoints, CheckpointSchedule, make_checkpoints
from acmr.run.preparation import Prepared, prepare
from acmr.run.run_state import RunState, make_state
from acmr.run_folders import changes
from acmr.settings.compose import compose_config, parse
from acmr.settings.run_spec import RunSpec, specify
from acmr.storage import durable
from acmr.storage.run_dir import RunDir

#: Small networks, a buffer that wraps, rows of metrics that checkpoints fall between.
SMALL = (
    "tracking=off", "progress=off", "agent.hidden_sizes=[16,16]", "agent.batch_size=16", "agent.learning_starts=70",
    "agent.buffer_size=180", "log_every=70", "checkpoint_every=40", "threshold=-1000", "consecutive=2",
)  # fmt: skip
HUMANOID = ("env=humanoid", "total_timesteps=300", *SMALL)
ANT = ("env=ant", "total_timesteps=300", "env.max_episode_steps=90", *SMALL)
#: As few durable writes as show every kind of them: two checkpoints, episodes, metrics, the end.
SHORT = (
    *(word for word in ANT if not word.startswith(("total_timesteps", "env.max_episode_steps", "agent.learning"))),
    "total_timesteps=90", "env.max_episode_steps=25", "agent.learning_starts=50",
)  # fmt: skip
#: Entries of summary.json that say how long it took, and those that follow from these and from where the run lies.
TIMES = ("wall_seconds", "steps_per_second", "files", "sha256")
#: Files that say how a run went, not what came of it.
ASIDE = {"run.log", "status.json", ".lock"}


@cache
def spec(output: Path, *overrides: str) -> RunSpec:
    return specify(parse(compose_config([f"output_dir={output}", *overrides])))


@cache
def found_out(overrides: tuple[str, ...]) -> Prepared:
    """What a run finds out of its settings before it touches the disk, found out once."""
    made = spec(Path("unused"), *overrides)
    # Whoever edits the program while these tests run does not change it for them.
    reproducibility._program(("acmr.agent.sac",))
    return prepare(made)


@dataclass
class Ended:
    """How a process ended: its exit code, negative for a signal, and what it said."""

    code: int
    said: str


@dataclass
class Run:
    """One run, to be started as often as wanted."""

    output: Path
    overrides: tuple[str, ...]
    spec: RunSpec = field(init=False)

    def __post_init__(self) -> None:
        self.spec = spec(self.output, *self.overrides)

    @property
    def folder(self) -> Path:
        return self.spec.directory

    @property
    def checkpoints(self) -> list[int]:
        return sorted(int(path.stem[5:]) for path in (self.folder / "checkpoint").glob("step_*.json"))

    def start(self, prepare: Callable[[], None] = lambda: None, *more: str) -> int:
        """Starts a process; ``prepare`` is called in it first. Returns its number."""
        self.output.mkdir(parents=True, exist_ok=True)
        made = spec(self.output, *self.overrides, *more)
        found_out(self.overrides)
        child = os.fork()
        if child:
            return child
        code = 70
        try:
            with open(self.output / f"said.{os.getpid()}", "w", buffering=1) as said:
                os.dup2(said.fileno(), 1)
                os.dup2(said.fileno(), 2)
                code = self._run(made, prepare)
        finally:
            os._exit(code)

    def _run(self, made: RunSpec, prepare: Callable[[], None]) -> int:
        sys.stdout = sys.stderr = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115
        buffers: list[ReplayBuffer] = []

        class Watched(ReplayBuffer):
            def __init__(self, *arguments: object) -> None:
                super().__init__(*arguments)
                buffers.append(self)

        save = experiment.save_teacher

        def note_and_save(*arguments: object) -> None:
            # The first thing that a run does at its end; the buffer is as it will be judged.
            (self.output / "buffer.sha256").write_text(content_hash(buffers[-1]))
            save(*arguments)

        trainer.ReplayBuffer, experiment.save_teacher = Watched, note_and_save
        # What every process of a run would find out again; no process changes it for another.
        prepared = found_out(self.overrides)
        experiment.prepare = lambda made: replace(prepared, spec=made)
        summary.git_commit = lambda: "a commit"
        try:
            prepare()
            made_of_it = experiment.run_experiment(made)
        except ConfigError as error:
            print(f"error: {error}")
            return error.exit_code
        except SystemExit as stopped:
            return int(stopped.code)
        except BaseException:
            traceback.print_exc()
            return 70
        return experiment.exit_code(made_of_it)

    def wait(self, child: int) -> Ended:
        _, status = os.waitpid(child, 0)
        said = self.output / f"said.{child}"
        # One that was killed at once has said nothing.
        ended = Ended(os.waitstatus_to_exitcode(status), said.read_text() if said.exists() else "")
        said.unlink(missing_ok=True)
        return ended

    def __call__(self, prepare: Callable[[], None] = lambda: None, *more: str) -> Ended:
        return self.wait(self.start(prepare, *more))

    def finish(self) -> dict[str, bytes]:
        """Starts it and expects that it comes to its end; returns what it left."""
        ended = self()
        assert ended.code == 0, ended.said
        return self.outcome()

    def outcome(self) -> dict[str, bytes]:
        """All that must be the same however often a run was killed."""
        names = {path.name for path in self.folder.iterdir()}
        found = {name: (self.folder / name).read_bytes() for name in sorted(names - ASIDE)}
        found["metrics.csv"] = without_speed(found["metrics.csv"])
        said = json.loads(found["summary.json"])
        assert set(said["files"]) == {"config.yaml", "episodes.csv", "metrics.csv"}
        assert changes(self.folder, said) == {}
        found["summary.json"] = json.dumps({key: said[key] for key in said if key not in TIMES}).encode()
        found["buffer"] = (self.output / "buffer.sha256").read_bytes()
        # Where it lies is not what it is, but a teacher's own hash is of that, too.
        found["teacher.json"] = re.sub(rb'"description_sha256": "\w+"', b"", found.get("teacher.json", b""))
        return {name: data.replace(str(self.output).encode(), b"OUTPUT") for name, data in found.items()}


def parts(run: Run) -> tuple[RunState, Checkpoints]:
    """The parts of a run in this process, as they are before its first step."""
    prepared, run_dir = deepcopy(replace(found_out(run.overrides), spec=run.spec)), RunDir(run.folder)
    state = make_state(prepared, run_dir)
    return state, make_checkpoints(prepared, state, run_dir)


def same(outcome: dict[str, bytes], untouched: dict[str, bytes]) -> None:
    """Expects two runs to have left the same, and says what differs."""
    differing = [name for name in sorted(outcome.keys() | untouched.keys()) if outcome.get(name) != untouched.get(name)]
    assert not differing, differing


def without_speed(metrics: bytes) -> bytes:
    rows = list(csv.reader(metrics.decode().splitlines()))
    return "\n".join(",".join(row[:1] + row[2:]) for row in rows).encode()


def content_hash(buffer: ReplayBuffer) -> str:
    """Hash of every transition that may be drawn, oldest first."""
    kept = buffer.transitions(buffer.oldest, buffer.added)
    return hashlib.sha256(
        b"".join(kept[name].tobytes() for name in sorted(kept)) + str(buffer.added).encode()
    ).hexdigest()


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def at_step(number: int, action: Callable[[], None] = die) -> Callable[[], None]:
    """Something that happens within a step, before a checkpoint of it could be made."""

    def prepare() -> None:
        before = CheckpointSchedule.on_step

        def watched(schedule: CheckpointSchedule, step: int) -> None:
            if step == number:
                action()
            before(schedule, step)

        CheckpointSchedule.on_step = watched

    return prepare


def at_write(number: int, action: Callable[[], None] = die) -> Callable[[], None]:
    """Something that happens at one of the steps that :mod:`acmr.storage.durable` takes, counted from 1."""

    def prepare() -> None:
        count = 0

        def hook(name: str, path: Path) -> None:
            nonlocal count
            count += 1
            if count == number:
                action()

        durable.hook = hook

    return prepare


def count_writes(into: Path) -> Callable[[], None]:
    """Notes each step that :mod:`acmr.storage.durable` takes as a line of a file."""

    def prepare() -> None:
        stream = into.open("a", buffering=1)
        durable.hook = lambda name, path: print(name, path.name, file=stream)

    return prepare


def fail_with(number: int) -> Callable[[], None]:
    """An action that fails as the system does with this ``errno``."""

    def action() -> None:
        raise OSError(number, os.strerror(number))

    return action
