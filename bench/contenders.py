"""Learners to compare, each able to take some training steps (environment step included) when asked."""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from acmr.agent.architecture import Architecture, Dimensions, is_adapter, is_hidden
from acmr.agent.networks import Networks
from acmr.agent.precision import choose_products
from acmr.agent.replay_buffer import ReplayBuffer
from acmr.agent.sac import SAC
from acmr.config import ExperimentConfig
from acmr.envs import describe, make_env
from acmr.records import EpisodeInProgress
from acmr.run.random_streams import random_streams
from acmr.run.trainer import Trainer
from acmr.settings.compose import compose_config, parse
from acmr.tracking.observer import Observer

Steps = Callable[[int], None]
LEARNING_STARTS = 300
BUFFER_SIZE = 100_000


def settings(*overrides: str) -> ExperimentConfig:
    """A run's settings as the command line would make them."""
    return parse(compose_config([*overrides, "tracking=off"]))


def cell_networks(cell: str, source: Dimensions, target: Dimensions, hidden_sizes: list[int]) -> Networks:
    """Networks with the shapes and frozen layers of one of the paper's cells; the weights are random."""
    dims = source if cell in ("H0", "H1") else target
    high, generator = np.full(dims.action, 0.4, np.float32), torch.Generator().manual_seed(0)
    architecture = Architecture.plain(dims, hidden_sizes, -high, high)
    if cell in ("A3", "A4"):
        architecture = replace(architecture, core=source)
    networks = Networks(architecture, generator)
    for name, layer in networks.layers().items():
        frozen = (cell == "A2" and is_hidden(name)) or (cell == "A4" and not is_adapter(name))
        layer.requires_grad_(not frozen)
    return networks


def ours(*overrides: str) -> Steps:
    """This project's trainer as a run builds it, without files and tracking."""
    return ours_with_environment(*overrides)[0]


def ours_with_environment(*overrides: str) -> tuple[Steps, gym.Env]:
    """The same, and the environment that it steps."""
    config = settings(*overrides, f"agent.learning_starts={LEARNING_STARTS}", f"agent.buffer_size={BUFFER_SIZE}")
    about = describe(config.env)
    env = make_env(config.env)
    assert isinstance(env.action_space, gym.spaces.Box)
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    streams, low, high = random_streams(config.seed), env.action_space.low, env.action_space.high
    networks = Networks(Architecture.plain(dims, config.agent.hidden_sizes, low, high), streams.networks)
    agent = SAC(networks, config.agent, streams.acting, streams.learning)
    buffer = ReplayBuffer(config.agent.buffer_size, dims.observation, dims.action)
    episode = EpisodeInProgress(about.reward_terms, about.has_forward_velocity)

    def train(pause: Observer) -> None:
        Trainer(env, agent, buffer, streams, 10**9, config.log_every, episode, observers=[pause]).train()

    run, precision = _Paused(train), choose_products(config.agent).precision

    def steps(count: int) -> None:
        torch.set_float32_matmul_precision(precision)
        run.steps(count)

    return steps, env


def sb3(fast_products: bool = False) -> Steps:
    """Stable-Baselines3 as its users run it; with ``fast_products`` its products go through oneDNN too."""
    from stable_baselines3 import SAC as SB3SAC

    model = SB3SAC("MlpPolicy", _gym_humanoid(), **_peer_settings(), device="cpu")

    def steps(count: int) -> None:
        torch.set_float32_matmul_precision("medium" if fast_products else "highest")
        model.learn(count, reset_num_timesteps=False)

    return steps


def sbx() -> Steps:
    """SBX, the same in JAX."""
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    from sbx import SAC as SBXSAC

    model = SBXSAC("MlpPolicy", _gym_humanoid(), **_peer_settings())
    return lambda count: _discard(model.learn(count, reset_num_timesteps=False))


def _peer_settings() -> dict[str, Any]:
    return {
        "batch_size": 256,
        "buffer_size": BUFFER_SIZE,
        "learning_starts": LEARNING_STARTS,
        "policy_kwargs": {"net_arch": [256, 256]},
        "seed": 1,
    }


def _gym_humanoid() -> gym.Env:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gym.make("Humanoid-v4")


def _discard(model: object) -> None:
    pass


class _Paused(Observer):
    """Runs a training loop in a thread that goes on only while somebody waits for its steps."""

    def __init__(self, train: Callable[[Observer], None]) -> None:
        self._go, self._done = threading.Semaphore(0), threading.Semaphore(0)
        self._left = 0
        self._thread = threading.Thread(target=lambda: train(self), daemon=True)
        self._started = False

    def steps(self, count: int) -> None:
        self._left = count
        if self._started:
            self._go.release()
        else:
            self._thread.start()
            self._started = True
        while not self._done.acquire(timeout=5.0):
            if not self._thread.is_alive():
                raise RuntimeError("the training loop ended")

    def on_step(self, step: int) -> None:
        self._left -= 1
        if self._left == 0:
            self._done.release()
            self._go.acquire()
