"""Names of observations and actions, against the values that they name."""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.spaces import Box

from acmr.config import EnvConfig
from acmr.envs import describe, make_env
from acmr.envs.naming import part_names
from acmr.settings.compose import environment_config, options

COMPONENTS = {"x": 0, "y": 1, "z": 2, "qw": 3, "qx": 4, "qy": 5, "qz": 6, "wx": 3, "wy": 4, "wz": 5}
#: What environments show only within limits.
CLIPPED = {
    "Hopper": {"qvel/": 10},
    "Walker2d": {"qvel/": 10},
    "InvertedDoublePendulum": {"qvel/": 10, "qfrc_constraint/": 10},
    "Ant": {"cfrc_ext/": 1},
}
VERSIONED = ["Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum"]
VERSIONED += ["InvertedPendulum", "Reacher", "Swimmer", "Walker2d"]
GYMNASIUM = [f"{name}-v{version}" for name in VERSIONED for version in (4, 5)] + ["Pusher-v5"]


def of(env_id: str, **settings: Any) -> EnvConfig:
    return EnvConfig(name=env_id, id=env_id, source=env_id, **settings)


EVERYWHERE = [environment_config(name) for name in options("env") if name != "gym" and not name.startswith("grid")] + [
    of(env_id) for env_id in GYMNASIUM
]
EVERYWHERE += [
    of("Humanoid-v4", kwargs={"exclude_current_positions_from_observation": False}),
    of("Humanoid-v5", kwargs={"include_cvel_in_observation": False, "include_cinert_in_observation": False}),
    of("Ant-v4", kwargs={"use_contact_forces": True}),
    of("Ant-v5", kwargs={"exclude_current_positions_from_observation": False}, remove_bodies=["aux_2"]),
    of("Hopper-v5", kwargs={"exclude_current_positions_from_observation": False}),
]


def looked_up(data: mujoco.MjData, model: mujoco.MjModel, name: str) -> float:
    """The value that a name stands for, by MuJoCo's own access by name."""
    kind, _, rest = name.partition("/")
    part, _, component = rest.partition("/")
    if kind == "fingertip-target":
        return float((data.body("fingertip").xpos - data.body("target").xpos)[COMPONENTS[part]])
    if kind == "xpos":
        return float(data.body(part).xpos[COMPONENTS[component]])
    if kind in ("cos", "sin"):
        return float(getattr(np, kind)(data.joint(part).qpos[0]))
    if kind in ("cinert", "cvel", "cfrc_ext"):
        # MuJoCo knows an unnamed body by its number only; in an edited robot its old number has become its name.
        named = any(model.body(i).name == part for i in range(model.nbody))
        return float(getattr(data.body(part if named else int(part.removeprefix("body_"))), kind)[int(component)])
    values = np.atleast_1d(getattr(data.joint(part), kind))
    return float(values[COMPONENTS[component] if component else 0])


@pytest.mark.parametrize("config", EVERYWHERE, ids=lambda config: f"{config.name}-{len(config.kwargs)}")
def test_names_name_the_values(config: EnvConfig) -> None:
    env, description = make_env(config), describe(config)
    robot: Any = env.unwrapped
    env.reset(seed=3)
    env.action_space.seed(3)
    for _ in range(12):
        action = env.action_space.sample()
        observation = env.step(action)[0]
    names = description.observation_names
    assert len(names) == len(set(names)) == len(observation)
    expected = np.array([looked_up(robot.data, robot.model, name) for name in names])
    for kind, limit in CLIPPED.get(config.id.split("-")[0], {}).items():
        rows = [row for row, name in enumerate(names) if name.startswith(kind)]
        expected[rows] = np.clip(expected[rows], -limit, limit)
    assert np.array_equal(observation, expected)
    for command, name in zip(action, description.action_names, strict=True):
        driven = robot.model.joint(name if name != "slide" else "slider").id
        (motor,) = np.flatnonzero(robot.model.actuator_trnid[:, 0] == driven)
        assert robot.data.ctrl[motor] == command


