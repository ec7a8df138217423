"""Names every observation and every action of an environment.

The names that an environment has itself are taken; else a name is only given where it is proved: the environment is
stepped, and each observation is compared with the MuJoCo field that it is named after. What does not agree is named by
its index.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from gymnasium.spaces import Box

from acmr.envs.conversion import ConvertedEnv, is_kept
from acmr.envs.spaces import own_names

PROBE_STEPS = 10

#: Where environments have names of their own: this project's word for it, gym-anm's, opfgym's.
_OBSERVATIONS = ("observation_names", "obs_values", "obs_keys")
_ACTIONS = ("action_names", "act_keys")

_AXES = ("x", "y", "z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_SPIN = ("wx", "wy", "wz")
_POSITION_PARTS = {mujoco.mjtJoint.mjJNT_FREE: _AXES + _QUATERNION, mujoco.mjtJoint.mjJNT_BALL: _QUATERNION}
_VELOCITY_PARTS = {mujoco.mjtJoint.mjJNT_FREE: _AXES + _SPIN, mujoco.mjtJoint.mjJNT_BALL: _SPIN}


@dataclass(frozen=True)
class PartNames:
    """Names of a model's parts by id; unnamed ones get a name that no other part has."""

    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    tendons: tuple[str, ...]
    actuators: tuple[str, ...]


@dataclass(frozen=True)
class Probe:
    """What stepping an environment shows.

    Attributes:
        observation_names: One per row of the flattened observation.
        action_names: One per row of the flattened action.
        info_keys: Names of what ``info`` holds and a run records, in order of appearance.
    """

    observation_names: tuple[str, ...]
    action_names: tuple[str, ...]
    info_keys: tuple[str, ...]


@dataclass(frozen=True)
class _Block:
    """Rows of an observation: their names, and how to read them from the simulation."""

    names: tuple[str, ...]
    read: Callable[[mujoco.MjData], np.ndarray]


def part_names(model: mujoco.MjModel) -> PartNames:
    """Names a model's bodies, joints, tendons and actuators.

    An unnamed body is ``body_<id>``, and so on; an unnamed actuator is called after the joint it drives, if it is the
    only one that does.
    """
    joints = _named((model.joint(i).name for i in range(model.njnt)), "joint")
    driven = [
        joints[joint] if transmission == mujoco.mjtTrn.mjTRN_JOINT else ""
        for transmission, joint in zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)
    ]
    own = [model.actuator(i).name for i in range(model.nu)]
    called = [
        name or (joint if driven.count(joint) == 1 and joint not in own else "")
        for name, joint in zip(own, driven, strict=True)
    ]
    return PartNames(
        bodies=_named((model.body(i).name for i in range(model.nbody)), "body"),
        joints=joints,
        tendons=_named((model.tendon(i).name for i in range(model.ntendon)), "tendon"),
        actuators=_named(called, "actuator"),
    )


