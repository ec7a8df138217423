"""Checkpoints of a run: taken up at its start, made when they fall due, and when it is asked to stop."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from acmr.config import INEXACT, TEACHER_CHOICE, ConfigError, ExperimentConfig, is_neutral, schema_defaults
from acmr.envs.state import ANYTIME, NEVER
from acmr.records import DamagedError
from acmr.run.preparation import Prepared
from acmr.run.reproducibility import differences, fingerprint
from acmr.run.run_state import RunState, arrays_bytes
from acmr.run.stop_signals import Stopped, StopSignals
from acmr.run.trainer import is_finite
from acmr.storage.checkpoint_store import KEPT, FormatError, Snapshot, SnapshotStore
from acmr.storage.durable import WriteError
from acmr.storage.hold import RunHeldError
from acmr.storage.run_dir import RunDir
from acmr.text import flatten
from acmr.tracking.observer import Observer

#: Steps between two checkpoints where none are set: a share of the run, within these bounds.
_SHARE, _LEAST, _MOST = 20, 1_000, 25_000
#: Where none are set, the run trains for this many times as long as the last checkpoint took before the next one.
_PAUSE = 60.0
#: Seconds that a run which was asked to stop may take to reach the end of its episode, where it needs that.
_EPISODE_WAIT = 20.0


@dataclass(frozen=True)
class CheckpointKey:
    """What a checkpoint must agree on with the run that takes it up.

    Attributes:
        run: What is learned: settings and what the teacher gave.
        fingerprint: What it is computed with (:mod:`acmr.run.reproducibility`).
        command: Says what starts the run.
        mode: ``exact``, or ``inexact`` to go on although the fingerprint is another.
    """

    run: Mapping[str, Any]
    fingerprint: dict[str, str]
    command: Callable[[], str]
    mode: str

    @property
    def digest(self) -> str:
        """Hash of ``run``."""
        return hashlib.sha256(json.dumps(self.run, sort_keys=True, default=str).encode()).hexdigest()


class Checkpoints:
    """Stores a run's state and takes it up again.

    Args:
        store: Where to.
        state: The parts of the run.
        key: What a checkpoint must agree on with it.

    Attributes:
        inexact: For each time that the run went on although something differed: the step, and what.
    """

    def __init__(self, store: SnapshotStore, state: RunState, key: CheckpointKey) -> None:
        self._store, self._state, self._key = store, state, key
        # Files that the kept checkpoints need beside their own two, by step.
        self._files: dict[int, set[str]] = {}
        self.inexact: list[dict[str, Any]] = []

    def load(self, warn: Callable[[str], None]) -> int | None:
        """Takes up the latest checkpoint that is whole.

        Args:
            warn: Called with one line for each that is not.

        Returns:
            The step that it was made at; None if there are no checkpoints.

        Raises:
            ConfigError: If there are some and none can be used; nothing has been changed then.
        """
        problems: list[DamagedError] = []
        try:
            steps = self._store.steps()
        except DamagedError as error:
            raise ConfigError(f"{error}; remove it, or type output_dir=FOLDER for another place") from error
        for step in steps:
            try:
                self._take_up(step)
            except DamagedError as error:
                problems.append(error)
                continue
            for problem, damaged in zip(problems, steps, strict=False):
                warn(f"warning: {self._about(damaged, problem)}; going on from the checkpoint before, of step {step:,}")
            for later in [later for later in steps if later > step]:
                self._store.discard(later)
            return step
        if steps:
            raise ConfigError(
                f"{self._refusal(steps, problems)}; to start from the first step again, type: "
                f"{self._key.command()} force=true"
            )
        return None

    def _refusal(self, steps: list[int], problems: list[DamagedError]) -> str:
        if all(isinstance(problem, FormatError) for problem in problems):
            # Of one run, so that the latest speaks for both.
            return f"a checkpoint of another version of this program, which can finish this run: {problems[0]}"
        listed = "; ".join(self._about(step, problem) for step, problem in zip(steps, problems, strict=True))
        return f"no checkpoint can be used ({listed})"

    def _about(self, step: int, problem: DamagedError) -> str:
        return f"{problem}" if str(self._store.folder) in str(problem) else f"{self._file(step)}: {problem}"

    def save(self) -> bool:
        """Makes a checkpoint, unless the learner's numbers are no longer finite; the trainer will see that itself."""
        if not is_finite(self._state.trainer.agent):
            return False
        if not self._files:
            self._store.prepare()
        step, snapshot = self._state.trainer.global_step, self._state.capture()
        about = {
            "run": self._key.digest,
            "fingerprint": self._key.fingerprint,
            "inexact": self.inexact,
            "state": snapshot.values,
        }
        self._store.write(step, Snapshot(about, snapshot.arrays))
        self._files[step] = self._state.replay.names
        self._files = dict(sorted(self._files.items())[-KEPT:])
        self._store.prune(self._files)
        return True

    def clear(self) -> None:
        """Removes all checkpoints."""
        self._store.clear()

    @property
    def latest(self) -> int | None:
        """Step of the latest checkpoint that this process knows to be good."""
        return max(self._files, default=None)

    def _take_up(self, step: int) -> None:
        snapshot = self._store.read(step)
        try:
            run, fingerprint = snapshot.values["run"], dict(snapshot.values["fingerprint"])
            inexact, state = list(snapshot.values["inexact"]), dict(snapshot.values["state"])
        except (KeyError, TypeError, ValueError) as error:
            raise DamagedError("not a checkpoint of this program") from error
        if run != self._key.digest:
            raise ConfigError(
                f"{self._file(step)}: a checkpoint of another run (other settings, or a teacher that was trained "
                f"again since); to start anew, type: {self._key.command()} force=true"
            )
        differing = differences(fingerprint, self._key.fingerprint)
        if differing and self._key.mode != INEXACT:
            raise ConfigError(
                f"{self._file(step)}: made under other conditions: {', '.join(differing)}; the run would not be the "
                "one it began as. Go on where it was made, or type resume=inexact to go on here (its summary will "
                "say so), or force=true to start anew"
            )
        self._state.restore(Snapshot(state, snapshot.arrays))
        self._files = {step: self._state.replay.names}
        self.inexact = [*inexact, *([{"step": step, "differing": differing}] if differing else [])]

    def _file(self, step: int) -> str:
        return str(self._store.state_file(step))


