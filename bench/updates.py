"""Updates alone, on random batches: what the paper's cells cost beside each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from acmr.agent.learner import find_learner
from acmr.agent.networks import Networks
from acmr.agent.precision import choose_products
from acmr.agent.replay_buffer import ReplayBuffer
from acmr.config import SACConfig

TWINS = ("A1", "A2", "A3", "A4")


def updates(
    networks: Networks, batch_size: int = 256, transitions: int = 5_000, learner: str = "sac"
) -> Callable[[int], None]:
    """A function that makes some updates on batches of random transitions."""
    config = SACConfig(learner, list(networks.architecture.hidden_sizes), batch_size=batch_size)
    agent = find_learner(config)(networks, config, torch.Generator().manual_seed(1), torch.Generator().manual_seed(2))
    precision = choose_products(config).precision
    dims, rng = networks.dims, np.random.default_rng(0)
    buffer = ReplayBuffer(transitions, dims.observation, dims.action)
    for index in range(transitions):
        observation, after = rng.standard_normal((2, dims.observation))
        action = rng.uniform(-0.4, 0.4, dims.action)
        buffer.add(observation, action, rng.standard_normal(), after, False, index % 100 == 99)
    done = 0

    def take(count: int) -> None:
        nonlocal done
        torch.set_float32_matmul_precision(precision)
        for _ in range(count):
            done += 1
            agent.update(buffer.sample(config.batch_size, rng), done)

    return take
