"""Makes and describes the environments that agents are trained in, from their settings.

env = make_env(config.env)
description = describe(config.env)
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.spaces import Box

from acmr.config import ConfigError, EnvConfig
from acmr.envs.construct import cannot_run, construct
from acmr.envs.conversion import ConvertedEnv, FaultyEnvironmentError
from acmr.envs.naming import part_names, probe
from acmr.envs.state import ResumeCheck, time_limits, try_resume
from acmr.envs.wrappers.carried import carried_names, normalized_names
from acmr.envs.wrappers.memory import give_lasting
from acmr.envs.wrappers.partial import PartialEnv, kept_rows
from acmr.records import REWARD_PREFIX, VELOCITY_KEY
from acmr.stateful import State

__all__ = ["EnvDescription", "check_resume", "describe", "make_env"]


@dataclass(frozen=True)
class EnvDescription:
    """What an agent in an environment sees, does and is told.

    Attributes:
        observation_names: One per observation.
        action_names: One per action.
        action_low: Least value of each action.
        action_high: Greatest value of each action.
        max_episode_steps: Steps an episode may take; None: no time limit is known.
        bodies: Names of the MuJoCo bodies without the world; empty where there is no MuJoCo model.
        reward_terms: Keys of ``info`` that begin with ``reward_``: the parts that the reward is made of.
        has_forward_velocity: Whether ``info`` holds ``x_velocity``, in m/s.
        model_hash: SHA-256 (hex) of the compiled MuJoCo model, or of the registration where there is no model.
        parts: What the observation is made of, as in ``Dict``, where it is not one array; else None.
        normalized: Names of what each chosen wrapper normalizes by running statistics, by the wrapper's name.
    """

    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    max_episode_steps: int | None
    bodies: tuple[str, ...]
    reward_terms: tuple[str, ...]
    has_forward_velocity: bool
    model_hash: str
    parts: str | None = None
    normalized: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def remarks(self, name: str) -> list[str]:
        """What somebody who trains in it should know at once, in lines.

        Args:
            name: What to call the environment.
        """
        lines = []
        if self.parts is not None:
            names = self.observation_names
            shown = ", ".join(names if len(names) <= 6 else [*names[:3], "...", *names[-2:]])
            lines.append(f"observations of {name}: a {self.parts}, laid side by side as {len(names)} numbers: {shown}")
        if self.max_episode_steps is None:
            lines.append(
                f"warning: {name} has no time limit: an episode lasts until it ends by itself, and only episodes that "
                "end are recorded; type env.max_episode_steps=1000 to set one"
            )
        return lines


#: What was seen of environments with all their sensors and actuators, by the settings that they were made from.
_tried_out: dict[str, EnvDescription] = {}


def make_env(
    config: EnvConfig, render_mode: str | None = None, wrappers: State | None = None
) -> gym.Env[np.ndarray, np.ndarray]:
    """Makes an environment with one-dimensional Box spaces and its time limit.

    Observations or actions of several dimensions, and observations that are made of parts, are flattened. What it takes
    and gives is copied, converted and checked (:mod:`acmr.envs.conversion`).

    Args:
        config: The environment's settings.
        render_mode: As in Gymnasium (``rgb_array``, ``human``); None: not rendered.
        wrappers: What the wrappers around it remember already (:mod:`acmr.envs.wrappers.memory`).

    Raises:
        ConfigError: With one line that says what is wrong with the settings.
    """
    env = _with_kept(config, _try_out(config), construct(config, render_mode))
    give_lasting(env, wrappers or {}, settled=False)
    return env


def _with_kept(config: EnvConfig, whole: EnvDescription, env: gym.Env[Any, Any]) -> gym.Env[np.ndarray, np.ndarray]:
    """Flattens an environment and takes from it what the settings drop."""
    sensors, actuators = _kept(config, whole)
    all_kept = len(sensors) == len(whole.observation_names) and len(actuators) == len(whole.action_names)
    flat = len(env.observation_space.shape or ()) == 1 and len(env.action_space.shape or ()) == 1
    return env if all_kept and flat else PartialEnv(env, sensors, actuators)


def describe(config: EnvConfig) -> EnvDescription:
    """Describes an environment; the first time in a process, a throwaway instance is tried out for that.

    Raises:
        ConfigError: As :func:`make_env`.
    """
    whole = _try_out(config)
    sensors, actuators = _kept(config, whole)
    return replace(
        whole,
        observation_names=tuple(whole.observation_names[row] for row in sensors),
        action_names=tuple(whole.action_names[row] for row in actuators),
        action_low=tuple(whole.action_low[row] for row in actuators),
        action_high=tuple(whole.action_high[row] for row in actuators),
    )


def check_resume(config: EnvConfig) -> ResumeCheck:
    """Checks when an environment's state can be stored (:mod:`acmr.envs.state`), with two or three instances of it.

    One of them is also tried out, so that :func:`describe` and :func:`make_env` need not do that afterwards.

    Raises:
        ConfigError: As :func:`make_env`.
    """
    whole, env = _tried(config)
    try:
        return try_resume(lambda: make_env(config), _with_kept(config, whole, env))
    except Exception as error:
        # What was refused says itself what is wrong; anything else is what code of the environment raised.
        if isinstance(error, ConfigError) and not isinstance(error, FaultyEnvironmentError):
            raise
        raise cannot_run(config, error) from error


def _try_out(config: EnvConfig) -> EnvDescription:
    """Describes the environment with all its sensors and actuators."""
    key = _key(config)
    if key not in _tried_out:
        _tried(config)[1].close()
    return _tried_out[key]


def _tried(config: EnvConfig) -> tuple[EnvDescription, ConvertedEnv]:
    """An instance that has been tried out, and what was seen of it."""
    env = construct(config)
    try:
        whole = _tried_out[_key(config)] = _look_at(env, config)
    except Exception as error:
        env.close()
        raise cannot_run(config, error) from error
    return whole, env


def _key(config: EnvConfig) -> str:
    # Not the name, the teacher and what is dropped: none of them changes what is constructed.
    made_from = (config.id, config.kwargs, config.remove_bodies, config.max_episode_steps, config.wrappers)
    return json.dumps(made_from, sort_keys=True, default=repr)


def _look_at(env: ConvertedEnv, config: EnvConfig) -> EnvDescription:
    seen, actions, model = probe(env), env.action_space, getattr(env.unwrapped, "model", None)
    assert isinstance(actions, Box)
    names, normalized = (seen.observation_names, seen.action_names), {}
    if config.wrappers:
        # What the simulation shows is what lies within them.
        bare = _try_out(replace(config, wrappers=[]))
        names = carried_names(env.env, bare.observation_names, bare.action_names)
        normalized = normalized_names(env.env, bare.observation_names)
    return EnvDescription(
        observation_names=names[0],
        action_names=names[1],
        action_low=tuple(actions.low.ravel().tolist()),
        action_high=tuple(actions.high.ravel().tolist()),
        max_episode_steps=min(time_limits(env), default=None),
        bodies=part_names(model).bodies[1:] if isinstance(model, mujoco.MjModel) else (),
        reward_terms=tuple(key for key in seen.info_keys if key.startswith(REWARD_PREFIX)),
        has_forward_velocity=VELOCITY_KEY in seen.info_keys,
        model_hash=_hash(env),
        parts=None if env.observation_names is None else type(env.env.observation_space).__name__,
        normalized=normalized,
    )


def _kept(config: EnvConfig, whole: EnvDescription) -> tuple[np.ndarray, np.ndarray]:
    sensors = kept_rows(config.drop_sensors, whole.observation_names, key="drop_sensors", environment=config.name)
    actuators = kept_rows(config.drop_actuators, whole.action_names, key="drop_actuators", environment=config.name)
    return sensors, actuators


def _hash(env: gym.Env[Any, Any]) -> str:
    model = getattr(env.unwrapped, "model", None)
    if isinstance(model, mujoco.MjModel):
        content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, content)
        return hashlib.sha256(content.tobytes()).hexdigest()
    spec = env.spec
    assert spec is not None
    entry: Any = spec.entry_point
    # Some register a function with arguments, a functools.partial, which has no name of its own.
    named, arguments = getattr(entry, "func", entry), getattr(entry, "keywords", {})
    place = entry if isinstance(entry, str) else f"{named.__module__}:{named.__qualname__}"
    registration = {"id": spec.id, "entry_point": place, "kwargs": {**arguments, **spec.kwargs}}
    return hashlib.sha256(json.dumps(registration, default=str, sort_keys=True).encode()).hexdigest()
