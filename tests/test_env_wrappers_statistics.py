"""Running statistics of wrappers: in checkpoints, beside the networks, and in evaluations, students and exports."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from torture import ANT, Run, at_step, parts, same

import acmr
from acmr.config import ConfigError, TransferConfig
from acmr.envs import describe, make_env
from acmr.envs.wrappers.memory import lasting_state
from acmr.evaluation.cli import main as evaluation
from acmr.exchange.exports import main as export
from acmr.records import description_sha256
from acmr.settings.compose import environment_config
from acmr.storage.state_data import as_json
from acmr.transfer.statistics import MOST_COUNTED, handed_over
from acmr.transfer.teacher import load_teacher

WORDS = (
    *ANT,
    "env.wrappers=[{name:NormalizeObservation},{name:FrameStackObservation,stack_size:2},{name:NormalizeReward}]",
)


@pytest.mark.slow
def test_a_killed_run_goes_on_bit_for_bit_with_its_statistics(untouched, tmp_path):
    run = Run(tmp_path / "killed", WORDS)
    for step in (55, 123, 188):
        run(at_step(step))
    same(run.finish(), untouched(WORDS))
    about = json.loads((run.folder / "teacher.json").read_text())
    rows = list(csv.DictReader((run.folder / "episodes.csv").read_text().splitlines()))
    # Each step and each reset was counted once, whatever was done twice; the last episode may still have been going on.
    begun = len(rows) + (int(rows[-1]["global_step"]) < about["global_step"])
    counted = about["wrappers"]["values"]["NormalizeObservation"]["count"]
    assert counted == pytest.approx(about["global_step"] + begun)


def test_returns_are_raw_where_rewards_are_normalized(untouched):
    """Before it learns, it does what the robot without wrappers does, and is paid the same."""
    later = (*(word for word in WORDS if "learning_starts" not in word), "agent.learning_starts=280")
    words = (later, tuple(word for word in later if "wrappers" not in word))
    first, plain = ([float(row["episodic_return"]) for row in rows(untouched(each))] for each in words)
    assert first[:2] == plain[:2]


def rows(outcome: dict[str, bytes]) -> list[dict[str, str]]:
    return list(csv.DictReader(outcome["episodes.csv"].decode().splitlines()))


# --- the statistics beside the networks ---


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of a robot whose observations are normalized and stacked."""
    run = Run(tmp_path_factory.mktemp("taught"), WORDS)
    run.finish()
    return run.folder


def test_evaluations_act_on_what_was_seen_in_training(taught, capsys):
    """Against the mean action worked out by hand from raw observations, mean and variance."""
    assert evaluation([str(taught), "--episodes", "1", "--seed", "5"]) == 0
    played = json.loads((taught / "evaluation.json").read_text())
    told = load_teacher(taught).wrapper_states()["NormalizeObservation"]
    actor, plain = load_teacher(taught).build_networks().actor, make_env(environment_config("ant"))
    observation, total, length = plain.reset(seed=5)[0], 0.0, played["each"][0]["episode_length"]
    frames = [observation, observation]
    assert length > 20
    for _ in range(length):
        seen = [(frame - told["mean"]) / np.sqrt(told["var"] + 1e-8) for frame in frames[-2:]]
        with torch.no_grad():
            action = actor.mode(torch.tensor(np.concatenate(seen), dtype=torch.float32)[None])[0].numpy()
        observation, reward, *_ = plain.step(action)
        frames.append(observation)
        total += reward
    assert played["mean_return"] == pytest.approx(total, rel=1e-3)


def test_a_loaded_policy_brings_them_along_and_they_stay(taught):
    policy = acmr.load(taught)
    env = policy.environment()
    before = lasting_state(env)["NormalizeObservation"]
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        observation = env.step(policy(observation))[0]
    after = lasting_state(env)["NormalizeObservation"]
    told = load_teacher(taught).wrapper_states()["NormalizeObservation"]
    for key in ("mean", "var", "count"):
        assert np.array_equal(before[key], after[key])
        assert np.array_equal(before[key], told[key])


def student(taught: Path, folder: Path, *words: str) -> Run:
    rest = [word for word in WORDS if not word.startswith(("env=", "env.wrappers"))]
    return Run(folder, (*rest, f"transfer.teacher={taught}", *words))


