"""Finished runs used from the command line: real environments, real files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from finished_run import ANT, make_run, result
from safetensors.numpy import load_file

from acmr.agent.architecture import Dimensions
from acmr.envs import make_env
from acmr.evaluation.cli import main


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return make_run(tmp_path / "seed_1")


def test_returns_are_those_of_an_independent_calculation(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(run), "--episodes", "3", "--seed", "7"]) == 0
    weights = load_file(run / "teacher.safetensors")
    env, returns, velocities = make_env(ANT), [], []
    robot: Any = env.unwrapped
    torso = robot.data.body("torso")
    for seed in (7, 8, 9):
        observation, _ = env.reset(seed=seed)
        total, steps, start, over = 0.0, 0, torso.xpos[0], False
        while not over:
            hidden = observation
            for layer in ("actor.input", "actor.hidden_1"):
                hidden = np.maximum(weights[f"{layer}.weight"] @ hidden + weights[f"{layer}.bias"], 0)
            action = np.tanh(weights["actor.mean.weight"] @ hidden + weights["actor.mean.bias"])  # Ant acts in [-1, 1]
            observation, reward, terminated, truncated, _ = env.step(action)
            total, steps, over = total + float(reward), steps + 1, terminated or truncated
        returns.append(total)
        velocities.append((torso.xpos[0] - start) / (steps * 0.05))  # a step of Ant's takes 0.05 s
    content = result(run)
    each = [episode["episodic_return"] for episode in content["each"]]
    assert each == pytest.approx(returns, abs=1e-3)
    assert [episode["seed"] for episode in content["each"]] == [7, 8, 9]
    assert [episode["mean_forward_velocity"] for episode in content["each"]] == pytest.approx(velocities, abs=1e-4)
    assert content["mean_forward_velocity"] == pytest.approx(np.mean(velocities), abs=1e-4)
    assert content["mean_return"] == pytest.approx(np.mean(each))
    assert content["std_return"] == pytest.approx(np.sqrt(np.mean((np.array(each) - np.mean(each)) ** 2)))
    assert content["policy"] == "deterministic"
    assert content["same_robot"] is True
    printed = capsys.readouterr()
    assert printed.err == ""
    assert [line.split()[0] for line in printed.out.splitlines()] == ["episode"] * 3 + ["mean", "written:"]


def test_a_teacher_alone_is_evaluated_by_its_folder_or_its_file(run: Path) -> None:
    assert main([str(run), "--episodes", "2"]) == 0
    whole = result(run)
    for name in ("config.yaml", "summary.json", "evaluation.json"):
        (run / name).unlink()
    for given in (run, run / "teacher.safetensors"):
        assert main([str(given), "--episodes", "2"]) == 0
        assert result(run)["each"] == whole["each"]


def test_an_episode_does_not_depend_on_those_before_it(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "e.json"

    def returns(*arguments: str) -> list[float]:
        assert main([str(run), "--out", str(out), *arguments]) == 0
        return [episode["episodic_return"] for episode in json.loads(out.read_text())["each"]]

    for mode in ([], ["--stochastic"]):
        three = returns("--episodes", "3", *mode)
        assert returns("--episodes", "1", "--seed", "2", *mode) == three[2:]
        assert len(set(three)) == 3
    assert returns("--episodes", "3") != three
    assert not (run / "evaluation.json").exists()


def test_a_student_with_adapters(tmp_path: Path) -> None:
    run_dir = make_run(tmp_path / "expand", core=Dimensions(27, 8))
    assert main([str(run_dir), "--episodes", "1"]) == 0
    assert np.isfinite(result(run_dir)["mean_return"])


def spoil(run_dir: Path, what: str) -> Path:
    tensors, config = run_dir / "teacher.safetensors", run_dir / "config.yaml"
    settings = yaml.safe_load(config.read_text())
    if what == "no such run":
        return run_dir / "nothing"
    if what == "no run":
        config.unlink()
    elif what == "unfinished":
        (run_dir / "summary.json").unlink()
    elif what == "diverged":
        (run_dir / "summary.json").write_text('{"status": "diverged"}')
    elif what == "damaged teacher":
        data = bytearray(tensors.read_bytes())
        data[-100] ^= 1
        tensors.write_bytes(bytes(data))
    elif what == "no teacher":
        tensors.unlink()
    elif what == "damaged config":
        config.write_text("env: [1, 2")
    elif what == "config without env":
        config.write_text("seed: 1")
    elif what == "unknown setting":
        config.write_text(yaml.safe_dump({"env": {**settings["env"], "gravity": 1}}))
    elif what == "another robot":
        config.write_text(yaml.safe_dump({"env": {**settings["env"], "remove_bodies": []}}))
    return run_dir


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("no such run", "no such run directory"),
        ("no run", "no config.yaml"),
        ("unfinished", "not finished"),
        ("diverged", "not finished"),
        ("damaged teacher", "damaged or exchanged"),
        ("no teacher", "no teacher.safetensors in it"),
        ("damaged config", "not readable"),
        ("config without env", "config.yaml: damaged"),
        ("unknown setting", "gravity"),
        ("another robot", "27 sensors and 8 actuators here"),
    ],
)
def test_what_cannot_be_evaluated_says_why(run: Path, what: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(spoil(run, what)), "--episodes", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert said in line
    assert not (run / "evaluation.json").exists()


def test_a_result_that_cannot_be_written_says_where_else(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for out in (run, run / "config.yaml" / "e.json"):
        assert main([str(run), "--episodes", "1", "--out", str(out)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ")
        assert str(out) in line
        assert line.endswith("type --out FILE.json")


def test_a_robot_that_has_changed_is_remarked_on(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    description = json.loads((run / "teacher.json").read_text())
    # As a run of another robot would have described itself, without the check of its own entries.
    del description["description_sha256"]
    (run / "teacher.json").write_text(json.dumps({**description, "model_hash": "0" * 64}))
    assert main([str(run), "--episodes", "1"]) == 0
    assert "warning: ant_three_legs is not the robot" in capsys.readouterr().err
    assert result(run)["same_robot"] is False


@pytest.mark.parametrize(
    "arguments",
    [
        *(["--episodes", "0"], ["--episodes", "two"], ["--seed", "-1"], ["--video", "film.avi"]),
        *(["--seconds", "0"], ["--seconds", "nan"], ["--seconds", "long"], ["--seconds", "2"], ["--width", "0"]),
    ],
)
def test_bad_arguments(run: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([str(run), *arguments])
    assert stopped.value.code == 2
    assert arguments[1] in capsys.readouterr().err.splitlines()[-1]


def test_other_bodies_are_played_in_before_any_learning(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What fits of a policy for three legs, in a body with four, in its own, and where nothing fits."""
    arguments = [str(run), "--env", "ant,ant_three_legs", "--episodes", "1", "--impute", "zero"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "ant: 23 of 23 sensors kept, 0 gone, 4 added; 6 of 6 actuators kept, 0 gone, 2 added" in said
    assert said.splitlines()[-3].split()[:2] == ["body", "mean"]
    found = {name: json.loads((run / f"evaluation-{name}.json").read_text()) for name in ("ant", "ant_three_legs")}
    assert (found["ant"]["environment"], found["ant"]["impute"]) == ("ant", "zero")
    # The named environment, not the run's own, whose episodes end after 12 steps.
    assert found["ant_three_legs"]["each"][0]["episode_length"] > 12
    assert main([str(run), "--env", "Pendulum-v1", "--impute", "zero"]) == 2
    assert "no sensor of the same name" in capsys.readouterr().err
    assert not (run / "evaluation-Pendulum-v1.json").exists()


@pytest.mark.parametrize(
    "wrong", [["--env", "ant,"], ["--env", "ant,humanoid", "--out", "x.json"], ["--impute", "zero"]]
)
def test_bodies_that_make_no_sense_are_refused(run: Path, wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([str(run), *wrong])
    assert stop.value.code == 2
