"""Puts the wrappers of ``env.wrappers`` around an environment: Gymnasium's own, or the user's."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym

from acmr.config import ConfigError
from acmr.envs.wrappers.partial import near_matches
from acmr.text import brief, one_line, typed_mapping

#: The entry of a wrapper that says which one it is; all others are its arguments.
NAME = "name"
#: What would change what the trainer counts on: it resets the environment itself.
_REFUSED = {"Autoreset": "it resets within an episode, which the training does itself"}


class OwnReward(gym.Wrapper[Any, Any, Any, Any]):
    """Adds up the rewards of the environment within all chosen wrappers, since returns are counted in those.

    A wrapper may scale or clip the reward for the learner, or make several steps in one; the threshold is of the raw
    one. It is empty between two steps, so that a checkpoint needs nothing of it.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._rewards: list[Any] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets, and forgets what has not been taken."""
        self._rewards.clear()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps, and remembers the reward."""
        result = self.env.step(action)
        self._rewards.append(result[1])
        return result

    def take(self) -> list[Any]:
        """The rewards since they were last taken, as the environment gave them."""
        rewards = self._rewards.copy()
        self._rewards.clear()
        return rewards


def wrapped(env: gym.Env[Any, Any], wrappers: Sequence[Mapping[str, Any]]) -> gym.Env[Any, Any]:
    """The environment within wrappers, the first of them innermost.

    Args:
        env: With its body edited and its time limit.
        wrappers: Each with its ``name`` and its arguments, as in ``{name: FrameStackObservation, stack_size: 3}``.

    Raises:
        ConfigError: If one cannot be made; one line says which, and what it takes.
    """
    if not wrappers:
        return env
    env = OwnReward(env)
    for settings in wrappers:
        env = _wrap(env, settings)
    return env


def chosen_layers(env: gym.Env[Any, Any]) -> Iterator[gym.Wrapper[Any, Any, Any, Any]]:
    """The chosen wrappers around an environment, the innermost first."""
    layers = []
    while isinstance(env, gym.Wrapper) and not isinstance(env, OwnReward):
        layers.append(env)
        env = env.env
    if isinstance(env, OwnReward):
        yield from reversed(layers)


def own_reward(env: gym.Env[Any, Any]) -> OwnReward | None:
    """The layer that knows the raw rewards; None where no wrapper was chosen."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, OwnReward):
            return env
        env = env.env
    return None


def _wrap(env: gym.Env[Any, Any], settings: Mapping[str, Any]) -> gym.Env[Any, Any]:
    given, arguments = f"env.wrappers=[{typed_mapping(settings)}]", dict(settings)
    made_by = _find(str(arguments.pop(NAME)), given)
    allowed = [name for name in inspect.signature(made_by).parameters if name not in ("self", "env")]
    if unknown := [name for name in arguments if name not in allowed]:
        takes = f"it takes {', '.join(allowed)}" if allowed else "it takes none"
        raise ConfigError(f"{given}: {settings[NAME]} has no argument {unknown[0]}; {takes}")
    try:
        result = made_by(env, **arguments)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise ConfigError(f"{given}: {one_line(error)}") from error
    return result


def _find(name: str, given: str) -> type[gym.Wrapper[Any, Any, Any, Any]]:
    module, _, own = name.rpartition(":")
    if name in _REFUSED:
        raise ConfigError(f"{given}: {_REFUSED[name]}; leave it out")
    if not module:
        known = _gymnasium_s()
        if name not in known:
            near = near_matches(name, list(known)) or ["FrameStackObservation", "NormalizeObservation"]
            raise ConfigError(
                f"{given}: Gymnasium has no wrapper {name} (near: {', '.join(near)}); one of your own is module:Name"
            )
        return known[name]
    try:
        found = getattr(importlib.import_module(module), own)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise ConfigError(f"{given}: cannot import {name}: {one_line(error)}") from error
    if not (inspect.isclass(found) and issubclass(found, gym.Wrapper)):
        raise ConfigError(f"{given}: {name} is {brief(found)}, but a class derived from gymnasium.Wrapper is needed")
    return found


def _gymnasium_s() -> dict[str, type[gym.Wrapper[Any, Any, Any, Any]]]:
    """Gymnasium's own wrappers by their names; those that need a package which is not installed are left out."""
    # By __all__: some names stand for a module that is imported when they are asked for.
    found: dict[str, type[gym.Wrapper[Any, Any, Any, Any]]] = {}
    for name in gym.wrappers.__all__:
        try:
            entry = getattr(gym.wrappers, name)
        except Exception:
            continue
        if inspect.isclass(entry) and issubclass(entry, gym.Wrapper):
            found[name] = entry
    return found
