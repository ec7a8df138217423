"""Finished runs -> a folder that can be committed: ``python -m analysis.publish runs/paper results/paper``.

With each run go its networks and an evaluation of them; what is left out is large or of no use elsewhere: checkpoints,
logs, films. The folder is analyzed as the runs are, and its networks can be evaluated and transferred from.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acmr.cells import CELLS
from acmr.command import command, typed
from acmr.config import THRESHOLD, TransferConfig
from acmr.foreign import is_there, read_bytes, read_mapping
from acmr.names import terminal
from acmr.records import (
    COMPLETE,
    CONFIG_FILE,
    DESCRIPTION_FILE,
    EPISODES_FILE,
    EVALUATION_FILE,
    FILES_ENTRY,
    METRICS_FILE,
    SEALED_FILES,
    SUMMARY_FILE,
    TENSOR_FILE,
    TRANSFER_FILE,
    DamagedError,
    ended_state,
)
from acmr.run_folders import changes, run_folders, sealed
from acmr.text import size
from analysis.evaluations import adds_up
from analysis.portable import SLIM_RECORDS, portable_file, slim_file

#: A table above this is compressed; networks above it are published in half precision, unless students learn from them.
LARGE = 1_000_000
#: What the folder of all published runs may hold in all, in bytes: every clone of the project carries it.
MOST = 60_000_000
#: Taken for an evaluation before it is made.
EVALUATION_BYTES = 8_000
RECORDS = (CONFIG_FILE, SUMMARY_FILE, EPISODES_FILE, METRICS_FILE, TRANSFER_FILE)
NETWORKS = (TENSOR_FILE, DESCRIPTION_FILE)
#: What every published policy is asked for: deterministic episodes, and the environment seed of the first.
EPISODES, FIRST_SEED = 20, 0


class PublishError(ValueError):
    """Runs that cannot be published. Its message is one line for the user."""


@dataclass
class Published:
    """What came of it.

    Attributes:
        added: Run directories below the folder to which something was added.
        there: Those that were whole already.
        left_out: A line for each evaluation that could not be made.
    """

    added: list[Path] = field(default_factory=list)
    there: list[Path] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def _silent(line: str) -> None: ...


def publish(
    runs: Path, out: Path, say: Callable[[str], None] = _silent, trust: bool = False, small: bool = False
) -> Published:
    """Copies the records of every run that has come to its end, and the networks with an evaluation of those complete.

    Args:
        runs: Folder of runs, as ``runs/paper``.
        out: Folder that they are added to, under the same names.
        say: Told of every evaluation before it is made, for it takes a while.
        trust: Whether an evaluation may run the code that a run's own files name.
        small: Whether to keep a few kilobytes of each run (:mod:`analysis.portable`): of its episodes what measures
            need, no metrics, no evaluation, and networks, in half precision, only of runs that took nothing.

    Raises:
        PublishError: If there is nothing to publish, ``out`` holds other results of a run, or it would become too
            large; then nothing is written.
    """
    folders = [folder.path for folder in run_folders(runs) if is_there(folder.path / SUMMARY_FILE)]
    with tempfile.TemporaryDirectory() as scratch:
        found = {
            path.relative_to(runs): files
            for path in folders
            if (files := _files(path, out / path.relative_to(runs), Path(scratch), small))
        }
    if not found:
        raise PublishError(f"{runs}: no run has come to its end there; make status says how far they are")
    for run, files in found.items():
        differing = [name for name, data in files.items() if _other(out / run / name, data)]
        if differing:
            raise PublishError(
                f"{out / run}: {', '.join(differing)} of another run there; remove that folder or give another one"
            )
    missing = {run: [name for name in files if not (out / run / name).exists()] for run, files in found.items()}
    _check_size(out, runs, sum(_bytes_of(found[run], names) for run, names in missing.items()))
    done = Published()
    for run, names in missing.items():
        (out / run).mkdir(parents=True, exist_ok=True)
        for name in names:
            _write(out / run / name, found[run][name])
        evaluated = not small and _evaluate(runs / run, out / run, say, done.left_out, trust)
        (done.added if names or evaluated else done.there).append(out / run)
    return done


def _files(run: Path, target: Path, scratch: Path, small: bool) -> dict[str, bytes]:
    """Names and contents of what is published of a run, but for its evaluation; nothing if it has not ended."""
    try:
        summary = read_mapping(run / SUMMARY_FILE)
    except DamagedError as error:
        raise PublishError(f"{error}; move that run away, or make it anew") from None
    if ended_state(summary) is None:
        return {}
    if changed := changes(run, summary):
        raise PublishError(f"{run}: {'; '.join(changed.values())}; put back what the run wrote, or make it anew")
    records = SLIM_RECORDS if small else RECORDS
    files = dict(_packed(run / name, small) for name in records if is_there(run / name))
    files[SUMMARY_FILE] = _resealed(summary, files)
    # The networks of a run that diverged are of no use.
    usable = ended_state(summary) == COMPLETE and (not small or summary.get("transfer") == TransferConfig().name)
    if usable and all(is_there(run / name) for name in NETWORKS):
        is_full = not small and (_teaches(summary) or len(_portable(run / TENSOR_FILE)) <= LARGE)
        source = run if is_full else _halved(run, target, scratch)
        files |= {name: _portable(source / name) for name in NETWORKS}
    return files


def _resealed(summary: dict[str, Any], files: dict[str, bytes]) -> bytes:
    """The summary as it is published: it tells what the published files hold, which may be less than the run's do."""
    if FILES_ENTRY not in summary:
        return files[SUMMARY_FILE]
    digests = {}
    for name in (name for name in SEALED_FILES if name in files or f"{name}.gz" in files):
        data = files[name] if name in files else gzip.decompress(files[f"{name}.gz"])
        digests[name] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    if digests == summary[FILES_ENTRY]:
        return files[SUMMARY_FILE]
    return (json.dumps(sealed(summary, digests), indent=2) + "\n").encode()


