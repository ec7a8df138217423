"""What ``import acmr`` offers: train, load and results, against the command and against the networks themselves."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from finished_run import make_run
from guides import ROOT, blocks
from gymnasium.spaces import Box

import acmr
from acmr.config import ConfigError
from acmr.transfer.teacher import load_teacher

TINY = {"profile": "quick", "total_timesteps": 1200, "agent.hidden_sizes": [8], "tracking": "off"}
NAME = "runs/quick/ant-none-hidden_sizes=8-total_timesteps=1200/seed_1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder in which one short run was made, and what that said."""
    folder = tmp_path_factory.mktemp("python")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        folder.joinpath("said.txt").touch()
        acmr.train("env=ant", **TINY)
    return folder


def test_importing_it_loads_nothing_that_takes_long():
    loaded = "import sys, acmr; print(sorted({m.partition('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", loaded], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not {"torch", "numpy", "mujoco", "gymnasium", "pandas", "hydra", "wandb", "acmr.app"} & set(
        eval(done.stdout)
    )
    assert {"train", "load", "results"} <= set(dir(acmr))
    with pytest.raises(AttributeError, match="offers Policy, Results, Run, load, results, train"):
        acmr.trian  # noqa: B018


def test_a_run_is_the_one_that_the_command_makes_and_says_nothing(folder, monkeypatch, capfd):
    monkeypatch.chdir(folder)
    threads = torch.get_num_threads()
    again = acmr.train("env=ant", seed=1, **TINY)
    assert capfd.readouterr() == ("", "")
    assert str(again.directory) == NAME
    assert (folder / NAME / "summary.json").is_file()
    assert again.summary["status"] == "complete"
    assert again.summary["global_step"] == again.summary["total_timesteps"] == 1200
    assert len(again.episodes) == again.summary["episodes"] > 0
    assert torch.get_num_threads() == threads
    said = []
    acmr.train("env=ant", seed=1, say=said.append, **TINY)
    assert said == [f"{NAME}: complete already, return 125 not reached; force=true runs it anew"]
    assert again.command == ("python run.py profile=quick env=ant agent.hidden_sizes=[8] total_timesteps=1200 seed=1")


@pytest.mark.parametrize(
    ("words", "settings", "says"),
    [
        (["transfer=hiden"], {}, "transfer=hiden: must be one of direct, expand, hidden, named, none; did you mean"),
        (["seed=1,2"], {}, "several values are several runs"),
        (["matrix=quick", "plan=true"], {}, "words of a sweep; train\\(\\) makes one run"),
        (["-m", "seed=1"], {}, "-m: an option of the command line"),
        ([], {"freeze": 2}, "freeze=2: must be one of false, gradual, true"),
        ([], {"agent.gama": 1}, "agent.gama: no such setting; did you mean agent.gamma"),
        ([], {"config_dir": "nowhere"}, "--config-dir nowhere: there is no such folder"),
        (["transfer=expand", "profile=quick"], {"seed": 77}, "seed_77 does not exist; train it with: python run.py"),
    ],
)
def test_what_cannot_be_run_is_one_line(words, settings, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=says) as raised:
        acmr.train(*words, **settings)
    assert "\n" not in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def test_own_settings_hold_for_one_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own" / "env").mkdir(parents=True)
    (tmp_path / "own" / "env" / "swing.yaml").write_text("name: swing\nid: Pendulum-v1\nsource: swing\n")
    with pytest.raises(ConfigError, match=r"python run.py --config-dir own .*env=swing.* seed=4"):
        acmr.train("env=swing", "transfer=expand", config_dir="own", seed=4, profile="quick")
    with pytest.raises(ConfigError, match="env=swing: must be one of"):
        acmr.train("env=swing")


def test_a_policy_acts_as_its_networks_do(tmp_path):
    path = make_run(tmp_path / "run")
    policy, teacher = acmr.load(str(path)), load_teacher(path)
    assert policy.spaces.observation.shape == (len(policy.names.observations),) == (23,)
    assert isinstance(policy.spaces.action, Box)
    assert policy.names.actions == tuple(teacher.description.action_names)
    assert policy.summary == {"status": "complete"}
    seen = np.random.default_rng(0).normal(size=(7, 23))
    many = policy(seen)
    assert many.shape == (7, 6)
    assert many.dtype == np.float32
    # By hand, from the numbers in the file.
    hidden = seen
    for name in ("input", "hidden_1"):
        weight, bias = (teacher.tensors[f"actor.{name}.{kind}"].double().numpy() for kind in ("weight", "bias"))
        hidden = np.maximum(hidden @ weight.T + bias, 0)
    weight, bias = (teacher.tensors[f"actor.mean.{kind}"].double().numpy() for kind in ("weight", "bias"))
    np.testing.assert_allclose(many, np.tanh(hidden @ weight.T + bias), atol=1e-6)
    np.testing.assert_allclose(policy(seen[3]), many[3], atol=1e-6)
    drawn = policy(seen, np.random.default_rng(1))
    assert np.array_equal(drawn, policy(seen, np.random.default_rng(1)))
    assert not np.allclose(drawn, many)
    assert all(policy.spaces.action.contains(action) for action in drawn)
    with pytest.raises(ValueError, match=r"shape \(22,\): \(23,\) or \(many, 23\)"):
        policy(seen[0][:22])
    env = policy.environment()
    observation, _ = env.reset(seed=1)
    env.step(policy(observation))


def test_a_teacher_alone_is_loaded_by_its_folder_or_its_file(tmp_path):
    path = make_run(tmp_path / "run")
    for name in ("config.yaml", "summary.json"):
        (path / name).unlink()
    for given in (path, path / "teacher.safetensors"):
        assert acmr.load(given).summary["global_step"] == 100
    with pytest.raises(ConfigError, match="no such run directory"):
        acmr.load(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="not a run directory"):
        acmr.load(tmp_path / "empty")


def test_results_are_what_the_analysis_reads(folder):
    runs, episodes = acmr.results(str(folder / "runs" / "quick"))
    assert list(runs["state"]) == ["complete"]
    assert list(runs["env"]) == ["ant"]
    assert len(episodes) == runs["episodes"].iloc[0]
    assert {"run", "seed", "global_step", "episodic_return"} <= set(episodes)
    with pytest.raises(ValueError, match="there is no such folder"):
        acmr.results(folder / "nothing")


@pytest.mark.slow
def test_ctrl_c_ends_it_as_python_expects_and_it_goes_on_later(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    long = {**TINY, "total_timesteps": 6000, "checkpoint_every": 500}
    status = tmp_path / NAME.replace("1200", "6000") / "checkpoint"

    def interrupt():
        while not list(status.glob("*")):
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        acmr.train("env=ant", **long)
    said = []
    assert acmr.train("env=ant", say=said.append, **long).summary["global_step"] == 6000
    assert [line for line in said if "resumed at step" in line]


@pytest.mark.slow
def test_the_page_runs_as_it_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in blocks(ROOT / "docs" / "python.md"):
        exec(block.text, names)
    assert "ant-none" in capsys.readouterr().out
