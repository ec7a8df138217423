"""Removes bodies from MuJoCo robots by name, with everything that hangs on them or names a part of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

from acmr.config import ConfigError
from acmr.envs.naming import part_names
from acmr.text import message


def edited_model(path: str, remove: Sequence[str]) -> mujoco.MjModel:
    """Compiles a model file without some of its bodies.

    What hangs on a removed body goes with it, and so does everything that names a part of it: joints, actuators,
    sensors, tendons, equalities, contact pairs and exclusions, rows of keyframes, cameras and lights that follow it.
    A part without a name is called as in the whole robot (``body_4``), so that a name means the same part in both.

    Args:
        path: The MJCF file.
        remove: Names of bodies.

    Returns:
        The compiled model: not one read back from XML, which keeps only six digits of each number.

    Raises:
        ConfigError: If a body does not exist, or if what is left has no joint or no actuator.
    """
    given = f"env.remove_bodies={_listed(remove)}"
    spec = mujoco.MjSpec.from_file(path)
    _name_parts(spec, _compiled(spec, given))
    existing = [body.name for body in spec.bodies if body.name != "world"]
    for name in remove:
        if name not in existing:
            raise ConfigError(f"{given}: there is no body {name!r}; there are {', '.join(existing)}")
    for name in remove:
        # A body that hung on one removed before is gone already.
        if any(body.name == name for body in spec.bodies):
            spec.delete(spec.body(name))
    left = {body.name for body in spec.bodies}
    for watcher in [*spec.cameras, *spec.lights]:
        if watcher.targetbody and watcher.targetbody not in left:
            spec.delete(watcher)
    if not spec.joints or not spec.actuators:
        what = "joint" if not spec.joints else "actuator"
        raise ConfigError(f"{given}: no {what} would be left to control; keep the main body and a part that moves")
    return _compiled(spec, given)


def without_bodies(base: type[MujocoEnv], remove: Sequence[str]) -> type[MujocoEnv]:
    """A subclass of a Gymnasium MuJoCo environment whose robot lacks some bodies.

    Rewards, termination and observations stay the environment's own code, on the smaller model. The observation space
    is measured, because v4 classes state it as a number.

    Args:
        base: The environment's class.
        remove: Names of bodies.
    """

    def initialize_simulation(self: MujocoEnv) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = edited_model(self.fullpath, remove)
        screen = model.vis.global_
        screen.offwidth = max(screen.offwidth, self.width)
        screen.offheight = max(screen.offheight, self.height)
        return model, mujoco.MjData(model)

    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        base.__init__(self, *args, **kwargs)
        observation = self._get_obs()
        self.observation_space = Box(-np.inf, np.inf, observation.shape, observation.dtype)

    members = {"__init__": init, "_initialize_simulation": initialize_simulation, "__module__": base.__module__}
    return type(base.__name__, (base,), members)


def _name_parts(spec: mujoco.MjSpec, whole: mujoco.MjModel) -> None:
    names = part_names(whole)
    for parts, known in ((spec.bodies, names.bodies), (spec.joints, names.joints), (spec.actuators, names.actuators)):
        for part in parts:
            if not part.name:
                part.name = known[part.id]


def _compiled(spec: mujoco.MjSpec, given: str) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise ConfigError(f"{given}: MuJoCo cannot build this: {message(error)}") from error


def _listed(names: Sequence[str]) -> str:
    return f"[{','.join(names)}]"
