"""The plain learner as a choice: its losses, its state, the names of its runs, and the guide to changing it."""

import copy
import signal

import numpy as np
import pytest
import torch
from guides import ROOT, copy_checkout, follow
from test_sac import CONFIGURATIONS, DIMS, fresh, generator, make_batch, student
from torture import ANT, Run, at_step, same

from acmr.agent.learner import LEARNERS, find_learner
from acmr.agent.sac import SAC
from acmr.agent.sac_plain import PlainSAC
from acmr.config import ConfigError, SACConfig
from acmr.settings.compose import CONFIG_FOLDER, compose_config, parse
from acmr.settings.run_spec import specify, teacher_spec
from acmr.transfer.teacher import load_teacher
from sweeps.plan import expand, make_plan

CONFIG = SACConfig(hidden_sizes=[16, 12], batch_size=32)
PLAIN = (*ANT, "agent=sac_plain")


def spec(*overrides: str):
    return specify(parse(compose_config(overrides)))


def make_plain(networks) -> PlainSAC:
    return PlainSAC(networks, CONFIG, generator(10), generator(11))


def test_losses_by_hand():
    values, expected = torch.tensor([[1.0, 2.0], [4.0, 0.0]]), torch.tensor([2.0, 0.0])
    assert PlainSAC.critic_loss(values, expected, CONFIG).item() == (1 + 4) / 2 + (4 + 0) / 2
    log_prob, alpha = torch.tensor([-1.0, 3.0]), torch.tensor([0.5])
    assert PlainSAC.actor_loss(values, log_prob, alpha, CONFIG).item() == ((-0.5 - 1) + (1.5 - 0)) / 2
    aim = PlainSAC.temperature_loss(alpha.log(), log_prob, -2.0, CONFIG).item()
    assert aim == pytest.approx(-0.5 * ((-1 - 2) + (3 - 2)) / 2)
    made = PlainSAC.expected_value(torch.tensor([1.0, 1.0]), torch.tensor([0.0, 1.0]), values, log_prob, alpha, CONFIG)
    np.testing.assert_allclose(made, [1 + 0.99 * (1 + 0.5), 1.0])


@pytest.mark.parametrize("first", [0, 7], ids=["at its start", "after some updates"])
@pytest.mark.parametrize(("method", "freeze"), CONFIGURATIONS)
def test_a_restored_learner_goes_on_bit_for_bit(method, freeze, first, teacher_factory):
    agent, restored = (make_plain(student(method, freeze, teacher_factory)[0]) for _ in range(2))
    for step in range(1, first + 1):
        agent.update(make_batch(step), step)
        agent.act(np.zeros(DIMS.observation))
    restored.update(make_batch(99), 2)
    restored.load_state_dict(copy.deepcopy(agent.state_dict()))
    for learner in (agent, restored):
        for step in range(first + 1, first + 9):
            learner.update(make_batch(step), step)
    np.testing.assert_array_equal(agent.act(np.ones(DIMS.observation)), restored.act(np.ones(DIMS.observation)))
    ours, theirs = agent.state_dict(), restored.state_dict()
    assert all(torch.equal(value, theirs["tensors"][name]) for name, value in ours["tensors"].items())
    assert agent.metrics() == restored.metrics()


def test_the_state_of_the_fast_learner_is_refused():
    with pytest.raises(ValueError, match="another agent"):
        make_plain(fresh()).load_state_dict(SAC(fresh(), CONFIG, generator(1), generator(2)).state_dict())


@pytest.mark.slow
def test_a_run_that_is_killed_ends_as_one_that_is_not(untouched, tmp_path):
    run = Run(tmp_path, PLAIN)
    assert run(at_step(150)).code == -signal.SIGKILL
    ended = run()
    assert (ended.code, "resumed at step 120 of" in ended.said) == (0, True), ended.said
    same(run.outcome(), untouched(PLAIN))
    # It is no other name for the fast one.
    assert run.outcome()["metrics.csv"] != untouched(ANT)["metrics.csv"]
    assert load_teacher(run.folder).build_networks().dims.observation == 27


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        (["experiment=A2"], "armless_humanoid-hidden-frozen"),
        (["experiment=A2", "agent=sac"], "armless_humanoid-hidden-frozen"),
        (["experiment=A2", "agent=sac_plain"], "armless_humanoid-hidden-frozen-agent=sac_plain"),
        (["agent=sac_plain", "agent.q_lr=1e-4"], "armless_humanoid-none-agent=sac_plain-q_lr=0.0001"),
        (["+agent.options.delta=0.5"], "armless_humanoid-none-delta=0.5"),
    ],
)
def test_the_name_of_a_run_says_the_learner(overrides, name):
    made = spec(*overrides)
    assert made.name == name
    assert (made.cell is None) == ("=" in name)


def test_a_plain_run_is_found_again_by_its_command_and_has_the_usual_teacher():
    made = spec("experiment=A1", "agent=sac_plain", "seed=3")
    assert "agent=sac_plain" in made.command
    assert spec(*made.command.split()[2:]).directory == made.directory
    assert teacher_spec(made.config).name == "humanoid-none"


def test_a_sweep_over_learners_is_planned_with_one_teacher(tmp_path):
    jobs = [[f"output_dir={tmp_path}", "experiment=A1", f"agent={name}"] for name in ("sac", "sac_plain")]
    runs = make_plan(expand(jobs)).runs
    assert [run.spec.name for run in runs] == [
        "humanoid-none", "armless_humanoid-hidden", "armless_humanoid-hidden-agent=sac_plain",
    ]  # fmt: skip
    assert [run.teacher for run in runs] == [None, 0, 0]


def test_every_learner_has_a_yaml_file_and_the_other_way_round():
    files = sorted(path.stem for path in (CONFIG_FOLDER / "agent").glob("*.yaml"))
    assert sorted(LEARNERS.names) == files
    for name in files:
        assert spec(f"agent={name}").config.agent.name == name
        assert find_learner(spec(f"agent={name}").config.agent)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"name": "sac_plain", "precision": "bfloat16"}, "float32 only; type agent.precision=float32"),
        ({"name": "replay_buffer"}, "agent.name=replay_buffer: must be one of sac"),
        ({"name": "no/such"}, "agent.name=no/such: must be one of sac"),
    ],
)
def test_what_no_learner_can_is_refused_in_one_line(changes, says):
    with pytest.raises(ConfigError, match=says) as caught:
        find_learner(SACConfig(**changes))
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_the_guide_to_a_loss_of_ones_own(tmp_path):
    said = follow(ROOT / "docs" / "howto-loss.md", copy_checkout(tmp_path / "checkout"))
    assert said.count("complete, ") == 2


def test_a_learner_without_thawing_is_refused_where_layers_thaw(monkeypatch):
    class Own:
        precisions = ("float32",)

        def __init__(self, networks, config, acting, learning, log_alpha=0.0, device="cpu"): ...

    monkeypatch.setitem(LEARNERS._entries, "own", Own)
    assert find_learner(SACConfig(name="own")) is Own
    with pytest.raises(ConfigError, match="agent=own: this learner has no argument thaws"):
        find_learner(SACConfig(name="own"), thaws=True)
