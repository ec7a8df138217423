"""Mirrors of runs that exist already: shown in a terminal, sent to a server, written anew from a run's own files.

``python -m acmr.tracking.mirror dashboard [FOLDER]``, ``... sync --base-url URL [FOLDER]``, ``... rebuild RUN_DIR...``.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from heapq import merge
from pathlib import Path
from typing import Any

import yaml

from acmr.config import ConfigError, TrackingConfig
from acmr.records import CONFIG_FILE, EPISODES_FILE, METRICS_FILE, SUMMARY_FILE
from acmr.text import one_line
from acmr.tracking.wandb_backend import linked_mirrors, server_problem, wandb_environment
from acmr.tracking.wandb_tracker import Tracker, labels, make_tracker

#: A row of a CSV file: its global step and its columns.
Row = tuple[int, dict[str, float]]


def replay(tracker: Tracker, run_dir: Path, until_step: int | None = None) -> None:
    """Mirrors the rows that a run has written so far; a resumed run does this first.

    Args:
        tracker: A fresh tracker of the same run.
        run_dir: The run's directory.
        until_step: The last global step to mirror; None: all.
    """
    # An episode that ends at a step comes before that step's metrics, as in the run itself.
    for step, row in merge(_rows(run_dir / EPISODES_FILE), _rows(run_dir / METRICS_FILE), key=lambda item: item[0]):
        if until_step is not None and step > until_step:
            break
        tracker.metrics(step, row)


def rebuild(run_dir: Path, warn: Callable[[str], None]) -> None:
    """Writes the offline mirror of a run anew from its own files, in place of the one that there may be.

    Args:
        run_dir: The run's directory, finished or not: ``<output_dir>/<profile>/<run>/seed_<n>``.
        warn: Called with one line if the mirror cannot be written.

    Raises:
        ConfigError: If this is no run's directory.
    """
    run_dir = run_dir.resolve()
    try:
        settings: dict[str, Any] = yaml.safe_load((run_dir / CONFIG_FILE).read_text())
        tracking = {**settings["tracking"], "mode": "offline", "base_url": None}
        summary = _summary(run_dir)
        run_name = run_dir.parent.name
        words = labels(settings, run_name, summary.get("cell") if summary else None)
        profile, seed = str(settings["profile"]), int(settings["seed"])
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{run_dir} is no run's directory ({one_line(error)}); give one as in {_example()}"
        ) from error
    tracker = make_tracker(
        TrackingConfig(**tracking),
        output_dir=run_dir.parents[2],
        run_name=run_name,
        profile=profile,
        seed=seed,
        settings=settings,
        warn=warn,
        **words,
    )
    replay(tracker, run_dir)
    tracker.finish(summary, exit_code=0 if summary else 1)


def unsent(folder: Path) -> list[Path]:
    """The W&B files in a flat folder that no server has yet, or that have grown since they were sent."""
    files = sorted(folder.glob("*run-*/run-*.wandb"))
    return [file for file in files if not _is_sent(file)]


def sync(folder: Path, base_url: str) -> int:
    """Sends mirrors to a server with ``wandb sync``.

    Args:
        folder: The flat folder of mirrors.
        base_url: The server's address; its key is read from ``WANDB_API_KEY``.

    Returns:
        How many runs were sent.

    Raises:
        ConfigError: If the folder or the server is missing, or if the server did not take every run.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: there is no such folder of mirrors; runs with tracking=offline write runs/wandb")
    files = unsent(folder)
    if not files:
        return 0
    if problem := server_problem(base_url):
        raise ConfigError(f"{len(files)} runs wait in {folder}, but {problem}")
    foreign = {key: value for key, value in os.environ.items() if not key.startswith("WANDB_")}
    variables = {**foreign, **wandb_environment(folder.absolute()), "WANDB_BASE_URL": base_url}
    variables["WANDB_DIR"] = _log_folder(folder)
    del variables["WANDB_SILENT"]
    command = [sys.executable, "-m", "wandb", "sync", "--yes", "--include-online", "--include-synced"]
    subprocess.run([*command, *(str(file.parent) for file in files)], env=variables, check=False)
    missing = [file for file in files if not _is_sent(file)]
    if missing:
        raise ConfigError(
            f"{base_url} did not take {len(missing)} of {len(files)} runs, {missing[0].parent} among them; "
            "the same command sends them again"
        )
    return len(files)


def dashboard(folder: Path) -> None:
    """Shows the mirrors in a terminal with ``wandb leet``, in place of this process.

    Raises:
        ConfigError: If there are none.
    """
    if not any(folder.glob("*run-*")):
        raise ConfigError(f"{folder}: no mirrors there; runs with tracking=offline, the default, write runs/wandb")
    links = linked_mirrors(folder)
    os.environ["WANDB_DIR"] = _log_folder(folder)
    os.execv(sys.executable, [sys.executable, "-m", "wandb", "leet", str(links)])


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m acmr.tracking.mirror", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    again = commands.add_parser("rebuild", help="write the mirrors of runs anew from their own files")
    again.add_argument("run_dirs", nargs="+", type=Path, metavar="RUN_DIR")
    send = commands.add_parser("sync", help="send offline mirrors to a server (key: WANDB_API_KEY)")
    send.add_argument("--base-url", default=os.environ.get("WANDB_BASE_URL") or None, help="as in http://HOST:PORT")
    send.add_argument("folder", nargs="?", type=Path, default=Path("runs/wandb"), help="default: runs/wandb")
    look = commands.add_parser("dashboard", help="browse mirrors in the terminal, without an account")
    look.add_argument("folder", nargs="?", type=Path, default=Path("runs/wandb"), help="default: runs/wandb")
    given = parser.parse_args(arguments)
    problems: list[str] = []
    try:
        if given.command == "rebuild":
            for run_dir in given.run_dirs:
                rebuild(run_dir, problems.append)
        elif given.command == "dashboard":
            dashboard(given.folder)
        elif not given.base_url:
            problems.append(
                "no server is named; type make sync BASE_URL=http://HOST:PORT (or add --base-url http://HOST:PORT)"
            )
        else:
            print(f"{sync(given.folder, given.base_url)} runs sent to {given.base_url}")
    except ConfigError as error:
        problems.append(str(error))
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    return 2 if problems else 0


def _rows(file: Path) -> Iterator[Row]:
    """Rows of a CSV file whose every field is a number; a row that a kill tore is left out."""
    if not file.exists():
        return
    with file.open(newline="") as lines:
        reader = csv.reader(line for line in lines if line.endswith("\n"))
        header = next(reader, [])
        for fields in reader:
            if len(fields) == len(header):
                row = {key: float(text) for key, text in zip(header, fields, strict=True) if text}
                yield int(row.pop("global_step")), row


def _summary(run_dir: Path) -> dict[str, Any] | None:
    file = run_dir / SUMMARY_FILE
    return json.loads(file.read_text()) if file.exists() else None


def _is_sent(file: Path) -> bool:
    marker = file.with_suffix(".wandb.synced")
    return marker.exists() and marker.stat().st_mtime >= file.stat().st_mtime


def _log_folder(folder: Path) -> str:
    """Where W&B's commands may write their logs; by default that is a new folder in the current one."""
    logs = folder.absolute() / ".home"
    logs.mkdir(exist_ok=True)
    return str(logs)


def _example() -> str:
    return "runs/paper/armless_humanoid-hidden-frozen/seed_3"


if __name__ == "__main__":
    sys.exit(main())
