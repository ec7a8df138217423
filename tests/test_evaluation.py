"""Finished runs used from the command line: real environments, real files, a real lack of OpenGL."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from gymnasium.spaces import Box
from safetensors.numpy import load_file

from acmr.checkpoint import FORMAT_VERSION, TeacherDescription, save_teacher
from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe, make_env
from acmr.evaluation import main
from acmr.networks import Dimensions, Networks
from acmr.video import Film, make_camera, open_gl, steps_per_second

ROOT = Path(__file__).resolve().parents[1]
ANT = EnvConfig(
    name="ant_three_legs",
    id="Ant-v5",
    source="ant",
    kwargs={"include_cfrc_ext_in_observation": False},
    remove_bodies=["back_leg"],
    max_episode_steps=12,
)


def can_draw() -> bool:
    try:
        open_gl(64, 64).free()
    except ConfigError:
        return False
    return True


needs_gl = pytest.mark.skipif(not can_draw(), reason="no OpenGL library on this machine")


def make_run(path: Path, core: Dimensions | None = None) -> Path:
    """A finished run whose networks are random."""
    about, env = describe(ANT), make_env(ANT)
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    space = env.action_space
    assert isinstance(space, Box)
    low, high = space.low, space.high
    networks = Networks(dims, (32, 32), low, high, torch.Generator().manual_seed(5), core)
    path.mkdir(parents=True)
    description = TeacherDescription(
        format_version=FORMAT_VERSION, environment=ANT.name, environment_id=ANT.id, model_hash=about.model_hash,
        observation_names=list(about.observation_names), action_names=list(about.action_names),
        action_low=low.tolist(), action_high=high.tolist(), hidden_sizes=[32, 32],
        core=[core.observation, core.action] if core else None, adapter_activation="relu", log_alpha=0.0, seed=1,
        profile="quick", global_step=100, final_return=None, config={},
    )  # fmt: skip
    save_teacher(path, networks, description)
    (path / "config.yaml").write_text(yaml.safe_dump({"env": asdict(ANT), "seed": 1}))
    (path / "summary.json").write_text(json.dumps({"status": "complete"}))
    return path


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return make_run(tmp_path / "seed_1")


def result(run_dir: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((run_dir / "evaluation.json").read_text())
    return content


def test_returns_are_those_of_an_independent_calculation(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(run), "--episodes", "3", "--seed", "7"]) == 0
    weights = load_file(run / "teacher.safetensors")
    env, returns = make_env(ANT), []
    for seed in (7, 8, 9):
        observation, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            hidden = observation
            for layer in ("actor.input", "actor.hidden_1"):
                hidden = np.maximum(weights[f"{layer}.weight"] @ hidden + weights[f"{layer}.bias"], 0)
            action = np.tanh(weights["actor.mean.weight"] @ hidden + weights["actor.mean.bias"])  # Ant acts in [-1, 1]
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    content = result(run)
    each = [episode["episodic_return"] for episode in content["each"]]
    assert each == pytest.approx(returns, abs=1e-3)
    assert [episode["seed"] for episode in content["each"]] == [7, 8, 9]
    assert content["mean_return"] == pytest.approx(np.mean(each))
    assert content["std_return"] == pytest.approx(np.sqrt(np.mean((np.array(each) - np.mean(each)) ** 2)))
    assert content["policy"] == "deterministic"
    assert content["same_robot"] is True
    printed = capsys.readouterr()
    assert printed.err == ""
    assert [line.split()[0] for line in printed.out.splitlines()] == ["episode"] * 3 + ["mean", "written:"]


def test_an_episode_does_not_depend_on_those_before_it(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "e.json"

    def returns(*arguments: str) -> list[float]:
        assert main([str(run), "--out", str(out), *arguments]) == 0
        return [episode["episodic_return"] for episode in json.loads(out.read_text())["each"]]

    for mode in ([], ["--stochastic"]):
        three = returns("--episodes", "3", *mode)
        assert returns("--episodes", "1", "--seed", "2", *mode) == three[2:]
        assert len(set(three)) == 3
    assert returns("--episodes", "3") != three
    assert not (run / "evaluation.json").exists()


def test_a_student_with_adapters(tmp_path: Path) -> None:
    run_dir = make_run(tmp_path / "expand", core=Dimensions(27, 8))
    assert main([str(run_dir), "--episodes", "1"]) == 0
    assert np.isfinite(result(run_dir)["mean_return"])


def spoil(run_dir: Path, what: str) -> Path:
    tensors, config = run_dir / "teacher.safetensors", run_dir / "config.yaml"
    settings = yaml.safe_load(config.read_text())
    if what == "no such run":
        return run_dir / "nothing"
    if what == "no run":
        config.unlink()
    elif what == "unfinished":
        (run_dir / "summary.json").unlink()
    elif what == "diverged":
        (run_dir / "summary.json").write_text('{"status": "diverged"}')
    elif what == "damaged teacher":
        data = bytearray(tensors.read_bytes())
        data[-100] ^= 1
        tensors.write_bytes(bytes(data))
    elif what == "no teacher":
        tensors.unlink()
    elif what == "damaged config":
        config.write_text("env: [1, 2")
    elif what == "config without env":
        config.write_text("seed: 1")
    elif what == "unknown setting":
        config.write_text(yaml.safe_dump({"env": {**settings["env"], "gravity": 1}}))
    elif what == "another robot":
        config.write_text(yaml.safe_dump({"env": {**settings["env"], "remove_bodies": []}}))
    return run_dir


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("no such run", "no such run directory"),
        ("no run", "no config.yaml"),
        ("unfinished", "not finished"),
        ("diverged", "not finished"),
        ("damaged teacher", "damaged or exchanged"),
        ("no teacher", "no such teacher file"),
        ("damaged config", "not readable"),
        ("config without env", "config.yaml: damaged"),
        ("unknown setting", "gravity"),
        ("another robot", "27 sensors and 8 actuators here"),
    ],
)
def test_what_cannot_be_evaluated_says_why(run: Path, what: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(spoil(run, what)), "--episodes", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert said in line
    assert not (run / "evaluation.json").exists()


def test_a_robot_that_has_changed_is_remarked_on(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    description = json.loads((run / "teacher.json").read_text())
    # As a run of another robot would have described itself, without the check of its own entries.
    del description["description_sha256"]
    (run / "teacher.json").write_text(json.dumps({**description, "model_hash": "0" * 64}))
    assert main([str(run), "--episodes", "1"]) == 0
    assert "warning: ant_three_legs is not the robot" in capsys.readouterr().err
    assert result(run)["same_robot"] is False


@pytest.mark.parametrize(
    "arguments", [["--episodes", "0"], ["--seed", "-1"], ["--video", "film.avi"], ["--episodes", "two"]]
)
def test_bad_arguments(run: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([str(run), *arguments])
    assert stopped.value.code == 2
    assert arguments[1] in capsys.readouterr().err.splitlines()[-1]


def call(variables: dict[str, str], *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "acmr.evaluation", *map(str, arguments)]
    # Drawing in this process leaves a variable behind that would hide what happens in a fresh one.
    clean = {key: value for key, value in os.environ.items() if key != "PYOPENGL_PLATFORM"}
    environment = {**clean, **variables}
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)


def test_without_opengl_the_evaluation_still_works(run: Path, tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    # OSMesa's binding is broken in mujoco 4.0, so much that mujoco cannot even be imported.
    done = call({"MUJOCO_GL": "osmesa"}, run, "--episodes", 1, "--video", film)
    assert done.returncode == 0
    assert len(result(run)["each"]) == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("no video: no OpenGL library")
    assert "apt-get install libegl1 libgl1-mesa-dri" in line
    assert not film.exists()


def test_without_a_driver_a_still_names_the_package(tmp_path: Path) -> None:
    # EGL with no vendor, as where libgl1-mesa-dri is missing.
    variables = {"__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path), "DISPLAY": "", "MUJOCO_GL": ""}
    done = call(variables, "still", "ant", "--out", tmp_path / "ant.png")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: no OpenGL library")
    assert "libgl1-mesa-dri" in line
    assert not (tmp_path / "ant.png").exists()


@needs_gl
def test_a_film_runs_at_the_robots_pace_and_shows_it_move(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film = tmp_path / "deep" / "film.mp4"
    assert main([str(run), "--episodes", "2", "--video", str(film)]) == 0
    assert f"video: {film}, 12 frames at 20.0 a second" in capsys.readouterr().err
    frames = iio.imread(film).astype(int)
    assert frames.shape == (12, 480, 480, 3)
    assert iio.immeta(film)["duration"] == pytest.approx(12 * 0.05)  # 12 steps of 0.05 s
    first, last = frames[0], frames[-1]
    assert np.abs(first - last).mean() > 2


@needs_gl
def test_a_film_that_cannot_be_written_costs_a_line(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(run), "--episodes", "1", "--video", str(run / "config.yaml" / "film.mp4")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("no video: ")
    assert len(result(run)["each"]) == 1


@needs_gl
def test_the_camera_follows_the_robot() -> None:
    env = make_env(ANT)
    robot: Any = env.unwrapped
    where = []
    for distance in (0.0, 30.0):
        env.reset(seed=0)
        position = robot.init_qpos.copy()
        position[0] += distance
        robot.set_state(position, robot.init_qvel)
        camera = make_camera(env, 128, 128)
        where.append(np.argwhere(skin(camera.frame())))
        camera.close()
    assert len(where[0]) > 300
    assert np.abs(where[0].mean(axis=0) - where[1].mean(axis=0)).max() < 2


def skin(picture: np.ndarray) -> np.ndarray:
    """Which pixels are of a robot: it is orange, and the floor is not."""
    colors = picture.astype(int)
    found: np.ndarray = (colors[..., 0] - colors[..., 2]) > 30
    return found


@pytest.mark.parametrize(("env_id", "filmed_at"), [("Humanoid-v4", 33.3), ("Ant-v5", 20), ("Hopper-v5", 31.25)])
def test_the_pace_is_the_environments_own(env_id: str, filmed_at: float, tmp_path: Path) -> None:
    env = make_env(EnvConfig(name=env_id, id=env_id, source=env_id))
    assert steps_per_second(env) == pytest.approx(env.metadata["render_fps"], abs=0.5)
    assert Film(tmp_path / "film.mp4", env, say=print).fps == pytest.approx(filmed_at, abs=0.05)


@needs_gl
def test_stills_show_the_body_that_was_edited(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot_pixels = []
    for name in ("humanoid", "armless_humanoid"):
        out = tmp_path / f"{name}.png"
        assert main(["still", name, "--out", str(out), "--width", "160", "--height", "200"]) == 0
        picture = iio.imread(out)
        assert picture.shape == (200, 160, 3)
        robot_pixels.append(skin(picture).sum())
    assert robot_pixels[0] > 1.1 * robot_pixels[1] > 100
    assert capsys.readouterr().err == ""
    assert main(["still", "Nothing-v1", "--out", str(tmp_path / "x.png")]) == 2
    assert "Gymnasium knows no such environment" in capsys.readouterr().err
