"""The first episodes of a student by name: several ways to begin are tried, counted, recorded, and one is chosen."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
import torch
from test_sac_reference import SOURCE, generator, make_networks
from torture import ANT, SMALL, Run, at_step, parts

from acmr.agent.sac import SAC
from acmr.agent.sac_plain import PlainSAC
from acmr.config import ConfigError, SACConfig
from acmr.settings.compose import compose_config, parse
from acmr.transfer.audition import EPISODES, Audition
from acmr.transfer.named import TRIED

LEARNERS = (SAC, PlainSAC)


def play(returns: dict[str, list[float]]) -> tuple[list[str], str, Audition]:
    """Who plays in which order if each choice's episodes return these, and who is chosen."""
    audition, left, order = Audition({name: {} for name in returns}), {k: list(v) for k, v in returns.items()}, []
    while not audition.is_over:
        order.append(audition.best)
        audition.add(left[order[-1]].pop(0))
    return order, audition.best, audition


def test_the_best_plays_on_without_a_break() -> None:
    order, chosen, _ = play({"a": [1.0], "b": [9.0] * 5, "c": [2.0]})
    assert "".join(order) == "abcbbbb"
    assert chosen == "b"


def test_luck_in_one_episode_is_found_out() -> None:
    order, chosen, _ = play({"a": [10.0, 0.0, 0.0], "b": [6.0] * 5, "c": [5.0]})
    # After its second episode a has a mean of 5, less than b's 6.
    assert "".join(order) == "abcabbbb"
    assert chosen == "b"


def test_one_that_does_well_enough_plays_on_before_the_others_are_tried() -> None:
    returns = {"a": [4.0], "b": [5.0, 6.0, 1.0], "c": [3.0], "d": [5.0, 5.0, 9.0, 7.0, 5.0]}
    audition, order = Audition({name: {} for name in returns}).until(5.0), []
    while not audition.is_over:
        order.append(audition.best)
        audition.add(returns[order[-1]].pop(0))
    assert "".join(order) == "abbbcddddd"
    assert audition.best == "d"


def test_of_equals_the_first_is_chosen_and_a_single_one_need_not_play() -> None:
    assert play({"a": [3.0] * 5, "b": [3.0] * 5})[:2] == (["a", "b", "a", "a", "a", "a"], "a")
    assert Audition({}).is_over
    assert Audition({"a": {}}).is_over
    assert not Audition({"a": {}, "b": {}}).is_over


@pytest.mark.parametrize("cut", [0, 1, 3, 6])
def test_it_goes_on_from_its_state(cut: int) -> None:
    returns = {"a": [10.0, 0.0, 0.0], "b": [6.0] * 5, "c": [5.0]}
    order, chosen, _ = play(returns)
    begun, again = Audition({name: {} for name in returns}), Audition({name: {} for name in returns})
    left = {name: list(each) for name, each in returns.items()}
    for _ in range(cut):
        begun.add(left[begun.best].pop(0))
    again.load_state_dict(json.loads(json.dumps(begun.state_dict())))
    found = []
    while not again.is_over:
        found.append(again.best)
        again.add(left[found[-1]].pop(0))
    assert (order[:cut] + found, again.best) == (order, chosen)


@pytest.mark.parametrize("state", [{"returns": {}}, {"returns": {"a": []}}, {"returns": {"b": [], "a": []}}])
def test_the_state_of_another_audition_is_refused(state: dict) -> None:
    with pytest.raises(ValueError, match="an audition of"):
        Audition({"a": {}, "b": {}}).load_state_dict(state)


