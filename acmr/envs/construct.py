"""Constructs a Gymnasium environment from its settings; what cannot be constructed is refused in one line."""

from __future__ import annotations

import contextlib
import copy
import importlib
import inspect
import re
import traceback
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.spaces import Box

from acmr.config import ConfigError, EnvConfig
from acmr.envs.bodies import without_bodies
from acmr.envs.conversion import ConvertedEnv, FaultyEnvironmentError, place_of
from acmr.envs.spaces import is_empty, is_usable
from acmr.envs.wrappers.chosen import wrapped
from acmr.envs.wrappers.partial import near_matches
from acmr.text import brief, one_line, typed_mapping

#: What MuJoCo says of Gymnasium's own model files, and Gymnasium of its own wrappers, of no use to who runs them.
_MODEL_REMARK, _SPACE_REMARK = r"compiler attribute .* is deprecated", r".*precision lowered by casting"
#: What dm_control says where there is no screen, of no use to who trains.
_SCREEN_REMARK = r".*The DISPLAY environment variable is missing"
#: The package of DeepMind's environments, and which one registers them with Gymnasium.
_DM_CONTROL, _SHIMMY = "dm_control", "shimmy"


def find_spec(env_id: str) -> EnvSpec:
    """The registration of a Gymnasium id; ``module:Name-v0`` imports the module first, which registers it.

    Raises:
        ConfigError: If there is none.
    """
    if env_id == "???":
        raise ConfigError("env.id is missing: which Gymnasium environment? Type env.id=Hopper-v5, for instance")
    module, _, name = env_id.rpartition(":")
    if module:
        try:
            with _quiet_models():
                importlib.import_module(module)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise ConfigError(f"env.id={env_id}: cannot import {module}: {one_line(error)}") from error
    spec = gym.registry.get(name)
    if spec is None or _is_stub(spec):
        near = near_matches(name, gym_ids())
        hint = f"; near: {', '.join(near)}" if near else ""
        if name.startswith(f"{_DM_CONTROL}/") and not module:
            hint = f"; type env.id={_SHIMMY}:{name}, once pip install '{_SHIMMY}[dm-control]' is done"
        raise ConfigError(f"env.id={env_id}: Gymnasium knows no such environment{hint}")
    return spec


def gym_ids() -> list[str]:
    """The ids that Gymnasium can make, newest version first."""
    ids = [name for name, spec in gym.registry.items() if not _is_stub(spec)]
    return sorted(ids, key=lambda name: gym.registry[name].version or 0, reverse=True)


def construct(config: EnvConfig, render_mode: str | None = None) -> ConvertedEnv:
    """Builds the environment with its body edited and its time limit, without the checks that slow each step down.

    What it is given and gives back is converted outside of all its wrappers.

    Raises:
        ConfigError: If it cannot be built, or if its spaces are not what an agent here can use.
    """
    spec = copy.copy(find_spec(config.id))
    creator = _creator(spec)
    kwargs = dict(config.kwargs)
    if config.remove_bodies:
        if not (inspect.isclass(creator) and issubclass(creator, MujocoEnv)):
            raise ConfigError(
                f"env.remove_bodies=[{','.join(config.remove_bodies)}]: {config.id} is no MuJoCo environment of "
                "Gymnasium; only these have bodies to remove. Type env.drop_sensors=[...] instead"
            )
        edited: Any = without_bodies(creator, config.remove_bodies)
        spec.entry_point = edited
    if render_mode is not None:
        modes = getattr(creator, "metadata", {}).get("render_modes", [])
        if render_mode not in modes:
            raise ConfigError(f"render_mode={render_mode}: {config.id} offers {', '.join(modes) or 'none'}")
        kwargs["render_mode"] = render_mode
    # Gymnasium would check at every step that there was a reset, and what is passed; the trainer sees to both.
    spec.order_enforce = False
    with _quiet_models():
        try:
            env = gym.make(spec, max_episode_steps=config.max_episode_steps, disable_env_checker=True, **kwargs)
        except ConfigError:
            raise
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise ConfigError(_reason(config, creator, error)) from error
        try:
            env = wrapped(env, config.wrappers)
        except ConfigError:
            env.close()
            raise
    _check_spaces(config.id, env)
    return ConvertedEnv(env, config.id)


def cannot_run(config: EnvConfig, error: BaseException) -> ConfigError:
    """The error of an environment that was built but cannot be reset or stepped."""
    given = [f"env.id={config.id}"]
    if config.kwargs:
        given.append(f"env.kwargs={config.kwargs}")
    if config.remove_bodies:
        given.append(f"env.remove_bodies=[{','.join(config.remove_bodies)}]")
    if config.wrappers:
        given.append(f"env.wrappers=[{','.join(map(typed_mapping, config.wrappers))}]")
    # What a missing body, site or joint looks like in the environment's own code.
    needed = config.remove_bodies and isinstance(error.__cause__ or error, LookupError)
    why = "its own code needs a part that is gone" if needed else "this environment cannot run"
    place = place_of(error)
    raised = f"{one_line(error)} ({place})" if place else one_line(error)
    reason = error.reason if isinstance(error, FaultyEnvironmentError) else raised
    return ConfigError(f"{' '.join(given)}: {why}: {reason}")


