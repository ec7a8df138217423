"""What a finished run says of itself, and of the networks it leaves."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from acmr.agent.learner import Learner
from acmr.config import THRESHOLD
from acmr.envs import EnvDescription
from acmr.envs.state import RestorableEnv
from acmr.envs.wrappers.memory import lasting_state
from acmr.records import COMPLETE, DIVERGED, NO_EPISODE, EpisodeRecord, portable_settings, steps_to_threshold
from acmr.run.reproducibility import git_commit, machine, versions
from acmr.run.trainer import DivergedError
from acmr.settings.run_spec import RunSpec
from acmr.stateful import State
from acmr.storage.state_data import as_json
from acmr.text import one_line, size
from acmr.transfer.description import FORMAT_VERSION, PolicyStatistics, TeacherDescription
from acmr.transfer.statistics import measure_policy

#: Episodes that the final return is the mean of.
FINAL_EPISODES = 10
#: Bytes that the description of a teacher holds of what wrappers remember, at most: far less than its readers take.
_MOST_TOLD = 1 << 20


def summarize(
    spec: RunSpec, history: Sequence[EpisodeRecord], steps: int, wall: float, diverged: DivergedError | None = None
) -> dict[str, Any]:
    """The content of ``summary.json``.

    Args:
        spec: The run.
        history: Every episode that ended.
        steps: Environment steps that were taken.
        wall: Seconds that the training took.
        diverged: What ended it, if it did not come to its last step.
    """
    config = spec.config
    returns = [record.episodic_return for record in history]
    met = steps_to_threshold([record.global_step for record in history], returns, config.threshold, config.consecutive)
    return {
        "status": DIVERGED if diverged else COMPLETE,
        **({"step": diverged.step, "cause": diverged.cause} if diverged else {}),
        "cell": spec.cell,
        "run": spec.name,
        "profile": config.profile,
        "env": config.env.name,
        "transfer": config.transfer.name,
        "freeze": config.freeze,
        "seed": config.seed,
        "seeding": config.seeding,
        "global_step": steps,
        "total_timesteps": config.total_timesteps,
        "stop": config.stop,
        "stop_after": config.stop_after,
        "episodes": len(history),
        **({} if history else {"note": f"{NO_EPISODE}, so that nothing is known of the return"}),
        "threshold": config.threshold,
        "consecutive": config.consecutive,
        "steps_to_threshold": met.last if met else None,
        "steps_to_threshold_first": met.first if met else None,
        "censored": met is None,
        "final_return": float(np.mean(returns[-FINAL_EPISODES:])) if returns else None,
        "steps_per_second": steps / wall,
        "wall_seconds": wall,
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": machine(config.threads, config.device),
    }


def describe_teacher(
    spec: RunSpec,
    about: EnvDescription,
    agent: Learner,
    env: RestorableEnv,
    summary: Mapping[str, Any],
    say: Callable[[str], None],
) -> TeacherDescription:
    """What the file of the final networks says of them.

    Args:
        spec: The run.
        about: Its environment.
        agent: The learner at the end.
        env: The environment at the end.
        summary: The content of ``summary.json``.
        say: Where a line goes if the policy cannot be played.
    """
    made, states = agent.networks.architecture, lasting_state(env.env)
    for wrapper, names in about.normalized.items():
        states[wrapper]["names"] = list(names)
    told = _told(states, say)
    return TeacherDescription(
        format_version=FORMAT_VERSION,
        environment=spec.config.env.name,
        environment_id=spec.config.env.id,
        model_hash=about.model_hash,
        observation_names=list(about.observation_names),
        action_names=list(about.action_names),
        action_low=list(made.action_low),
        action_high=list(made.action_high),
        hidden_sizes=list(made.hidden_sizes),
        core=[made.core.observation, made.core.action] if made.core else None,
        adapter_activation=made.adapter_activation,
        log_alpha=agent.log_alpha.item(),
        seed=spec.config.seed,
        profile=spec.config.profile,
        global_step=summary["global_step"],
        final_return=summary["final_return"],
        config=json.loads(json.dumps(portable_settings(spec.settings))),
        log_std=made.log_std,
        statistics=_statistics(spec, agent, states, say),
        wrappers=told,
    )


def _told(states: State, say: Callable[[str], None]) -> dict[str, Any] | None:
    """What wrappers remember, as the description holds it; one of the user's may remember what it does not."""
    try:
        told = as_json(states) if states else None
        if len(json.dumps(told, allow_nan=False)) <= _MOST_TOLD:
            return told
        why = f"more than {size(_MOST_TOLD)}"
    except (TypeError, ValueError) as error:
        why = one_line(error)
    say(f"warning: what {', '.join(states)} remember is not stored with the networks ({why}): evaluations begin anew")
    return None


def _statistics(spec: RunSpec, agent: Learner, wrappers: State, say: Callable[[str], None]) -> PolicyStatistics | None:
    """What the final policy sees and does."""
    try:
        return measure_policy(agent.networks.actor, spec.config.env, wrappers)
    except Exception as error:
        # Whatever an environment does once more: the run is finished, and only its students would ask for this.
        say(f"warning: the final policy could not be played ({one_line(error)}); its students cannot be told means")
        return None


def reached(summary: Mapping[str, Any]) -> str:
    """Whether a run met its threshold, in words that follow on others."""
    step, total = summary.get("steps_to_threshold"), summary.get("total_timesteps")
    if summary.get("episodes") == 0:
        return f", but {NO_EPISODE}: nothing is known of its return; type more total_timesteps or a time limit"
    threshold = f"{summary.get('threshold', float('nan')):g}"
    said = f", return {threshold} reached at step {step:,}" if step else f", return {threshold} not reached"
    if summary.get("stop") != THRESHOLD or summary["global_step"] == total:
        return said
    return f"{said}; stopped there" if step else f"{said} by step {summary['global_step']:,}; stopped there"
