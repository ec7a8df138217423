"""Lays out run directories as runs leave them, for the tests of the analysis (helpers, no tests)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import reduce
from hashlib import sha256
from operator import getitem
from pathlib import Path

import numpy as np
import yaml

from acmr.cells import CELLS, TARGET, run_name
from acmr.config import STOP_KEYS
from acmr.records import SEALED_FILES, steps_to_threshold
from acmr.run_folders import sealed

PAIRS = {"paper": ("humanoid", "armless_humanoid"), "quick": ("ant", "ant_three_legs")}
HEADER = "global_step,episodic_return,episode_length,mean_forward_velocity,reward_forward,reward_survive"


def run_directory(root: Path, cell: str, seed: int, profile: str = "paper", **stop: object) -> Path:
    row = CELLS[cell]
    env = PAIRS[profile][row.role == TARGET]
    return root / run_name(env, row.transfer, row.freeze, {**row.changes, **stop}) / f"seed_{seed}"


def settings(cell: str, seed: int, profile: str, total: int, threshold: float) -> dict:
    row = CELLS[cell]
    source, target = PAIRS[profile]
    stored: dict = {
        "seed": seed,
        "freeze": row.freeze,
        "total_timesteps": total,
        "threshold": threshold,
        "consecutive": 5,
        "threads": 1,
        "profile": profile,
        "pair": {"source": source, "target": target},
        "env": {"name": target if row.role == TARGET else source, "id": "Humanoid-v4"},
        "agent": {"q_lr": 0.001, "learning_starts": total // 200, "hidden_sizes": [256, 256]},
        "transfer": {"name": row.transfer, "teacher": None},
    }
    for key, value in row.changes.items():
        *groups, leaf = key.split(".")
        reduce(getitem, groups, stored)[leaf] = value
    return stored


def rows_reaching(steps: float | None, total: int, threshold: float = 4900.0, length: int = 100) -> np.ndarray:
    """Episodes (step, return, length) whose fifth in a row at the threshold ends exactly at ``steps`` (None: never)."""
    last = int(steps) if steps is not None else total
    ends = [last - k * length for k in range(5)]
    assert ends[-1] > 0
    early = np.arange(length, ends[-1], length)
    late = np.arange(last + length, total + 1, length)
    ends = np.concatenate([early, ends[::-1], late]).astype(int)
    low = (ends < last - 4 * length) if steps is not None else np.ones(len(ends), bool)
    returns = np.where(low, threshold - 1 - 1000.0 / ends, threshold)
    return np.column_stack([ends, returns, np.diff(ends, prepend=0)])


def realistic_rows(
    rng: np.random.Generator, total: int, half: float, top: float = 5600.0, noise: float = 0.12
) -> np.ndarray:
    """A learning curve: short, bad episodes first, then longer ones; half the return is reached at step ``half``."""
    rows, step = [], 0
    while True:
        level = 1 / (1 + math.exp(-6 * (step - half) / max(half, 1)))
        level = min(1.0, max(0.0, 0.01 + level))
        length = int(np.clip(1000 * level * (1 + 2 * noise * rng.standard_normal()), 15, 1000))
        if length > 950:
            length = 1000
        step += length
        if step > total:
            return np.array(rows)
        speed = 3 * level * (1 + noise * rng.standard_normal())
        rows.append((step, 5.0 * length * (0.85 + 0.15 * level * (top / 5000)) + 90 * speed, length, speed))


def csv_text(rows: np.ndarray, columns: int = 6) -> str:
    names = HEADER.split(",")[:columns]
    lines = [",".join(names)]
    for row in rows:
        speed = row[3] if len(row) > 3 else 1.5
        values = [int(row[0]), float(row[1]), int(row[2]), float(speed), float(row[1]) * 0.2, float(row[1]) * 0.8]
        lines.append(",".join(repr(value) for value in values[:columns]))
    return "\n".join(lines) + "\n"


def metrics_text(total: int, speed: float) -> str:
    """A run that learned at ``speed`` steps per second, after random actions that were much faster."""
    every = max(1, total // 100)
    rows = [f"{step},{5000.0 if step <= total // 200 else speed},0.5" for step in range(every, total + 1, every)]
    return "\n".join(["global_step,steps_per_second,critic_loss", *rows]) + "\n"


def write_run(
    root: Path,
    cell: str,
    seed: int,
    rows: np.ndarray,
    *,
    profile: str = "paper",
    total: int = 1_000_000,
    threshold: float = 4900.0,
    summary: dict | bool = True,
    **more: object,
) -> Path:
    """Lays out a run's directory as a run leaves it; ``summary=False``: unfinished; a dict: additions to it."""
    stop = {key: more[key] for key in STOP_KEYS if more.get(key)}
    directory = run_directory(root, cell, seed, profile, **stop)
    directory.mkdir(parents=True)
    config = settings(cell, seed, profile, total, threshold) | more
    (directory / "config.yaml").write_text(yaml.safe_dump(config))
    (directory / "episodes.csv").write_text(csv_text(rows))
    (directory / "metrics.csv").write_text(metrics_text(total, 110.0 + seed))
    (directory / "run.log").write_text("started\n")
    if summary is not False:
        content = {
            "status": "complete",
            "cell": cell,
            "env": config["env"]["name"],
            "transfer": config["transfer"]["name"],
            "freeze": config["freeze"],
            "seed": seed,
            "profile": profile,
            "run": directory.parent.name,
            "global_step": total,
            "total_timesteps": total,
            "episodes": len(rows),
            "threshold": threshold,
            "consecutive": 5,
            "steps_per_second": 110.0 + seed,
            "wall_seconds": total / (110.0 + seed),
            "versions": {"torch": "2.13.0"},
            "git_commit": "0123456",
            "machine": "node-1",
        }
        (directory / "summary.json").write_text(json.dumps(content | (summary if isinstance(summary, dict) else {})))
    return directory


