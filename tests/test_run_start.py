"""Ways of starting: as a module, through a link, from a notebook, with paths as people type them, ended at once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from acmr.config import ConfigError
from acmr.settings.command_line import hydra_arguments
from acmr.settings.compose import compose_config, parse

ROOT = Path(__file__).resolve().parents[1]
TINY = (
    "env=gym", "env.id=Pendulum-v1", "env.max_episode_steps=30", "total_timesteps=60", "agent.hidden_sizes=[4]",
    "agent.batch_size=4", "agent.learning_starts=50", "tracking=off", "progress=off",
)  # fmt: skip


def python(folder: Path, *words: str, **more: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **more}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=120
    )


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr.removeprefix("error: ").strip()


@pytest.mark.slow
def test_as_a_module_a_sweep_trains_and_says_how_to_go_on(tmp_path: Path) -> None:
    words = ["-m", "run", "-m", "seed=1,2", *TINY, "output_dir=runs"]
    done = python(tmp_path, *words, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(list(tmp_path.glob("runs/paper/*/seed_*/summary.json"))) == 2
    (plan,) = tmp_path.glob("runs/.sweeps/*/plan.json")
    assert json.loads(plan.read_text())["command"].startswith("python -m run -m seed=1,2 env=gym ")


@pytest.mark.parametrize("words", [("seed=1", "--cfg", "job"), ("-m", "seed=1,2", "plan=true")])
def test_through_a_link(words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "train.py").symlink_to(ROOT / "run.py")
    done = python(tmp_path, "train.py", *words)
    assert done.returncode == 0, done.stderr
    assert "armless_humanoid" in done.stdout


#: What a cell of a notebook does, in a process with a notebook's words.
CELL = "import sys; sys.argv = {argv}; sys.path.insert(0, {root!r}); import run; code = run.main(); print(code)"


@pytest.mark.slow
def test_in_a_notebook(tmp_path: Path) -> None:
    for words in (["-f", "/root/kernel-1.json"], ["--f=/root/kernel-1.json"]):
        argv = ["ipykernel_launcher.py", *words]
        done = python(tmp_path, "-c", CELL.format(argv=argv, root=str(ROOT)))
        assert done.stdout == "2\n"
        assert "type %run run.py seed=1 in a cell, or !python run.py seed=1" in done.stderr
        assert done.stderr.count("\n") == 1
    done = python(tmp_path, "-c", CELL.format(argv=["run.py", *TINY, "output_dir=runs"], root=str(ROOT)))
    assert done.stdout.endswith("0\n"), done.stderr
    assert list(tmp_path.glob("runs/paper/*/seed_1/summary.json"))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["seed=1,2"], "seed=1,2: several values are several runs; add -m, as in python run.py -m seed=1,2"),
        (["seed=range(1,4)"], "add -m, as in python run.py -m 'seed=range(1,4)'"),
        (["experiment=A1,A2"], "add -m, as in python run.py -m experiment=A1,A2"),
        (["agent.q_lr=choice(1e-3,1e-4)"], "add -m, as in python run.py -m 'agent.q_lr=choice(1e-3,1e-4)'"),
        (["output_dir="], "output_dir=: a path is needed, as in output_dir=runs"),
        (["output_dir='  '"], "output_dir=: a path is needed, as in output_dir=runs"),
        (["-m", "seed=1,2", "output_dir="], "output_dir=: a path is needed, as in output_dir=runs"),
        (["transfer=hidden", "transfer.teacher="], "transfer.teacher=: a path is needed"),
        (["output_dir=~no_such_user/runs"], "there is no such user"),
        (["output_dir=$HOME/runs"], "is not looked up here; let the shell do it, without single quotes around it"),
        (
            ["output_dir=${HOME}/runs"],
            "${HOME} is no setting; leave the single quotes out, so that the shell looks it up, or",
        ),
        (["tracking.dir='${env:SCRATCH}/w'"], "or type ${oc.env:SCRATCH}"),
        (["transfer=hidden", "transfer.teacher=${STORE:-x}/t"], "or type ${oc.env:STORE}"),
        (["output_dir=$(pwd)/runs"], "is not looked up here; let the shell do it"),
        (
            ["hydra.searchpath=[s3://bucket/conf]"],
            "hydra.searchpath: s3://bucket/conf: a folder or a package is needed",
        ),
        ([f"agent.hidden_sizes=[{'8,' * 20_000}8]"], "agent.hidden_sizes: 40,022 characters, at most 16,384 are taken"),
        ([f"agent.hidden_sizes=[{'8,' * 100}8]"], "agent.hidden_sizes: 101 widths, at most 100 are taken"),
        (["consecutive=2147483649"], "consecutive=2147483649: an integer of at most 2147483648 is needed"),
        (["threshold=1e101"], "a finite return is needed, of at most 1e+100 in size"),
        (["-m", "output_dir=s3://bucket/runs"], "is an address; type a folder of this machine"),
        (["transfer=hidden", "transfer.teacher=file:///tmp/a"], "transfer.teacher=file:///tmp/a: is an address"),
        (["--resolve"], "--resolve: goes with --cfg, as in python run.py --cfg job --resolve"),
        (["-sc"], "--shell-completion: type eval"),
        (["--experimental-rerun", "x"], "--experimental-rerun: is not offered"),
        (["-m", "seed=range(3,1)"], "seed=range(3,1): holds no value; type them one by one"),
        (["--nope"], "--nope: no such option; python run.py --hydra-help lists them"),
        (["--config-dir"], "expected one argument"),
        (["seed=1", "-m", "env=ant"], "env=ant: stands behind an option; options such as -m go before all settings"),
    ],
)
@pytest.mark.first_is_fast
def test_what_cannot_be_started_is_one_line(words: list[str], says: str, tmp_path: Path) -> None:
    assert says in one_line(python(tmp_path, str(ROOT / "run.py"), *words))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("key", ["output_dir", "tracking.dir"])
def test_a_tilde_is_the_users_own_folder(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    for typed, meant in {"~/runs": "/home/somebody/runs", "~": "/home/somebody", "a~b": "a~b", "./~": "./~"}.items():
        config = parse(compose_config(hydra_arguments([f"{key}={typed}"])))
        assert (config.output_dir if key == "output_dir" else config.tracking.dir) == meant


def test_a_folder_may_have_any_letters(tmp_path: Path) -> None:
    for name in ("meine läufe", "a=b/c", "日本", "x (old)", "50%"):
        assert parse(compose_config(hydra_arguments([f"output_dir={tmp_path / name}"]))).output_dir == str(
            tmp_path / name
        )
    with pytest.raises(ConfigError, match="there is no such folder"):
        hydra_arguments(["hydra.searchpath=[nowhere]"])


@pytest.mark.parametrize(
    ("word", "allowed"),
    [
        ("hydra/launcher=3", "one of local, slurm"),
        ("hydra/launcher=null", "one of local"),
        ("hydra/sweeper=0", "a name"),
    ],
)
def test_a_group_of_hydras_is_no_number(word, allowed):
    with pytest.raises(ConfigError, match=f"^{word}: must be {allowed}"):
        hydra_arguments([word])


#: Starts a program that gets Ctrl-C as it begins to load a module.
INTERRUPTED = """
import os, runpy, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)

