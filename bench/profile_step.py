"""Where a training step's time goes: ``python -m bench.profile_step``."""

from __future__ import annotations

import argparse
import functools
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch

from acmr.agent import replay_buffer, sac
from acmr.agent.architecture import Dimensions
from acmr.agent.kernels import layers, parameters, policy
from bench import contenders, work

#: Method, and the line of the report that its own time (without that of methods below it) is counted to.
STAGES: list[tuple[Any, str, str]] = [
    (sac.SAC, "act", "acting"),
    (replay_buffer.ReplayBuffer, "add", "storing the transition"),
    (replay_buffer.ReplayBuffer, "sample", "gathering the batch"),
    (layers.Stack, "forward", "networks, forward"),
    (layers.CriticStack, "share", "networks, forward"),
    (layers.CriticStack, "forward_actions", "networks, forward"),
    (layers.Stack, "backward", "networks, backward"),
    (layers.CriticStack, "action_gradient", "networks, backward"),
    (policy.SquashedGaussian, "sample", "Gaussian"),
    (parameters.Adam, "step", "Adam"),
    (sac.SAC, "_draw", "Gaussian"),
    (sac.SAC, "update", "the rest of the update, targets"),
]


class Stopwatch:
    """Own CPU time of the methods it is wrapped around."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._inner = [0.0]

    def wrap(self, owner: Any, name: str, stage: str) -> None:
        method: Callable[..., Any] = getattr(owner, name)

        @functools.wraps(method)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            began = time.process_time()
            result = method(*args, **kwargs)
            took = time.process_time() - began
            self.seconds[stage] += took - self._inner.pop()
            self._inner[-1] += took
            return result

        setattr(owner, name, timed)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.profile_step", description=__doc__)
    parser.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)))
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("overrides", nargs="*", default=["experiment=H0"], help="settings of the run")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {arguments.core})
    torch.set_num_threads(1)
    watch = Stopwatch()
    for owner, name, line in STAGES:
        watch.wrap(owner, name, line)
    take, environment = contenders.ours_with_environment(*arguments.overrides)
    watch.wrap(environment, "step", "environment step")
    take(contenders.LEARNING_STARTS + 50)
    watch.seconds.clear()
    began = time.process_time()
    take(arguments.steps)
    total = (time.process_time() - began) / arguments.steps
    print(f"{'stage':34}{'ms a step':>10}{'share':>8}")
    for stage, seconds in sorted(watch.seconds.items(), key=lambda item: -item[1]):
        print(f"{stage:34}{seconds / arguments.steps * 1e3:10.3f}{seconds / arguments.steps / total:8.1%}")
    rest = total - sum(watch.seconds.values()) / arguments.steps
    print(f"{'the rest of the loop':34}{rest * 1e3:10.3f}{rest / total:8.1%}")
    print(f"{'all':34}{total * 1e3:10.3f}")
    if arguments.overrides == ["experiment=H0"]:
        networks = contenders.cell_networks("H0", Dimensions(376, 17), Dimensions(270, 11), [256, 256])
        seconds = work.ProductTimer(work.step_work(networks, 256)).seconds()
        print(f"{'of that, matrix products (alone)':34}{seconds * 1e3:10.3f}{seconds / total:8.1%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
