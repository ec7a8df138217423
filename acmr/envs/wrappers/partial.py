"""Takes sensors and actuators from an agent while the robot's body stays whole."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from acmr.command import typed
from acmr.config import ConfigError


def kept_rows(wanted: Sequence[int | str], names: Sequence[str], *, key: str, environment: str) -> np.ndarray:
    """Rows that are left when some are dropped.

    Args:
        wanted: What to drop: names, globs (``cinert/*``), or indices, negative ones counting from the end.
        names: The name of each row.
        key: The setting, for messages: ``drop_sensors`` or ``drop_actuators``.
        environment: The environment's name, for messages.

    Returns:
        Indices, ascending, (kept,).

    Raises:
        ConfigError: If an entry matches nothing, or if nothing would be left.
    """
    given = f"env.{key}=[{','.join(map(str, wanted))}]"
    dropped: set[int] = set()
    for entry in wanted:
        rows = _matches(entry, names)
        if not rows:
            raise ConfigError(f"{given}: {_unknown(entry, names)}; {typed('envs')} {environment} lists them all")
        dropped.update(rows)
    if len(dropped) == len(names):
        raise ConfigError(f"{given}: nothing would be left of {environment}'s {len(names)}; drop fewer")
    return np.array([row for row in range(len(names)) if row not in dropped], dtype=np.intp)


class PartialEnv(gym.Wrapper[np.ndarray, np.ndarray, Any, Any]):
    """Shows an agent some rows of the flattened observation and lets it command some rows of the flattened action.

    A dropped actuator is commanded 0, or the middle of its range where that does not hold 0.
    """

    def __init__(self, env: gym.Env[Any, Any], sensors: np.ndarray, actuators: np.ndarray) -> None:
        """Wraps.

        Args:
            env: With Box spaces.
            sensors: Rows of the observation that are kept, (kept,).
            actuators: Rows of the action that are kept, (kept,).
        """
        super().__init__(env)
        seen, commanded = env.observation_space, env.action_space
        assert isinstance(seen, Box)
        assert isinstance(commanded, Box)
        self._sensors, self._actuators, self._shape = sensors, actuators, commanded.shape
        self.observation_space = _rows(seen, sensors)
        self.action_space = _rows(commanded, actuators)
        low, high = commanded.low.ravel(), commanded.high.ravel()
        self._neutral = np.where((low <= 0) & (high >= 0), 0.0, low / 2 + high / 2).astype(commanded.dtype)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Resets; returns the rows that are left, (kept,), and the environment's info."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation.ravel()[self._sensors], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """Steps with commands for the actuators that are left, (kept,)."""
        command = self._neutral.copy()
        command[self._actuators] = action
        observation, reward, terminated, truncated, info = self.env.step(command.reshape(self._shape))
        return observation.ravel()[self._sensors], reward, terminated, truncated, info


def near_matches(given: str, names: Sequence[str], count: int = 3) -> list[str]:
    """Names that look like the one given, best first; a name's last part counts too (``right_knee``)."""
    lowered = {name.lower(): name for name in reversed(names)}
    tails = {name.lower().split("/", 1)[-1]: name for name in reversed(names)}
    whole = [lowered[match] for match in get_close_matches(given.lower(), lowered, count, 0.7)]
    partial = [name for name in names if given.lower() in name.lower()][:count]
    tail = [tails[match] for match in get_close_matches(given.lower(), tails, count, 0.7)]
    return list(dict.fromkeys([*partial, *whole, *tail]))[:count]


def _matches(entry: int | str, names: Sequence[str]) -> list[int]:
    if isinstance(entry, int):
        return [entry % len(names)] if -len(names) <= entry < len(names) else []
    exact = [row for row, name in enumerate(names) if name == entry]
    return exact or [row for row, name in enumerate(names) if fnmatchcase(name, entry)]


def _unknown(entry: int | str, names: Sequence[str]) -> str:
    if isinstance(entry, int):
        return f"index {entry} is not in {-len(names)}..{len(names) - 1}"
    near = near_matches(entry.strip("*"), names)
    hint = f" (near: {', '.join(near)})" if near else f" (there are {', '.join(names[:3])}, ...)"
    return f"nothing is called {entry!r}{hint}"


def _rows(space: Box, rows: np.ndarray) -> Box:
    return Box(space.low.ravel()[rows], space.high.ravel()[rows], dtype=space.dtype.type)
