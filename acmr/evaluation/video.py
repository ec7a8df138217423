"""Films an environment as mp4 or GIF, at its own speed."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
from PIL import Image

from acmr.config import ConfigError
from acmr.evaluation.camera import Camera, is_robot, make_camera
from acmr.text import message

#: Files that a film can be, and the frames per second that it has at most: an environment with more of them is filmed
#: at every n-th step. A GIF holds each frame whole, and has to fit into a page.
MAX_FPS = {".mp4": 35.0, ".gif": 20.0}
FILM_SUFFIXES = tuple(MAX_FPS)
#: Colors of a GIF, and of how many of its frames they are taken.
_COLORS, _PALETTE_FRAMES = 64, 16
_ENVIRONMENTS_OWN_FPS = 30.0


class Film:
    """An mp4 or gif file at the environment's own speed; if it cannot be made, one line says why.

    Attributes:
        fps: Frames per second.
    """

    def __init__(
        self,
        path: Path,
        env: gym.Env[Any, Any],
        width: int = 480,
        height: int = 480,
        seconds: float | None = None,
        say: Callable[[str], None] = lambda line: print(line, file=sys.stderr),
    ) -> None:
        """Makes the camera first: no file is begun where nothing can be drawn.

        Args:
            path: The file; its ending says what it is.
            env: What is filmed.
            width: In pixels.
            height: In pixels.
            seconds: Of simulated time, episode after episode; None: until the first episode ends.
            say: Where lines for the user go.
        """
        speed = steps_per_second(env)
        self._stride = math.ceil(speed / MAX_FPS[path.suffix])
        self._path, self.fps, self._say = path, speed / self._stride, say
        self._seconds = seconds
        self._planned = math.inf if seconds is None else max(1, round(seconds * self.fps))
        self._steps = self._frames = 0
        self._writer: Any = None
        self._camera: Camera | None = None
        with self._reporting_errors():
            self._camera = make_camera(env, width, height)

    def step(self) -> None:
        """Takes the environment's present state in; to be called before every step."""
        if self._camera is not None and self._steps % self._stride == 0:
            with self._reporting_errors():
                self._write(self._camera.frame())
            if self._frames >= self._planned:
                self.close()
        self._steps += 1

    def end_episode(self) -> None:
        """Ends the film if it was to show one episode."""
        if self._seconds is None:
            self.close()

    def close(self) -> None:
        """Ends the file, if that has not been done, and says where it is."""
        filmed = self._camera is not None and self._writer is not None
        with self._reporting_errors():
            self._end()
            if filmed:
                length = f"{self._frames / self.fps:.1f} s"
                if self._seconds is not None and self._frames < self._planned:
                    length += f" of the {self._seconds:g} s asked for, for want of more --episodes"
                self._say(f"video: {self._path}, {self._frames} frames at {self.fps:.1f} a second, {length}")

    @contextmanager
    def _reporting_errors(self) -> Iterator[None]:
        try:
            yield
        except (ConfigError, OSError) as error:
            self._say(f"no video: {message(error)}")
            with suppress(OSError):
                self._end()

    def _end(self) -> None:
        camera, writer, self._camera, self._writer = self._camera, self._writer, None, None
        if camera is not None:
            camera.close()
        if writer is not None:
            writer.close()

    def _write(self, frame: np.ndarray) -> None:
        if self._writer is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_bytes(b"")  # a better error than ffmpeg's
            self._writer = _open_writer(self._path, self.fps)
        self._writer.append_data(frame)
        self._frames += 1


class GifWriter:
    """A GIF that repeats for ever, with one small palette for all frames: with its own each frame is twice as large."""

    def __init__(self, path: Path, fps: float) -> None:
        """Remembers the file; it is written when the last frame is known."""
        self._path, self._duration = path, 1000.0 / fps
        self._frames: list[np.ndarray] = []

    def append_data(self, frame: np.ndarray) -> None:
        """Adds a frame, (height, width, 3), uint8."""
        self._frames.append(frame)

    def close(self) -> None:
        """Writes the file."""
        some = self._frames[:: math.ceil(len(self._frames) / _PALETTE_FRAMES)]
        palette = Image.fromarray(np.concatenate(some)).quantize(_COLORS, method=Image.Quantize.MEDIANCUT)
        pictures = [
            Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in self._frames
        ]
        # GIF counts in hundredths of a second: what one frame is rounded by, the next ones make up for.
        ends = np.round(np.arange(len(pictures) + 1) * self._duration / 10) * 10
        durations = np.diff(ends).astype(int).tolist()
        pictures[0].save(self._path, save_all=True, append_images=pictures[1:], duration=durations, loop=0)


def _open_writer(path: Path, fps: float) -> Any:
    if path.suffix == ".gif":
        return GifWriter(path, fps)
    return imageio.get_writer(
        str(path), format="FFMPEG", mode="I", fps=fps, quality=7, macro_block_size=2, ffmpeg_log_level="error"
    )


def steps_per_second(env: gym.Env[Any, Any]) -> float:
    """Environment steps in a second of simulated time."""
    interval = getattr(env.unwrapped, "dt", None)
    if is_robot(env) and isinstance(interval, float) and interval > 0:
        return 1.0 / interval
    return float(env.metadata.get("render_fps") or _ENVIRONMENTS_OWN_FPS)
