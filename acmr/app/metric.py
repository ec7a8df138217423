"""One number for a finished run, which a search is after (the setting ``metric``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from acmr.config import STEPS, ExperimentConfig
from acmr.evaluation.rollout import play
from acmr.records import DIVERGED, EPISODES_FILE
from acmr.settings.run_spec import RunSpec
from acmr.transfer.teacher import load_teacher
from analysis.statistics.metrics import area_under_curve

#: Episodes that an evaluation plays; the k-th is reset with seed k - 1.
EPISODES = 10


def metric_of(spec: RunSpec, summary: Mapping[str, Any], metric: str) -> float:
    """What a run is worth.

    Args:
        spec: The run.
        summary: Its ``summary.json``.
        metric: ``steps_to_threshold``: environment steps, less is better; a run that never reached its threshold, or
            diverged, counts as the most that it could have taken (its restricted value).
            ``final_return``: mean return of its last ten episodes; ``area``: mean height of its learning curve;
            ``evaluation``: mean return of ten episodes of its final policy, deterministic: more is better.

    Returns:
        NaN where there is nothing to tell it from: no episode ended, or no policy was left because it diverged.
    """
    if metric == STEPS:
        reached = summary.get("steps_to_threshold")
        return float(spec.config.most_steps if reached is None else reached)
    if metric == "final_return":
        return float("nan") if summary.get("final_return") is None else float(summary["final_return"])
    if metric == "area":
        episodes = pd.read_csv(spec.directory / EPISODES_FILE)
        return area_under_curve(episodes["global_step"], episodes["episodic_return"])
    return float("nan") if summary.get("status") == DIVERGED else _evaluated(spec)


def metric_line(config: ExperimentConfig, summary: Mapping[str, Any], value: float) -> str:
    """A value for people."""
    restricted = config.metric == STEPS and summary.get("steps_to_threshold") is None
    return f"{config.metric}: {value:,.6g}{' (not reached: the most it could have taken)' if restricted else ''}"


def _evaluated(spec: RunSpec) -> float:
    teacher = load_teacher(spec.directory)
    actor, wrappers = teacher.build_networks().actor.eval(), teacher.wrapper_states()
    played = play(actor, spec.config.env, wrappers, episodes=EPISODES, seed=0, stochastic=False)
    returns = [episode.episodic_return for episode in played]
    return sum(returns) / len(returns)
