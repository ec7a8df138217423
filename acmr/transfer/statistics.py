"""What a policy sees and does on average, measured by playing it in its own environment; and what wrappers had seen.

First layers that come from a teacher expect numbers in the teacher's units. So what changes numbers has to be the same
around both environments, and running statistics are handed over by the names of the sensors.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from acmr.agent.networks import Actor
from acmr.config import ConfigError, EnvConfig, TransferConfig
from acmr.records import DESCRIPTION_FILE
from acmr.settings.stored import stored_environment
from acmr.stateful import State
from acmr.text import typed_mapping
from acmr.transfer.description import PolicyStatistics
from acmr.transfer.name_map import PartMap, map_names, parse_renames
from acmr.transfer.teacher import Teacher

#: Episodes that are played, and the most steps of each: an environment may have no time limit.
EPISODES, MOST_STEPS = 10, 1_000
#: What a student's command line says in place of that environment.
_REMEDY = "describe that environment in conf/env; else type transfer.impute=zero"
#: Wrappers that leave what each sensor and each actuator says, and what a step pays, as it is: they may differ.
_HARMLESS = (
    *("FrameStackObservation", "TimeAwareObservation", "FilterObservation", "FlattenObservation", "ReshapeObservation"),
    *("DtypeObservation", "RecordEpisodeStatistics", "TimeLimit"),
)
#: Observations that statistics of another body count as at most, where they say nothing of a sensor that was added: it
#: begins with mean 0 and deviation 1, and has to come to its own.
MOST_COUNTED = 1_000.0


def measure_policy(actor: Actor, config: EnvConfig, wrappers: State) -> PolicyStatistics:
    """Plays a policy as in training, with sampled actions; the same policy always gives the same numbers.

    Args:
        actor: The policy; it is not changed.
        config: Its environment.
        wrappers: What the wrappers around it have remembered.

    Raises:
        ConfigError: If the environment cannot be made or fails.
    """
    # As late as this: whoever imports this module decides how mujoco is loaded (acmr.evaluation.camera.without_gl).
    from acmr.envs import make_env
    from acmr.envs.wrappers.memory import give_lasting

    actor, env = copy.deepcopy(actor).cpu().eval(), make_env(config)
    seen, done, first = [], [], []
    try:
        for episode in range(EPISODES):
            give_lasting(env, wrappers, settled=True)
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
    measured = measure_policy(teacher.build_networks().actor, config, teacher.wrapper_states())
    return replace(teacher, description=replace(about, statistics=measured))


def check_units(teacher: Teacher, wrappers: Sequence[Mapping[str, Any]], config: TransferConfig) -> None:
    """Refuses a teacher whose sensors and actuators were scaled otherwise than the student's.

    Args:
        teacher: The teacher.
        wrappers: Those around the student's environment.
        config: The transfer, for the message.

    Raises:
        ConfigError: If wrappers that change numbers are not the same.
    """
    told = teacher.description.config.get("env")
    theirs = told.get("wrappers") if isinstance(told, dict) else None
    known = theirs if isinstance(theirs, list) and all(isinstance(entry, dict) for entry in theirs) else []
    before, now = (_that_scale(each) for each in (known, wrappers))
    if before != now:
        shown = [f"[{','.join(map(typed_mapping, each))}]" for each in (before, now)]
        raise ConfigError(
            f"transfer={config.name}: the teacher {teacher.path} learned within the wrappers {shown[0]}, the student "
            f"would in {shown[1]}, and its first layer be told other numbers; type 'env.wrappers={shown[0]}'"
            f"{config.rules.or_instead}"
        )


def handed_over(teacher: Teacher, normalized: Mapping[str, Sequence[str]], config: TransferConfig) -> State:
    """Running statistics for the student's wrappers, sensor by sensor.

    Args:
        teacher: The teacher.
        normalized: The student's sensors that each of its wrappers normalizes, by the wrapper's name.
        config: The transfer, with what is called otherwise.

    Returns:
        As :func:`acmr.envs.wrappers.memory.give_lasting` takes it.

    Raises:
        ConfigError: If the teacher does not have them.
    """
    states, found, rename = teacher.wrapper_states(), dict[str, Any](), parse_renames(config.rename)
    for wrapper, ours in normalized.items():
        told = states.get(wrapper, {})
        theirs = told.get("names")
        shapes = {np.shape(told.get(key)) for key in ("mean", "var")}
        if not isinstance(theirs, list) or shapes != {(len(theirs),)}:
            raise ConfigError(
                f"{teacher.path}: does not say what {wrapper} had seen of which sensor; train it again"
                f"{config.rules.or_instead}"
            )
        found[wrapper] = _by_name(told, map_names(theirs, ours, rename), len(ours))
    return found


def _act(actor: Actor, observation: np.ndarray, noise: torch.Generator) -> np.ndarray:
    with torch.no_grad():
        batch = torch.as_tensor(observation, dtype=torch.float32).unsqueeze(0)
        action, _ = actor.sample(batch, torch.randn(1, actor.action_scale.numel(), generator=noise))
    return action[0].numpy()


def _by_name(told: Mapping[str, Any], sensors: PartMap, count: int) -> State:
    mean, var = np.zeros(count), np.ones(count)
    mean[list(sensors.ours)] = told["mean"][list(sensors.theirs)]
    var[list(sensors.ours)] = told["var"][list(sensors.theirs)]
    seen = float(told["count"])
    return {"mean": mean, "var": var, "count": min(seen, MOST_COUNTED) if sensors.added else seen}


def _that_scale(wrappers: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [dict(entry) for entry in wrappers if entry.get("name") not in _HARMLESS]
