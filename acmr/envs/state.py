"""Captures and restores the state of an environment so that it goes on bit for bit, and checks whether it does.

A Gymnasium environment is a robot within wrappers, here called its layers. A layer with ``state_dict`` and
``load_state_dict`` speaks for itself; Gymnasium's own have neither, so what is known of them is written here.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.wrappers import TimeLimit

from acmr.envs.conversion import ConvertedEnv, number
from acmr.envs.wrappers.chosen import OwnReward
from acmr.envs.wrappers.memory import has_memory, remember, remembered
from acmr.envs.wrappers.partial import PartialEnv
from acmr.stateful import State, Stateful

ANYTIME, BETWEEN_EPISODES, NEVER = "anytime", "between episodes", "never"
#: Steps of a check before the state is captured, and after it.
_BEFORE, _AFTER = 25, 25
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
#: Wrappers that remember nothing from one step to the next.
_STATELESS = (PartialEnv, OwnReward)

Env = gym.Env[Any, Any]


class RestorableEnv(gym.Wrapper[Any, Any, Any, Any]):
    """An environment with a state.

    Args:
        env: As :func:`acmr.envs.make_env` makes it.
        whole: Whether its state is good at any step; otherwise between two episodes only.
    """

    def __init__(self, env: Env, whole: bool) -> None:
        super().__init__(env)
        self._whole = whole

    def state_dict(self) -> State:
        """Its state; if that is not whole, then only what outlives the reset that comes next."""
        return capture(self.env, self._whole)

    def load_state_dict(self, state: State) -> None:
        """Goes on from there; between two episodes it is to be reset next."""
        restore(self.env, state)


def capture(env: Env, whole: bool) -> State:
    """The state of an environment.

    Args:
        env: As :func:`acmr.envs.make_env` makes it.
        whole: Whether to capture all of its layers, so that it can go on within an episode; otherwise only what is
            known to outlive a reset, which has to come next. A whole state serves between two episodes, too: a robot
            may hold numbers that no reset takes back.
    """
    layers, bare = _layers(env), env.unwrapped
    state: State = {"random": bare.np_random.bit_generator.state}
    # Either way: only the layer itself knows what of it outlives a reset.
    state["layers"] = {name: layer.state_dict() for name, layer in layers.items() if isinstance(layer, Stateful)}
    state["layers"] |= {name: remembered(layer) for name, layer in layers.items() if _is_gymnasium_s(layer)}
    if whole:
        state["elapsed_steps"] = {name: limit._elapsed_steps for name, limit in _time_limits(layers)}
        if isinstance(bare, MujocoEnv):
            state["robot"] = _capture_robot(bare)
    return state


def restore(env: Env, state: State) -> None:
    """Puts a fresh environment into a captured state.

    Raises:
        KeyError: If a part is missing.
        ValueError: If a part does not fit.
    """
    layers, bare, whole = _layers(env), env.unwrapped, "elapsed_steps" in state
    if whole:
        # Layers make some of their variables in their first reset; what it sets is overwritten below.
        env.reset()
    bare.np_random.bit_generator.state = state["random"]
    for name, layer in layers.items():
        if isinstance(layer, Stateful):
            layer.load_state_dict(state["layers"][name])
        elif _is_gymnasium_s(layer):
            remember(layer, state["layers"][name])
    if whole:
        for name, limit in _time_limits(layers):
            limit._elapsed_steps = state["elapsed_steps"][name]
        if isinstance(bare, MujocoEnv):
            _restore_robot(bare, state["robot"])


def time_limits(env: Env) -> list[int]:
    """Steps after which the time limits around an environment end an episode, its own wrappers' included."""
    return [limit._max_episode_steps for _, limit in _time_limits(_layers(env))]


def _layers(env: Env) -> dict[str, Env]:
    """The wrappers from the outermost, then the environment itself, each under a name of its own."""
    found = [env]
    while isinstance(found[-1], gym.Wrapper):
        found.append(found[-1].env)
    # The conversion has no state; counting it would rename all that lies within.
    found = [layer for layer in found if not isinstance(layer, ConvertedEnv)]
    return {f"{depth}_{type(layer).__name__}": layer for depth, layer in enumerate(found)}


def _is_gymnasium_s(layer: Env) -> bool:
    return has_memory(layer) and not isinstance(layer, Stateful)


def _time_limits(layers: Mapping[str, Env]) -> list[tuple[str, TimeLimit]]:
    return [(name, layer) for name, layer in layers.items() if isinstance(layer, TimeLimit)]


def _capture_robot(robot: MujocoEnv) -> State:
    """The state of a MuJoCo robot: its own numbers, and the simulation's.

    After ``mj_step`` the positions of bodies lag behind the joints, and some rewards read them before the next step.
    So MuJoCo's own ``mjSTATE_INTEGRATION`` is not enough: it gives the right observations and, at the first step, wrong
    rewards. Nor would ``mj_forward`` help, since it computes the positions that a run which was never interrupted does
    not have yet. So every array of ``MjData`` itself is kept. Contacts and constraint forces, which lie in its arena,
    are not: each step makes them anew.
    """
    integration = np.empty(mujoco.mj_stateSize(robot.model, _INTEGRATION))
    mujoco.mj_getState(robot.model, robot.data, integration, _INTEGRATION)
    return {
        "numbers": {name: value for name, value in vars(robot).items() if type(value) in (bool, int, float)},
        "arrays": {name: np.array(value) for name, value in vars(robot).items() if _is_numeric(value)},
        "integration": integration,
        "data": {name: getattr(robot.data, name).copy() for name in data_arrays(robot.model)},
    }


