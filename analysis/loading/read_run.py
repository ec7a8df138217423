"""One run's directory -> its row, its episodes, its settings; or the reason why it cannot be used."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from acmr.cells import draws_apart, stops
from acmr.config import INDEPENDENT, POLICY, THRESHOLD
from acmr.foreign import is_there
from acmr.records import (
    COMPLETE,
    CONFIG_FILE,
    DIVERGED,
    ENDED,
    EPISODE_COLUMNS,
    EPISODE_FILES,
    EPISODES_FILE,
    RUNNING,
    STATUS_FILE,
    STOPPED,
    SUMMARY_FILE,
    VELOCITY_COLUMN,
    DamagedError,
    ended_state,
    unended_reason,
)
from acmr.run_folders import RunFolder
from acmr.text import LONGEST_MESSAGE
from analysis.loading.episodes import read_episodes
from analysis.loading.identify import Identity, identify
from analysis.loading.run_files import RunFiles, read_files
from analysis.loading.values import MOST_STEPS, number, read_mapping

#: States of a run that is there, beside those that it says itself.
FOREIGN, UNFINISHED, UNKNOWN, DAMAGED, DUPLICATE = "foreign", "unfinished", "unknown", "damaged", "duplicate"
#: A run that stopped at its threshold, of which there is a longer one.
SUPERSEDED = "superseded"


@dataclass(frozen=True)
class FoundRun:
    """What lies in one directory.

    Attributes:
        row: What is known of the run, by the columns of the table ``runs`` of :class:`~analysis.loading.load.RunSet`.
        episodes: Its episodes, empty if they cannot be read.
        config: Its settings, empty if there are none.
        summary: Its summary, empty if there is none.
    """

    row: dict[str, Any]
    episodes: pd.DataFrame
    config: dict[str, Any]
    summary: dict[str, Any]


def read_run(root: Path, folder: RunFolder) -> FoundRun:
    """Reads one run; whatever is wrong with it becomes its state and reason.

    Args:
        root: The runs folder.
        folder: The run's.
    """
    directory, problem = folder.path, folder.problem
    notes = [problem] if problem else []
    files, frame, said = read_files(directory), no_episodes(), list[str]()
    notes += files.problems
    damaged = bool(notes)
    if not files.problems:
        try:
            frame, said = _episodes(directory, files)
            notes += said if len(frame) or not problem else []
        except DamagedError as error:
            notes.append(str(error))
            damaged = True
    name = directory.relative_to(root).as_posix()
    parent = Path(name).parent.as_posix() if directory != root else directory.resolve().parent.name
    config, summary = files.config, files.summary
    parent = parent if parent != "." else root.resolve().name
    identity = identify(directory, parent, config, summary)
    state, reasons = (DAMAGED, []) if damaged else _state(directory, identity, frame, files, notes)
    measures = _measures(state, frame, config, summary)
    doubts = [*files.doubts, *_unknown(state, measures)]
    reasons += [*doubts, *files.left_out]
    reasons += [f"also found as {other.relative_to(root).as_posix()}" for other in folder.others]
    row = {"run": name, **vars(identity), "state": state, "reason": "; ".join([*notes, *reasons])}
    row |= measures | _stop(parent, frame, config, summary) | {"doubts": "; ".join([*said, *doubts])}
    seeding = summary.get("seeding", config.get("seeding"))
    row["apart"] = draws_apart(parent) if seeding is None else seeding == INDEPENDENT
    if state == DIVERGED and not pd.isna(row["stop_after"]):
        row["horizon"] = int(row["stop_after"])  # it would not have been watched any longer
    elif state == UNFINISHED:
        row["horizon"] = max(row["horizon"], _steps_said(directory))
    return FoundRun(row, frame, config, summary)


def _episodes(directory: Path, files: RunFiles) -> tuple[pd.DataFrame, list[str]]:
    path = next((directory / name for name in EPISODE_FILES if is_there(directory / name)), None)
    if path is None:
        return no_episodes(), [f"no {EPISODES_FILE}"]
    return read_episodes(path, own=files.begun, ended=bool(files.summary))


def _state(
    directory: Path, identity: Identity, frame: pd.DataFrame, files: RunFiles, notes: list[str]
) -> tuple[str, list[str]]:
    if identity.seed is None:
        return DAMAGED, ["its seed is not known: call its folder seed_<n>, n a whole number below 2^63"]
    if files.summary:
        return _ended_state(frame, files.summary, notes)
    if not files.begun and len(frame):
        return FOREIGN, [f"no {CONFIG_FILE} and no {SUMMARY_FILE}: taken as complete"]
    return UNFINISHED, [_unfinished(directory)]


def _unknown(state: str, measures: Mapping[str, float | int | None]) -> list[str]:
    """What a run that counts does not tell of itself."""
    if state not in ENDED or measures["acts_from"] is not None:
        return []
    return ["how many actions it began with at random is not known, and so its initial return is not"]


def _ended_state(frame: pd.DataFrame, summary: dict[str, Any], notes: list[str]) -> tuple[str, list[str]]:
    count = summary.get("episodes")
    if isinstance(count, int) and count != len(frame):
        return DAMAGED, [f"{SUMMARY_FILE} counts {count} episodes, {EPISODES_FILE} {len(frame)}"]
    if count is None and notes and not len(frame):
        return DAMAGED, []
    state = ended_state(summary)
    if state is None:
        unfinished = summary["status"] in (RUNNING, STOPPED)
        return UNFINISHED if unfinished else UNKNOWN, [unended_reason(summary)]
    reasons = []
    if summary.get("cause"):
        reasons.append(f"at step {summary.get('step', '?')}: {summary['cause']}"[:LONGEST_MESSAGE])
    if summary.get("inexact_resumes"):
        reasons.append(f"resumed inexactly: {json.dumps(summary['inexact_resumes'])}"[:LONGEST_MESSAGE])
    if summary.get("physics_warnings"):
        reasons.append(f"warnings of MuJoCo: {json.dumps(summary['physics_warnings'])}"[:LONGEST_MESSAGE])
    return state, reasons


def _unfinished(directory: Path) -> str:
    try:
        said = read_mapping(directory / STATUS_FILE)
        steps = f"{said['state']} at step {said['global_step']:,} of {said['total_timesteps']:,}"
        return f"no {SUMMARY_FILE}; {steps[:LONGEST_MESSAGE]}"
    except (DamagedError, LookupError, TypeError, ValueError):
        return f"no {SUMMARY_FILE}"


def _measures(
    state: str, frame: pd.DataFrame, config: dict[str, Any], summary: dict[str, Any]
) -> dict[str, float | int | None]:
    last = int(frame["global_step"].iloc[-1]) if len(frame) else 0
    total = number(summary.get("total_timesteps", config.get("total_timesteps")))
    reached = number(summary.get("global_step"))
    # What a run that diverged would have returned afterwards is known: nothing. It did not reach in all its time.
    ends = {COMPLETE: (reached, total), DIVERGED: (total, reached)}.get(state, ())
    given = config.get("agent")
    agent = given if isinstance(given, dict) else {}
    starts = number(agent.get("learning_starts"))
    return {
        "episodes": len(frame),
        "last_step": last,
        "horizon": max(last, int(next((end for end in ends if end is not None), last))),
        "total_timesteps": total,
        "learning_starts": starts,
        "acts_from": 0.0 if agent.get("start") == POLICY or state == FOREIGN else starts,
        "threshold": number(summary.get("threshold", config.get("threshold"))),
        "consecutive": number(summary.get("consecutive", config.get("consecutive"))),
        "wall_seconds": number(summary.get("wall_seconds")),
        "steps_per_second": number(summary.get("steps_per_second")),
        "steps_in_summary": number(summary.get("steps_to_threshold")),
    }


def _stop(name: str, frame: pd.DataFrame, config: dict[str, Any], summary: dict[str, Any]) -> dict[str, Any]:
    """Whether a run ends at its own threshold before its last step, and when it does at the latest."""
    said = summary.get("stop", config.get("stop"))
    stopping = stops(name) if said is None else said == THRESHOLD
    total = number(summary.get("total_timesteps", config.get("total_timesteps")))
    end = number(summary.get("global_step")) or (frame["global_step"].iloc[-1] if len(frame) else 0)
    after = number(summary.get("stop_after", config.get("stop_after")))
    return {"cut": stopping and (total is None or end < total), "stop_after": after if stopping else None}


def _steps_said(directory: Path) -> int:
    """Steps that a run under way says it has taken: without an episode's end among them, it has not reached by then."""
    try:
        said = read_mapping(directory / STATUS_FILE).get("global_step")
    except DamagedError:
        return 0
    return said if isinstance(said, int) and 0 < said < MOST_STEPS else 0


def no_episodes() -> pd.DataFrame:
    """The frame of episodes without any."""
    columns = dict.fromkeys(EPISODE_COLUMNS, "int64") | {"episodic_return": "float64", VELOCITY_COLUMN: "float64"}
    return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in columns.items()})