_, module, *sys.argv = sys.argv
sys.path.insert(0, os.getcwd())
sys.meta_path.insert(0, Interrupt())
if sys.argv[0].endswith(".py"):
    runpy.run_path(sys.argv[0], run_name="__main__")
else:
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize(
    ("module", "words"),
    [
        *((module, ("run.py", *TINY)) for module in ("hydra", "yaml", "acmr.settings.validate", "numpy", "mujoco")),
        *((module, ("run.py", "-m", "seed=1,2", *TINY)) for module in ("hydra.main", "sweeps.sweeper", "joblib")),
        ("pandas", ("analysis", "results/paper", "--summary")),
        ("torch", ("acmr.evaluation", "results/paper/humanoid-none/seed_1")),
    ],
)
@pytest.mark.first_is_fast
def test_ctrl_c_at_once_is_one_line(module: str, words: tuple[str, ...], tmp_path: Path) -> None:
    more = [f"output_dir={tmp_path}"] if words[0] == "run.py" else []
    done = python(ROOT, "-c", INTERRUPTED, module, *words, *more)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "stopped by Ctrl-C; the same command starts it again\n"
    assert list(tmp_path.iterdir()) == []


def test_libraries_cannot_make_something_else_of_ctrl_c(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(
        "import os, signal, sys\n"
        "from acmr.command import command, end_at_ctrl_c\n"
        "@command\n"
        "def main():\n"
        "    end_at_ctrl_c()\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "    except BaseException:\n"
        "        pass\n"
        "    return 0\n"
        "sys.exit(main())\n"
    )
    assert python(tmp_path, "program.py", PYTHONPATH=str(ROOT)).returncode == 130
