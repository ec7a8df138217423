"""How an update's cost grows with batch, width and observation: ``python -m bench.scaling``."""

from __future__ import annotations

import os
import statistics
import sys
import time

import numpy as np
import torch

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.networks import Networks
from bench import updates, work

BASE = {"batch": 256, "width": 256, "observation": 376}
VALUES = {"batch": (32, 64, 128, 512, 1024), "width": (64, 128, 512), "observation": (27, 94, 188, 752)}
ACTIONS, ROUNDS, STEPS = 17, 5, 10


def main() -> int:
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    torch.set_num_threads(1)
    print(f"{'batch':>6}{'width':>7}{'observation':>13}{'GFLOP':>8}{'ms':>8}{'GFLOP/s':>9}{'ms / base':>11}")
    base = measure(BASE)
    for settings in [BASE, *({**BASE, key: value} for key, values in VALUES.items() for value in values)]:
        milliseconds, gflop = base if settings is BASE else measure(settings)
        print(
            f"{settings['batch']:6}{settings['width']:7}{settings['observation']:13}{gflop:8.3f}{milliseconds:8.2f}"
            f"{gflop / milliseconds * 1e3:9.0f}{milliseconds / base[0]:11.2f}",
            flush=True,
        )
    return 0


def measure(settings: dict[str, int]) -> tuple[float, float]:
    """Median milliseconds of CPU time, and the GFLOP of the products, of an update."""
    dims, high = Dimensions(settings["observation"], ACTIONS), np.full(ACTIONS, 0.4, np.float32)
    architecture = Architecture.plain(dims, [settings["width"]] * 2, -high, high)
    networks = Networks(architecture, torch.Generator().manual_seed(0))
    take = updates.updates(networks, settings["batch"], transitions=2_000)
    take(6)
    times = []
    for _ in range(ROUNDS):
        began = time.process_time()
        take(STEPS)
        times.append((time.process_time() - began) / STEPS)
    return statistics.median(times) * 1e3, work.flops(work.step_work(networks, settings["batch"])) / 1e9


if __name__ == "__main__":
    sys.exit(main())
