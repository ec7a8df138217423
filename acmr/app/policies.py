"""``acmr.load``: the policy of a finished run, or of a teacher, as a function from observations to actions."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box

from acmr.envs import make_env
from acmr.envs.wrappers.memory import give_lasting
from acmr.evaluation.evaluate import load_policy, load_run
from acmr.storage.run_dir import RunDir
from acmr.transfer.description import TeacherDescription
from acmr.transfer.teacher import Teacher

#: Of a description: what is known of the training where there is no summary.
_OF_TRAINING = ("environment", "seed", "profile", "global_step", "final_return")


class Spaces(NamedTuple):
    """What the policy sees, and what it does: each a Box of one dimension."""

    observation: Box
    action: Box


class Names(NamedTuple):
    """A name for every number of an observation and of an action."""

    observations: tuple[str, ...]
    actions: tuple[str, ...]


class Policy:
    """A policy that acts as it did when its training ended, or as its mean has it.

    Args:
        path: Where it was loaded from.
        teacher: Its networks.

    Attributes:
        spaces: ``.observation`` and ``.action``, Boxes of one dimension.
        names: ``.observations`` and ``.actions``.
        summary: What the run's ``summary.json`` says; of a teacher alone, what is known of its training.
        description: What ``teacher.json`` says.
    """

    def __init__(self, path: Path, teacher: Teacher) -> None:
        self._path = path
        self._actor = teacher.build_networks().actor.eval()
        about = teacher.description
        self.description: TeacherDescription = about
        seen = Box(-np.inf, np.inf, (len(about.observation_names),), np.float32)
        low, high = (np.asarray(bound, np.float32) for bound in (about.action_low, about.action_high))
        self.spaces = Spaces(seen, Box(low, high, dtype=np.float32))
        self.names = Names(tuple(about.observation_names), tuple(about.action_names))
        said = RunDir(path).summary() if path.is_dir() else None
        self.summary: dict[str, Any] = said or {name: getattr(about, name) for name in _OF_TRAINING}

    def __call__(self, observation: np.ndarray, noise: np.random.Generator | None = None) -> np.ndarray:
        """The action for an observation, or one for each of several.

        Args:
            observation: (observation,) or (many, observation), in the order of ``names.observations``.
            noise: Where the draws of a sampled action come from; None: the action that the policy takes on average.

        Returns:
            (action,) or (many, action), float32, within ``spaces.action``.

        Raises:
            ValueError: If the observation has another number of numbers.
        """
        given = np.asarray(observation, np.float32)
        wanted = len(self.names.observations)
        if given.ndim not in (1, 2) or given.shape[-1] != wanted:
            raise ValueError(f"an observation of shape {given.shape}: ({wanted},) or (many, {wanted}) is needed")
        seen = torch.from_numpy(np.atleast_2d(given))
        with torch.no_grad():
            if noise is None:
                action = self._actor.mode(seen)
            else:
                draws = noise.standard_normal((len(seen), len(self.names.actions)), np.float32)
                action = self._actor.sample(seen, torch.from_numpy(draws))[0]
        found: np.ndarray = action.numpy()
        return found if given.ndim == 2 else found[0]

    def environment(self, trust: bool = False) -> gym.Env[np.ndarray, np.ndarray]:
        """A new copy of the environment that it learned in, with the sensors, actuators and wrappers that it knows.

        Running statistics of its wrappers are those of the end of the training, and stay so.

        Args:
            trust: Whether the run's own files may choose code to run (docs/security.md).

        Raises:
            ConfigError: If it cannot be made, or would run code that only these files choose.
        """
        teacher, config = load_run(self._path, trust)
        env = make_env(config)
        # As in an evaluation: what was seen in training is what the policy's numbers are relative to.
        give_lasting(env, teacher.wrapper_states(), settled=True)
        return env

    def __repr__(self) -> str:
        return (
            f"Policy({str(self._path)!r}: {len(self.names.observations)} sensors, {len(self.names.actions)} actuators)"
        )


def load(path: str | Path) -> Policy:
    """The policy of a finished run, by its directory; or of a teacher, by its folder or its ``.safetensors`` file.

    Raises:
        ConfigError: If there is none, if the run is not finished, or if a file is damaged.
    """
    return Policy(Path(path), load_policy(Path(path))[0])
