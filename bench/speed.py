"""How fast a training step is, beside other SACs and beside the limit of this machine: ``python -m bench.speed``.

Everything runs in one process on one core, in turns, and every ratio is between neighbors in time. CPU time counts;
wall time is shown. A virtual core may share its execution units with other cores: quiet neighbors, good numbers.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
#: Shares of what is possible on a machine that are aimed at, for each precision. On a Zen 5 core they are 2.9 x SB3 of
#: 3.7 possible, 1.45 x SBX of 1.8, 0.78 of 1, and with bfloat16 4 x SB3 of 7.4: the aims move with a machine's limits.
AIMS = {"ours": 0.78, "ours_bfloat16": 0.54}
#: Share that has been reached on every machine (docs/performance.md): below it something has become slower.
FLOOR = 0.68
#: The same of what bfloat16 can give: float32's step with its products' time replaced by that of bfloat16's.
BFLOAT16_FLOOR = 0.75
LIMITS = {"ours": "products", "ours_bfloat16": "products_bfloat16"}
TWIN_TOLERANCE = 1.02


def main() -> int:
    arguments = _arguments()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {arguments.core})
    os.environ["OMP_NUM_THREADS"] = "1"
    import torch

    torch.set_num_threads(1)
    result = {"machine": _machine(arguments.core), **measure(arguments.rounds, arguments.steps)}
    result["verdicts"] = verdicts(result)
    RESULTS.mkdir(exist_ok=True)
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    path = RESULTS / f"speed-{stamp}.json"
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(
        "\n".join(
            [*table(result), f"written to {path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}"]
        )
    )
    failed = [verdict for verdict in result["verdicts"] if verdict["value"] < verdict["floor"]]
    return 1 if arguments.check and failed else 0


def measure(rounds: int, steps: int) -> dict[str, Any]:
    """Takes turns; returns seconds a step of every contender and round, and the work that a step is."""
    import torch

    from acmr.agent.architecture import Dimensions
    from acmr.agent.precision import use_fast_float32
    from bench import contenders, updates, work

    source, target = Dimensions(376, 17), Dimensions(270, 11)
    networks = contenders.cell_networks("H0", source, target, [256, 256])
    products = use_fast_float32()
    step = work.step_work(networks, 256)
    timer, reduced_timer = work.ProductTimer(step), work.ProductTimer(step, torch.bfloat16)
    takes: dict[str, Callable[[int], None]] = {
        "ours": contenders.ours("experiment=H0"),
        "ours_bfloat16": contenders.ours("experiment=H0", "agent.precision=bfloat16"),
    }
    takes |= _peers(contenders)
    takes |= {
        cell: updates.updates(contenders.cell_networks(cell, source, target, [256, 256])) for cell in updates.TWINS
    }
    for name, take in takes.items():
        print(f"warming up {name}", file=sys.stderr)
        take(20 if name in updates.TWINS else contenders.LEARNING_STARTS + 20)
    alone = ("products_default", "products", "products_bfloat16")
    times: dict[str, list[dict[str, float]]] = {name: [] for name in [*takes, *alone]}
    for index in range(rounds):
        print(f"round {index + 1} of {rounds}", file=sys.stderr)
        for name, precision, each in zip(
            alone, ("highest", *2 * [products.precision]), (timer, timer, reduced_timer), strict=True
        ):
            torch.set_float32_matmul_precision(precision)
            seconds = each.seconds()
            times[name].append({"cpu": seconds, "wall": seconds})
        for name, take in takes.items():
            times[name].append(_timed(take, steps))
    torch.set_float32_matmul_precision(products.precision)
    cells = {cell: contenders.cell_networks(cell, source, target, [256, 256]) for cell in updates.TWINS}
    return {
        "products": asdict(products),
        "flops_per_step": work.flops(step),
        "flops_per_cell": {cell: work.flops(work.step_work(each, 256)) for cell, each in cells.items()},
        "bytes_per_step": work.bytes_of_step(networks, 256),
        "gflops_by_shape": timer.rates(),
        "seconds_per_step": times,
    }


def _peers(contenders: Any) -> dict[str, Callable[[int], None]]:
    peers = {"sb3": contenders.sb3, "sb3_onednn": lambda: contenders.sb3(fast_products=True), "sbx": contenders.sbx}
    found: dict[str, Callable[[int], None]] = {}
    for name, make in peers.items():
        try:
            found[name] = make()
        except ImportError as error:
            print(f"{name} is left out ({error}); pip install -e '.[bench]' installs it", file=sys.stderr)
    return found


def _timed(take: Callable[[int], None], steps: int) -> dict[str, float]:
    cpu, wall = time.process_time(), time.perf_counter()
    take(steps)
    return {"cpu": (time.process_time() - cpu) / steps, "wall": (time.perf_counter() - wall) / steps}


def ratio(result: dict[str, Any], over: str, under: str) -> float | None:
    """Median over the rounds of one contender's CPU time over another's in the same round."""
    times = result["seconds_per_step"]
    if not times.get(over) or not times.get(under):
        return None
    return statistics.median(a["cpu"] / b["cpu"] for a, b in zip(times[over], times[under], strict=True))


def verdicts(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Each ratio with this machine's limit, what is aimed at, and what it must not fall under."""
    rows = []
    for name, over, under in (
        ("SB3's time / ours", "sb3", "ours"),
        ("SBX's time / ours", "sbx", "ours"),
        ("products' time / ours", "products", "ours"),
        ("SB3's time / ours, bfloat16", "sb3", "ours_bfloat16"),
    ):
        value, limit = ratio(result, over, under), ratio(result, over, LIMITS[under])
        if value is not None and limit is not None:
            floor = FLOOR * limit if under == "ours" else 0.0
            rows.append(_verdict(name, value, floor, AIMS[under] * limit, limit))
    rows.append(_bfloat16_verdict(result))
    for frozen, free in (("A2", "A1"), ("A4", "A3")):
        value = ratio(result, free, frozen)
        if value is not None:
            limit = result["flops_per_cell"][free] / result["flops_per_cell"][frozen]
            rows.append(
                _verdict(f"{free}'s update / {frozen}'s", value, 1.0 / TWIN_TOLERANCE, 1.0 / TWIN_TOLERANCE, limit)
            )
    return rows


