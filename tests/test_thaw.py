"""Layers that thaw: none before its step, in both learners alike, and a resume is exact on either side of it."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_resume import untouched  # noqa: F401
from test_sac_reference import assert_same_course, generator, make_batch, make_networks
from torture import ANT, SMALL, Run, at_step, same

from acmr.agent.fine_tuning import thaw_schedule
from acmr.agent.kernels import arrays
from acmr.agent.sac import SAC
from acmr.agent.sac_plain import PlainSAC
from acmr.config import SACConfig

LEARNERS = (SAC, PlainSAC)
SIZES = (32, 24, 16)
CONFIG = SACConfig(hidden_sizes=list(SIZES), batch_size=48)
#: Three for the four layers that A4 freezes in each network.
STEPS = (9, 20, 31)


def frozen_of(networks):
    return [name for name, layer in networks.layers().items() if not layer.weight.requires_grad]


def make(kind, teacher_factory, cell="A4", steps=STEPS, config=CONFIG):
    networks = make_networks(cell, SIZES, teacher_factory)
    thaws = thaw_schedule(frozen_of(networks), steps)
    return kind(networks, config, generator(1), generator(2), thaws=thaws), thaws


def go_on(agent, first, last):
    for step in range(first, last + 1):
        agent.update(make_batch(agent.networks.dims, step, agent.config.batch_size), step)


def values(agent):
    return {name: value.clone() for name, value in agent.networks.state_dict().items()}


@pytest.mark.parametrize("kind", LEARNERS)
@pytest.mark.parametrize("cell", ["A4", "A2"])
def test_a_layer_learns_from_its_step_on_and_so_does_its_target(kind, cell, teacher_factory):
    agent, thaws = make(kind, teacher_factory, cell)
    assert sorted(set(thaws.values())) == list(STEPS)[: 2 if cell == "A2" else 3]
    start, targets = values(agent), copy.deepcopy(agent.targets.state_dict())
    for step in range(1, 41):
        go_on(agent, step, step)
        for name, begin in thaws.items():
            # The actor learns at every second step.
            begun = step >= (begin if name.startswith("critic") else begin + begin % 2)
            for tensor in (f"{name}.weight", f"{name}.bias"):
                assert torch.equal(agent.networks.state_dict()[tensor], start[tensor]) != begun, (step, tensor)
                if name.startswith("critic"):
                    twin = f"{int(name[7]) - 1}.{tensor[9:]}"
                    assert torch.equal(agent.targets.state_dict()[twin], targets[twin]) != begun, (step, twin)


@pytest.mark.parametrize("kind", LEARNERS)
@pytest.mark.parametrize("changes", [{}, {"warmup": 8}], ids=["at once", "rising"])
def test_the_optimizer_of_what_thaws_begins_fresh(kind, changes, teacher_factory):
    """Adam's first step is as long as its rate, wherever there is a gradient; warm-up takes a share of it."""
    config = replace(CONFIG, policy_frequency=1, **changes)
    agent, thaws = make(kind, teacher_factory, steps=(9,), config=config)
    go_on(agent, 1, 8)
    before = values(agent)
    go_on(agent, 9, 9)
    for name in thaws:
        rate = (config.policy_lr if name.startswith("actor") else config.q_lr) / (config.warmup or 1)
        moved = (agent.networks.state_dict()[f"{name}.weight"] - before[f"{name}.weight"]).abs()
        assert float(moved.max()) == pytest.approx(rate, rel=0.02), name


@pytest.mark.parametrize("kind", LEARNERS)
def test_what_thaws_before_the_first_update_was_never_frozen(kind, teacher_factory):
    """A3 and A4 differ in freezing only, so that A4 thawed at once is A3."""
    thawed, _ = make(kind, teacher_factory, steps=(1,))
    free = kind(make_networks("A3", SIZES, teacher_factory), CONFIG, generator(1), generator(2))
    for agent in (thawed, free):
        go_on(agent, 1, 30)
    for name, value in free.networks.state_dict().items():
        assert torch.equal(thawed.networks.state_dict()[name], value), name
    assert thawed.metrics() == free.metrics()


