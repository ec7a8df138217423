"""Controls: a teacher whose names are shuffled, and one that has learned nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from test_config import refusal, spec

from acmr.agent.architecture import Dimensions
from acmr.run.preparation import prepare
from acmr.transfer.find import find_teacher, shuffled, untrained
from acmr.transfer.teacher import Teacher, load_teacher

ROOT = Path(__file__).parents[1]
PUBLISHED = ROOT / "results" / "paper" / "humanoid-none" / "seed_1"
ARMLESS = Dimensions(270, 11)


@pytest.fixture(scope="module")
def teacher() -> Teacher:
    return load_teacher(PUBLISHED)


def test_no_name_stays_and_none_is_lost(teacher):
    about, other = (each.description for each in (teacher, shuffled(teacher, 101)))
    for kind in ("observation_names", "action_names"):
        ours, theirs = getattr(about, kind), getattr(other, kind)
        assert sorted(ours) == sorted(theirs)
        assert not any(name == dealt for name, dealt in zip(ours, theirs, strict=True))
    assert shuffled(teacher, 101).description == other != shuffled(teacher, 102).description
    # Weights and statistics stay with the sensors that they are of.
    assert shuffled(teacher, 101).tensors is teacher.tensors
    assert other.statistics == about.statistics


def test_an_untrained_teacher_has_nothing_of_the_trained_one(teacher):
    fresh = untrained(teacher, 101)
    assert {name: value.shape for name, value in fresh.tensors.items()} == {
        name: value.shape for name, value in teacher.tensors.items()
    }
    assert not any(torch.equal(fresh.tensors[name], value) for name, value in teacher.tensors.items())
    assert (fresh.log_alpha(), fresh.description.statistics) == (0.0, None)
    assert all(torch.equal(value, untrained(teacher, 101).tensors[name]) for name, value in fresh.tensors.items())
    assert not torch.equal(untrained(teacher, 102).tensors["actor.mean.weight"], fresh.tensors["actor.mean.weight"])


def words(control: str, *more: str) -> list[str]:
    return ["transfer=named", "seed=101", f"transfer.teacher={PUBLISHED}", f"transfer.control={control}", *more]


def test_what_stands_in_for_what_is_gone_is_the_untrained_policys_own():
    found = find_teacher(spec(*words("untrained")).config, ARMLESS)
    # A random policy falls at once.
    assert found.description.statistics.steps < 1_000


@pytest.mark.parametrize("control", ["shuffled", "untrained"])
def test_a_run_says_that_it_is_a_control(control, teacher):
    made = spec(*words(control, "transfer.impute=zero"))
    assert made.cell is None
    assert f"-control={control}" in made.name
    prepared = prepare(made)
    assert prepared.report.details["control"] == control
    assert any(line.strip().startswith("a control: the teacher with") for line in prepared.report.lines())
    assert prepared.report.details["sensors"]["kept"] == 270
    plain = prepare(spec(*words("none", "transfer.impute=zero")))
    assert "control" not in plain.report.details
    for name in ("actor.input", "critic_1.input"):
        assert not torch.equal(prepared.networks.layers()[name].weight, plain.networks.layers()[name].weight)
    same = torch.equal(prepared.networks.actor.hidden_1.weight, teacher.tensors["actor.hidden_1.weight"])
    assert same == (control == "shuffled")


def test_a_control_that_changes_nothing_is_refused_in_one_line():
    assert "transfer=hidden transfer.control=shuffled: reads no names" in refusal(
        "transfer=hidden", "transfer.control=shuffled"
    )
    assert "there is no teacher; leave it out" in refusal("transfer.control=untrained")
    assert "must be one of none, shuffled, untrained" in refusal("transfer=named", "transfer.control=random")


@pytest.mark.parametrize(
    ("typed", "name"),
    [
        # The table of docs/howto-transfer.md.
        (["experiment=N1", "transfer.control=shuffled"], "armless_humanoid-named-control=shuffled"),
        (["experiment=N1", "transfer.control=untrained"], "armless_humanoid-named-control=untrained"),
        (["experiment=N1", "transfer.impute=zero"], "armless_humanoid-named-impute=zero"),
        (
            ["experiment=A0", "agent.start=policy", "agent.warmup=5000"],
            "armless_humanoid-none-start=policy-warmup=5000",
        ),
        (["experiment=A1", "agent.warmup=5000"], "armless_humanoid-hidden-warmup=5000"),
        (["experiment=N1", "transfer.teacher_seeds=3"], "armless_humanoid-named"),
    ],
)
def test_what_can_be_typed_as_a_control_is_a_run_of_its_own(typed, name):
    assert spec(*typed, "seed=101").name == name
