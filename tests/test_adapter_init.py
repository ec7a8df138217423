"""Adapters that begin as the selection of names: the student begins as its teacher, as far as it is the same body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_config import refusal, spec
from test_named import ACTIONS, ACTUATORS, BODY, MEANS, OBSERVATIONS, SENSORS, SIZES, outputs

from acmr.agent.architecture import CLAMP, Architecture, Dimensions, is_adapter
from acmr.agent.networks import Networks
from acmr.config import ConfigError, TransferConfig
from acmr.transfer.description import PolicyStatistics
from acmr.transfer.methods import Student, Transferred, transfer
from acmr.transfer.teacher import Teacher

NAMES = {"adapter_init": "names", "adapter_activation": "none"}


@pytest.fixture
def teacher(teacher_factory: Callable[..., Teacher]) -> Teacher:
    made: Teacher = teacher_factory(BODY, SIZES)
    seen = PolicyStatistics(10, 100, MEANS, [1.0] * 12, [0.5] * 12, [0.1] * 5, [0.2] * 5)
    return replace(made, description=replace(made.description, statistics=seen))


def expand(
    teacher: Teacher, sensors: list[str], actuators: list[str], bound: float = 1.0, freeze: bool = False, **said: object
) -> Transferred:
    high = np.full(len(actuators), bound, np.float32)
    architecture = Architecture.plain(Dimensions(len(sensors), len(actuators)), SIZES, -high, high)
    student = Student(Networks(architecture, torch.Generator().manual_seed(1)), sensors, actuators)
    config = replace(TransferConfig(name="expand", impute="mean"), **{**NAMES, **said})
    return transfer(student, teacher, config, freeze, torch.Generator().manual_seed(2))


@pytest.mark.parametrize("log_std", ["tanh", CLAMP])
def test_in_the_same_body_it_is_the_teachers_function_bit_for_bit(log_std, teacher_factory):
    teacher = teacher_factory(BODY, SIZES, log_std=log_std)
    made = expand(teacher, SENSORS, ACTUATORS, impute="zero")
    wanted, found = (outputs(each, OBSERVATIONS, ACTIONS) for each in (teacher.build_networks(), made.networks))
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(found, wanted, strict=True))
    assert set(made.report.fitted) == {name for name in made.networks.layers() if is_adapter(name)}
    assert made.report.fresh == []


def test_freezing_leaves_the_adapters_to_learn(teacher):
    frozen = expand(teacher, SENSORS, ACTUATORS, freeze=True)
    assert set(frozen.report.frozen) == {name for name in frozen.networks.layers() if not is_adapter(name)}
    assert all(layer.weight.requires_grad == is_adapter(name) for name, layer in frozen.networks.layers().items())


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), impute=st.sampled_from(["mean", "zero", "initial", "0.5"]))
def test_gone_sensors_that_are_constant_leave_the_teachers_function_in_any_order(teacher, data, impute):
    left = data.draw(st.lists(st.integers(0, 11), min_size=1, unique=True))
    motors = data.draw(st.lists(st.integers(0, 4), min_size=1, unique=True))
    made = expand(teacher, [SENSORS[row] for row in left], [ACTUATORS[row] for row in motors], impute=impute)
    seen = {"mean": MEANS, "zero": [0.0] * 12, "initial": [0.5] * 12, "0.5": [mean / 2 for mean in MEANS]}[impute]
    done = {"mean": 0.1, "zero": 0.0, "initial": 0.1, "0.5": 0.05}[impute]
    constant, acted = torch.tensor(seen).repeat(64, 1), torch.full((64, 5), done)
    constant[:, left], acted[:, motors] = OBSERVATIONS[:, left], ACTIONS[:, motors]
    wanted = outputs(teacher.build_networks(), constant, acted)
    found = outputs(made.networks, OBSERVATIONS[:, left], ACTIONS[:, motors])
    for ours, theirs in zip(found, (*(part[:, motors] for part in wanted[:2]), *wanted[2:]), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_it_begins_as_a_student_by_name_does(teacher):
    left, motors = SENSORS[3:], ACTUATORS[:3]
    by_name = expand(teacher, left, motors, name="named", adapter_init="random")
    for ours, theirs in zip(
        *(
            outputs(made.networks, OBSERVATIONS[:, 3:], ACTIONS[:, :3])
            for made in (expand(teacher, left, motors), by_name)
        ),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_what_is_added_changes_nothing_and_other_bounds_are_the_same_share(teacher):
    made = expand(teacher, ["new", *SENSORS], [*ACTUATORS, "tail"], bound=0.4)
    more = torch.cat((50 * torch.ones(64, 1), OBSERVATIONS), dim=1)
    found = outputs(made.networks, more, torch.cat((0.4 * ACTIONS, 0.4 * torch.ones(64, 1)), dim=1))
    wanted = outputs(teacher.build_networks(), OBSERVATIONS, ACTIONS)
    for ours, theirs in zip((*(part[:, :5] for part in found[:2]), *found[2:]), wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_several_stand_ins_are_tried_where_asked_for(teacher):
    made = expand(teacher, SENSORS[2:], ACTUATORS, impute="auto")
    assert not made.audition.is_over
    assert set(made.audition.biases()) == {f"{part}.input_adapter" for part in ("actor", "critic_1", "critic_2")}


def test_the_default_is_what_it_was(teacher):
    plain = expand(teacher, SENSORS, ACTUATORS, adapter_init="random")
    assert TransferConfig().adapter_init == "random"
    assert plain.report.fitted == []
    assert not torch.equal(plain.networks.actor.input_adapter.weight, torch.eye(12))
    made = spec("experiment=A4", "transfer.adapter_init=names", "transfer.adapter_activation=none")
    assert (made.cell, made.name) == (
        None, "armless_humanoid-expand-frozen-adapter_activation=none-adapter_init=names",
    )  # fmt: skip


def test_combinations_that_mean_nothing_are_refused_in_one_line(teacher):
    assert "would cut off whatever is below zero" in refusal("transfer=expand", "transfer.adapter_init=names")
    assert "must be one of random, names" in refusal("transfer=expand", "transfer.adapter_init=zero")
    with pytest.raises(
        ConfigError, match=r"transfer=hidden transfer\.adapter_init=names: this method makes no adapters"
    ):
        expand(teacher, SENSORS, ACTUATORS, name="hidden")