def probe(env: ConvertedEnv) -> Probe:
    """Steps a throwaway environment with random actions and names what it sees.

    Args:
        env: It is reset and stepped, and not fit for use afterwards.

    Raises:
        FaultyEnvironmentError: If it fails, or gives what is not finite.
    """
    action_space = env.action_space
    assert isinstance(action_space, Box)
    robot: Any = env.unwrapped
    data: Any = getattr(robot, "data", None)
    simulated = isinstance(data, mujoco.MjData) and isinstance(getattr(robot, "model", None), mujoco.MjModel)
    layouts = _layouts(robot) if simulated else []
    observations: list[np.ndarray] = []
    readings: list[list[np.ndarray]] = [[] for _ in layouts]
    obeyed = simulated and action_space.shape == (robot.model.nu,)
    info_keys: dict[str, None] = {}
    rng = np.random.default_rng(0)
    first, _ = env.reset(seed=0)
    if not np.isfinite(first).all():
        raise env.fault("its first observation is not finite")
    for _ in range(PROBE_STEPS):
        # NumPy draws a float where the bounds are arrays without a dimension.
        action = np.asarray(rng.uniform(action_space.low, action_space.high), action_space.dtype)
        observation, reward, terminated, truncated, info = env.step(action)
        if not (np.isfinite(observation).all() and np.isfinite(reward)):
            raise env.fault("its observation or its reward is not finite")
        observations.append(np.ravel(observation))
        for layout, values in zip(layouts, readings, strict=True):
            values.append(_read(layout, data))
        obeyed = obeyed and np.array_equal(data.ctrl, action)
        info_keys.update(dict.fromkeys(filter(is_kept, info)))
        if terminated or truncated:
            env.reset()
    seen = np.stack(observations)
    names = env.observation_names or tuple(f"obs/{row}" for row in range(seen.shape[1]))
    for layout, values in zip(layouts, readings, strict=True):
        if _agrees(layout, np.stack(values), seen):
            names = tuple(name for block in layout for name in block.names)
            break
    count = int(np.prod(action_space.shape))
    actions = part_names(robot.model).actuators if obeyed else tuple(f"action/{row}" for row in range(count))
    # What an environment says of itself goes before what was found out.
    names = own_names(env.env, _OBSERVATIONS, len(names)) or names
    return Probe(names, own_names(env.env, _ACTIONS, count) or actions, tuple(info_keys))


def _layouts(env: Any) -> list[list[_Block]]:
    """The layouts that an environment's observation may have, likeliest first."""
    model = env.model
    layouts = []
    structure = getattr(env, "observation_structure", None)
    if isinstance(structure, dict):
        layouts.append({key: size for key, size in structure.items() if key in _FIELDS})
    contact = {"cfrc_ext": 6 * model.nbody}
    inertia = {"cinert": 10 * model.nbody, "cvel": 6 * model.nbody, "qfrc_actuator": model.nv}
    for skipped in (0, 1, 2):
        motion = {"qpos": model.nq - skipped, "qvel": model.nv}
        layouts += [motion, {**motion, **contact}, {**motion, **inertia, **contact}]
    blocks = [[_field(model, key, size) for key, size in layout.items() if size > 0] for layout in layouts]
    special = _SPECIAL.get(type(env).__name__)
    return blocks if special is None else [*special(model), *blocks]


def _read(layout: Sequence[_Block], data: mujoco.MjData) -> np.ndarray:
    try:
        return np.concatenate([np.ravel(block.read(data)) for block in layout])
    except LookupError:
        # Another robot whose class happens to have the name of one of Gymnasium's.
        return np.empty(0)


def _field(model: mujoco.MjModel, key: str, size: int) -> _Block:
    """The last ``size`` numbers of a field: what environments leave out stands first (world body, root joint)."""
    names = tuple(_FIELDS[key](model))
    return _Block(names[-size:], lambda data: np.ravel(getattr(data, key))[-size:])


def _joint_parts(model: mujoco.MjModel, prefix: str, parts: dict[Any, tuple[str, ...]]) -> list[str]:
    names = []
    for joint, kind in zip(part_names(model).joints, model.jnt_type, strict=True):
        components = parts.get(mujoco.mjtJoint(kind))
        names += [f"{prefix}/{joint}"] if components is None else [f"{prefix}/{joint}/{part}" for part in components]
    return names


def _body_parts(model: mujoco.MjModel, prefix: str, count: int) -> list[str]:
    return [f"{prefix}/{body}/{index}" for body in part_names(model).bodies for index in range(count)]


def _tendons(model: mujoco.MjModel, prefix: str) -> list[str]:
    return [f"{prefix}/{tendon}" for tendon in part_names(model).tendons]


_FIELDS: dict[str, Callable[[mujoco.MjModel], list[str]]] = {
    "qpos": lambda model: _joint_parts(model, "qpos", _POSITION_PARTS),
    "qvel": lambda model: _joint_parts(model, "qvel", _VELOCITY_PARTS),
    "cinert": lambda model: _body_parts(model, "cinert", 10),
    "cvel": lambda model: _body_parts(model, "cvel", 6),
    "qfrc_actuator": lambda model: _joint_parts(model, "qfrc_actuator", _VELOCITY_PARTS),
    "cfrc_ext": lambda model: _body_parts(model, "cfrc_ext", 6),
    "ten_length": lambda model: _tendons(model, "ten_length"),
    "ten_velocity": lambda model: _tendons(model, "ten_velocity"),
}


