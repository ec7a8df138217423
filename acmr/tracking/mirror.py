"""What trackers show of runs that exist already: in a terminal, on a server, written anew from a run's own files.

``python -m acmr.tracking.mirror dashboard [FOLDER]``, ``... sync --base-url URL [FOLDER]``, ``... rebuild RUN_DIR...``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from acmr.cells import plain_name
from acmr.command import command, typed
from acmr.config import ConfigError
from acmr.foreign import is_there, read_mapping
from acmr.names import terminal
from acmr.records import CONFIG_FILE, SUMMARY_FILE, DamagedError
from acmr.settings.compose import compose_config, options, parse
from acmr.settings.run_spec import RunSpec
from acmr.settings.stored import stored_config
from acmr.settings.validate import check_address
from acmr.text import message
from acmr.tracking.observer import Say
from acmr.tracking.wandb_backend import linked_mirrors, server_problem, wandb_environment
from acmr.tracking.watchers import make_tracker, recorded, replay

_EXAMPLE = "runs/paper/armless_humanoid-hidden-frozen/seed_3"


def rebuild(run_dir: Path, tracking: str, say: Say, folder: str | None = None) -> None:
    """Writes what a tracker shows of a run anew from the run's own files, in place of what there may be.

    Args:
        run_dir: The run's directory, finished or not: ``<output_dir>/<profile>/<run>/seed_<n>``.
        tracking: Name of a file in ``conf/tracking``, whichever the run itself was made with.
        say: Takes one line if it cannot be written.
        folder: Where mirrors go; None: ``<output_dir>/wandb``. What the run's own settings say of it may be of another
            machine, or of somebody else.

    Raises:
        ConfigError: If this is no run's directory.
    """
    run_dir = run_dir.resolve()
    try:
        config = stored_config(read_mapping(run_dir / CONFIG_FILE, CONFIG_FILE))
        summary = _summary(run_dir)
        # All of it before what there is of the mirror is removed.
        events = recorded(run_dir)
    except (DamagedError, ConfigError) as error:
        raise ConfigError(f"{run_dir} is no run's directory ({message(error)}); give one as in {_EXAMPLE}") from error
    chosen = parse(compose_config([f"tracking={tracking}", "tracking.base_url=null"])).tracking
    own = replace(config.tracking, tracker=chosen.tracker, options=chosen.options, base_url=None, dir=folder)
    # What is removed and written lies where the run does, whatever its files say.
    config = replace(config, tracking=own, **_place(run_dir, config.seed))
    name = run_dir.parent.name
    tracker = make_tracker(RunSpec(config, {}, name, _cell(summary), plain_name(name)), say)
    replay(tracker, events)
    tracker.close(summary)


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
    sent = (path for file in files for path in (file, file.parent / "files", *file.parent.glob("files/**/*")))
    if odd := next((path for path in sent if is_there(path) and not _is_plain(path)), None):
        raise ConfigError(f"{odd}: no regular file; W&B would send what it leads to. Move {odd.parent} away")
    if problem := server_problem(base_url):
        raise ConfigError(f"{len(files)} runs wait in {folder}, but {problem}")
    foreign = {key: value for key, value in os.environ.items() if not key.startswith("WANDB_")}
    variables = {**foreign, **wandb_environment(folder.absolute()), "WANDB_BASE_URL": base_url}
    del variables["WANDB_SILENT"]
    command = [sys.executable, "-m", "wandb", "sync", "--yes", "--include-online", "--include-synced"]
    # In its own folder W&B would look for settings, too.
    with tempfile.TemporaryDirectory() as logs:
        given = [*command, *(str(file.parent) for file in files)]
        subprocess.run(given, env=variables | {"WANDB_DIR": logs}, check=False)
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


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog=typed("mirror"), description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    again = commands.add_parser("rebuild", help="write the mirrors of runs anew from their own files")
    again.add_argument("--tracking", default="offline", choices=options("tracking"), help="default: offline (W&B)")
    again.add_argument("--dir", metavar="FOLDER", help="of the mirrors; default: wandb, in the folder of all runs")
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
                rebuild(run_dir, given.tracking, problems.append, given.dir)
        elif given.command == "dashboard":
            dashboard(given.folder)
        elif not given.base_url:
            problems.append(
                "no server is named; type make sync BASE_URL=http://HOST:PORT (or add --base-url http://HOST:PORT)"
            )
        else:
            check_address("--base-url", given.base_url)
            print(f"{sync(given.folder, given.base_url)} runs sent to {given.base_url}")
    except ConfigError as error:
        problems.append(str(error))
    for problem in problems:
        print(terminal(f"error: {problem}"), file=sys.stderr)
    return 2 if problems else 0


def _place(run_dir: Path, seed: int) -> dict[str, Any]:
    """The settings that a run's place follows from, ``<output_dir>/<profile>/<run>/seed_<n>``."""
    if len(run_dir.parts) < 5 or run_dir.name != f"seed_{seed}":
        raise ConfigError(
            f"{run_dir} is no run's directory (its settings are of seed {seed}); give one as in {_EXAMPLE}"
        )
    return {"output_dir": str(run_dir.parents[2]), "profile": run_dir.parents[1].name}


def _cell(summary: Mapping[str, Any] | None) -> str | None:
    said = (summary or {}).get("cell")
    return said if isinstance(said, str) else None


def _summary(run_dir: Path) -> dict[str, Any] | None:
    file = run_dir / SUMMARY_FILE
    return read_mapping(file, SUMMARY_FILE) if is_there(file) else None


def _is_sent(file: Path) -> bool:
    marker = file.with_suffix(".wandb.synced")
    return marker.exists() and marker.stat().st_mtime >= file.stat().st_mtime


def _is_plain(path: Path) -> bool:
    return not path.is_symlink() and (path.is_file() or path.is_dir())


def _log_folder(folder: Path) -> str:
    """Where W&B's commands may write their logs; by default that is a new folder in the current one."""
    logs = folder.absolute() / ".home"
    logs.mkdir(exist_ok=True)
    return str(logs)


if __name__ == "__main__":
    sys.exit(main())
