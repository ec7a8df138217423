"""Copies, converts and checks all that an environment is given and gives back, whatever wrote it.

People return lists, arrays of one number, arrays that they overwrite in the next step. Here, and nowhere else, that
becomes what the rest of the program counts on, or an error of one line.
"""

from __future__ import annotations

import os
import sysconfig
import traceback
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from acmr.config import ConfigError
from acmr.envs.spaces import flat_space, flattened, names_of, to_array
from acmr.envs.wrappers.chosen import own_reward
from acmr.records import RAW_REWARD_KEY, REWARD_PREFIX, VELOCITY_KEY
from acmr.text import brief, one_line

#: An error is shown where the environment's own code is: not in wrappers, unless they are its own, ...
_PASSING_ON = (os.path.dirname(gym.__file__), os.path.dirname(__file__))
#: ... and Gymnasium's own environments are some of it ...
_GYMNASIUM_S = os.path.join(os.path.dirname(gym.__file__), "envs", "")
#: ... and not in a library that it calls, unless it is all library.
_LIBRARIES = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
_RETURNS = {
    "reset": "reset(seed=..., options=...) must return (observation, info)",
    "step": "step must return (observation, reward, terminated, truncated, info)",
}


class FaultyEnvironmentError(ConfigError):
    """An environment raised an exception, or gave what cannot be used.

    Attributes:
        reason: What it did, without its name.
    """

    def __init__(self, env_id: str, reason: str) -> None:
        super().__init__(f"env.id={env_id}: {reason}")
        self.reason = reason


class ConvertedEnv(gym.Wrapper[np.ndarray, np.ndarray, Any, Any]):
    """Gives arrays, floats and bools that nobody else holds, and keeps actions within the space's own bounds.

    It remembers nothing from one step to the next, so that a checkpoint needs nothing of it.

    Args:
        env: With any observation space that :func:`acmr.envs.spaces.is_usable` accepts, and a Box of actions.
        env_id: What messages call it.

    Attributes:
        observation_names: One for each number of an observation that is made of parts; None where it is one array.
    """

    def __init__(self, env: gym.Env[Any, Any], env_id: str) -> None:
        super().__init__(env)
        self._env_id = env_id
        given, actions = env.observation_space, env.action_space
        assert isinstance(actions, Box)
        self._low, self._high, self._command = actions.low, actions.high, actions.dtype
        self._declared = given
        box = given if isinstance(given, Box) else flat_space(given)
        self.observation_names = None if isinstance(given, Box) else names_of(given)
        self.observation_space, self._shape, self._dtype = box, box.shape, box.dtype
        self._raw = own_reward(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Resets; returns a copy of the observation, and info as :meth:`step`.

        Raises:
            FaultyEnvironmentError: If the environment raises an exception, or gives what cannot be used.
        """
        try:
            observation, info = self.env.reset(seed=seed, options=options)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise self._raised("reset", error) from error
        return self._observation(observation), self._info(info)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Steps with a copy of the action, rounded to the space's dtype and then clipped to its bounds.

        Returns:
            A copy of the observation in the space's shape and dtype, the reward, whether the episode was terminated
            and truncated, and info; there the terms of the reward and the velocity are floats where they are numbers,
            and are left out where they are not. Where wrappers were chosen, it holds the reward from within them, too.

        Raises:
            FaultyEnvironmentError: As :meth:`reset`.
        """
        # A copy: an environment may keep its action, or change it, before the caller stores what it meant.
        command = np.array(action, self._command)
        # Rounding may carry a saturated policy out of the bounds, and environments check them.
        np.maximum(command, self._low, out=command)
        np.minimum(command, self._high, out=command)
        try:
            observation, reward, terminated, truncated, info = self.env.step(command)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise self._raised("step", error) from error
        info = self._info(info)
        if self._raw is not None:
            info[RAW_REWARD_KEY] = sum(map(self._reward, self._raw.take()))
        return (
            self._observation(observation),
            self._reward(reward),
            self._flag("terminated", terminated),
            self._flag("truncated", truncated),
            info,
        )

    def close(self) -> None:
        """Closes the environment; what that raises is dropped, for nothing of the run depends on it any more."""
        try:
            self.env.close()
        except Exception:
            return

    def fault(self, reason: str) -> FaultyEnvironmentError:
        """An error of this environment."""
        return FaultyEnvironmentError(self._env_id, reason)

    def _observation(self, given: Any) -> np.ndarray:
        # What most environments give takes the short way, which costs a copy and two comparisons.
        if type(given) is np.ndarray and given.dtype == self._dtype and given.shape == self._shape:
            return given.copy()
        try:
            if self.observation_names is None:
                return to_array(given, self._shape, self._dtype, "its observation")
            return flattened(given, self._declared, self._dtype)
        except ValueError as error:
            raise self.fault(str(error)) from error

    def _reward(self, given: Any) -> float:
        value = number(given)
        if value is None:
            raise self.fault(f"its reward is {brief(given)}, but one number is needed")
        return value

    def _flag(self, name: str, given: Any) -> bool:
        if given is True or given is False:
            return given
        value = number(given)
        if value not in (0.0, 1.0):
            raise self.fault(f"its {name} is {brief(given)}, but True or False is needed")
        return bool(value)

    def _info(self, given: Any) -> dict[str, Any]:
        if given is None:
            return {}
        if type(given) is not dict and not isinstance(given, Mapping):
            raise self.fault(f"its info is {brief(given)}, but a dictionary is needed")
        info = dict(given)
        for key, value in given.items():
            # Nearly all are floats already.
            if not isinstance(value, float) and is_kept(key):
                told = number(value)
                if told is None:
                    del info[key]
                else:
                    info[key] = told
        return info

    def _raised(self, method: str, error: BaseException) -> FaultyEnvironmentError:
        place = place_of(error)
        # Where no code of the environment raised it, it was the attempt to take apart what the environment returned.
        where, hint = (f"{place}, in {method}", "") if place else (f"in {method}", f"; {_RETURNS[method]}")
        return self.fault(f"{one_line(error)} ({where}){hint}")


def is_kept(key: object) -> bool:
    """Whether a run records what ``info`` holds under a key: a term of the reward or the forward velocity."""
    return isinstance(key, str) and (key.startswith(REWARD_PREFIX) or key == VELOCITY_KEY)


def number(given: Any) -> float | None:
    """What is one number, also as an array, a list or a tensor of one; None: it is something else."""
    if isinstance(given, float):
        return float(given)
    if isinstance(given, int | np.floating | np.integer):
        try:
            return float(given)
        except OverflowError:
            return None
    if given is None or isinstance(given, str | bytes):
        return None
    try:
        array = np.asarray(given)
    except Exception:
        return None
    return float(array.item()) if array.size == 1 and array.dtype.kind in "biuf" else None


def place_of(error: BaseException) -> str | None:
    """File and line (``cart.py:41``) of the innermost of the environment's own code, or of its library."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _only_passes_on(frame.filename)]
    own = [frame for frame in frames if not frame.filename.startswith(_LIBRARIES)] or frames
    return f"{os.path.basename(own[-1].filename)}:{own[-1].lineno}" if own else None


def _only_passes_on(file: str) -> bool:
    return file.startswith(_PASSING_ON) and not file.startswith(_GYMNASIUM_S)
