"""The environments an agent can be trained in, made from their settings.

env = make_env(config.env)
description = describe(config.env)
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from acmr.config import ConfigError, EnvConfig
from acmr.envs.construct import cannot_run, construct
from acmr.envs.naming import Probe, probe
from acmr.envs.wrappers import PartialEnv, kept_rows
from acmr.records import VELOCITY_KEY

__all__ = ["EnvDescription", "describe", "make_env"]


@dataclass(frozen=True)
class EnvDescription:
    """What an agent in an environment sees, does and is told.

    Attributes:
        observation_names: One per observation.
        action_names: One per action.
        reward_terms: Keys of ``info`` that begin with ``reward_``: the parts that the reward is made of.
        has_forward_velocity: Whether ``info`` holds ``x_velocity``, in m/s.
        model_hash: SHA-256 (hex) of the compiled MuJoCo model, or of the registration where there is no model.
    """

    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    reward_terms: tuple[str, ...]
    has_forward_velocity: bool
    model_hash: str


def make_env(config: EnvConfig, render_mode: str | None = None) -> gym.Env[np.ndarray, np.ndarray]:
    """Makes an environment with one-dimensional Box spaces and its time limit.

    Observations or actions of several dimensions are flattened. No wrapper checks what is passed to it.

    Args:
        config: The environment's settings.
        render_mode: As in Gymnasium (``rgb_array``, ``human``); None: not rendered.

    Raises:
        ConfigError: With one line that says what is wrong with the settings.
    """
    seen = _try_out(config)[0]
    env = construct(config, render_mode)
    sensors, actuators = _kept(config, seen)
    whole = len(sensors) == len(seen.observation_names) and len(actuators) == len(seen.action_names)
    flat = len(env.observation_space.shape or ()) == 1 and len(env.action_space.shape or ()) == 1
    return env if whole and flat else PartialEnv(env, sensors, actuators)


def describe(config: EnvConfig) -> EnvDescription:
    """Describes an environment, by trying out a throwaway instance of it.

    Raises:
        ConfigError: As :func:`make_env`.
    """
    seen, model_hash = _try_out(config)
    sensors, actuators = _kept(config, seen)
    return EnvDescription(
        observation_names=tuple(seen.observation_names[row] for row in sensors),
        action_names=tuple(seen.action_names[row] for row in actuators),
        reward_terms=tuple(key for key in seen.info_keys if key.startswith("reward_")),
        has_forward_velocity=VELOCITY_KEY in seen.info_keys,
        model_hash=model_hash,
    )


def _try_out(config: EnvConfig) -> tuple[Probe, str]:
    env = construct(config)
    try:
        return probe(env), _hash(env)
    except ConfigError:
        raise
    except Exception as error:
        raise cannot_run(config, error) from error
    finally:
        env.close()


def _kept(config: EnvConfig, seen: Probe) -> tuple[np.ndarray, np.ndarray]:
    sensors = kept_rows(config.drop_sensors, seen.observation_names, key="drop_sensors", environment=config.name)
    actuators = kept_rows(config.drop_actuators, seen.action_names, key="drop_actuators", environment=config.name)
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
    place = entry if isinstance(entry, str) else f"{entry.__module__}:{entry.__qualname__}"
    registration = {"id": spec.id, "entry_point": place, "kwargs": spec.kwargs}
    return hashlib.sha256(json.dumps(registration, default=str, sort_keys=True).encode()).hexdigest()
