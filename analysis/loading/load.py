"""Run directories -> one tidy frame of episodes and one of runs.

Nothing that lies in the runs folder vanishes: what cannot be used is listed with its state and the reason.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from acmr.records import CELLS, EPISODE_COLUMNS, VELOCITY_COLUMN
from analysis.loading.episodes import EPISODE_FILES, DamagedError, read_episodes
from analysis.loading.identify import PAIRS, SEED, Identity, identify

#: States of runs that have come to their end, and so enter the comparisons. A run that diverged will never reach the
#: threshold: leaving it out would favor settings that break.
COUNTED = ("complete", "foreign", "diverged")
#: Folders that hold other files of the same names (of W&B, Hydra).
PASSED_OVER = ("wandb", "__pycache__")
#: Order of the groups: the paper's experiments, then the others by name.
CELL_ORDER = tuple(CELLS)

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class InputError(ValueError):
    """Input that cannot be analyzed. Its message is one line for the user."""


@dataclass(frozen=True)
class RunSet:
    """All that was found below one folder.

    Attributes:
        root: The runs folder.
        runs: One row a run, indexed by its path below the root: ``group, cell, seed, profile, env, transfer, freeze``
            (see :class:`~analysis.loading.identify.Identity`), ``state`` and ``reason``, ``counted`` (enters
            comparisons), ``episodes`` (number), ``last_step`` (end of the last episode), ``horizon`` (step up to which
            the run is known not to have reached the threshold, if it has not), ``learning_starts``, ``threshold``,
            ``consecutive``, ``wall_seconds``, ``steps_per_second``.
        episodes: One row an episode: ``run, group, seed`` and the columns of ``episodes.csv``; steps ascend within a
            run.
        configs: The settings of each run that has them.
        summaries: The summary of each run that has one.
    """

    root: Path
    runs: pd.DataFrame
    episodes: pd.DataFrame
    configs: dict[str, dict[str, Any]] = field(default_factory=dict)
    summaries: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def groups(self) -> list[str]:
        """Names of the groups that there are: the paper's cells first."""
        found = set(self.runs["group"])
        return [cell for cell in CELL_ORDER if cell in found] + sorted(found - set(CELL_ORDER))

    @property
    def pair(self) -> tuple[str, str]:
        """Names of the source and the target environment."""
        for config in self.configs.values():
            pair = config.get("pair")
            if isinstance(pair, dict) and {"source", "target"} <= set(pair):
                return str(pair["source"]), str(pair["target"])
        for pair in PAIRS:
            if set(pair) & set(self.runs["env"].dropna()):
                return pair
        return PAIRS[0]


def load(root: Path) -> RunSet:
    """Reads every run below a folder.

    Args:
        root: Usually ``runs/<profile>``; any layout whose runs end in ``<name>/seed_<n>`` is found.

    Raises:
        InputError: If there is no such folder, or it holds runs of more than one profile.
    """
    if not root.is_dir():
        what = "is no folder" if root.exists() else "there is no such folder"
        raise InputError(f"{root}: {what}; give one with runs, as in runs/paper (python run.py matrix=paper makes it)")
    found = [_read_run(root, directory, problem) for directory, problem in _run_directories(root)]
    rows, frames, configs, summaries = [], {}, {}, {}
    for row, frame, config, summary in found:
        name = row["run"]
        rows.append(row)
        frames[name] = frame
        configs.update({name: config} if config else {})
        summaries.update({name: summary} if summary else {})
    runs = _runs_frame(rows)
    _one_profile(root, runs)
    _mark_duplicates(runs)
    return RunSet(root, runs, _episodes_frame(runs, frames), configs, summaries)


def _run_directories(root: Path) -> Iterator[tuple[Path, str]]:
    problems: list[OSError] = []
    for folder, children, files in os.walk(root, onerror=problems.append):
        children[:] = sorted(child for child in children if child not in PASSED_OVER and not child.startswith("."))
        path = Path(folder)
        if SEED.fullmatch(path.name) or {*EPISODE_FILES, "summary.json"} & set(files):
            children.clear()
            yield path, ""
    for problem in problems:
        yield Path(str(problem.filename)), f"cannot be read: {problem.strerror}"