@pytest.mark.parametrize("kickstart", [0.0, 3.0])
@pytest.mark.parametrize("kind", LEARNERS)
def test_biases_reach_networks_targets_and_origin(kind: type, kickstart: float, teacher_factory) -> None:
    config = SACConfig(hidden_sizes=[24, 16], kickstart=kickstart)
    agent = kind(make_networks("H1", (24, 16), teacher_factory), config, generator(1), generator(2))
    seen = torch.randn(SOURCE.observation, generator=generator(3)).numpy()
    before = agent.act(seen)
    biases = {f"{part}.input": torch.full((24,), value) for part, value in
              {"actor": 0.5, "critic_1": 1.5, "critic_2": -2.5}.items()}  # fmt: skip
    agent.set_biases(biases)
    for part, value in {"actor": 0.5, "critic_1": 1.5, "critic_2": -2.5}.items():
        assert torch.equal(getattr(agent.networks, part).input.bias, torch.full((24,), value))
    assert [float(target.input.bias[0]) for target in agent.targets] == [1.5, -2.5]
    state = agent.state_dict()["tensors"]
    assert any(name.startswith("origin") for name in state) == bool(kickstart)
    if kickstart:
        held = agent.origin if kind is PlainSAC else agent._origin.actor
        assert torch.equal(held.input.bias, torch.full((24,), 0.5))
    agent._generators["acting"].manual_seed(1)
    after = agent.act(seen)
    assert abs(after - before).max() > 1e-3
    # What acts is what is stored: the same networks, newly made, act alike.
    twin = kind(make_networks("H1", (24, 16), teacher_factory), config, generator(1), generator(2))
    twin.load_state_dict(agent.state_dict())
    twin._generators["acting"].manual_seed(1)
    assert (twin.act(seen) == after).all()


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """A student without a leg, and its teacher."""
    teacher = Run(tmp_path_factory.mktemp("teacher"), ANT)
    assert teacher().code == 0
    # The threshold is out of reach, so that every run goes on to its end.
    return (
        "env=ant_three_legs", "total_timesteps=700", "env.max_episode_steps=30", *SMALL, "threshold=100000",
        "transfer=named", f"transfer.teacher={teacher.folder}", "agent.kickstart=5", "agent.warmup=30",
    )  # fmt: skip


def test_its_steps_are_steps_of_the_run_and_nothing_is_learned_meanwhile(
    words: tuple[str, ...], tmp_path: Path
) -> None:
    trainer = parts(Run(tmp_path, words))[0].trainer
    start = {name: tensor.clone() for name, tensor in trainer.agent.networks.state_dict().items()}
    tried, exploring = [], trainer.streams.exploration.bit_generator.state
    while not trainer.audition.is_over:
        tried.append(trainer.audition.best)
        episode = trainer.global_step
        while trainer.observation is None or trainer.global_step == episode:
            trainer._step()
        while trainer.observation is not None:
            trainer._step()
    assert tried[:4] == list(TRIED)
    assert len(tried) == sum(map(len, trainer.audition.returns.values()))
    assert trainer.global_step > trainer.agent.config.learning_starts
    assert len(trainer.buffer) == min(trainer.global_step, 180)
    # Nobody acts at random before the choice is made, whatever agent.start says.
    assert trainer.streams.exploration.bit_generator.state == exploring
    changed = {
        name for name, tensor in trainer.agent.networks.state_dict().items() if not torch.equal(tensor, start[name])
    }
    assert changed <= {f"{part}.input.bias" for part in ("actor", "critic_1", "critic_2")}
    chosen = trainer.audition.biases()
    assert torch.equal(trainer.agent.networks.actor.input.bias, chosen["actor.input"])
    trainer._step()
    assert not torch.equal(trainer.agent.networks.critic_1.input.weight, start["critic_1.input.weight"])


def test_what_was_chosen_is_said_and_stored(words: tuple[str, ...], tmp_path: Path) -> None:
    run = Run(tmp_path, words)
    ended = run()
    assert ended.code == 0
    summary = json.loads((run.folder / "summary.json").read_text())
    audition = summary["audition"]
    assert len(audition["returns"][audition["chosen"]]) == EPISODES
    assert list(audition["returns"]) == list(TRIED)
    assert f"what is gone counts as: {audition['chosen']}" in ended.said
    assert "what does best in the first episodes" in ended.said


@pytest.mark.slow
@pytest.mark.parametrize("step", [60, 215, 640])
@pytest.mark.parametrize("learner", ["sac", "sac_plain"])
def test_a_killed_run_goes_on_bit_for_bit(learner: str, step: int, words: tuple[str, ...], tmp_path: Path) -> None:
    words = (*words, f"agent={learner}")
    whole, killed = Run(tmp_path / "whole", words), Run(tmp_path / "killed", words)
    assert whole().code == 0
    assert killed(at_step(step)).code == -signal.SIGKILL
    assert killed().code == 0
    assert killed.outcome() == whole.outcome()


@pytest.mark.parametrize("given", ["automatic", "nan", "inf", "1,5"])
def test_other_rules_are_refused_in_one_line(given: str) -> None:
    with pytest.raises(ConfigError, match=r"transfer\.impute=.*: must be one of auto, mean, zero, initial, or a share"):
        parse(compose_config([f"transfer.impute='{given}'"]))