def test_rows_move_with_the_joint_they_name() -> None:
    env = make_env(environment_config("armless_humanoid"))
    names = describe(environment_config("armless_humanoid")).observation_names
    robot: Any = env.unwrapped
    before, _ = env.reset(seed=0)
    robot.data.joint("right_knee").qvel[0] += 0.125
    after = robot._get_obs()
    assert [names[row] for row in np.flatnonzero(before != after)] == ["qvel/right_knee"]
    robot.data.joint("root").qpos[2] += 0.125
    assert [names[row] for row in np.flatnonzero(robot._get_obs() != after)] == ["qpos/root/z"]


def test_clipped_velocities_keep_their_names() -> None:
    config = of("Hopper-v5")
    env = make_env(config)
    env.reset(seed=0)
    robot: Any = env.unwrapped
    robot.data.joint("rootz").qvel[0] = 50.0
    row = describe(config).observation_names.index("qvel/rootz")
    assert robot._get_obs()[row] == 10.0


@pytest.mark.parametrize(("whole", "part"), [("humanoid", "armless_humanoid"), ("humanoid_v5", "armless_humanoid_v5")])
def test_armless_names_are_among_the_full_ones_with_the_same_values(whole: str, part: str) -> None:
    envs = [make_env(environment_config(name)) for name in (whole, part)]
    described = [describe(environment_config(name)) for name in (whole, part)]
    full, armless = (description.observation_names for description in described)
    assert set(armless) < set(full)
    assert described[1].action_names == described[0].action_names[: len(described[1].action_names)]
    if whole == "humanoid":
        assert sum(a != b for a, b in zip(full, armless, strict=False)) == 254

    rng = np.random.default_rng(1)
    target: Any = envs[1].unwrapped
    source: Any = envs[0].unwrapped
    for env in envs:
        env.reset(seed=0)
    target.data.qpos[:] += rng.uniform(-0.1, 0.1, target.model.nq)
    target.data.qvel[:] = rng.uniform(-1, 1, target.model.nv)
    target.data.ctrl[:] = rng.uniform(-0.4, 0.4, target.model.nu)
    for joint in part_names(target.model).joints:
        source.data.joint(joint).qpos[:] = target.data.joint(joint).qpos
        source.data.joint(joint).qvel[:] = target.data.joint(joint).qvel
    for actuator in part_names(target.model).actuators:
        source.data.actuator(actuator).ctrl[:] = target.data.actuator(actuator).ctrl
    for robot in (source, target):
        mujoco.mj_forward(robot.model, robot.data)
    seen = dict(zip(full, source._get_obs(), strict=True))
    here = dict(zip(armless, target._get_obs(), strict=True))
    # The last of a body's ten inertia values is its mass; the others are about the centre of mass, which moves.
    exact = [name for name in armless if name.split("/")[0] in ("qpos", "qvel", "qfrc_actuator")]
    exact += [name for name in armless if name.startswith("cinert/") and name.endswith("/9")]
    assert {name: here[name] for name in exact} == {name: seen[name] for name in exact}
    assert sum(here[name] != 0 for name in exact) > 50


def test_unnamed_bodies_keep_their_names_when_others_go() -> None:
    full, part = (describe(of("Ant-v5", remove_bodies=gone)).observation_names for gone in ([], ["back_leg"]))
    assert "cfrc_ext/body_13/0" in part
    assert set(part) < set(full)
    assert not any(name.startswith(("cfrc_ext/body_10/", "qvel/hip_3")) for name in part)


def test_parts_without_names_of_their_own() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody>
        <body><joint name="a"/><geom size=".1"/><body name="body_1"><joint/><geom size=".1"/></body></body>
        <body><joint name="b"/><geom size=".1"/></body>
        </worldbody><actuator>
        <motor joint="a"/> <motor joint="b"/> <motor joint="b" gear="2"/> <motor name="c" joint="a"/>
        </actuator></mujoco>"""
    )
    names = part_names(model)
    assert names.bodies == ("world", "body_1_", "body_1", "body_3")
    assert names.joints == ("a", "joint_1", "b")
    assert names.actuators == ("actuator_0", "actuator_1", "actuator_2", "c")


class Backwards(HopperEnv):
    """Shows its observation in reverse and drives its joints in reverse."""

    def _get_obs(self) -> Any:
        return super()._get_obs()[::-1].copy()

    def do_simulation(self, ctrl: Any, n_frames: int) -> None:
        super().do_simulation(ctrl[::-1], n_frames)


gym.register("AcmrBackwards-v0", cast(Any, Backwards), max_episode_steps=100)


class ReacherEnv(HopperEnv):
    """Has the name of a class of Gymnasium's, but not its robot."""


