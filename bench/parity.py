"""Whether bfloat16 learns as float32 does: ``python -m bench.parity RUNS``.

Compares steps to threshold of runs that differ in ``agent.precision`` alone, which this makes (half an hour on two
cores):

    python run.py -m profile=quick experiment=H0 agent.precision=float32,bfloat16 seed=1,2,3,4,5,6,7,8,9,10
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from analysis.statistics.survival import log_rank
from analysis.statistics.two_samples import permutation_p, t_test


def steps_to_threshold(folder: Path) -> dict[int, tuple[float, bool]]:
    """For each seed of complete runs: steps, and whether they reached the threshold or were only watched so long."""
    found = {}
    for path in sorted(folder.glob("seed_*/summary.json")):
        summary = json.loads(path.read_text(encoding="utf-8"))
        if summary["status"] == "complete":
            steps, total = summary["steps_to_threshold"], summary["total_timesteps"]
            found[int(path.parent.name.removeprefix("seed_"))] = (steps or total, steps is not None)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.parity", description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="?", default=Path("runs/quick"), help="default: runs/quick")
    parser.add_argument("--environment", default="ant", help="default: ant")
    arguments = parser.parse_args()
    folders = [arguments.runs / f"{arguments.environment}-none{end}" for end in ("", "-precision=bfloat16")]
    full, reduced = (steps_to_threshold(folder) for folder in folders)
    seeds = sorted(full.keys() & reduced.keys())
    if len(seeds) < 2:
        print(f"{folders[1]}: {len(seeds)} seeds are complete in both precisions, two or more are needed")
        return 2
    samples = []
    for name, found in (("float32", full), ("bfloat16", reduced)):
        steps, reached = (np.array(column) for column in zip(*(found[seed] for seed in seeds), strict=True))
        print(
            f"{name:9} {reached.sum()} of {len(seeds)} reached; mean {steps.mean():,.0f}, SD {steps.std(ddof=1):,.0f}: "
            + " ".join(f"{step:,.0f}{'' if did else '+'}" for step, did in zip(steps, reached, strict=True))
        )
        samples.append((steps, reached))
    (exact, exact_reached), (rounded, rounded_reached) = samples
    test = t_test(exact, rounded, pooled=False)
    survival = log_rank(exact, exact_reached, rounded, rounded_reached)
    print(f"bfloat16 less float32: {rounded.mean() - exact.mean():,.0f} steps")
    print(f"95% interval (Welch): {test.low:,.0f} to {test.high:,.0f}")
    print(f"permutation p = {permutation_p(exact, rounded):.3f}; with runs that never reached: {survival.p:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
