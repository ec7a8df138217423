"""The contract of a run's directory: its files, its states, its columns, and the measure that the paper takes from it.

What ``acmr`` writes, ``sweeps`` watches and ``analysis`` reads is agreed here and nowhere else. Standard library only,
so that none of them has to load what the others need.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

#: Every setting of a run; written first, so that a directory which holds a run has it.
CONFIG_FILE = "config.yaml"
#: One row an episode, one row ``log_every`` steps.
EPISODES_FILE, METRICS_FILE = "episodes.csv", "metrics.csv"
#: What a run's episodes may lie in; the first that is there is read.
EPISODE_FILES = (EPISODES_FILE, f"{EPISODES_FILE}.gz")
#: What was copied, fresh and frozen.
TRANSFER_FILE = "transfer.json"
#: Written last: a run that has it came to its end.
SUMMARY_FILE = "summary.json"
#: What the run is doing right now, and what was said, with times.
STATUS_FILE, LOG_FILE = "status.json", "run.log"
#: The final networks of a run, and their description.
TENSOR_FILE, DESCRIPTION_FILE = "teacher.safetensors", "teacher.json"
#: What ``python -m acmr.evaluation`` adds afterwards.
EVALUATION_FILE = "evaluation.json"
#: Folder of TensorBoard's event files: they show a run, and are no result.
EVENTS_FOLDER = "tensorboard"
#: A run's place below the folder of all runs is ``<profile>/<name>/seed_<n>``.
#: The greatest seed: the greatest integer that every reader of CSV and JSON holds exactly.
MOST_SEED = 2**53 - 1
#: The most episodes in a row, and the greatest return in size, that a run is judged by.
MOST_CONSECUTIVE, MOST_RETURN = 2**31, 1e100
SEED_FOLDER = re.compile(r"seed_(\d+)")

#: States of a run that is under way, was asked to stop or was ended by an error, as ``status.json`` names them.
RUNNING, STOPPED, FAILED = "running", "stopped", "failed"
#: States of a run that came to its end, as ``status.json`` and ``summary.json`` name them.
COMPLETE, DIVERGED = "complete", "diverged"
ENDED = (COMPLETE, DIVERGED)
#: Entries of ``summary.json``: the size and SHA-256 of each of the files below, and the SHA-256 of all other entries.
FILES_ENTRY, SEAL_ENTRY = "files", "sha256"
#: What a finished run is judged by: its settings and its two tables.
SEALED_FILES = (CONFIG_FILE, EPISODES_FILE, METRICS_FILE)
#: What other programs call a run that came to its end.
_FINISHED = ("completed", "finished", "done", "success", "successful", "succeeded", "ended", "ok")
#: How a path begins that says where something lies on one machine; a leading dot or name says less.
_ON_THIS_MACHINE = re.compile(r"/.|~|\.\./|file://|[A-Za-z]:[\\/]")
#: What is said of a run that came to its end before any of its episodes did.
NO_EPISODE = "no episode ended"

#: The first columns of every ``episodes.csv``; a file with only these is complete.
EPISODE_COLUMNS = ("global_step", "episodic_return", "episode_length")
#: Further columns, where the environment reports them; ``reward_*`` columns (sums of the reward's terms) follow.
VELOCITY_COLUMN = "mean_forward_velocity"
#: The first columns of every ``metrics.csv``; those of the learner follow.
METRIC_COLUMNS = ("global_step", "steps_per_second")
#: What an environment's ``info`` calls its forward velocity, in m/s.
VELOCITY_KEY = "x_velocity"
#: Where ``info`` holds the reward of the environment itself, if wrappers around it may have changed it.
RAW_REWARD_KEY = "acmr_raw_reward"
#: How the names of the terms of the reward begin in an environment's ``info``.
REWARD_PREFIX = "reward_"


def ended_state(summary: Mapping[str, Any]) -> str | None:
    """How a run ended by its ``summary.json``: one of ``ENDED``, whatever the program that wrote it calls that.

    Args:
        summary: The file's contents. Without a status it is of a run that came to its end, as the file is written last.

    Returns:
        None if its status is another word.
    """
    said = summary.get("status")
    word = COMPLETE if said is None else str(said).strip().lower()
    return COMPLETE if word in _FINISHED else word if word in ENDED else None


def unended_reason(summary: Mapping[str, Any]) -> str:
    """Why a run with a ``summary.json`` has not ended: it says so itself, or its status is no known word."""
    said = str(summary.get("status"))
    if said in (RUNNING, STOPPED):
        return f"{SUMMARY_FILE} says that it is {said}"
    known = ", ".join((*ENDED, RUNNING, STOPPED))
    return f"{SUMMARY_FILE}: status {said[:40]!r} is not known; write one of {known}"


def portable(value: Any) -> Any:
    """A value as it goes to others, who are not to be told where things lie on this machine.

    Of such a path the last name is left, and of a run's directory the one before it, too: ``humanoid-none/seed_1``.

    Args:
        value: As JSON and YAML hold it; other paths, and all else, stay as they are.
    """
    if isinstance(value, Mapping):
        return {key: portable(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [portable(entry) for entry in value]
    if not isinstance(value, str) or not _ON_THIS_MACHINE.match(value):
        return value
    parts = PurePosixPath(value).parts
    # The third from the end of a short path may be somebody's home.
    is_run = len(parts) > 4 and SEED_FOLDER.fullmatch(parts[-1])
    return "/".join(parts[-2:] if is_run else parts[-1:])


def portable_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as they go to others: without paths of this machine, and without what only shows the run.

    Args:
        settings: All settings of a run, or some.
    """
    kept = {key: portable(value) for key, value in settings.items() if key != "tracking"}
    return kept | {"output_dir": "runs"} if "output_dir" in kept else kept


