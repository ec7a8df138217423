"""Resident memory of a paper run whose replay buffer is full: ``python -m bench.memory``."""

from __future__ import annotations

import argparse
import resource
import sys

import numpy as np
import torch

from acmr.agent.architecture import Dimensions
from acmr.agent.precision import choose_products
from acmr.agent.replay_buffer import ReplayBuffer
from acmr.agent.sac import SAC
from acmr.config import SACConfig
from bench import contenders

TARGET_GB = 2.2
EPISODE = 100


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.memory", description=__doc__)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--check", action="store_true", help="exit with 1 if it is more than the target")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    dims, config = Dimensions(376, 17), SACConfig(buffer_size=arguments.transitions)
    choose_products(config)
    # The environment and its libraries are part of a run.
    contenders.ours("experiment=H0")(5)
    networks = contenders.cell_networks("H0", dims, Dimensions(270, 11), config.hidden_sizes)
    agent = SAC(networks, config, torch.Generator().manual_seed(1), torch.Generator().manual_seed(2))
    buffer, rng = ReplayBuffer(config.buffer_size, dims.observation, dims.action), np.random.default_rng(0)
    observation, action = rng.standard_normal(dims.observation), rng.uniform(-0.4, 0.4, dims.action)
    for index in range(arguments.transitions):
        ended = index % EPISODE == EPISODE - 1
        buffer.add(observation, action, 1.0, observation, ended, ended)
    for step in range(1, 21):
        agent.update(buffer.sample(config.batch_size, rng), step)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    print(f"{arguments.transitions:,} transitions: {peak:.2f} GB resident at most (target: under {TARGET_GB})")
    return 1 if arguments.check and peak >= TARGET_GB else 0


if __name__ == "__main__":
    sys.exit(main())
