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

from acmr.config import EnvConfig, ExperimentConfig, SACConfig, TrackingConfig, TransferConfig
from acmr.settings.run_spec import RunSpec
from acmr.tracking.observer import Observer
from acmr.tracking.wandb_backend import mirrors_of
from acmr.tracking.watchers import make_tracker

ROOT = Path(__file__).resolve().parents[1]
RUN = "ant_three_legs-hidden-frozen"
ID = f"quick-{RUN}-s3"
#: What a child process begins with: a tracker in the folder that is its argument, its warnings on standard output.
CHILD = """
import os, signal, subprocess, sys, time
from pathlib import Path
from acmr.records import EpisodeRecord
from tracking_tools import OFF, OFFLINE, make_tracker, spec
def start(tracker=OFFLINE, folder=sys.argv[1]):
    return make_tracker(spec(folder, tracker=tracker), lambda line: print("WARNING", line))
def service():
    listed = subprocess.run(["ps", "-o", "pid=,comm=", "--ppid", str(os.getpid())], capture_output=True, text=True)
    return [int(line.split()[0]) for line in listed.stdout.splitlines() if "wandb-core" in line]
"""
OFFLINE, OFF = TrackingConfig().tracker, None


def spec(
    output_dir: Path | str, name: str = RUN, cell: str | None = "A2", stop: str = "horizon", **tracking: Any
) -> RunSpec:
    """A cell of the quick profile."""
    config = ExperimentConfig(
        seed=3,
        freeze=True,
        stop=stop,
        profile="quick",
        output_dir=str(output_dir),
        env=EnvConfig(name="ant_three_legs", id="Ant-v5", source="ant"),
        transfer=TransferConfig(name="hidden"),
        agent=SACConfig(hidden_sizes=[64, 64], q_lr=0.001),
        tracking=TrackingConfig(**tracking),
    )
    return RunSpec(config, {}, name, cell, name)


def start(output_dir: Path, warnings: list[str], **tracking: Any) -> Observer:
    return make_tracker(spec(output_dir, **tracking), warnings.append)


def records(mirror: Path) -> list[dict[str, Any]]:
    """The records of a W&B file, by W&B's own reader."""
    return [json.loads(line) for line in inspect(mirror).splitlines()]


def inspect(mirror: Path, *options: str) -> str:
    """What ``wandb leet inspect --json`` prints, without the seconds that importing wandb takes."""
    from wandb.util import get_core_path  # here, so that a child process need not load it

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
    environment = {**os.environ, "HOME": str(home), "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", **(variables or {})}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def the_mirror(output_dir: Path) -> Path:
    (found,) = mirrors_of(output_dir / "wandb", ID)
    return found
