"""Films and stills: real environments, real files, a real lack of OpenGL."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from finished_run import ANT, make_run, result
from PIL import Image, ImageSequence

from acmr.config import ConfigError, EnvConfig
from acmr.envs import make_env
from acmr.evaluation.camera import make_camera, open_gl
from acmr.evaluation.cli import main
from acmr.evaluation.video import Film, GifWriter, steps_per_second

ROOT = Path(__file__).resolve().parents[1]


def can_draw() -> bool:
    try:
        open_gl(64, 64).free()
    except ConfigError:
        return False
    return True


needs_gl = pytest.mark.skipif(not can_draw(), reason="no OpenGL library on this machine")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return make_run(tmp_path / "seed_1")


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
@pytest.mark.slow
def test_a_film_of_some_seconds_goes_on_over_the_episodes(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Episodes of 12 steps of 0.05 s.
    film = tmp_path / "film.gif"
    arguments = ["--video", str(film), "--width", "120", "--height", "80"]
    assert main([str(run), "--episodes", "3", *arguments, "--seconds", "1"]) == 0
    assert capsys.readouterr().err == f"video: {film}, 20 frames at 20.0 a second, 1.0 s\n"
    assert iio.imread(film).shape == (20, 80, 120, 3)
    assert iio.immeta(film)["duration"] == 50
    with Image.open(film) as picture:
        assert picture.info["loop"] == 0
    assert main([str(run), "--episodes", "1", *arguments, "--seconds", "1"]) == 0
    assert "12 frames at 20.0 a second, 0.6 s of the 1 s asked for, for want of more --episodes" in (
        capsys.readouterr().err
    )
    assert len(iio.imread(film)) == 12


def test_a_gif_keeps_its_pace_and_its_colors(tmp_path: Path) -> None:
    path = tmp_path / "colors.gif"
    writer = GifWriter(path, fps=16.0)  # 62.5 ms a frame, in a format that counts tens of them
    given = np.zeros((16, 8, 8, 3), np.uint8)
    given[:, :, :, 0] = np.arange(255, 0, -16)[:, None, None]
    given[8:, :4, :, 2] = 200  # a color that the first frames do not have
    for frame in given:
        writer.append_data(frame)
    writer.close()
    with Image.open(path) as picture:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
    assert sum(durations) == 1000
    assert set(durations) == {60, 70}
    assert np.abs(iio.imread(path).astype(int) - given).max() <= 8


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