def _read_run(
    root: Path, directory: Path, problem: str
) -> tuple[dict[str, Any], pd.DataFrame, dict[str, Any], dict[str, Any]]:
    notes = [problem] if problem else []
    damaged = bool(problem)
    config, summary, frame = {}, {}, _no_episodes()
    try:
        config = _mapping_of(directory / "config.yaml")
        summary = _mapping_of(directory / "summary.json")
        path = next((directory / name for name in EPISODE_FILES if (directory / name).is_file()), None)
        if path is not None:
            frame, said = read_episodes(path)
            notes += said
        elif not problem:
            notes.append("no episodes.csv")
    except DamagedError as error:
        notes.append(str(error))
        damaged = True
    name = directory.relative_to(root).as_posix()
    parent = Path(name).parent.as_posix() if directory != root else directory.resolve().parent.name
    identity = identify(directory, parent if parent != "." else root.resolve().name, config, summary)
    state, reasons = ("damaged", []) if damaged else _state(directory, identity, frame, config, summary, notes)
    row = {"run": name, **vars(identity), "state": state, "reason": "; ".join([*notes, *reasons])}
    return {**row, **_measures(state, frame, config, summary)}, frame, config, summary


def _mapping_of(path: Path) -> dict[str, Any]:
    """Contents of a YAML or JSON file; empty if there is no such file."""
    if not path.is_file():
        return {}
    try:
        text = path.read_text(encoding="utf-8")
        value = json.loads(text) if path.suffix == ".json" else _yaml(text)
    except (OSError, ValueError, yaml.YAMLError, RecursionError):
        raise DamagedError(f"{path.name}: cannot be read") from None
    if not isinstance(value, dict):
        raise DamagedError(f"{path.name}: holds no settings")
    return value


def _yaml(text: str) -> Any:
    # No run writes aliases; in a foreign file they can hold a mapping within itself, or a billion of them.
    if "*" in text and any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, _LOADER)):
        raise ValueError("aliases")
    return yaml.load(text, _LOADER)


def _state(
    directory: Path,
    identity: Identity,
    frame: pd.DataFrame,
    config: dict[str, Any],
    summary: dict[str, Any],
    notes: list[str],
) -> tuple[str, list[str]]:
    if identity.seed is None:
        return "damaged", ["its seed is not known: call its folder seed_<n>"]
    if summary:
        return _ended_state(frame, summary, notes)
    if not config and len(frame):
        return "foreign", ["no config.yaml and no summary.json: taken as complete"]
    return "unfinished", [_unfinished(directory)]


def _ended_state(frame: pd.DataFrame, summary: dict[str, Any], notes: list[str]) -> tuple[str, list[str]]:
    count = summary.get("episodes")
    if isinstance(count, int) and count != len(frame):
        return "damaged", [f"summary.json counts {count} episodes, episodes.csv {len(frame)}"]
    if count is None and notes and not len(frame):
        return "damaged", []
    reasons = []
    if summary.get("cause"):
        reasons.append(f"at step {summary.get('step', '?')}: {summary['cause']}")
    if summary.get("inexact_resumes"):
        reasons.append(f"resumed inexactly: {json.dumps(summary['inexact_resumes'])}")
    if summary.get("physics_warnings"):
        reasons.append(f"warnings of MuJoCo: {json.dumps(summary['physics_warnings'])}")
    return str(summary.get("status", "complete")), reasons


def _unfinished(directory: Path) -> str:
    try:
        said = _mapping_of(directory / "status.json")
        return f"no summary.json; {said['state']} at step {said['global_step']:,} of {said['total_timesteps']:,}"
    except (DamagedError, LookupError, TypeError, ValueError):
        return "no summary.json"


