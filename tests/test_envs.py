"""Every environment of conf/env, and what make_env and describe make of any other."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Text

from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe, make_env
from acmr.settings.compose import compose_config, environment_config, options, parse

ROOT = Path(__file__).resolve().parent.parent
DIMENSIONS = {
    "humanoid": (376, 17),
    "armless_humanoid": (270, 11),
    "humanoid_v5": (348, 17),
    "armless_humanoid_v5": (242, 11),
    "ant": (27, 8),
    "ant_three_legs": (23, 6),
    "halfcheetah": (17, 6),
    "lame_halfcheetah": (17, 5),
    "whole_ant": (27, 8),
    "ant_leg_lost": (23, 6),
    "ant_leg_added": (27, 8),
    "whole_walker2d": (17, 6),
    "walker2d_foot_lost": (15, 5),
    "walker2d_foot_added": (17, 6),
    "whole_halfcheetah": (17, 6),
    "halfcheetah_motor_failed": (17, 5),
    "halfcheetah_motor_added": (17, 6),
    "whole_hopper": (11, 3),
    "hopper_sensors_failed": (8, 3),
    "hopper_sensors_added": (11, 3),
    "whole_humanoid": (45, 17),
    "humanoid_arm_lost": (39, 14),
    "humanoid_arm_added": (45, 17),
}
#: All robots; the power grids are in tests/test_grid.py, for they need an extra.
NAMED_LEAVES = [name for name in options("env") if name != "gym" and not name.startswith("grid")]


class Toy(gym.Env[Any, Any]):
    """Observes twice the action it was given. Its spaces are arguments."""

    def __init__(
        self,
        low: Any = -1.0,
        high: Any = 1.0,
        shape: tuple[int, ...] = (2, 3),
        dtype: str = "float32",
        seen: str = "box",
    ) -> None:
        kind: Any = np.dtype(dtype).type
        self.action_space = Box(np.full(shape, low, kind), np.full(shape, high, kind), dtype=kind)
        spaces: dict[str, gym.Space[Any]] = {"dict": Dict({"a": Discrete(2)}), "text": Text(3)}
        self.observation_space = spaces.get(seen, Box(-np.inf, np.inf, tuple(shape)))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(self.action_space.shape or (), np.float32), {}

    def step(self, action: Any) -> Any:
        assert action.shape == self.action_space.shape
        return 2 * action.astype(np.float32), 1.0, False, False, {"reward_toy": 1.0, "note": "text"}


gym.register("AcmrToy-v0", cast(Any, Toy), max_episode_steps=7)
gym.register("AcmrEndlessToy-v0", cast(Any, Toy))


def of(env_id: str, **settings: Any) -> EnvConfig:
    return EnvConfig(name=env_id, id=env_id, source=env_id, **settings)


@pytest.mark.parametrize("name", NAMED_LEAVES)
def test_every_leaf_builds_resets_and_steps(name: str) -> None:
    config = environment_config(name)
    env, description = make_env(config), describe(config)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 1000
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    env.action_space.seed(1)
    for _ in range(20):
        observation, reward, terminated, _, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert np.isfinite(float(reward))
        if terminated:
            env.reset()
    assert (len(description.observation_names), len(description.action_names)) == DIMENSIONS[config.name]
    assert (env.observation_space.shape, env.action_space.shape) == tuple((n,) for n in DIMENSIONS[config.name])
    assert set(description.reward_terms) == {key for key in info if key.startswith("reward_")}
    assert description.has_forward_velocity


def test_leaves_are_all_here() -> None:
    assert set(options("env")) >= {*DIMENSIONS, "gym"}
    pairs = {"paper": "humanoid", "quick": "ant", "paper_v5": "humanoid_v5", "shifts": "whole_ant"}
    for profile, source in pairs.items():
        assert environment_config(f"{profile}_source") == environment_config(source)
        assert environment_config(f"{profile}_target").source == source


def test_hydra_names_a_gymnasium_environment_by_its_id() -> None:
    config = parse(compose_config(["env=gym", "env.id=Hopper-v5", "env.drop_sensors=[qvel/*,0]"])).env
    assert (config.name, config.source) == ("Hopper-v5", "Hopper-v5")
    assert make_env(config).observation_space.shape == (4,)


def test_paper_pair_in_the_paper_s_terms() -> None:
    for name in ("paper_source", "paper_target"):
        env = make_env(environment_config(name))
        assert isinstance(env.action_space, Box)
        assert set(env.action_space.low) == {np.float32(-0.4)}
        assert set(env.action_space.high) == {np.float32(0.4)}
        robot: Any = env.unwrapped
        assert robot.frame_skip == 5
        env.reset(seed=0)
        for height, over in ((1.01, False), (0.99, True), (1.99, False), (2.01, True)):
            robot.data.qpos[2] = height
            assert robot.terminated is over
    assert describe(environment_config("humanoid")).reward_terms == ("reward_linvel", "reward_quadctrl", "reward_alive")


def test_humanoid_is_bitwise_gymnasium_s() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        theirs = gym.make("Humanoid-v4")
    ours = make_env(environment_config("humanoid"))
    rng = np.random.default_rng(0)
    assert np.array_equal(ours.reset(seed=5)[0], theirs.reset(seed=5)[0])
    episodes = 0
    for _ in range(1000):
        action = rng.uniform(-0.4, 0.4, 17).astype(np.float32)
        mine, other = ours.step(action), theirs.step(action)
        assert mine[0].tobytes() == other[0].tobytes()
        assert mine[1:] == other[1:]
        if mine[2] or mine[3]:
            episodes += 1
            assert np.array_equal(ours.reset()[0], theirs.reset()[0])
    assert episodes > 10


def test_time_limit() -> None:
    env = make_env(replace(environment_config("ant"), max_episode_steps=3))
    env.reset(seed=0)
    assert [env.step(np.zeros(8, np.float32))[3] for _ in range(3)] == [False, False, True]
    endless = make_env(of("AcmrEndlessToy-v0")).spec
    assert endless is not None
    assert endless.max_episode_steps is None


def test_kwargs_reach_the_environment() -> None:
    whole = make_env(of("Ant-v5")).observation_space.shape
    assert whole == (105,)
    assert make_env(
        of("Ant-v5", kwargs={"exclude_current_positions_from_observation": False})
    ).observation_space.shape == (107,)


def test_trying_out_leaves_the_randomness_alone() -> None:
    first, second = (make_env(environment_config("ant")).reset()[0] for _ in range(2))
    assert not np.array_equal(first, second)


def test_several_dimensions_are_flattened() -> None:
    env = make_env(of("AcmrToy-v0"))
    assert env.observation_space.shape == env.action_space.shape == (6,)
    assert env.reset(seed=0)[0].shape == (6,)
    action = np.linspace(-1, 1, 6, dtype=np.float32)
    assert np.array_equal(env.step(action)[0], 2 * action)
    description = describe(of("AcmrToy-v0"))
    assert description.observation_names == tuple(f"obs/{row}" for row in range(6))
    assert description.action_names == tuple(f"action/{row}" for row in range(6))
    assert description.reward_terms == ("reward_toy",)
    assert not description.has_forward_velocity


def test_hash_tells_models_apart_and_only_those() -> None:
    hashes = {name: describe(environment_config(name)).model_hash for name in DIMENSIONS}
    assert hashes["humanoid"] == hashes["humanoid_v5"]
    # A sensor or a motor that failed is no other robot.
    assert hashes["whole_hopper"] == hashes["hopper_sensors_failed"]
    assert len(set(hashes.values())) == 9
    code = (
        "from acmr.envs import describe; from acmr.settings.compose import environment_config;"
        "print(describe(environment_config('ant_three_legs')).model_hash)"
    )
    again = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert again.stdout.strip() == hashes["ant_three_legs"]


def test_hash_without_a_model_is_the_registration_s() -> None:
    first, again, other = (describe(of("AcmrToy-v0", kwargs={"shape": shape})) for shape in ([2, 3], [2, 3], [6]))
    assert first.model_hash == again.model_hash
    assert first.model_hash != other.model_hash
    assert len(first.model_hash) == 64


def test_nothing_is_printed_or_written(tmp_path: Path) -> None:
    code = (
        "from acmr.config import EnvConfig; from acmr.envs import make_env\n"
        "for name in ('Humanoid-v4', 'HalfCheetah-v5'): make_env(EnvConfig(name, name, name))"
    )
    command = [sys.executable, "-W", "always::DeprecationWarning", "-W", "always::UserWarning", "-c", code]
    done = subprocess.run(
        command, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True
    )
    assert "out of date" not in done.stderr
    assert "deprecated" not in done.stdout + done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (of("Humaniod-v4"), r"env.id=Humaniod-v4: Gymnasium knows no .*near: .*Humanoid-v4"),
        (of("Humanoid"), r"near: Humanoid-v5"),
        (of("Hopper-v3"), r"env.id=Hopper-v3: Gymnasium knows no .*Hopper-v5"),
        (of("???"), r"env.id is missing.*Hopper-v5"),
        (of("no_such_package:Robot-v0"), r"cannot import no_such_package"),
        (of("CartPole-v1"), r"its actions are a Discrete space.*Box"),
        (of("AcmrToy-v0", kwargs={"seen": "dict"}), r"its observation is ndarray .* but its space declares 1 parts"),
        (of("AcmrToy-v0", kwargs={"seen": "text"}), r"its observations are a Text space.*Box"),
        (of("AcmrToy-v0", kwargs={"high": np.inf}), r"actions range from -1 to inf.*finite"),
        (of("AcmrToy-v0", kwargs={"high": -1}), r"actions range from -1 to -1"),
        (of("AcmrToy-v0", kwargs={"dtype": "int64"}), r"actions are int64.*continuous"),
        (of("Humanoid-v4", kwargs={"healthy_z": 1}), r"env.kwargs.healthy_z: .*no such argument.*healthy_z_range"),
        (of("Humanoid-v4", kwargs={"frame_skip": 1}), r"env.kwargs.frame_skip: .*no such argument"),
        (of("Humanoid-v4", kwargs={"healthy_z_range": 3}), r"env.kwargs=.*healthy_z_range.*cannot run: TypeError"),
        (of("Humanoid-v5", kwargs={"xml_file": "/no/such.xml"}), r"/no/such.xml does not exist"),
        (of("Pusher-v4"), r"Pusher-v4.*mujoco"),
    ],
)
def test_what_cannot_run_gives_one_line(config: EnvConfig, message: str) -> None:
    for use in (make_env, describe):
        with pytest.raises(ConfigError, match=message) as caught:
            use(config)
        assert "\n" not in str(caught.value)


def test_unknown_render_mode() -> None:
    with pytest.raises(ConfigError, match=r"render_mode=video: Humanoid-v4 offers .*rgb_array"):
        make_env(environment_config("humanoid"), render_mode="video")
    with pytest.raises(ConfigError, match="offers none"):
        make_env(of("AcmrToy-v0"), render_mode="rgb_array")