def seal(directory: Path, **more: object) -> Path:
    """Adds to a finished run what tells later whether its files are what they were, as runs leave it themselves."""
    path = directory / "summary.json"
    contents = {name: (directory / name).read_bytes() for name in SEALED_FILES}
    files = {name: {"size": len(data), "sha256": sha256(data).hexdigest()} for name, data in contents.items()}
    path.write_text(json.dumps(sealed(json.loads(path.read_text()) | more, files), indent=2) + "\n")
    return directory


def cut(rows: np.ndarray, threshold: float = 4900.0, after: float = np.inf) -> np.ndarray:
    """The episodes of the same run if it stops at its threshold, or after so many steps."""
    met = steps_to_threshold(rows[:, 0].tolist(), rows[:, 1].tolist(), threshold)
    return rows[rows[:, 0] <= min(met.last if met else np.inf, after)]


def write_cut(
    root: Path, cell: str, seed: int, rows: np.ndarray, total: int, after: int | None = None, **more: object
) -> Path:
    """Lays out the run of these episodes as ``stop=threshold`` leaves it."""
    threshold = float(more.get("threshold", 4900.0))
    left = cut(rows, threshold, total if after is None else after)
    met = steps_to_threshold(left[:, 0].tolist(), left[:, 1].tolist(), threshold)
    said = {"stop": "threshold", "stop_after": after, "global_step": met.last if met else after or total}
    said["steps_to_threshold"] = met.last if met else None
    more = {"summary": said, "total": total, "stop": "threshold", "stop_after": after, **more}
    return write_run(root, cell, seed, left, **more)


def write_under_way(root: Path, cell: str, seed: int, step: int, total: int, after: int | None = None) -> Path:
    """Lays out a run that stops at its threshold and has taken so many steps without meeting it."""
    stop = {"stop": "threshold", "stop_after": after}
    directory = write_run(root, cell, seed, rows_reaching(None, step), total=total, summary=False, **stop)
    status = {"state": "running", "global_step": step, "total_timesteps": after or total}
    (directory / "status.json").write_text(json.dumps(status))
    return directory


def write_matrix(
    root: Path,
    times: dict[str, Sequence[float | None]],
    total: int = 1_000_000,
    length: int = 1000,
    profile: str = "paper",
) -> None:
    """Runs whose steps to threshold are the ones given, seeds from 1 on."""
    for cell, values in times.items():
        for seed, steps in enumerate(values, start=1):
            write_run(root, cell, seed, rows_reaching(steps, total, length=length), total=total, profile=profile)


def write_realistic(
    root: Path, seeds: Sequence[int] = (1, 2, 3), total: int = 1_000_000, profile: str = "paper"
) -> None:
    """All seven cells with curves like the paper's; A4 never reaches."""
    half = {"H0": 0.42, "H1": 0.1, "A0": 0.4, "A1": 0.38, "A2": 0.28, "A3": 0.27, "A4": 0.7}
    for cell, share in half.items():
        for seed in seeds:
            rng = np.random.default_rng([seed, sum(map(ord, cell))])
            rows = realistic_rows(rng, total, share * total * (1 + 0.06 * rng.standard_normal()))
            if cell == "A4":
                rows[:, 1] *= 0.12 + 0.05 * rng.random()
            write_run(root, cell, seed, rows, total=total, profile=profile)