@contextlib.contextmanager
def _quiet_models() -> Iterator[None]:
    """Silences remarks about model files, which MuJoCo prints and also writes to a file in the working directory."""

    def relay(message: str) -> None:
        if not re.match(_MODEL_REMARK, message):
            warnings.warn(message, stacklevel=2)

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(relay)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", _MODEL_REMARK)
            warnings.filterwarnings("ignore", _SCREEN_REMARK)
            warnings.filterwarnings("ignore", _SPACE_REMARK)
            yield
    finally:
        mujoco.set_mju_user_warning(before)


def _creator(spec: EnvSpec) -> Any:
    if not isinstance(spec.entry_point, str):
        return spec.entry_point
    try:
        return load_env_creator(spec.entry_point)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise ConfigError(f"env.id={spec.id}: {one_line(error)}") from error


def _is_stub(spec: EnvSpec) -> bool:
    """Whether an id only exists to say where its environment went (the v2 and v3 ones)."""
    return inspect.isfunction(spec.entry_point) and spec.entry_point.__name__.startswith("_raise")


def _reason(config: EnvConfig, creator: Any, error: BaseException) -> str:
    unknown = re.search(r"(?:unexpected keyword|multiple values for(?: keyword)?) argument '(\w+)'", str(error))
    if unknown and unknown[1] in config.kwargs:
        allowed = [
            name
            for name, parameter in inspect.signature(creator).parameters.items()
            if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
        ]
        return f"env.kwargs.{unknown[1]}: {config.id} has no such argument; it has {', '.join(allowed) or 'none'}"
    if _is_mujoco_too_new(error):
        return (
            f"env.id={config.id}: {_DM_CONTROL} does not run with MuJoCo {mujoco.__version__}, which lacks what it "
            f"needs ({one_line(error)}); it does with MuJoCo 3: pip install 'mujoco<4', in an environment of its "
            "own (pip says then that acmr wants MuJoCo 4)"
        )
    return str(cannot_run(config, error))


def _is_mujoco_too_new(error: BaseException) -> bool:
    """Whether dm_control looked for a field of MuJoCo's model or data that MuJoCo 4 has no more."""
    frames = traceback.walk_tb(error.__traceback__)
    within = any(str(frame.f_globals.get("__name__")).split(".")[0] == _DM_CONTROL for frame, _ in frames)
    return within and isinstance(error, AttributeError) and re.search(r"\bMj(Model|Data)\b", str(error)) is not None


def _check_spaces(env_id: str, env: gym.Env[Any, Any]) -> None:
    for name in ("observation_space", "action_space"):
        space = getattr(env, name, None)
        if not isinstance(space, gym.Space):
            what = "nothing" if space is None else brief(space)
            raise ConfigError(
                f"env.id={env_id}: its {name} is {what}, but one of gymnasium.spaces is needed; set self.{name} in its "
                "__init__, as in gymnasium.spaces.Box(-1.0, 1.0, (3,))"
            )
        if is_usable(space) and is_empty(space):
            raise ConfigError(f"env.id={env_id}: its {name} {space} holds no numbers; one at least is needed")
    if not is_usable(env.observation_space):
        raise ConfigError(
            f"env.id={env_id}: its observations are a {type(env.observation_space).__name__} space that is no fixed "
            "number of numbers; Box, Discrete, MultiBinary and MultiDiscrete can be used, and Dict and Tuple of these"
        )
    action = env.action_space
    if not isinstance(action, Box):
        raise ConfigError(
            f"env.id={env_id}: its actions are a {type(action).__name__} space, but only Box spaces "
            "(arrays of numbers) can be used"
        )
    if not np.issubdtype(action.dtype, np.floating):
        raise ConfigError(f"env.id={env_id}: its actions are {action.dtype}, but only continuous actions can be used")
    if not (np.isfinite(action.low).all() and np.isfinite(action.high).all() and (action.low < action.high).all()):
        raise ConfigError(
            f"env.id={env_id}: its actions range from {action.low.min():g} to {action.high.max():g}, but each needs a "
            "finite least and a greater most value"
        )
    # The policy's numbers are float32: there a range of all finite numbers is infinite, and 1e6 to 1e6 + 0.01 is one.
    with np.errstate(over="ignore"):
        low, high = action.low.astype(np.float32), action.high.astype(np.float32)
        usable = np.isfinite(high - low) & ((high - low) / 2 > 0)
    if not usable.all():
        low_given, high_given = (float(ends[~usable].flat[0]) for ends in (action.low, action.high))
        raise ConfigError(
            f"env.id={env_id}: its actions range from {low_given} to {high_given}, which is too "
            f"{'wide' if high_given - low_given > 1 else 'narrow'} for the policy's float32; scale them, as "
            "gymnasium.wrappers.RescaleAction does"
        )
