"""The learner multiplies what it must and no more: its operations, counted as they run, are those of bench/work.py."""

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from acmr.agent.architecture import Dimensions
from acmr.agent.replay_buffer import Batch
from acmr.agent.sac import SAC
from acmr.config import SACConfig
from bench.contenders import cell_networks
from bench.work import flops, step_work

SOURCE, TARGET, BATCH = Dimensions(23, 5), Dimensions(17, 4), 8


@pytest.mark.parametrize("cell", ["H0", "A1", "A2", "A3", "A4"])
@pytest.mark.parametrize("frequency", [1, 2, 3])
def test_products_are_those_that_are_counted(cell, frequency):
    networks = cell_networks(cell, SOURCE, TARGET, [12, 10])
    dims = networks.dims
    config = SACConfig(hidden_sizes=[12, 10], batch_size=BATCH, policy_frequency=frequency)
    agent = SAC(networks, config, torch.Generator().manual_seed(1), torch.Generator().manual_seed(2))
    observations, actions = torch.randn(2, BATCH, dims.observation), torch.randn(BATCH, dims.action)
    batch = Batch(observations[0], actions, torch.randn(BATCH), observations[1], torch.zeros(BATCH))
    agent.update(batch, 1)
    with FlopCounterMode(display=False) as counter:
        for step in range(1, frequency + 1):
            agent.update(batch, step)
    # A value head is a matrix and a vector, which the counter does not see.
    work = step_work(networks, BATCH, frequency)
    matrices = {product: count for product, count in work.items() if 1 not in (product.columns, product.inner)}
    assert counter.get_total_flops() == pytest.approx(flops(matrices) * frequency)


def test_the_papers_step_is_1_115_gflop():
    sensors, actions, width, batch = 376, 17, 256, 256
    actor = sensors * width + width * width + width * 2 * actions
    critic = (sensors + actions) * width + width * width + width
    deltas = width * width + width
    critics_update = actor + 4 * critic + 2 * (critic + deltas)
    actors = 3 * actor + 2 * sensors * width + 2 * (actor + width * width + 2 * actions * width)
    through = 2 * (actions * width + width * width + width) + 2 * (deltas + actions * width)
    total = 2 * batch * (critics_update + (actors + 2 * through) / 2)
    networks = cell_networks("H0", Dimensions(376, 17), Dimensions(270, 11), [256, 256])
    assert flops(step_work(networks, 256)) == total
    assert total == pytest.approx(1.115e9, rel=1e-3)
    assert np.isclose(flops(step_work(networks, 512)), 2 * total)