def description_sha256(content: Mapping[str, Any]) -> str:
    """The hash of all entries of ``teacher.json`` but itself, as it stands in the file."""
    rest = {name: value for name, value in content.items() if name != "description_sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


class DamagedError(Exception):
    """A file of a run does not hold what was written to it. The message says which file and what is wrong."""


@dataclass(frozen=True)
class EpisodeRecord:
    """One finished episode.

    Attributes:
        global_step: Environment steps taken in the run when the episode ended, this one's last step included.
        episodic_return: Sum of the raw rewards.
        episode_length: Steps in the episode.
        mean_forward_velocity: Mean ``x_velocity`` in m/s over the steps that it was reported with, NaN if there were
            none; None where the environment never reports it.
        reward_terms: Sum over the episode of each ``reward_*`` term that the environment reports.
    """

    global_step: int
    episodic_return: float
    episode_length: int
    mean_forward_velocity: float | None = None
    reward_terms: dict[str, float] = field(default_factory=dict)

    @classmethod
    def from_row(cls, global_step: int, row: Mapping[str, float]) -> EpisodeRecord:
        """The episode of a row of ``episodes.csv``.

        Raises:
            KeyError: If one of ``EPISODE_COLUMNS`` is missing.
        """
        terms = dict(row)
        total, length = (terms.pop(name) for name in EPISODE_COLUMNS[1:])
        velocity = terms.pop(VELOCITY_COLUMN, None)
        return cls(global_step, total, int(length), velocity, terms)

    def row(self) -> dict[str, float]:
        """The episode as a row of ``episodes.csv``: its columns, in their order, after ``global_step``."""
        own = dict(zip(EPISODE_COLUMNS[1:], (self.episodic_return, self.episode_length), strict=True))
        velocity = {} if self.mean_forward_velocity is None else {VELOCITY_COLUMN: self.mean_forward_velocity}
        return {**own, **velocity, **self.reward_terms}


@dataclass
class EpisodeInProgress:
    """Sums over the current episode.

    Attributes:
        terms: Names of the reward's terms that the environment reports with each step.
        velocity: Whether it reports its forward velocity.
        reports: Steps that it reported its velocity with.
    """

    terms: tuple[str, ...]
    velocity: bool
    length: int = 0
    total: float = 0.0
    distance: float = 0.0
    reports: int = 0
    sums: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begins the next episode."""
        self.length, self.total, self.distance, self.reports = 0, 0.0, 0.0, 0
        self.sums = dict.fromkeys(self.terms, 0.0)

    def step(self, reward: float, info: Mapping[str, Any]) -> None:
        """Adds one environment step; a term that ``info`` does not hold at this step adds nothing."""
        self.length += 1
        # Returns and thresholds are of what the environment pays, whatever the learner is told.
        self.total += info.get(RAW_REWARD_KEY, reward)
        if self.velocity and VELOCITY_KEY in info:
            self.distance += float(info[VELOCITY_KEY])
            self.reports += 1
        for name in self.terms:
            self.sums[name] += float(info.get(name, 0.0))

    def state_dict(self) -> dict[str, Any]:
        """The sums so far."""
        sums = {"total": self.total, "distance": self.distance, "sums": dict(self.sums)}
        return {"length": self.length, "reports": self.reports, **sums}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on with these sums.

        Raises:
            ValueError: If they are of an environment with other terms.
        """
        if state["sums"].keys() != set(self.terms):
            raise ValueError("an episode with other terms of the reward")
        self.length, self.total, self.distance = state["length"], state["total"], state["distance"]
        self.reports, self.sums = state["reports"], dict(state["sums"])

    def record(self, global_step: int) -> EpisodeRecord:
        """The episode, ended at ``global_step``."""
        velocity = (self.distance / self.reports if self.reports else math.nan) if self.velocity else None
        return EpisodeRecord(global_step, self.total, self.length, velocity, dict(self.sums))


@dataclass(frozen=True)
class StepsToThreshold:
    """Global steps at the end of the last and of the first of the episodes that met the threshold."""

    last: int
    first: int


def meets_threshold(returns: Sequence[float], threshold: float, consecutive: int = 5) -> bool:
    """Whether the latest ``consecutive`` of these returns are all at least ``threshold``.

    Asked after each episode, it is first true at the episode that :func:`steps_to_threshold` finds.
    """
    latest = returns[-consecutive:]
    return len(latest) == consecutive and all(value >= threshold for value in latest)


def steps_to_threshold(
    global_steps: Sequence[int], returns: Sequence[float], threshold: float, consecutive: int = 5
) -> StepsToThreshold | None:
    """The paper's measure: steps until ``consecutive`` episodes running return at least ``threshold``.

    Raw returns, not smoothed (paper, section 4.2). NaN never meets a threshold.

    Args:
        global_steps: Step at each episode's end, (episodes,), ascending.
        returns: Raw return of each episode, (episodes,).
        threshold: Return to reach.
        consecutive: Episodes that must reach it without a miss between them.

    Returns:
        The end of the last (the measure) and of the first of these episodes; None if it never happened.
    """
    streak = 0
    for index, value in enumerate(returns):
        streak = streak + 1 if value >= threshold else 0
        if streak == consecutive:
            return StepsToThreshold(int(global_steps[index]), int(global_steps[index - consecutive + 1]))
    return None