def _restore_robot(robot: MujocoEnv, state: State) -> None:
    for name, value in vars(robot).items():
        if type(value) in (bool, int, float):
            vars(robot)[name] = state["numbers"][name]
        elif _is_numeric(value):
            stored = _like(value, state["arrays"][name])
            # A NumPy number must not come back as an array, nor as Python's: they round differently beside float32.
            vars(robot)[name] = stored[()] if isinstance(value, np.generic) else stored
    mujoco.mj_setState(robot.model, robot.data, state["integration"], _INTEGRATION)
    # After it, since it sets some of these arrays as well.
    for name in data_arrays(robot.model):
        array = getattr(robot.data, name)
        array[...] = _like(array, state["data"][name])


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


def try_resume(make: Callable[[], Env], first: Env | None = None) -> ResumeCheck:
    """Captures the state of one instance, puts another into it, and compares what both do next.

    Args:
        make: Makes instances. Each state goes into a new one, as that of a resumed run does: what an environment makes
            in its first step would be there already in one that has been played with.
        first: The instance whose states are captured; it may have been used, and is closed. None: a new one.
    """
    first, rng = first or make(), np.random.default_rng(0)
    space = first.action_space
    assert isinstance(space, gym.spaces.Box)
    actions = rng.uniform(space.low, space.high, (_BEFORE + 2 * _AFTER, *space.low.shape)).astype(np.float32)
    try:
        opening = _play(first, actions[:_BEFORE], reset={"seed": 7})
        # What does not draw with NumPy has no state of its random numbers that could be stored.
        if not isinstance(first.unwrapped.np_random, np.random.Generator):
            return ResumeCheck(NEVER, opening)
        rest = actions[_BEFORE:]
        if knows_all_layers(first):
            # The next episode belongs to it: a state within this one is of use only where that follows exactly as well.
            same, trace = _goes_on(first, make, rest, whole=True)
            if same:
                return ResumeCheck(ANYTIME, opening + trace)
        same, trace = _goes_on(first, make, rest, whole=False)
        return ResumeCheck(BETWEEN_EPISODES if same else NEVER, opening + trace)
    finally:
        first.close()


def knows_all_layers(env: Env) -> bool:
    """Whether the state of every layer can be captured at any step."""
    *wrappers, bare = _layers(env).values()
    known = all(
        isinstance(layer, Stateful) or _is_gymnasium_s(layer) or type(layer) in (TimeLimit, *_STATELESS)
        for layer in wrappers
    )
    return known and isinstance(bare, MujocoEnv | Stateful)


def _goes_on(env: Env, make: Callable[[], Env], actions: np.ndarray, *, whole: bool) -> tuple[bool, bytes]:
    """Whether a second instance does the same from here on, and what it should do.

    With its whole state it goes on within the episode and into the next one, otherwise it begins with two new ones.
    """
    # A copy, as a file would hold it: a state may share memory with the environment that goes on first.
    state = copy.deepcopy(capture(env, whole))
    expected = _play_on(env, actions, whole)
    second = make()
    try:
        restore(second, state)
        return _play_on(second, actions, whole) == expected, expected
    except (KeyError, ValueError, TypeError):
        # What does not fit into a new instance: an array that grows with the steps, a number that was none at first.
        return False, expected
    finally:
        second.close()


def _play_on(env: Env, actions: np.ndarray, in_episode: bool) -> bytes:
    """What the environment returns to half of the actions in this episode, and to the others in the next one."""
    return _play(env, actions[:_AFTER], None if in_episode else {}) + _play(env, actions[_AFTER:], {})


def _like(array: np.ndarray | np.generic, stored: np.ndarray) -> np.ndarray:
    if (stored.shape, stored.dtype) != (array.shape, array.dtype):
        raise ValueError(f"{stored.shape} {stored.dtype} stored, {array.shape} {array.dtype} expected")
    return stored


def _is_numeric(value: object) -> bool:
    return isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf"


def _play(env: Env, actions: np.ndarray, reset: Mapping[str, Any] | None = None) -> bytes:
    trace: list[bytes] = []
    if reset is not None:
        trace.append(np.asarray(env.reset(**reset)[0]).tobytes())
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        told = [value for key in sorted(info, key=str) if (value := number(info[key])) is not None]
        numbers = np.array([float(reward), terminated, truncated, *told])
        trace += [np.asarray(observation).tobytes(), numbers.tobytes()]
        if terminated or truncated:
            trace.append(np.asarray(env.reset()[0]).tobytes())
    return b"".join(trace)