def _teaches(summary: dict[str, Any]) -> bool:
    """Whether students learn from this run: the very networks then, so that what they learn can be made again."""
    cell = CELLS.get(str(summary.get("cell")))
    cut = summary.get("stop") == THRESHOLD and summary.get("global_step") != summary.get("total_timesteps")
    return cell is not None and cell.teaches and not cut


def _halved(run: Path, target: Path, scratch: Path) -> Path:
    """A folder with the networks in half precision: the published one if they are there, else one in ``scratch``."""
    own, published = _json(run / DESCRIPTION_FILE), _json(target / DESCRIPTION_FILE)
    if own.get("full_sha256") or (published and published.get("full_sha256") == own.get("sha256")):
        return run if own.get("full_sha256") else target
    folder = Path(tempfile.mkdtemp(dir=scratch))
    problem = _run("acmr.transfer.half", str(run), str(folder))
    if problem:
        raise PublishError(problem)
    return folder


def _evaluate(run: Path, target: Path, say: Callable[[str], None], left_out: list[str], trust: bool) -> bool:
    """Adds an evaluation of the published networks, if there are networks and it is not there; whether it did."""
    path, about = target / EVALUATION_FILE, _json(target / DESCRIPTION_FILE)
    if path.exists() or not about:
        return False
    wanted = {"policy": "deterministic", "seed": FIRST_SEED, "episodes": EPISODES, "sha256": about.get("sha256")}
    own = _json(run / EVALUATION_FILE)
    # Of an earlier version it lacks some of its numbers, changed since it has others: then it is made anew.
    if own | wanted == own and adds_up(own):
        _write(path, _portable(run / EVALUATION_FILE))
        return True
    say(f"evaluating {target}, {EPISODES} episodes")
    # Relative, so that no path of this machine is published.
    arguments = (os.path.relpath(target), "--episodes", str(EPISODES), "--seed", str(FIRST_SEED))
    problem = _run("acmr.evaluation", *arguments, *(["--trust"] if trust else []))
    if problem:
        left_out.append(f"no {EVALUATION_FILE} in {target}: {problem}")
    return not problem