@pytest.mark.parametrize("cell", ["A4", "A2"])
@pytest.mark.parametrize("changes", [{}, {"warmup": 15, "kickstart": 2.0, "critics_first": 5}], ids=["plain", "gentle"])
def test_both_learners_take_the_same_course(cell, changes, teacher_factory):
    thaws = thaw_schedule(frozen_of(make_networks(cell, SIZES, teacher_factory)), STEPS)
    config = replace(CONFIG, **changes)
    assert_same_course(lambda: make_networks(cell, SIZES, teacher_factory), config, updates=60, thaws=thaws)


def test_and_to_the_precision_of_float64(teacher_factory):
    torch.set_default_dtype(torch.float64)
    try:
        thaws = thaw_schedule(frozen_of(make_networks("A4", SIZES, teacher_factory)), STEPS)
        assert_same_course(lambda: make_networks("A4", SIZES, teacher_factory), CONFIG, updates=60, thaws=thaws)
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("devices", [{"cpu"}, set()], ids=["numpy", "torch"])
def test_bfloat16_thaws_the_same_layers(devices, teacher_factory, monkeypatch):
    monkeypatch.setattr(arrays, "NUMPY_DEVICES", devices)
    (exact, thaws), (reduced, _) = (
        make(SAC, teacher_factory, config=replace(CONFIG, precision=precision)) for precision in ("float32", "bfloat16")
    )
    start = values(exact)
    for last in (8, 19, 30, 60):
        for agent in (exact, reduced):
            go_on(agent, last - 8 if last == 8 else {19: 9, 30: 20, 60: 31}[last], last)
        for name, value in values(reduced).items():
            begun = thaws.get(name.rpartition(".")[0], 0) <= last
            assert torch.equal(value, start[name]) != begun, (last, name)
    for name, wanted in values(exact).items():
        taken, wanted = (values(reduced)[name] - start[name]).flatten(), (wanted - start[name]).flatten()
        assert torch.cosine_similarity(taken, wanted, dim=0) > 0.97, name


@pytest.mark.parametrize("kind", LEARNERS)
@pytest.mark.parametrize("at", [5, 8, 9, 25, 40])
def test_a_state_goes_on_bit_for_bit_on_either_side_of_a_thaw(kind, at, teacher_factory):
    (whole, _), (begun, _), (other, _) = (make(kind, teacher_factory) for _ in range(3))
    go_on(whole, 1, 50)
    go_on(begun, 1, at)
    # It had thawed further than the one whose state it takes up.
    go_on(other, 40, 45)
    other.load_state_dict(begun.state_dict())
    go_on(other, at + 1, 50)
    for name, value in whole.state_dict()["tensors"].items():
        assert torch.equal(value, other.state_dict()["tensors"][name]), name
    observation = np.ones(whole.networks.dims.observation)
    np.testing.assert_array_equal(whole.act(observation), other.act(observation))


@pytest.mark.parametrize("learner", ["sac", "sac_plain"])
@pytest.mark.slow
def test_kills_around_a_thaw_leave_no_trace(learner, untouched, tmp_path):  # noqa: F811
    teacher = untouched(ANT)[1]
    overrides = (
        "env=ant_three_legs", "transfer=expand", "freeze=true", "thaw=[100,140]", f"transfer.teacher={teacher}",
        f"agent={learner}", "total_timesteps=200", *SMALL,
    )  # fmt: skip
    run = Run(tmp_path, overrides)
    # Checkpoints are of the steps 40, 80, 120 and 160.
    for kill in (98, 130, 139, 170):
        run(at_step(kill))
    same(run.finish(), untouched(overrides)[0])
    report = json.loads((run.folder / "transfer.json").read_text())
    assert set(report["details"]["thaws"].values()) == {100, 140}
    assert set(report["details"]["thaws"]) == set(report["frozen"])
