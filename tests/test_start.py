"""Who acts before learning starts: uniform draws, or the policy as it was transferred."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from torture import ANT, Run, at_step, parts

from acmr.config import ConfigError
from acmr.settings.compose import compose_config, parse


@pytest.mark.parametrize("learner", ["sac", "sac_plain"])
@pytest.mark.parametrize("start", ["random", "policy"])
def test_only_who_is_to_act_draws_and_nothing_is_learned(start: str, learner: str, tmp_path: Path) -> None:
    words = [word for word in ANT if not word.startswith("agent=")]
    state, _ = parts(Run(tmp_path, (*words, f"agent={learner}", f"agent.start={start}")))
    trainer, streams = state.trainer, state.trainer.streams
    before = {name: tensor.clone() for name, tensor in trainer.agent.networks.state_dict().items()}
    exploring, acting = streams.exploration.bit_generator.state, streams.acting.get_state()
    seen = []
    for _ in range(60):
        trainer._step()
        seen.append(trainer.observation)
    assert trainer.global_step < trainer.agent.config.learning_starts
    assert (streams.exploration.bit_generator.state == exploring) == (start == "policy")
    assert torch.equal(streams.acting.get_state(), acting) == (start == "random")
    for name, tensor in trainer.agent.networks.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_the_first_actions_are_the_policys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state, _ = parts(Run(tmp_path, (*ANT, "agent.start=policy")))
    trainer, chosen, done = state.trainer, [], []
    act, step = trainer.agent.act, trainer.env.step
    monkeypatch.setattr(trainer.agent, "act", lambda seen: chosen.append(act(seen)) or chosen[-1])
    monkeypatch.setattr(trainer.env, "step", lambda action: done.append(np.array(action)) or step(action))
    for _ in range(20):
        trainer._step()
    assert len(chosen) == len(done) == 20
    assert np.array_equal(chosen, done)


@pytest.mark.parametrize("step", [40, 150])
@pytest.mark.first_is_fast
def test_a_killed_run_goes_on_bit_for_bit(step: int, tmp_path: Path) -> None:
    words = (*ANT, "agent.start=policy")
    whole, killed = Run(tmp_path / "whole", words), Run(tmp_path / "killed", words)
    assert whole().code == 0
    assert killed(at_step(step)).code == -signal.SIGKILL
    assert killed().code == 0
    assert killed.outcome() == whole.outcome()
    assert whole.spec.changes["agent.start"] == "policy"


def test_anything_else_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"agent\.start=teacher: must be one of random, policy"):
        parse(compose_config(["agent.start=teacher"]))
