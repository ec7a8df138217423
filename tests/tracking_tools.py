"""What the tests of the W&B mirror share."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wandb.util import get_core_path

from acmr.config import TrackingConfig
from acmr.tracking.wandb_backend import mirrors_of
from acmr.tracking.wandb_tracker import Tracker, labels, make_tracker

ROOT = Path(__file__).resolve().parents[1]
RUN = "ant_three_legs-hidden-frozen"
ID = f"quick-{RUN}-s3"
SETTINGS: dict[str, Any] = {
    "seed": 3,
    "freeze": True,
    "profile": "quick",
    "env": {"name": "ant_three_legs", "source": "ant"},
    "transfer": {"name": "hidden"},
    "agent": {"hidden_sizes": [64, 64], "q_lr": 0.001},
    "tracking": {"mode": "offline", "project": "acmr", "entity": None, "base_url": None, "dir": None},
}
#: What a child process begins with: a tracker in the folder that is its argument, its warnings on standard output.
CHILD = f"""
import os, signal, subprocess, sys, time
from pathlib import Path
from acmr.config import TrackingConfig
from acmr.records import EpisodeRecord
from acmr.tracking.wandb_tracker import make_tracker
settings = {SETTINGS!r}
def start(mode="offline", folder=sys.argv[1]):
    return make_tracker(TrackingConfig(mode=mode), output_dir=Path(folder), run_name={RUN!r}, profile="quick", seed=3,
        group="g", job_type="student", tags=["A2"], settings=settings, warn=lambda line: print("WARNING", line))
def service():
    listed = subprocess.run(["ps", "-o", "pid=,comm=", "--ppid", str(os.getpid())], capture_output=True, text=True)
    return [int(line.split()[0]) for line in listed.stdout.splitlines() if "wandb-core" in line]
"""


def start(output_dir: Path, warnings: list[str], **config: Any) -> Tracker:
    words = labels(SETTINGS, RUN, "A2")
    return make_tracker(
        TrackingConfig(**config),
        output_dir=output_dir,
        run_name=RUN,
        profile="quick",
        seed=3,
        settings=SETTINGS,
        warn=warnings.append,
        **words,
    )


def records(mirror: Path) -> list[dict[str, Any]]:
    """The records of a W&B file, by W&B's own reader."""
    return [json.loads(line) for line in inspect(mirror).splitlines()]


def inspect(mirror: Path, *options: str) -> str:
    """What ``wandb leet inspect --json`` prints, without the seconds that importing wandb takes."""
    (file,) = mirror.glob("run-*.wandb")
    command = [get_core_path(), "leet", "inspect", "--no-observability", *options, "--json", "--run-file", str(file)]
    return subprocess.run([*command, str(mirror.parent)], capture_output=True, text=True, check=True).stdout


def history(mirror: Path) -> list[dict[str, Any]]:
    """The rows that were logged, without what W&B adds."""
    rows = [record["history"]["item"] for record in records(mirror) if record["type"] == "history"]
    return [{key: value for key, value in row.items() if not key.startswith("_")} for row in rows]


def child(
    program: str, *arguments: object, home: Path, variables: Mapping[str, str] | None = None
) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", CHILD + textwrap.dedent(program), *map(str, arguments)]
    environment = {**os.environ, "HOME": str(home), "PYTHONPATH": str(ROOT), **(variables or {})}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def the_mirror(output_dir: Path) -> Path:
    (found,) = mirrors_of(output_dir / "wandb", ID)
    return found