gym.register("AcmrNamesake-v0", cast(Any, ReacherEnv), max_episode_steps=100)


def test_a_namesake_is_named_by_what_it_is() -> None:
    assert describe(of("AcmrNamesake-v0")).observation_names == describe(of("Hopper-v5")).observation_names


def test_what_does_not_agree_with_its_name_gets_an_index() -> None:
    description = describe(of("AcmrBackwards-v0"))
    assert description.observation_names == tuple(f"obs/{row}" for row in range(11))
    assert description.action_names == tuple(f"action/{row}" for row in range(3))


def test_without_a_model_names_are_indices() -> None:
    description = describe(of("Pendulum-v1"))
    assert description.observation_names == ("obs/0", "obs/1", "obs/2")
    assert description.action_names == ("action/0",)


class OwnNames(gym.Env[np.ndarray, np.ndarray]):
    """An environment that says what its numbers are, in one of the ways that there are."""

    observation_space = Box(-1, 1, (4,), np.float32)
    action_space = Box(-1, 1, (2,), np.float32)

    def __init__(self, **said: Any) -> None:
        for name, value in said.items():
            setattr(self, name, value)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        return np.zeros(4, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return np.zeros(4, np.float32), 0.0, False, False, {}


gym.register("AcmrOwnNames-v0", OwnNames, max_episode_steps=20)
INDICES = ("obs/0", "obs/1", "obs/2", "obs/3")


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({"observation_names": ["a", "b/1", "c d", "e"]}, ("a", "b/1", "c d", "e")),
        # As gym-anm has them: a quantity, where it is measured, its unit.
        (
            {"obs_values": [["bus_p", [0, 1], "MW"], ["aux", [0, 3], None]]},
            ("bus_p/0", "bus_p/1", "aux/0", "aux/3"),
        ),
        # As opfgym has them: a table, its column, its rows.
        (
            {"obs_keys": [["load", "p_mw", [4, 7]], ["sgen", "p_mw", ["north", "south"]]]},
            ("load/p_mw/4", "load/p_mw/7", "sgen/p_mw/north", "sgen/p_mw/south"),
        ),
        (
            {"observation_names": ["a", "b"], "obs_keys": [["load", [1, 2, 3, 4]]]},
            ("load/1", "load/2", "load/3", "load/4"),
        ),
        ({"observation_names": ["a", "b", "c"]}, INDICES),
        ({"observation_names": ["a", "a", "b", "c"]}, INDICES),
        ({"observation_names": ["a", "\x1b[31m", "b", "c"]}, INDICES),
        ({"observation_names": ["a", "1_0", "b", "c"]}, INDICES),
        ({"observation_names": [1, 2, 3, 4]}, INDICES),
        ({"observation_names": "abcd"}, INDICES),
        ({"obs_values": [["p", 3], 7, None, []]}, INDICES),
    ],
)
def test_an_environment_may_name_its_observations(said: dict[str, Any], expected: tuple[str, ...]) -> None:
    assert describe(of("AcmrOwnNames-v0", kwargs=said)).observation_names == expected


def test_an_environment_may_name_its_actions_and_lose_some() -> None:
    said = {"action_names": ["left", "right"], "observation_names": ["near/a", "near/b", "far/a", "far/b"]}
    description = describe(of("AcmrOwnNames-v0", kwargs=said, drop_sensors=["near/*"], drop_actuators=["left"]))
    assert description.observation_names == ("far/a", "far/b")
    assert description.action_names == ("right",)
