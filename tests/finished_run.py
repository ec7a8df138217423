"""A finished run whose networks are random, for the tests of what is done with one (helpers, no tests)."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
import yaml
from gymnasium.spaces import Box

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.networks import Networks
from acmr.config import EnvConfig
from acmr.envs import describe, make_env
from acmr.transfer.description import FORMAT_VERSION, TeacherDescription
from acmr.transfer.teacher import save_teacher

ANT = EnvConfig(
    name="ant_three_legs",
    id="Ant-v5",
    source="ant",
    kwargs={"include_cfrc_ext_in_observation": False},
    remove_bodies=["back_leg"],
    max_episode_steps=12,
)


def make_run(path: Path, core: Dimensions | None = None, width: int = 32) -> Path:
    """A finished run whose networks are random."""
    about, env = describe(ANT), make_env(ANT)
    dims = Dimensions(len(about.observation_names), len(about.action_names))
    space = env.action_space
    assert isinstance(space, Box)
    low, high = space.low, space.high
    architecture = replace(Architecture.plain(dims, (width, width), low, high), core=core)
    networks = Networks(architecture, torch.Generator().manual_seed(5))
    path.mkdir(parents=True)
    description = TeacherDescription(
        format_version=FORMAT_VERSION, environment=ANT.name, environment_id=ANT.id, model_hash=about.model_hash,
        observation_names=list(about.observation_names), action_names=list(about.action_names),
        action_low=low.tolist(), action_high=high.tolist(), hidden_sizes=[width, width],
        core=[core.observation, core.action] if core else None, adapter_activation="relu", log_alpha=0.0, seed=1,
        profile="quick", global_step=100, final_return=None, config={"env": asdict(ANT), "seed": 1},
    )  # fmt: skip
    save_teacher(path, networks, description)
    (path / "config.yaml").write_text(yaml.safe_dump({"env": asdict(ANT), "seed": 1}))
    (path / "summary.json").write_text(json.dumps({"status": "complete"}))
    return path


def result(run_dir: Path) -> dict[str, Any]:
    """What an evaluation has written."""
    content: dict[str, Any] = json.loads((run_dir / "evaluation.json").read_text())
    return content
