"""What a policy sees and does on average, measured by playing it in its own environment."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import torch

from acmr.agent.networks import Actor
from acmr.config import EnvConfig
from acmr.envs import make_env
from acmr.records import DESCRIPTION_FILE
from acmr.settings.stored import stored_environment
from acmr.transfer.description import PolicyStatistics
from acmr.transfer.teacher import Teacher

#: Episodes that are played, and the most steps of each: an environment may have no time limit.
EPISODES, MOST_STEPS = 10, 1_000
#: What a student's command line says in place of that environment.
_REMEDY = "describe that environment in conf/env; else type transfer.impute=zero"


def measure_policy(actor: Actor, config: EnvConfig) -> PolicyStatistics:
    """Plays a policy as in training, with sampled actions; the same policy always gives the same numbers.

    Args:
        actor: The policy; it is not changed.
        config: Its environment.

    Raises:
        ConfigError: If the environment cannot be made or fails.
    """
    actor, env = copy.deepcopy(actor).cpu().eval(), make_env(config)
    seen, done, first = [], [], []
    try:
        for episode in range(EPISODES):
            noise = torch.Generator().manual_seed(episode)
            observation, _ = env.reset(seed=episode)
            first.append(observation)
            for _ in range(MOST_STEPS):
                action = _act(actor, observation, noise)
                seen.append(observation)
                done.append(action)
                observation, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    break
    finally:
        env.close()
    observations, actions, initial = (np.array(rows, dtype=np.float64) for rows in (seen, done, first))
    return PolicyStatistics(
        episodes=EPISODES,
        steps=len(observations),
        observation_mean=observations.mean(axis=0).tolist(),
        observation_std=observations.std(axis=0).tolist(),
        observation_initial=initial.mean(axis=0).tolist(),
        action_mean=actions.mean(axis=0).tolist(),
        action_std=actions.std(axis=0).tolist(),
    )


def with_statistics(teacher: Teacher, remedy: str = _REMEDY, trust: bool = False) -> Teacher:
    """The teacher as it is if it knows its statistics, else with those of its policy in its own environment.

    Args:
        teacher: The teacher.
        remedy: What to type where its environment would run code that its files choose.
        trust: Whether that has been typed.

    Raises:
        ConfigError: If its environment is not one that its description alone may choose, or cannot be made.
    """
    about = teacher.description
    if about.statistics is not None:
        return teacher
    beside = teacher.path.with_name(DESCRIPTION_FILE)
    config = stored_environment(about.config, f"{beside} (it does not say what its policy saw)", remedy, trust)
    measured = measure_policy(teacher.build_networks().actor, config)
    return replace(teacher, description=replace(about, statistics=measured))


def _act(actor: Actor, observation: np.ndarray, noise: torch.Generator) -> np.ndarray:
    with torch.no_grad():
        batch = torch.as_tensor(observation, dtype=torch.float32).unsqueeze(0)
        action, _ = actor.sample(batch, torch.randn(1, actor.action_scale.numel(), generator=noise))
    return action[0].numpy()
