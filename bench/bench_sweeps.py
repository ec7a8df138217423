"""How fast sweeps are planned, watched and trained: ``python -m bench.bench_sweeps``.

Targets: planning at most 60 ms of CPU a run, ``make status`` under 3 s, both with 1,000 runs; two workers on two
cores in at most 0.55 of the time that one takes, on an otherwise idle machine. Exit code 1 if one is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from acmr.storage.run_dir import RunDir
from sweeps.folder import SweepFolder
from sweeps.plan import Plan, entries_of, expand, make_plan

ROOT = Path(__file__).resolve().parent.parent
PLAN_LIMIT, STATUS_LIMIT, WORKERS_LIMIT = 60.0, 3.0, 0.55


def many_jobs(folder: Path, runs: int) -> list[list[str]]:
    """Overrides of students and baselines, their teachers not among them."""
    seeds = -(-runs // 4)
    cells = ("A0", "A1", "A2", "A3")
    jobs = [[f"experiment={cell}", f"seed={seed}", f"output_dir={folder}"] for cell in cells for seed in range(seeds)]
    return jobs[:runs]


def bench_planning(folder: Path, runs: int) -> tuple[Plan, float]:
    """The plan, and milliseconds of CPU a run, the added teachers' included."""
    jobs = many_jobs(folder, runs)
    before = time.process_time()
    plan = make_plan(expand(jobs))
    return plan, (time.process_time() - before) / runs * 1e3


def bench_status(folder: Path, plan: Plan) -> float:
    """Seconds of the command where half of the runs are complete and the others under way."""
    header = {"command": "python run.py", "retries": 2, "grace": 20}
    SweepFolder.create(folder, header, entries_of(plan, folder), plan.order, ROOT / "conf")
    for run in plan.runs:
        run_dir = RunDir(run.spec.directory)
        run_dir.path.mkdir(parents=True, exist_ok=True)
        run_dir.start(run.spec.settings)
        told = {"state": "running", "global_step": 5000, "total_timesteps": 10**6, "steps_per_second": 50.0}
        told |= {"latest_return": 1.0, "process": os.getpid(), "host": os.uname().nodename, "updated": time.time()}
        (run_dir.path / "status.json").write_text(json.dumps(told))
        if run.index % 2:
            run_dir.write_json(run_dir.summary_file, {"status": "complete", "global_step": 10**6})
    before = time.perf_counter()
    command = [sys.executable, "-m", "sweeps.status", str(folder)]
    subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    return time.perf_counter() - before


def bench_workers(folder: Path, runs: int, steps: int, workers: int) -> float:
    """Seconds of a whole sweep of equal runs, from the command to its end."""
    seeds = ",".join(str(seed) for seed in range(1, runs + 1))
    words = ["-m", "profile=quick", "experiment=A0", f"seed={seeds}", f"total_timesteps={steps}", "tracking=off"]
    command = [sys.executable, str(ROOT / "run.py"), *words, f"workers={workers}", f"output_dir={folder}"]
    before = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - before


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.bench_sweeps", description=__doc__)
    parser.add_argument("--runs", type=int, default=1000, help="runs to plan and to look at (default: 1000)")
    parser.add_argument("--equal", type=int, default=6, help="equal runs to train (default: 6; 0: leave this out)")
    parser.add_argument("--steps", type=int, default=10_000, help="environment steps of each (default: 10000)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        plan, milliseconds = bench_planning(Path(scratch) / "many", options.runs)
        print(
            f"planning {options.runs} runs and {len(plan.runs) - options.runs} teachers: {milliseconds:.1f} ms of CPU "
            f"a run; at most {PLAN_LIMIT:.0f}"
        )
        seconds = bench_status(Path(scratch) / "many", plan)
        print(f"status of {len(plan.runs)} runs: {seconds:.2f} s; at most {STATUS_LIMIT:.0f}", flush=True)
        good = milliseconds < PLAN_LIMIT and seconds < STATUS_LIMIT
        if options.equal:
            one, two = (
                bench_workers(Path(scratch) / f"workers{count}", options.equal, options.steps, count)
                for count in (1, 2)
            )
            load = os.getloadavg()[0]
            print(
                f"{options.equal} runs of {options.steps:,} steps: one worker {one:.1f} s, two {two:.1f} s, ratio "
                f"{two / one:.3f}; at most {WORKERS_LIMIT} (load {load:.1f}, {len(os.sched_getaffinity(0))} cores)"
            )
            good = good and two / one <= WORKERS_LIMIT
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
