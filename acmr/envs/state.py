"""The state of an environment, captured so that it goes on bit for bit, and a rehearsal that shows whether it does.

After ``mj_step`` the positions of bodies lag behind the joints, and some rewards read them before the next step. So
MuJoCo's own ``mjSTATE_INTEGRATION`` is not enough: every array that lies in ``MjData`` itself is kept beside it.
Contacts and constraint forces are not; each step makes them anew.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.wrappers import TimeLimit

from acmr.envs.physics import PhysicsWarnings
from acmr.envs.wrappers import PartialEnv

ANYTIME, BETWEEN_EPISODES, NEVER = "anytime", "between episodes", "never"
#: Steps of a rehearsal before the state is captured, and after it.
_BEFORE, _AFTER = 25, 25
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION

Env = gym.Env[Any, Any]


@dataclass(frozen=True)
class EnvState:
    """An environment's state: numbers and text as JSON holds them, and arrays."""

    values: dict[str, Any]
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


def capture(env: Env, within_episode: bool) -> EnvState:
    """Copies the state.

    Args:
        env: As :func:`acmr.envs.make_env` makes it.
        within_episode: Whether the episode goes on; otherwise only what outlives a reset is kept.
    """
    bare = env.unwrapped
    values: dict[str, Any] = {"random": bare.np_random.bit_generator.state}
    if not within_episode:
        return EnvState(values)
    values["elapsed_steps"] = [limit._elapsed_steps for limit in _time_limits(env)]
    values["attributes"] = {name: value for name, value in vars(bare).items() if isinstance(value, bool | int | float)}
    arrays = {f"attribute.{name}": value.copy() for name, value in vars(bare).items() if _is_numeric(value)}
    assert isinstance(bare, MujocoEnv)
    integration = np.empty(mujoco.mj_stateSize(bare.model, _INTEGRATION))
    mujoco.mj_getState(bare.model, bare.data, integration, _INTEGRATION)
    arrays["integration"] = integration
    arrays |= {f"data.{name}": getattr(bare.data, name).copy() for name in data_arrays(bare.model)}
    return EnvState(values, arrays)


def restore(env: Env, state: EnvState) -> None:
    """Puts a fresh environment into a captured state. One captured between episodes is to be reset next.

    Raises:
        KeyError: If a part is missing.
        ValueError: If a part does not fit.
    """
    bare = env.unwrapped
    within_episode = "elapsed_steps" in state.values
    if within_episode:
        env.reset()
    bare.np_random.bit_generator.state = state.values["random"]
    if not within_episode:
        return
    for limit, elapsed in zip(_time_limits(env), state.values["elapsed_steps"], strict=True):
        limit._elapsed_steps = elapsed
    for name, value in vars(bare).items():
        if isinstance(value, bool | int | float):
            vars(bare)[name] = state.values["attributes"][name]
        elif _is_numeric(value):
            vars(bare)[name] = _like(value, state.arrays[f"attribute.{name}"]).copy()
    assert isinstance(bare, MujocoEnv)
    mujoco.mj_setState(bare.model, bare.data, state.arrays["integration"], _INTEGRATION)
    for name in data_arrays(bare.model):
        array = getattr(bare.data, name)
        array[...] = _like(array, state.arrays[f"data.{name}"])


def data_arrays(model: mujoco.MjModel) -> list[str]:
    """Names of the arrays that lie in ``MjData`` itself, not in the arena that each step fills anew."""
    data = mujoco.MjData(model)
    arrays = {name: getattr(data, name) for name in dir(data) if not name.startswith("_")}
    # What would lie in the arena has no place yet, so that a copy stands in for it.
    return [
        name
        for name, array in arrays.items()
        if isinstance(array, np.ndarray) and array.size and not array.flags.owndata
    ]


@dataclass(frozen=True)
class ResumeCheck:
    """What was seen of an environment.

    Attributes:
        when: When its state can be captured so that it goes on exactly: ``anytime``, ``between episodes``, ``never``.
        trace: Everything that the environment returned, as bytes.
    """

    when: str
    trace: bytes


def rehearse(make: Callable[[], Env]) -> ResumeCheck:
    """Captures the state of one instance, puts another into it, and compares what both do next.

    Args:
        make: Makes instances.
    """
    first, rng = make(), np.random.default_rng(0)
    space = first.action_space
    assert isinstance(space, gym.spaces.Box)
    actions = rng.uniform(space.low, space.high, (_BEFORE + 2 * _AFTER, *space.low.shape)).astype(np.float32)
    try:
        opening = _play(first, actions[:_BEFORE], reset={"seed": 7})
        within = _is_captured(first, make, actions[_BEFORE:-_AFTER]) if knows_all_parts(first) else (False, b"")
        between = _is_captured_between(first, make, actions[-_AFTER:])
    finally:
        first.close()
    # The state within an episode is of use only where the next episode follows exactly as well.
    when = NEVER if not between[0] else ANYTIME if within[0] else BETWEEN_EPISODES
    return ResumeCheck(when, opening + within[1] + between[1])


def knows_all_parts(env: Env) -> bool:
    """Whether an environment is a MuJoCo robot of Gymnasium's kind within wrappers whose state is known."""
    while isinstance(env, gym.Wrapper):
        if type(env) not in (TimeLimit, PartialEnv, PhysicsWarnings):
            return False
        env = env.env
    return isinstance(env, MujocoEnv)


def _is_captured(env: Env, make: Callable[[], Env], actions: np.ndarray) -> tuple[bool, bytes]:
    state = capture(env, within_episode=True)
    going_on = _play(env, actions)
    return _follows(make, state, actions, None, going_on), going_on


def _is_captured_between(env: Env, make: Callable[[], Env], actions: np.ndarray) -> tuple[bool, bytes]:
    try:
        state = capture(env, within_episode=False)
        going_on = _play(env, actions, reset={})
        return _follows(make, state, actions, {}, going_on), going_on
    except (AttributeError, TypeError, KeyError, ValueError):
        # Its random numbers are not NumPy's: nothing that could be stored.
        return False, b""


def _follows(
    make: Callable[[], Env], state: EnvState, actions: np.ndarray, reset: Mapping[str, Any] | None, expected: bytes
) -> bool:
    second = make()
    try:
        restore(second, state)
        return _play(second, actions, reset) == expected
    finally:
        second.close()


def _like(array: np.ndarray, stored: np.ndarray) -> np.ndarray:
    if (stored.shape, stored.dtype) != (array.shape, array.dtype):
        raise ValueError(f"{stored.shape} {stored.dtype} stored, {array.shape} {array.dtype} expected")
    return stored


def _is_numeric(value: object) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf"


def _play(env: Env, actions: np.ndarray, reset: Mapping[str, Any] | None = None) -> bytes:
    trace: list[bytes] = []
    if reset is not None:
        trace.append(np.asarray(env.reset(**reset)[0]).tobytes())
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        told = [float(value) for _, value in sorted(info.items()) if isinstance(value, int | float | np.number)]
        numbers = np.array([float(reward), terminated, truncated, *told])
        trace += [np.asarray(observation).tobytes(), numbers.tobytes()]
        if terminated or truncated:
            trace.append(np.asarray(env.reset()[0]).tobytes())
    return b"".join(trace)


def _time_limits(env: Env) -> list[TimeLimit]:
    found = []
    while isinstance(env, gym.Wrapper):
        if isinstance(env, TimeLimit):
            found.append(env)
        env = env.env
    return found
