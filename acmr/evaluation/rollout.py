"""Plays episodes with a policy, and films them if asked to."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from acmr.agent.networks import Actor
from acmr.config import EnvConfig
from acmr.evaluation.video import Film
from acmr.records import EpisodeInProgress
from acmr.stateful import State

#: Steps after which an episode is cut off where the environment has no time limit.
MOST_STEPS = 10_000


@dataclass(frozen=True)
class Episode:
    """One episode of an evaluation.

    Attributes:
        seed: What the environment was reset with.
        episodic_return: Sum of the raw rewards.
        episode_length: Steps in the episode.
        mean_forward_velocity: Mean forward velocity over the episode in m/s; None where it is not reported.
        terminated: Whether the environment ended it, not its time limit.
    """

    seed: int
    episodic_return: float
    episode_length: int
    mean_forward_velocity: float | None
    terminated: bool


@dataclass(frozen=True)
class VideoOptions:
    """What to film.

    Attributes:
        path: An mp4 or gif file.
        seconds: How long, of simulated time, episode after episode; None: the first episode.
        width: In pixels.
        height: In pixels.
    """

    path: Path
    seconds: float | None = None
    width: int = 480
    height: int = 480


def play(
    actor: Actor,
    config: EnvConfig,
    wrappers: State,
    *,
    episodes: int,
    seed: int,
    stochastic: bool,
    video: VideoOptions | None = None,
) -> Iterator[Episode]:
    """Plays episodes, each the same whatever came before it.

    Args:
        actor: The policy.
        config: Where it acts.
        wrappers: What the wrappers around that have remembered; it stays as it is.
        episodes: How many to play.
        seed: The k-th episode (k = 0, 1, ...) is reset with ``seed + k``.
        stochastic: Sample actions, as in training; else take the mean action.
        video: What to film.

    Raises:
        ConfigError: If the environment cannot be made.
    """
    # As late as this: whoever imports this module decides how mujoco is loaded (acmr.evaluation.camera.without_gl).
    from acmr.envs import describe, make_env
    from acmr.envs.wrappers.memory import give_lasting

    about = describe(config)
    env = make_env(config, render_mode=None if video is None else render_mode(config))
    film = Film(video.path, env, video.width, video.height, video.seconds) if video is not None else None
    try:
        for number in range(episodes):
            noise = torch.Generator().manual_seed(seed + number)
            give_lasting(env, wrappers, settled=True)
            observation, _ = env.reset(seed=seed + number)
            episode, terminated, truncated = EpisodeInProgress((), about.has_forward_velocity), False, False
            while not (terminated or truncated):
                if film is not None:
                    film.step()
                action = _act(actor, observation, noise if stochastic else None)
                observation, reward, terminated, truncated, info = env.step(action)
                episode.step(float(reward), info)
                truncated = truncated or (about.max_episode_steps is None and episode.length >= MOST_STEPS)
            if film is not None:
                film.end_episode()
            record = episode.record(episode.length)
            # An environment that reports its velocity may not have done so in this episode.
            velocity = record.mean_forward_velocity
            velocity = None if velocity is None or math.isnan(velocity) else velocity
            yield Episode(seed + number, record.episodic_return, record.episode_length, velocity, terminated)
    finally:
        if film is not None:
            film.close()
        env.close()


def render_mode(config: EnvConfig) -> str | None:
    """How an environment must be made to be drawn: robots are drawn from outside."""
    from acmr.envs import describe

    return None if describe(config).bodies else "rgb_array"


def _act(actor: Actor, observation: np.ndarray, noise: torch.Generator | None) -> np.ndarray:
    with torch.no_grad():
        batch = torch.as_tensor(observation, dtype=torch.float32).unsqueeze(0)
        if noise is None:
            action: torch.Tensor = actor.mode(batch)
        else:
            action, _ = actor.sample(batch, torch.randn(1, actor.action_scale.numel(), generator=noise))
    return action[0].numpy()
