"""Figures 2 and 3: pictures of the two robots, rendered by child processes.

The analysis itself imports neither MuJoCo nor torch; and a GL library that crashes takes only its child with it.
"""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

#: Seconds that a picture may take.
PATIENCE = 180
SIZE = 480
#: A name in ``conf/env``, or an id that Gymnasium itself knows. The names come from the settings of runs, and
#: ``module:Name-v0`` would run code that nobody here has chosen; what begins with a hyphen would be an option.
_PLAIN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*(/[A-Za-z0-9_.-]+)?")


@dataclass(frozen=True)
class Still:
    """A picture being rendered; without a process it is not."""

    name: str
    env: str
    path: Path
    process: subprocess.Popen[str] | None


def start(pair: tuple[str, str], folder: Path) -> list[Still]:
    """Starts to render the source and the target environment.

    Args:
        pair: Names of the two environments.
        folder: Where the pictures go; must exist until :func:`finish`.
    """
    stills = []
    for name, env in zip(("figure_2", "figure_3"), pair, strict=True):
        path = folder / f"{name}.png"
        if not _PLAIN.fullmatch(env):
            stills.append(Still(name, env, path, None))
            continue
        command = [sys.executable, "-m", "acmr.evaluation", "still", env, "--out", str(path)]
        command += ["--width", str(SIZE), "--height", str(SIZE)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        stills.append(Still(name, env, path, process))
    return stills


def finish(still: Still) -> tuple[np.ndarray | None, str]:
    """Waits for a picture.

    Returns:
        The picture, (height, width, channels), or None and one line that says why there is none.
    """
    if still.process is None:
        return None, f"no picture of {still.env}: runs can name environments of conf/env and of Gymnasium only"
    try:
        _, said = still.process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        still.process.kill()
        still.process.communicate()
        return None, f"no picture of {still.env} after {PATIENCE} s"
    if still.process.returncode == 0 and still.path.is_file():
        return plt.imread(still.path), ""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    if not lines:
        return None, f"rendering {still.env} ended with exit code {still.process.returncode}"
    return None, lines[-1].removeprefix("error: ")


def stop(stills: list[Still]) -> None:
    """Ends children that are still at work (the analysis itself failed)."""
    for still in stills:
        if still.process is not None and still.process.poll() is None:
            still.process.kill()
            still.process.communicate()
