"""Renders an environment without a screen.

MuJoCo robots are drawn by a camera of our own that follows them; other environments draw themselves. The OpenGL
library is loaded when the first camera is made, so that nothing else depends on there being one.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from acmr.config import ConfigError
from acmr.text import message

#: What has to be installed on Debian and Ubuntu to draw without a screen.
GL_PACKAGES = "libegl1 libgl1-mesa-dri"


class Camera(Protocol):
    """Draws an environment as it is now."""

    def frame(self) -> np.ndarray:
        """The picture, (height, width, 3), uint8."""

    def close(self) -> None:
        """Frees what the camera holds."""


class RobotCamera:
    """Follows the robot of a MuJoCo environment.

    Raises:
        ConfigError: If nothing can be drawn on this machine.
    """

    def __init__(
        self, env: gym.Env[Any, Any], width: int, height: int, azimuth: float | None = None, closeness: float = 1.0
    ) -> None:
        """Looks at the robot from where Gymnasium does, or from another side (in degrees) and distance."""
        import mujoco

        robot: Any = env.unwrapped
        self._mujoco, self._model, self._data = mujoco, robot.model, robot.data
        size = self._model.vis.global_
        size.offwidth, size.offheight = max(size.offwidth, width), max(size.offheight, height)
        self._gl = open_gl(width, height)
        self._gl.make_current()
        self._view = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(self._model, 10_000)
        self._options, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        mujoco.mjv_defaultFreeCamera(self._model, self._camera)
        place = getattr(getattr(robot, "mujoco_renderer", None), "default_cam_config", None) or {}
        for key in ("distance", "elevation", "azimuth"):
            if key in place:
                setattr(self._camera, key, place[key])
        self._camera.distance *= closeness
        if azimuth is not None:
            self._camera.azimuth = azimuth
        self._camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        self._camera.trackbodyid = place.get("trackbodyid", 1)

    def frame(self) -> np.ndarray:
        """The picture, (height, width, 3), uint8."""
        mujoco = self._mujoco
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._options, None, self._camera, everything, self._scene)
        mujoco.mjr_render(self._view, self._scene, self._context)
        picture = np.empty((self._view.height, self._view.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._view, self._context)
        # OpenGL's rows go up.
        return np.ascontiguousarray(picture[::-1])

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()


class OwnCamera:
    """Asks an environment that was made with ``render_mode="rgb_array"``."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Remembers the environment."""
        self._env = env

    def frame(self) -> np.ndarray:
        """The picture, (height, width, 3), uint8."""
        name = type(self._env.unwrapped).__name__
        try:
            picture = np.asarray(self._env.render())
        except Exception as error:
            raise ConfigError(f"{name} cannot draw itself: {message(error)}") from error
        if picture.ndim != 3 or picture.shape[2] < 3:
            raise ConfigError(f"{name} draws no pictures")
        return picture[..., :3]

    def close(self) -> None:
        """Does nothing: the environment is somebody else's."""


def is_robot(env: gym.Env[Any, Any]) -> bool:
    """Whether an environment is a MuJoCo simulation."""
    return hasattr(env.unwrapped, "model") and hasattr(env.unwrapped, "data")


def make_camera(
    env: gym.Env[Any, Any], width: int, height: int, azimuth: float | None = None, closeness: float = 1.0
) -> Camera:
    """A camera for an environment; one that draws itself decides on the size and the view.

    Raises:
        ConfigError: If nothing can be drawn on this machine.
    """
    return RobotCamera(env, width, height, azimuth, closeness) if is_robot(env) else OwnCamera(env)


def open_gl(width: int, height: int) -> Any:
    """An OpenGL context that draws into memory: MUJOCO_GL's, or EGL's, or that of a screen if there is one.

    Raises:
        ConfigError: If there is none, with the package that is missing.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen in ("egl", "glfw", "osmesa"):
        backends = [chosen]
    elif sys.platform == "darwin":
        backends = ["cgl", "glfw"]
    else:
        backends = ["egl", *(["glfw"] if os.environ.get("DISPLAY") else [])]
    reasons = []
    for backend in backends:
        try:
            return importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        except Exception as error:
            # Each way of not finding a library has its own exception, AttributeError among them.
            reasons.append(f"{backend}: {message(error)[:120]}")
    raise ConfigError(
        f"no OpenGL library to draw with ({'; '.join(reasons)}); install it with: apt-get install {GL_PACKAGES}, "
        "and leave MUJOCO_GL unset or set MUJOCO_GL=egl"
    )


@contextmanager
def without_gl() -> Iterator[None]:
    """Hides MUJOCO_GL inside: mujoco cannot even be imported where it names a library that is missing."""
    chosen = os.environ.pop("MUJOCO_GL", None)
    try:
        yield
    finally:
        if chosen is not None:
            os.environ["MUJOCO_GL"] = chosen
