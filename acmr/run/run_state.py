"""Captures and restores the complete state of a run: the parts that have one, by name.

A new part with a state is one more line in :meth:`RunState.parts`. ``tests/test_resume_fields.py`` leaves out each
entry of a checkpoint in turn and expects another run.
"""

from __future__ import annotations

import shutil
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from acmr.agent.networks import Networks
from acmr.agent.replay_files import ReplayFiles, replay_bytes
from acmr.config import ConfigError, ExperimentConfig
from acmr.envs import make_env
from acmr.envs.physics import PhysicsWarnings
from acmr.envs.state import ANYTIME, RestorableEnv
from acmr.records import DamagedError
from acmr.run.preparation import Prepared
from acmr.run.run_logs import RunLogs
from acmr.run.trainer import Trainer, make_trainer
from acmr.stateful import State, Stateful
from acmr.storage.checkpoint_store import KEPT, Snapshot
from acmr.storage.run_dir import RunDir
from acmr.storage.state_data import join, split
from acmr.text import one_line, size

#: Logs, settings and whatever is small, in bytes.
_SMALL = 1 << 20
#: Bytes that the arrays of all parts but the learner may take in a checkpoint.
_OTHER_ARRAYS = 256 << 20


class Clock:
    """The seconds that a run has taken, those of earlier processes included."""

    def __init__(self) -> None:
        self._before, self._started = 0.0, time.perf_counter()

    @property
    def seconds(self) -> float:
        """How long the run has taken so far."""
        return self._before + time.perf_counter() - self._started

    def start(self) -> None:
        """Counts the seconds of this process from now on."""
        # Not from its making on: what a process needs until its first step is no time of training.
        self._started = time.perf_counter()

    def state_dict(self) -> State:
        """The seconds so far."""
        return {"seconds": self.seconds}

    def load_state_dict(self, state: State) -> None:
        """Counts on from there."""
        self._before = float(state["seconds"])


@dataclass
class RunState:
    """The parts of a run.

    Attributes:
        trainer: With its agent, random streams and the sums of the current episode.
        environment: What the trainer steps, without the counter around it.
        warnings: That counter: what MuJoCo has warned of.
        replay: The trainer's replay buffer, with its files.
        logs: The run's own CSV files.
        clock: How long it takes.
    """

    trainer: Trainer
    environment: RestorableEnv
    warnings: PhysicsWarnings
    replay: ReplayFiles
    logs: RunLogs
    clock: Clock = field(default_factory=Clock)

    def parts(self) -> dict[str, Stateful]:
        """Everything that the rest of the run depends on, by its name in a checkpoint, in the order of restoring."""
        return {
            "trainer": self.trainer,
            "episode": self.trainer.episode,
            "streams": self.trainer.streams,
            "agent": self.trainer.agent,
            "environment": self.environment,
            "warnings": self.warnings,
            "replay": self.replay,
            "clock": self.clock,
            # Last, since restoring cuts the CSV files back: what is found to be damaged before has changed nothing.
            "logs": self.logs,
        }

    def capture(self) -> Snapshot:
        """Captures the state, and waits until the files that belong to it are on the disk.

        Raises:
            TypeError: If a part's state is not made as :data:`acmr.stateful.State` says.
        """
        return Snapshot(*split({name: part.state_dict() for name, part in self.parts().items()}))

    def restore(self, snapshot: Snapshot) -> None:
        """Puts a state into the parts.

        Raises:
            DamagedError: If it is not the state of such a run.
        """
        parts = self.parts()
        # Whatever a part makes of numbers that are not its own: somebody else's file must not end in a traceback.
        try:
            state = join(snapshot.values, snapshot.arrays)
            if state.keys() != parts.keys():
                raise ValueError(f"other parts: {', '.join(sorted(state.keys() ^ parts.keys()))}")
            for name, part in parts.items():
                part.load_state_dict(state[name])
        except ConfigError:
            # The environment failed at its first reset, and says so itself; the checkpoint is not to blame.
            raise
        except (KeyError, ValueError, TypeError, IndexError, AttributeError, RuntimeError, OverflowError) as error:
            raise DamagedError(f"not the state of this run ({one_line(error)})") from error


def make_state(prepared: Prepared, run_dir: RunDir) -> RunState:
    """Makes the parts of a run as they are before its first step; touches no disk."""
    made = make_env(prepared.spec.config.env, wrappers=prepared.wrapper_states)
    env = RestorableEnv(made, whole=prepared.resume_check.when == ANYTIME)
    logs = RunLogs(run_dir, prepared.about)
    warnings = PhysicsWarnings(env)
    trainer = make_trainer(prepared, warnings, logs)
    return RunState(trainer, env, warnings, ReplayFiles(run_dir.checkpoint_folder, trainer.buffer), logs)


def arrays_bytes(networks: Networks) -> int:
    """At most this much do the arrays of one checkpoint take: weights, targets, two moments each, and the rest.

    A checkpoint whose arrays are larger is not read, so that somebody else's cannot fill the memory.
    """
    return 5 * 4 * networks.architecture.parameter_count + _OTHER_ARRAYS


def space_needed(config: ExperimentConfig, networks: Networks) -> int:
    """Bytes that a run takes on the disk while it goes on."""
    weights = 4 * networks.architecture.parameter_count
    if config.checkpoint_every == 0:
        return weights + _SMALL
    dims, agent = networks.dims, config.agent
    replay = replay_bytes(agent.buffer_size, config.most_steps, dims.observation, dims.action)
    # One checkpoint more while the oldest is still there; each holds weights, most of their targets, two moments.
    return replay + (KEPT + 1) * 4 * weights + _SMALL


def check_space(config: ExperimentConfig, networks: Networks, run_dir: Path, checkpoint_folder: Path) -> None:
    """Refuses a run that its disk cannot take.

    Raises:
        ConfigError: With what it needs and what there is.
    """
    try:
        place = next((folder for folder in (run_dir, *run_dir.absolute().parents) if folder.is_dir()), Path("/"))
    except OSError as error:
        raise ConfigError(f"{run_dir}: cannot be made ({error.strerror}); type another output_dir=FOLDER") from error
    needed = space_needed(config, networks)
    try:
        free = shutil.disk_usage(place).free
    except OSError:
        # Not every file system tells; a run that it does not take ends with a line about that.
        return
    if needed > free + _held(checkpoint_folder):
        raise ConfigError(
            f"{run_dir}: takes up to {size(needed)} while it runs, but its disk has {size(free)} free; free some, "
            "type output_dir=FOLDER on another disk, or checkpoint_every=0 (it cannot be resumed then)"
        )


def _held(folder: Path) -> int:
    total = 0
    # Another process may be at work there, and remove what is looked at.
    with suppress(FileNotFoundError, NotADirectoryError):
        for path in folder.iterdir():
            with suppress(FileNotFoundError):
                total += path.lstat().st_size
    return total
