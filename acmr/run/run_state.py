"""Everything that the rest of a run depends on, taken from its parts and put back into them.

``tests/test_resume_fields.py`` leaves out each entry in turn and expects another run.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from acmr.agent.replay_files import BufferFiles
from acmr.envs.state import EnvState, capture, restore
from acmr.records import DamagedError
from acmr.run.run_logs import RunLogs
from acmr.run.trainer import Trainer
from acmr.storage.checkpoint_store import Snapshot
from acmr.storage.durable import FileDigest
from acmr.text import one_line

#: What :class:`acmr.records.EpisodeInProgress` sums up.
_EPISODE = ("length", "total", "distance", "sums")
#: Parts of :meth:`acmr.agent.sac.SAC.state_dict` that are plain numbers.
_LEARNER_VALUES = ("metric_sums", "metric_counts")
_AGENT, _ENVIRONMENT, _OBSERVATION = "agent/", "environment/", "observation"


@dataclass
class RunState:
    """The parts of a run that have a state.

    Attributes:
        trainer: With the agent, the buffer, the random streams and the environment.
        warnings: What MuJoCo has warned of.
        seconds_before: How long the run had taken when this process took it up.
    """

    trainer: Trainer
    warnings: Counter[str]
    logs: RunLogs
    files: BufferFiles
    seconds_before: float = 0.0
    _started: float = field(default_factory=time.perf_counter)

    @property
    def seconds(self) -> float:
        """How long the run has taken so far."""
        return self.seconds_before + time.perf_counter() - self._started

    def start_clock(self) -> None:
        """Counts the seconds of this process from now on."""
        self._started = time.perf_counter()

    def capture(self) -> Snapshot:
        """Copies the state, and waits until the files that belong to it are on the disk."""
        trainer = self.trainer
        agent, streams, observation = trainer.agent.state_dict(), trainer.streams, trainer.observation
        environment = capture(trainer.env, within_episode=observation is not None)
        arrays = {f"{_AGENT}{name}": tensor.cpu().numpy() for name, tensor in agent["tensors"].items()}
        arrays |= {f"{_AGENT}random/{name}": state.numpy() for name, state in agent["generators"].items()}
        arrays |= {f"{_ENVIRONMENT}{name}": array for name, array in environment.arrays.items()}
        if observation is not None:
            arrays[_OBSERVATION] = np.array(observation)
        values = {
            "global_step": trainer.global_step,
            "learner": {name: agent[name] for name in _LEARNER_VALUES},
            "replay": streams.replay.bit_generator.state,
            "exploration": streams.exploration.bit_generator.state,
            "added": trainer.buffer.added,
            "ended": trainer.buffer.ended,
            "episode": {name: getattr(trainer.episode, name) for name in _EPISODE},
            "environment": environment.values,
            "warnings": dict(self.warnings),
            "logs": {name: [mark.size, mark.sha256] for name, mark in self.logs.marks().items()},
            "wall_seconds": self.seconds,
        }
        return Snapshot(values, arrays, self.files.extend())

    def restore(self, snapshot: Snapshot) -> None:
        """Puts a state into the parts.

        Raises:
            DamagedError: If it is not the state of such a run.
        """
        try:
            self._restore(snapshot.values, snapshot)
        except (KeyError, ValueError, TypeError, IndexError, AttributeError, RuntimeError, OverflowError) as error:
            raise DamagedError(f"not the state of this run ({one_line(error)})") from error

    def _restore(self, values: dict[str, Any], snapshot: Snapshot) -> None:
        trainer, arrays = self.trainer, snapshot.arrays
        trainer.global_step = int(values["global_step"])
        trainer.observation = arrays.get(_OBSERVATION)
        if trainer.observation is not None and trainer.observation.shape != trainer.env.observation_space.shape:
            raise ValueError(f"an observation of shape {trainer.observation.shape}")
        self.files.load(snapshot.files, values["added"], values["ended"], trainer.observation)
        trainer.agent.load_state_dict(_agent_state(arrays, values["learner"]))
        trainer.streams.replay.bit_generator.state = values["replay"]
        trainer.streams.exploration.bit_generator.state = values["exploration"]
        for name in _EPISODE:
            setattr(trainer.episode, name, values["episode"][name])
        restore(trainer.env, EnvState(values["environment"], _part(arrays, _ENVIRONMENT)))
        self.warnings.clear()
        self.warnings.update(values["warnings"])
        self.seconds_before = float(values["wall_seconds"])
        # Last, since it cuts the files back.
        self.logs.go_on({name: FileDigest(count, sha256) for name, (count, sha256) in values["logs"].items()})


def _agent_state(arrays: dict[str, np.ndarray], values: dict[str, Any]) -> dict[str, Any]:
    parts = {name: torch.from_numpy(array.copy()) for name, array in _part(arrays, _AGENT).items()}
    generators = {name.removeprefix("random/"): parts.pop(name) for name in list(parts) if name.startswith("random/")}
    return {"tensors": parts, "generators": generators, **{name: values[name] for name in _LEARNER_VALUES}}


def _part(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
