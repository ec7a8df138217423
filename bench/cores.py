"""Two runs on two cores, each against running alone: ``python -m bench.cores``.

Each run is a process pinned to a core, as a sweep starts them. What they share is the last cache and the memory.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time

TARGET = 0.95


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.cores", description=__doc__)
    parser.add_argument("--worker", type=int, help="only take steps on this core and print their speed")
    parser.add_argument("--steps", type=int, default=300, help="training steps of a measurement")
    parser.add_argument("--rounds", type=int, default=3, help="measurements of each kind")
    parser.add_argument("--check", action="store_true", help="exit with 1 if a run is slower than its target")
    arguments = parser.parse_args()
    if arguments.worker is not None:
        return work(arguments.worker, arguments.steps)
    cores = sorted(os.sched_getaffinity(0))[:2]
    if len(cores) < 2:
        print("one core only: nothing to measure")
        return 0
    ratios = []
    for _ in range(arguments.rounds):
        alone = [run([core], arguments.steps)[0] for core in cores]
        together = run(cores, arguments.steps)
        ratios += [here / there for here, there in zip(together, alone, strict=True)]
        print(f"steps a second alone {_shown(alone)}, together {_shown(together)}", flush=True)
    share = statistics.median(ratios)
    print(f"each of two runs has {share:.2f} of its speed alone (target {TARGET})")
    return 1 if arguments.check and share < TARGET else 0


def run(cores: list[int], steps: int) -> list[float]:
    """Steps a second of one process on each of the cores, all at once."""
    command = [sys.executable, "-m", "bench.cores", "--steps", str(steps), "--worker"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    processes = [
        subprocess.Popen(
            [*command, str(core)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        for core in cores
    ]
    for process in processes:  # All have warmed up before one of them starts.
        assert process.stdout is not None
        process.stdout.readline()
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    return [float(json.loads(process.communicate()[0])) for process in processes]


def work(core: int, steps: int) -> int:
    os.sched_setaffinity(0, {core})
    from bench import contenders

    take = contenders.ours("experiment=H0")
    take(contenders.LEARNING_STARTS + 50)
    print("ready", flush=True)
    sys.stdin.readline()
    began = time.perf_counter()
    take(steps)
    print(json.dumps(steps / (time.perf_counter() - began)))
    return 0


def _shown(speeds: list[float]) -> str:
    return " and ".join(f"{speed:.1f}" for speed in speeds)


if __name__ == "__main__":
    sys.exit(main())
