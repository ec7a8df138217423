"""Learners that begin gently: rates that rise, critics first, and a penalty on leaving the transferred policy."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import torch
from test_sac_reference import assert_same_course, generator, make_batch, make_networks
from torture import ANT, Run, at_step

from acmr.agent.fine_tuning import actor_learns, kickstart_weight, rate_share
from acmr.agent.sac import SAC
from acmr.agent.sac_plain import PlainSAC
from acmr.config import ConfigError, SACConfig
from acmr.settings.compose import compose_config, parse

LEARNERS = (SAC, PlainSAC)
SIZES = (32, 24)
SMALL = {"hidden_sizes": list(SIZES), "batch_size": 48, "learning_starts": 0}
GENTLE = [
    {"warmup": 30},
    {"critics_first": 17},
    {"kickstart": 5.0, "kickstart_updates": 40},
    {"kickstart": 0.5, "kickstart_updates": 10_000, "warmup": 100, "critics_first": 9, "policy_frequency": 3},
    {"kickstart": 2.0, "autotune": False, "warmup": 3},
]


def learn(kind, config, teacher_factory, updates, cell="A1"):
    agent = kind(make_networks(cell, SIZES, teacher_factory), config, generator(1), generator(2))
    go_on(agent, 1, updates)
    return agent


def go_on(agent, first, last):
    for step in range(first, last + 1):
        agent.update(make_batch(agent.networks.dims, step, agent.config.batch_size), step)


def test_off_means_what_was_done_before():
    config = SACConfig()
    for updates in (0, 1, 10**6):
        assert rate_share(config, updates) == 1.0
        assert kickstart_weight(config, updates) == 0.0
        assert actor_learns(config, updates + 1)


def test_shares_and_weights_are_straight_lines():
    config = SACConfig(warmup=4, kickstart=50.0, kickstart_updates=100, critics_first=5)
    assert [rate_share(config, updates) for updates in range(6)] == [0.25, 0.5, 0.75, 1.0, 1.0, 1.0]
    assert [kickstart_weight(config, updates) for updates in (0, 50, 99, 100, 200)] == pytest.approx(
        [50, 25, 0.5, 0, 0]
    )
    assert [actor_learns(config, updates) for updates in (1, 5, 6)] == [False, False, True]


@pytest.mark.parametrize("changes", GENTLE, ids=str)
@pytest.mark.parametrize("cell", ["H1", "A2", "A3", "N1"])
@pytest.mark.first_is_fast
def test_both_learners_take_the_same_course(cell, changes, teacher_factory):
    assert_same_course(lambda: make_networks(cell, SIZES, teacher_factory), SACConfig(**SMALL | changes), updates=60)


@pytest.mark.parametrize("changes", GENTLE, ids=str)
def test_and_to_the_precision_of_float64(changes, teacher_factory):
    torch.set_default_dtype(torch.float64)
    try:
        assert_same_course(
            lambda: make_networks("A1", SIZES, teacher_factory), SACConfig(**SMALL | changes), updates=60
        )
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("kind", LEARNERS)
def test_the_first_step_of_a_rising_rate_is_its_share(kind, teacher_factory):
    before = make_networks("A0", SIZES, teacher_factory).state_dict()
    moved = {}
    for warmup in (0, 8):
        config = SACConfig(**SMALL | {"warmup": warmup, "policy_frequency": 1})
        after = learn(kind, config, teacher_factory, 1, "A0").networks.state_dict()
        # Adam's first step is as long as its rate, wherever there is a gradient.
        moved[warmup] = torch.cat([(after[name] - before[name]).flatten() for name in before]).double()
    assert torch.allclose(moved[8] * 8, moved[0], rtol=1e-2, atol=2e-6)
    assert moved[0].abs().max() > 1e-4


@pytest.mark.parametrize("kind", LEARNERS)
def test_critics_learn_alone_at_first(kind, teacher_factory):
    config = SACConfig(**SMALL | {"critics_first": 10})
    begun, agent = (learn(kind, config, teacher_factory, updates) for updates in (0, 10))
    for name, value in agent.networks.state_dict().items():
        assert torch.equal(value, begun.networks.state_dict()[name]) == name.startswith("actor"), name
    assert torch.equal(agent.log_alpha, begun.log_alpha)
    go_on(agent, 11, 12)
    assert not torch.equal(agent.networks.actor.mean.weight, begun.networks.actor.mean.weight)
    assert not torch.equal(agent.log_alpha, begun.log_alpha)


@pytest.mark.parametrize("kind", LEARNERS)
@pytest.mark.first_is_fast
def test_the_penalty_keeps_the_policy_near_until_it_has_faded(kind, teacher_factory):
    probe = torch.randn(200, make_networks("A1", SIZES, teacher_factory).dims.observation, generator=generator(9))

    def distance(**changes):
        agent = learn(kind, SACConfig(**SMALL | changes), teacher_factory, 200)
        start = make_networks("A1", SIZES, teacher_factory).actor
        return float(PlainSAC.distance(agent.networks.actor.outputs(probe), start.outputs(probe)).detach())

    free, held = distance(), distance(kickstart=200.0, kickstart_updates=10**6)
    assert held < free / 4
    # Once it has faded, it learns as freely as any.
    assert distance(kickstart=200.0, kickstart_updates=20) > 2 * held


@pytest.mark.parametrize("kind", LEARNERS)
def test_a_state_goes_on_bit_for_bit_whatever_the_networks_were(kind, teacher_factory):
    config = SACConfig(**SMALL | {"kickstart": 5.0, "kickstart_updates": 60, "warmup": 30})
    whole, begun = (learn(kind, config, teacher_factory, updates) for updates in (40, 15))
    # The origin is in the state: what it is taken up with is another policy.
    other = kind(make_networks("A0", SIZES, teacher_factory), config, generator(3), generator(4))
    other.load_state_dict(begun.state_dict())
    go_on(other, 16, 40)
    for name, value in whole.state_dict()["tensors"].items():
        assert torch.equal(value, other.state_dict()["tensors"][name]), name


@pytest.mark.parametrize("step", [110, 170])
@pytest.mark.slow
def test_a_killed_run_goes_on_bit_for_bit(step: int, tmp_path: Path) -> None:
    words = (*ANT, "agent.warmup=80", "agent.critics_first=30")
    whole, killed = Run(tmp_path / "whole", words), Run(tmp_path / "killed", words)
    assert whole().code == 0
    assert killed(at_step(step)).code == -signal.SIGKILL
    assert killed().code == 0
    assert killed.outcome() == whole.outcome()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["agent.warmup=-1"], r"agent\.warmup=-1: an integer of at least 0"),
        (["agent.critics_first=-5"], r"agent\.critics_first=-5: an integer of at least 0"),
        (["agent.kickstart=-1", "transfer=hidden"], r"agent\.kickstart=-1\.0: a number in \[0, inf\)"),
        (["agent.kickstart=nan", "transfer=hidden"], r"agent\.kickstart=nan: a number in \[0, inf\)"),
        (["agent.kickstart_updates=0"], r"agent\.kickstart_updates=0: an integer of at least 1"),
        (["agent.kickstart=50"], r"transfer=none agent\.kickstart=50: without a transfer .* leave it out"),
    ],
)
def test_what_cannot_be_is_refused(words, message):
    with pytest.raises(ConfigError, match=message):
        parse(compose_config(words))