def _run(module: str, *arguments: str) -> str:
    """Runs a module of the training's side, which the analysis does not load; what it said if it failed, else empty."""
    done = subprocess.run([sys.executable, "-m", module, *arguments], capture_output=True, text=True, check=False)
    if not done.returncode:
        return ""
    lines = done.stderr.strip().splitlines() or [f"{module} ended with code {done.returncode}"]
    return lines[-1].removeprefix("error: ")


def _json(path: Path) -> dict[str, Any]:
    """Contents of a JSON file; empty if it is not there or holds no mapping."""
    try:
        return read_mapping(path)
    except DamagedError:
        return {}


def _bytes_of(files: dict[str, bytes], names: list[str]) -> int:
    more = EVALUATION_BYTES if TENSOR_FILE in names else 0
    return sum(len(files[name]) for name in names) + more


def _check_size(out: Path, runs: Path, more: int) -> None:
    # What is committed is the folder of all profiles; figures that lie beside the runs are not.
    place = out.resolve()
    whole = next((folder for folder in (place, *place.parents) if folder.name == "results"), place)
    total = more + sum(path.stat().st_size for path in whole.glob("**/seed_*/*") if path.is_file())
    if total > MOST:
        raise PublishError(
            f"{os.path.relpath(whole)}: would hold {size(total)} of runs, and {size(MOST)} are the most that a clone "
            f"should carry; publish fewer of them, as in {typed('publish')} {runs}/NAME {out}/NAME"
        )


def _packed(path: Path, small: bool) -> tuple[str, bytes]:
    data = _portable(path)
    if small:
        return slim_file(path.name, data)
    if path.suffix != ".csv" or len(data) <= LARGE:
        return path.name, data
    return f"{path.name}.gz", gzip.compress(data, mtime=0)


def _portable(path: Path) -> bytes:
    """What is published of a file: nothing that only concerns this machine."""
    try:
        return portable_file(path.name, read_bytes(path, title=path.name))
    except DamagedError as error:
        raise PublishError(f"{path.parent}: {error}; move that run away, or make it anew") from None


def _other(path: Path, data: bytes) -> bool:
    """Whether something else lies there; what earlier versions have published says more of the machine."""
    try:
        return is_there(path) and portable_file(path.name, read_bytes(path)) != data
    except DamagedError:
        return True


def _write(path: Path, data: bytes) -> None:
    unfinished = path.with_name(f".{path.name}.tmp")
    # A link of that name would be written through.
    unfinished.unlink(missing_ok=True)
    unfinished.write_bytes(data)
    os.replace(unfinished, path)


def _print(line: str) -> None:
    print(terminal(line), flush=True)


def _report(done: Published) -> Iterator[str]:
    for run in done.added:
        yield f"added    {run} ({size(sum(path.stat().st_size for path in run.iterdir()))})"
    for run in done.there:
        yield f"is there {run}"
    yield from done.left_out


@command
def main() -> int:
    """Entry of ``python -m analysis.publish``."""
    parser = argparse.ArgumentParser(prog=typed("publish"), description="Finished runs, to be committed.")
    parser.add_argument("runs", type=Path, help="folder of runs, as runs/paper")
    parser.add_argument("out", type=Path, help="where they are added, as results/paper")
    parser.add_argument("--trust", action="store_true", help="run code that the runs' own files name, to evaluate them")
    parser.add_argument("--small", action="store_true", help="keep a few kilobytes of each run")
    given = parser.parse_args()
    try:
        done = publish(given.runs, given.out, _print, given.trust, given.small)
        print("\n".join(map(terminal, _report(done))))
    except (OSError, ValueError) as error:
        print(terminal(f"analysis.publish: {error}"), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