def test_a_student_by_name_begins_with_them_sensor_by_sensor(taught, tmp_path):
    wrappers = next(word for word in WORDS if word.startswith("env.wrappers"))
    run = student(taught, tmp_path, "env=ant_three_legs", "transfer=named", wrappers)
    begun = lasting_state(parts(run)[0].environment.env)["NormalizeObservation"]
    told, names = (
        load_teacher(taught).wrapper_states()["NormalizeObservation"],
        describe(replace(environment_config("ant_three_legs"))).observation_names,
    )
    for row, name in enumerate(names):
        theirs = told["names"].index(name)
        assert (begun["mean"][row], begun["var"][row]) == (told["mean"][theirs], told["var"][theirs])
    assert begun["count"] == told["count"]


def test_statistics_of_another_body_count_less_where_they_say_nothing(taught):
    teacher = load_teacher(taught)
    told = teacher.wrapper_states()
    told["NormalizeObservation"]["count"] = 5e6
    more = [*told["NormalizeObservation"]["names"], "qpos/tail"]
    changed = replace(teacher, description=replace(teacher.description, wrappers=as_json(told)))
    found = handed_over(changed, {"NormalizeObservation": more}, TransferConfig())["NormalizeObservation"]
    assert (found["mean"][-1], found["var"][-1], found["count"]) == (0.0, 1.0, MOST_COUNTED)


@pytest.mark.parametrize("words", [("env=ant", "transfer=direct"), ("env=ant_three_legs", "transfer=named")])
def test_first_layers_are_not_told_other_numbers(taught, tmp_path, words):
    run = student(taught, tmp_path, *words, "env.wrappers=[{name:FrameStackObservation,stack_size:2}]")
    with pytest.raises(ConfigError, match="learned within the wrappers"):
        parts(run)


def test_hidden_layers_may_come_from_anywhere(taught, tmp_path):
    run = student(taught, tmp_path, "env=ant_three_legs", "transfer=hidden")
    assert parts(run)[0].trainer.global_step == 0


def test_in_another_body_a_policy_keeps_its_wrappers(taught, capsys):
    assert evaluation([str(taught), "--episodes", "1", "--env", "ant_three_legs"]) == 0
    assert "46 of 54 sensors kept" in capsys.readouterr().out


def test_an_exported_policy_takes_observations_as_they_are(taught, tmp_path, capsys):
    path = tmp_path / "policy.pt"
    assert export([str(taught), "--torchscript", str(path)]) == 0
    assert "part of the first layers now" in capsys.readouterr().out
    told = load_teacher(taught).wrapper_states()["NormalizeObservation"]
    raw = np.random.default_rng(1).normal(told["mean"], np.sqrt(told["var"]), (9, 2, 27))
    seen = (raw - told["mean"]) / np.sqrt(told["var"] + 1e-8)
    actions = torch.jit.load(path)(torch.tensor(raw.reshape(9, 54), dtype=torch.float32)).detach().numpy()
    np.testing.assert_allclose(actions, acmr.load(taught)(seen.reshape(9, 54)), atol=2e-5)


@pytest.mark.parametrize("damage", ["shape", "count", "text", "kind"])
def test_damaged_statistics_are_one_line(taught, tmp_path, damage, capsys):
    folder = tmp_path / "copy"
    folder.mkdir()
    shutil.copy(taught / "teacher.safetensors", folder)
    about = json.loads((taught / "teacher.json").read_text())
    arrays, values = about["wrappers"]["arrays"], about["wrappers"]["values"]["NormalizeObservation"]
    mean = arrays["numpy/NormalizeObservation/mean"]
    if damage == "shape":
        mean |= {"data": mean["data"][:5], "shape": [5]}
    elif damage == "count":
        values["count"] = -1.0
    elif damage == "text":
        about["wrappers"] = "many"
    else:
        mean["dtype"] = "object"
    about["description_sha256"] = description_sha256(about)
    (folder / "teacher.json").write_text(json.dumps(about))
    assert evaluation([str(folder), "--episodes", "1"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("error: ")


def test_two_wrappers_of_a_class_have_names_of_their_own():
    class My_Count(gym.Wrapper):  # noqa: N801
        count = 0

        def state_dict(self):
            return {"count": self.count}

        def load_state_dict(self, state):
            self.count = state["count"]

    inner = My_Count(gym.make("Pendulum-v1"))
    outer = My_Count(inner)
    inner.count, outer.count = 3, 5
    assert lasting_state(outer) == {"My_Count": {"count": 3}, "My_Count_2": {"count": 5}}