def _bfloat16_verdict(result: dict[str, Any]) -> dict[str, Any]:
    """What bfloat16 gains over float32, where all but the products stays as it is.

    How much of a step the products are differs from machine to machine: with AMX they take a third of one in
    bfloat16, elsewhere more than half. So what is left beside them has to be counted.
    """
    names = ("ours", "products", "products_bfloat16")
    rounds = zip(*([each["cpu"] for each in result["seconds_per_step"][name]] for name in names), strict=True)
    limit = statistics.median(ours / (ours - products + reduced) for ours, products, reduced in rounds)
    value = ratio(result, "ours", "ours_bfloat16")
    assert value is not None
    return _verdict("ours / ours with bfloat16", value, BFLOAT16_FLOOR * limit, BFLOAT16_FLOOR * limit, limit)


def _verdict(name: str, value: float, floor: float, aim: float, limit: float) -> dict[str, Any]:
    return {"ratio": name, "value": value, "floor": floor, "aim": aim, "limit": limit}


def table(result: dict[str, Any]) -> list[str]:
    """The report for a reader."""
    machine, flops = result["machine"], result["flops_per_step"]
    lines = [
        f"{machine['processor']}, core {machine['core']}, load {machine['load']}; products: {result['products']}",
        f"a step: products of {flops / 1e9:.3f} GFLOP; Adam, targets, batch: {result['bytes_per_step'] / 1e6:.1f} MB",
        "",
        f"{'ms a step (median)':24}{'CPU':>8}{'wall':>8}{'GFLOP/s':>9}",
    ]
    for name, times in result["seconds_per_step"].items():
        cpu, wall = (statistics.median(each[kind] for each in times) for kind in ("cpu", "wall"))
        rate = f"{result['flops_per_step'] / cpu / 1e9:9.0f}" if name.startswith(("ours", "products")) else ""
        lines.append(f"{name:24}{cpu * 1e3:8.2f}{wall * 1e3:8.2f}{rate}")
    rates = sorted(result["gflops_by_shape"].items(), key=lambda item: -item[1])
    lines += ["", "one shape at a time, GFLOP/s: " + ", ".join(f"{shape} {rate:.0f}" for shape, rate in rates)]
    lines += ["", f"{'ratio':28}{'measured':>9}{'floor':>7}{'aim':>7}{'limit here':>12}"]
    for row in result["verdicts"]:
        verdict = (
            "  UNDER THE FLOOR"
            if row["value"] < row["floor"]
            else "  under the aim"
            if row["value"] < row["aim"]
            else ""
        )
        lines.append(
            f"{row['ratio']:28}{row['value']:9.2f}{row['floor']:7.2f}{row['aim']:7.2f}{row['limit']:12.2f}{verdict}"
        )
    return lines


def _machine(core: int) -> dict[str, Any]:
    from acmr.run.reproducibility import machine, versions

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    about = {"core": core, "cores": os.cpu_count(), "load": load, "python": platform.python_version()}
    return {**machine(1, "cpu"), **about, "versions": versions()}


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m bench.speed", description=__doc__)
    parser.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)), help="core to run on")
    parser.add_argument("--rounds", type=int, default=12, help="turns of every contender")
    parser.add_argument("--steps", type=int, default=40, help="training steps in a turn")
    parser.add_argument("--check", action="store_true", help="exit with 1 if a ratio is under its floor")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
