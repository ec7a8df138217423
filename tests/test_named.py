"""Transfer by name: what is kept is the teacher's, what is gone is a number, what is added changes nothing at first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.networks import Networks
from acmr.config import ConfigError, TransferConfig, TransferRules
from acmr.transfer.description import PolicyStatistics
from acmr.transfer.methods import Student, transfer
from acmr.transfer.name_map import map_bodies, map_names
from acmr.transfer.report import TransferReport
from acmr.transfer.teacher import Teacher

BODY = Dimensions(12, 5)
SIZES = (10, 9)
SENSORS, ACTUATORS = [f"obs/{row}" for row in range(12)], [f"action/{row}" for row in range(5)]
OBSERVATIONS = torch.randn(64, 12, generator=torch.Generator().manual_seed(7))
ACTIONS = torch.rand(64, 5, generator=torch.Generator().manual_seed(8)) * 2 - 1
MEANS = [0.25 * row - 1.0 for row in range(12)]


@pytest.fixture(params=[None, Dimensions(7, 3)], ids=["plain", "expanded"])
def teacher(request: pytest.FixtureRequest, teacher_factory: Callable[..., Teacher]) -> Teacher:
    """One of the plain kind, and one that was itself an expanded student."""
    made: Teacher = teacher_factory(BODY, SIZES, core=request.param)
    seen = PolicyStatistics(10, 100, MEANS, [1.0] * 12, [0.5] * 12, [0.1] * 5, [0.2] * 5)
    return replace(made, description=replace(made.description, statistics=seen))


def take(
    teacher: Teacher, sensors: Sequence[str], actuators: Sequence[str], bound: float = 1.0, **settings: object
) -> tuple[Networks, TransferReport]:
    high = np.full(len(actuators), bound, np.float32)
    architecture = Architecture.plain(Dimensions(len(sensors), len(actuators)), SIZES, -high, high)
    student = Student(Networks(architecture, torch.Generator().manual_seed(1)), sensors, actuators)
    config = replace(TransferConfig(name="named", rules=TransferRules(statistics=True), impute="mean"), **settings)
    made = transfer(student, teacher, config, False, torch.Generator().manual_seed(2))
    return made.networks, made.report


def outputs(networks: Networks, observations: torch.Tensor, actions: torch.Tensor) -> list[torch.Tensor]:
    with torch.no_grad():
        return [*networks.actor(observations), *(critic(observations, actions) for critic in networks.critics)]


def test_in_the_same_body_it_is_the_teacher_bit_for_bit(teacher: Teacher) -> None:
    networks, report = take(teacher, SENSORS, ACTUATORS)
    for name, tensor in networks.state_dict().items():
        assert torch.equal(tensor, teacher.tensors[name]), name
    assert report.fresh == []
    assert report.details["sensors"] == {"kept": 12, "gone": [], "added": []}


def test_the_order_of_names_does_not_matter(teacher: Teacher) -> None:
    rng = np.random.default_rng(3)
    rows, motors = rng.permutation(12), rng.permutation(5)
    networks, _ = take(teacher, [SENSORS[row] for row in rows], [ACTUATORS[row] for row in motors])
    wanted = outputs(teacher.build_networks(), OBSERVATIONS, ACTIONS)
    found = outputs(networks, OBSERVATIONS[:, rows], ACTIONS[:, motors])
    for ours, theirs in zip(found, (*(part[:, motors] for part in wanted[:2]), *wanted[2:]), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_what_is_only_added_changes_nothing_at_the_first_step(teacher: Teacher) -> None:
    networks, report = take(teacher, ["new/1", *SENSORS, "new/2"], [*ACTUATORS, "tail"])
    noise = torch.randn(64, 1, generator=torch.Generator().manual_seed(9))
    more = torch.cat((100 * noise, OBSERVATIONS, -3 * noise), dim=1)
    found = outputs(networks, more, torch.cat((ACTIONS, noise.tanh()), dim=1))
    wanted = outputs(teacher.build_networks(), OBSERVATIONS, ACTIONS)
    for ours, theirs in zip((*(part[:, :5] for part in found[:2]), *found[2:]), wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    # The new motor hardly moves, whatever is seen.
    assert float(found[0][:, 5].abs().max()) < 0.1
    assert report.details["sensors"]["added"] == ["new/1", "new/2"]
    assert report.details["actuators"]["added"] == ["tail"]


@pytest.mark.parametrize(
    ("impute", "sensed", "done", "said"),
    [
        ("mean", MEANS, 0.1, "its mean under the teacher's policy"),
        ("zero", [0.0] * 12, 0.0, "zero"),
        ("initial", [0.5] * 12, 0.1, "its mean at the start of an episode"),
        ("0.75", [0.75 * mean for mean in MEANS], 0.075, "0.75 of its mean under the teacher's policy"),
        ("-2", [-2.0 * mean for mean in MEANS], -0.2, "-2 of its mean under the teacher's policy"),
    ],
)
def test_what_is_gone_counts_as_a_constant(
    teacher: Teacher, impute: str, sensed: list[float], done: float, said: str
) -> None:
    left, motors = [0, 2, 3, 7, 11], [1, 4]
    networks, report = take(teacher, [SENSORS[row] for row in left], [ACTUATORS[row] for row in motors], impute=impute)
    constant = torch.tensor(sensed).repeat(64, 1)
    constant[:, left] = OBSERVATIONS[:, left]
    acted = torch.full((64, 5), done)
    acted[:, motors] = ACTIONS[:, motors]
    wanted = outputs(teacher.build_networks(), constant, acted)
    found = outputs(networks, OBSERVATIONS[:, left], ACTIONS[:, motors])
    for ours, theirs in zip(found, (*(part[:, motors] for part in wanted[:2]), *wanted[2:]), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    assert report.notes == ["5 of 12 sensors kept, 7 gone, 0 added", "2 of 5 actuators kept, 3 gone, 0 added",
                            f"what is gone counts as {said}"]  # fmt: skip


def test_the_critics_see_the_same_share_of_other_bounds(teacher: Teacher) -> None:
    networks, _ = take(teacher, SENSORS, ACTUATORS, bound=0.4)
    wanted = outputs(teacher.build_networks(), OBSERVATIONS, ACTIONS)
    found = outputs(networks, OBSERVATIONS, 0.4 * ACTIONS)
    for ours, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_what_is_called_otherwise_is_named(teacher: Teacher) -> None:
    sensors = ["eye", *SENSORS[1:]]
    networks, report = take(teacher, sensors, ACTUATORS, rename=["obs/0:eye"])
    wanted, found = (outputs(each, OBSERVATIONS, ACTIONS) for each in (teacher.build_networks(), networks))
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(found, wanted, strict=True))
    assert report.details["sensors"]["gone"] == []


@pytest.mark.parametrize(
    ("sensors", "actuators", "rename", "says"),
    [
        (["a", "b"], ACTUATORS, [], "no sensor of the same name"),
        (SENSORS, ["a"], [], "no actuator of the same name"),
        (SENSORS, ACTUATORS, ["obs/99:obs/1"], "the teacher has no obs/99; is it obs/9"),
        (SENSORS, ACTUATORS, ["obs/1:eyes"], "the student has no eyes"),
        (SENSORS, ACTUATORS, ["obs/1: obs/2"], "two of the teacher's parts would be called obs/2"),
        (SENSORS, ACTUATORS, ["obs/1"], "names are given as in 'transfer.rename={old: new}'"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    teacher: Teacher, sensors: list[str], actuators: list[str], rename: list[str], says: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        take(teacher, sensors, actuators, rename=rename)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_teacher_that_tells_nothing_is_refused_where_its_means_are_asked_for(teacher: Teacher) -> None:
    silent = replace(teacher, description=replace(teacher.description, statistics=None))
    with pytest.raises(ConfigError, match=r"transfer\.impute=zero"):
        take(silent, SENSORS[1:], ACTUATORS)
    take(silent, SENSORS[1:], ACTUATORS, impute="zero")


def test_the_map_is_a_partition_of_both_bodies() -> None:
    rng = np.random.default_rng(5)
    pool = [f"part/{number}" for number in range(40)]
    for _ in range(50):
        theirs, ours = (list(rng.permutation(pool)[: rng.integers(1, 40)]) for _ in range(2))
        found = map_names(theirs, ours)
        assert sorted((*found.theirs, *found.gone)) == list(range(len(theirs)))
        assert sorted((*found.ours, *found.added)) == list(range(len(ours)))
        assert all(theirs[a] == ours[b] for a, b in zip(found.theirs, found.ours, strict=True))
        assert {theirs[row] for row in found.gone} == set(theirs) - set(ours)


def test_without_arms_a_humanoid_keeps_270_sensors_and_11_actuators() -> None:
    from acmr.envs import describe
    from acmr.settings.compose import environment_config

    whole, armless = (describe(environment_config(name)) for name in ("humanoid", "armless_humanoid"))
    names = map_bodies(*((each.observation_names, each.action_names) for each in (whole, armless)), {})
    assert names.lines() == [
        "270 of 376 sensors kept, 106 gone, 0 added", "11 of 17 actuators kept, 6 gone, 0 added"
    ]  # fmt: skip