def _reacher(model: mujoco.MjModel) -> list[list[_Block]]:
    position, velocity = _FIELDS["qpos"](model), _FIELDS["qvel"](model)
    arm = part_names(model).joints[:2]
    blocks = [
        _Block(tuple(f"cos/{joint}" for joint in arm), lambda data: np.cos(data.qpos[:2])),
        _Block(tuple(f"sin/{joint}" for joint in arm), lambda data: np.sin(data.qpos[:2])),
        _Block(tuple(position[2:]), lambda data: data.qpos[2:]),
        _Block(tuple(velocity[:2]), lambda data: data.qvel[:2]),
    ]

    def offset(axes: int) -> _Block:
        names = tuple(f"fingertip-target/{axis}" for axis in _AXES[:axes])
        return _Block(names, lambda data: (data.body("fingertip").xpos - data.body("target").xpos)[:axes])

    return [[*blocks, offset(2)], [*blocks, offset(3)]]


def _pusher(model: mujoco.MjModel) -> list[list[_Block]]:
    def place(body: str) -> _Block:
        return _Block(tuple(f"xpos/{body}/{axis}" for axis in _AXES), lambda data: data.body(body).xpos)

    arm = _Block(tuple(_FIELDS["qpos"](model)[:7]), lambda data: data.qpos[:7])
    speed = _Block(tuple(_FIELDS["qvel"](model)[:7]), lambda data: data.qvel[:7])
    return [[arm, speed, place("tips_arm"), place("object"), place("goal")]]


def _double_pendulum(model: mujoco.MjModel) -> list[list[_Block]]:
    position, joints = _FIELDS["qpos"](model), part_names(model).joints
    force = [f"qfrc_constraint/{joint}" for joint in joints]
    blocks = [
        _Block(tuple(position[:1]), lambda data: data.qpos[:1]),
        _Block(tuple(f"sin/{joint}" for joint in joints[1:]), lambda data: np.sin(data.qpos[1:])),
        _Block(tuple(f"cos/{joint}" for joint in joints[1:]), lambda data: np.cos(data.qpos[1:])),
        _Block(tuple(_FIELDS["qvel"](model)), lambda data: data.qvel),
    ]
    first = _Block(tuple(force[:1]), lambda data: data.qfrc_constraint[:1])
    every = _Block(tuple(force), lambda data: data.qfrc_constraint)
    return [[*blocks, first], [*blocks, every]]


#: Layouts that no rule gives, by the name of the environment's class.
_SPECIAL: dict[str, Callable[[mujoco.MjModel], list[list[_Block]]]] = {
    "ReacherEnv": _reacher,
    "PusherEnv": _pusher,
    "InvertedDoublePendulumEnv": _double_pendulum,
}


def _agrees(layout: Sequence[_Block], values: np.ndarray, seen: np.ndarray) -> bool:
    """Whether observations, (steps, rows), are the named values, each block perhaps clipped as some environments do."""
    names = [name for block in layout for name in block.names]
    if values.shape != seen.shape or len(names) != seen.shape[1] or len(set(names)) != len(names):
        return False
    start = 0
    for block in layout:
        stop = start + len(block.names)
        shown = seen[:, start:stop]
        if not np.array_equal(np.clip(values[:, start:stop].astype(seen.dtype), shown.min(), shown.max()), shown):
            return False
        start = stop
    return True


def _named(names: Iterable[str], kind: str) -> tuple[str, ...]:
    given = list(names)
    taken = set(given)
    result = []
    for index, name in enumerate(given):
        if not name:
            name = f"{kind}_{index}"
            while name in taken:
                name += "_"
            taken.add(name)
        result.append(name)
    return tuple(result)
