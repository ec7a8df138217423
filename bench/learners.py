"""What the plain learner's updates take beside the fast one's: ``python -m bench.learners``."""

from __future__ import annotations

import os
import statistics
import sys
import time

import torch

from acmr.agent.architecture import Dimensions
from bench.contenders import cell_networks
from bench.updates import updates

SOURCE, TARGET, WIDTHS = Dimensions(376, 17), Dimensions(270, 11), [256, 256]
ROUNDS, STEPS = 12, 20


def main() -> int:
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    torch.set_num_threads(1)
    print(f"{'cell':6}{'plain / fast':>14}{'of rounds':>20}")
    for cell in ("H0", "A0", "A2", "A4"):
        ratios = measure(cell)
        print(f"{cell:6}{statistics.median(ratios):14.2f}{min(ratios):14.2f} -{max(ratios):5.2f}", flush=True)
    return 0


def measure(cell: str) -> list[float]:
    """CPU time of the plain learner's updates over that of the fast one's, by round: they take turns."""
    makers = [
        updates(cell_networks(cell, SOURCE, TARGET, WIDTHS), transitions=2_000, learner=name)
        for name in ("sac_plain", "sac")
    ]
    for take in makers:
        take(6)
    ratios = []
    for _ in range(ROUNDS):
        times = []
        for take in makers:
            began = time.process_time()
            take(STEPS)
            times.append(time.process_time() - began)
        ratios.append(times[0] / times[1])
    return ratios


if __name__ == "__main__":
    sys.exit(main())