def _measures(
    state: str, frame: pd.DataFrame, config: dict[str, Any], summary: dict[str, Any]
) -> dict[str, float | int | None]:
    last = int(frame["global_step"].iloc[-1]) if len(frame) else 0
    total = _number(summary.get("total_timesteps", config.get("total_timesteps")))
    reached = _number(summary.get("global_step"))
    # What a run that diverged would have returned afterwards is known: nothing. It did not reach in all its time.
    ends = {"complete": (reached, total), "diverged": (total, reached)}.get(state, ())
    agent = config.get("agent")
    starts = agent.get("learning_starts") if isinstance(agent, dict) else None
    return {
        "episodes": len(frame),
        "last_step": last,
        "horizon": max(last, int(next((end for end in ends if end is not None), last))),
        "total_timesteps": total,
        "learning_starts": _number(starts),
        "threshold": _number(summary.get("threshold", config.get("threshold"))),
        "consecutive": _number(summary.get("consecutive", config.get("consecutive"))),
        "wall_seconds": _number(summary.get("wall_seconds")),
        "steps_per_second": _number(summary.get("steps_per_second")),
        "steps_in_summary": _number(summary.get("steps_to_threshold")),
    }


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


_RUN_COLUMNS = (
    *("run", "group", "cell", "seed", "profile", "env", "transfer", "freeze", "state", "reason"),
    *("episodes", "last_step", "horizon", "total_timesteps", "learning_starts", "threshold", "consecutive"),
    *("wall_seconds", "steps_per_second", "steps_in_summary"),
)
_FLOATS = _RUN_COLUMNS[_RUN_COLUMNS.index("total_timesteps") :]


def _runs_frame(rows: list[dict[str, Any]]) -> pd.DataFrame:
    frame = pd.DataFrame(rows, columns=list(_RUN_COLUMNS))
    frame = frame.astype({**dict.fromkeys(_FLOATS, "float64"), "seed": "Int64"})
    frame = frame.astype(dict.fromkeys(("episodes", "last_step", "horizon"), "int64"))
    position = {cell: index for index, cell in enumerate(CELL_ORDER)}
    frame["order"] = [position.get(group, len(position)) for group in frame["group"]]
    frame = frame.sort_values(["order", "group", "seed", "run"], kind="stable").drop(columns="order")
    frame["counted"] = frame["state"].isin(COUNTED)
    return frame.set_index("run")


def _one_profile(root: Path, runs: pd.DataFrame) -> None:
    profiles = sorted(set(runs["profile"].dropna()))
    if len(profiles) > 1:
        raise InputError(
            f"{root}: holds runs of the profiles {', '.join(profiles)}, which are no one experiment; "
            f"give one of them, as in {root / profiles[0]}"
        )


def _mark_duplicates(runs: pd.DataFrame) -> None:
    """Of several directories that claim one group and seed, only one may count: a finished one, else the first."""
    for _, same in runs[runs["state"] != "damaged"].groupby(["group", "seed"]):
        if len(same) > 1:
            kept = same.sort_values("counted", ascending=False, kind="stable").index[0]
            others = [name for name in same.index if name != kept]
            runs.loc[others, "state"] = "duplicate"
            runs.loc[others, "reason"] = f"{kept} is the same group and seed"
            runs.loc[others, "counted"] = False


def _no_episodes() -> pd.DataFrame:
    columns = dict.fromkeys(EPISODE_COLUMNS, "int64") | {"episodic_return": "float64", VELOCITY_COLUMN: "float64"}
    return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in columns.items()})


def _episodes_frame(runs: pd.DataFrame, frames: dict[str, pd.DataFrame]) -> pd.DataFrame:
    order = list(runs.index)
    lengths = [len(frames[name]) for name in order]
    filled = [frames[name] for name in order if len(frames[name])] or [_no_episodes()]
    table = pd.concat(filled, ignore_index=True)
    repeat = np.repeat(np.arange(len(order)), lengths)
    table.insert(0, "run", pd.CategoricalIndex(pd.Categorical.from_codes(repeat, categories=pd.Index(order))))
    table.insert(1, "group", runs["group"].to_numpy()[repeat] if len(order) else [])
    table.insert(2, "seed", runs["seed"].array[repeat] if len(order) else [])
    return table