def make_checkpoints(prepared: Prepared, state: RunState, run_dir: RunDir) -> Checkpoints:
    """Makes what stores the state of a run in its directory; touches no disk."""
    store = SnapshotStore(run_dir.checkpoint_folder, arrays_bytes(prepared.networks))
    return Checkpoints(store, state, _key(prepared))


def discard_checkpoints(run_dir: RunDir) -> None:
    """Removes the checkpoints of a finished run that was killed between its last two acts, if nobody else does."""
    if run_dir.checkpoint_folder.exists():
        with suppress(RunHeldError, WriteError), run_dir.lock():
            SnapshotStore(run_dir.checkpoint_folder, 0).clear()


def _key(prepared: Prepared) -> CheckpointKey:
    spec, report, usual = prepared.spec, asdict(prepared.report), schema_defaults()
    # Only what differs from the schema's defaults: a setting that is added to it voids no checkpoint then.
    settings = {
        key: value
        for key, value in flatten(spec.settings).items()
        if not is_neutral(key) and key not in TEACHER_CHOICE and (key not in usual or value != usual[key])
    }
    # One teacher may be reached by several paths; its hash says which it is.
    teacher = {**(report["teacher"] or {}), "path": None}
    made_with = _chosen(spec.config)
    return CheckpointKey(
        run={"settings": settings, "transfer": {**report, "teacher": teacher}},
        fingerprint=fingerprint(spec.config.threads, spec.config.device, prepared.resume_check.trace, made_with),
        command=lambda: spec.command,
        mode=spec.config.resume,
    )


def _chosen(config: ExperimentConfig) -> tuple[str, ...]:
    """Modules that the settings name, whether or not there are such: of the learner and of the transfer method."""
    agent, transfer = config.agent, config.transfer
    own = transfer.method.partition(":")[0] if transfer.method else f"acmr.transfer.{transfer.name}"
    return f"acmr.agent.{agent.name}", own


class CheckpointSchedule(Observer):
    """Decides after each step whether a checkpoint is made, and whether the run stops.

    Args:
        checkpoints: Makes them.
        prepared: What the run starts with; says how often it wants them, and when its environment can be stored.
        state: The parts of the run.
        stop: Says whether the run is to stop.
        say: Takes a line for the user, at once if the environment cannot be stored at every step.
    """

    def __init__(
        self,
        checkpoints: Checkpoints,
        prepared: Prepared,
        state: RunState,
        stop: StopSignals,
        say: Callable[[str], None],
    ) -> None:
        self._checkpoints, self._trainer, self._stop, self._say = checkpoints, state.trainer, stop, say
        every, when = prepared.spec.config.checkpoint_every, prepared.resume_check.when
        if when != ANYTIME and every != 0:
            made = "not be stored (docs/howto-state.md): no checkpoints are made, a run that was stopped begins anew"
            if when != NEVER:
                made = "be stored between episodes only: checkpoints wait for the end of one"
            say(f"{prepared.spec.directory}: the state of {prepared.spec.config.env.name} can {made}")
        self._makes_any, self._anytime = when != NEVER and every != 0, when == ANYTIME
        total = self._trainer.total_timesteps
        self._interval = every or min(max(total // _SHARE, _LEAST), _MOST)
        self._pause = 0.0 if every else _PAUSE
        self._earliest = 0.0
        self._due_at = self._next_multiple()

    def on_step(self, step: int) -> None:
        """Makes a checkpoint if it is due.

        Raises:
            Stopped: If the run was asked to stop, with a checkpoint where that is possible.
            WriteError: If the disk does not take it; the one before is good still.
        """
        if (step < self._due_at and self._stop.received is None) or self._trainer.is_over:
            return
        possible = self._makes_any and (self._anytime or self._trainer.observation is None)
        if self._stop.received is not None:
            if possible or not self._makes_any or time.monotonic() - self._stop.since > _EPISODE_WAIT:
                self._leave(possible and self._checkpoints.save())
        elif possible:
            if time.monotonic() >= self._earliest:
                began = time.monotonic()
                self._checkpoints.save()
                now = time.monotonic()
                self._earliest = now + self._pause * (now - began)
            self._due_at = self._next_multiple()

    def _leave(self, stored: bool) -> None:
        step, latest = self._trainer.global_step, self._checkpoints.latest
        where = f"resumes at step {step:,}" if stored else f"goes back to step {latest:,}" if latest else "begins anew"
        self._say(f"stopped by {self._stop.name} at step {step:,}; run the same command to resume: it {where}")
        assert self._stop.received is not None
        raise Stopped(self._stop.received)

    def _next_multiple(self) -> int:
        if not self._makes_any:
            return self._trainer.total_timesteps
        return (self._trainer.global_step // self._interval + 1) * self._interval
