"""How fast the analysis is: ``python -m bench.bench_analysis``.

Two targets: 1,000 runs of 2,000 episodes loaded and measured in under 10 s; the paper's 21 runs
made into all tables and figures in under 60 s. Exit code 1 if one is missed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

from acmr.cells import CELLS, TARGET, planned_cells, run_name
from analysis.loading.load import load
from analysis.statistics.metrics import measure

LOAD_LIMIT, RESULTS_LIMIT = 10.0, 60.0
TERMS = ("reward_forward", "reward_survive", "reward_ctrl")


def write_run(root: Path, cell: str, seed: int, episodes: int, total: int, rng: np.random.Generator) -> None:
    """One run directory of a paper run's size: short episodes first, 1,000 steps at the end."""
    row = CELLS[cell]
    env, transfer, freeze = "armless_humanoid" if row.role == TARGET else "humanoid", row.transfer, row.freeze
    directory = root / run_name(env, transfer, freeze, {}) / f"seed_{seed}"
    directory.mkdir(parents=True)
    growth = np.linspace(0.02, 1, episodes) ** 1.5
    lengths = np.maximum(1, growth / growth.sum() * total).astype(int)
    returns = 5600 * np.minimum(1, np.linspace(0, 1.6, episodes)) * (1 + 0.05 * rng.standard_normal(episodes))
    rest = rng.standard_normal((episodes, 1 + len(TERMS)))
    lines = [f"global_step,episodic_return,episode_length,mean_forward_velocity,{','.join(TERMS)}"]
    for step, value, length, more in zip(np.cumsum(lengths), returns, lengths, rest.tolist(), strict=True):
        lines.append(f"{step},{float(value)!r},{length},{','.join(map(repr, more))}")
    (directory / "episodes.csv").write_text("\n".join(lines) + "\n")
    speeds = [f"{step},{110.0 + step % 7}" for step in range(1000, total + 1, 1000)]
    (directory / "metrics.csv").write_text("\n".join(["global_step,steps_per_second", *speeds]) + "\n")
    common = {"seed": seed, "freeze": freeze, "profile": "paper", "total_timesteps": total, "threshold": 4900.0}
    common["consecutive"] = 5
    agent = {f"setting_{number}": number for number in range(20)} | {"learning_starts": 5000}
    config = common | {"env": {"name": env}, "transfer": {"name": transfer}, "agent": agent}
    config["pair"] = {"source": "humanoid", "target": "armless_humanoid"}
    (directory / "config.yaml").write_text(yaml.safe_dump(config))
    summary = common | {"status": "complete", "cell": cell, "env": env, "transfer": transfer, "global_step": total}
    summary |= {"episodes": episodes, "wall_seconds": 9000.0, "steps_per_second": total / 9000.0}
    (directory / "summary.json").write_text(json.dumps(summary))


def bench_load(folder: Path, runs: int, episodes: int) -> tuple[float, float]:
    """Wall-clock and CPU seconds of loading many runs and computing their metrics."""
    rng = np.random.default_rng(0)
    cells = [cell.name for cell in planned_cells([])]
    for number in range(runs):
        write_run(folder, cells[number % len(cells)], number // len(cells), episodes, 1_000_000, rng)
    wall, cpu = time.perf_counter(), time.process_time()
    measured = measure(load(folder), 4900, 5)
    assert measured["steps_to_threshold"].notna().all()
    assert len(measured) == runs
    return time.perf_counter() - wall, time.process_time() - cpu


def bench_results(folder: Path, episodes: int) -> float:
    """Wall-clock seconds of the whole command on the paper's 21 runs, figures 2 and 3 included."""
    rng = np.random.default_rng(0)
    for cell in planned_cells([]):
        for seed in (1, 2, 3):
            write_run(folder / "runs", cell.name, seed, episodes, 1_000_000, rng)
    command = [sys.executable, "-m", "analysis", str(folder / "runs"), "--out", str(folder / "out")]
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.bench_analysis", description=__doc__)
    parser.add_argument("--runs", type=int, default=1000, help="runs to load (default: 1000)")
    parser.add_argument("--episodes", type=int, default=2000, help="episodes of each (default: 2000)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        wall, cpu = bench_load(Path(scratch) / "load", options.runs, options.episodes)
        print(
            f"{options.runs} runs x {options.episodes} episodes, loaded and measured: {wall:.1f} s "
            f"({cpu:.1f} s of CPU); at most {LOAD_LIMIT:.0f}"
        )
        results = bench_results(Path(scratch) / "results", 4000)
        print(f"21 runs x 4000 episodes, all tables and figures: {results:.1f} s; at most {RESULTS_LIMIT:.0f}")
    return 0 if wall < LOAD_LIMIT and results < RESULTS_LIMIT else 1


if __name__ == "__main__":
    sys.exit(main())
