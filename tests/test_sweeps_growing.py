"""A sweep that grows: real trainings that come, are withdrawn and come again, beside somebody who trains on his own."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from guides import ROOT
from omegaconf import OmegaConf

from acmr.config import ConfigError
from sweeps.growing import GrowingSweep
from sweeps.launchers.base import LauncherAdapter
from sweeps.plan import expand, make_plan
from sweeps.sweeper import Settings

TINY = [
    "env=gym", "env.id=Pendulum-v1", "env.max_episode_steps=50", "profile=quick", "agent.learning_starts=100",
    "agent.hidden_sizes=[8]", "tracking=off",
]  # fmt: skip
pytestmark = pytest.mark.slow


class Processes(LauncherAdapter):
    """Workers as processes of this machine."""

    started = 0

    def launch(self, folder, runs, number):
        workers = [subprocess.Popen(self.worker_command(folder)) for _ in range(min(self.workers, len(runs)))]
        self.started += len(workers)
        for worker in workers:
            worker.wait()


class Rounds(Processes):
    """As a cluster has it: each job its run."""

    workers_pick_runs = False

    def launch(self, folder, runs, number):
        code = "from sweeps.worker import *; Worker(SweepFolder(Path(sys.argv[1])), 0).take(int(sys.argv[2]))"
        for run in runs:
            self.started += 1
            subprocess.run([sys.executable, "-c", code, str(folder.path), str(run)], check=True)


def run_of(steps: int, *words: str):
    return expand([[*TINY, f"total_timesteps={steps}", *words]])[0]


def grown(first, look, workers: int = 2, kind=Processes):
    adapter = kind(OmegaConf.create({"hydra": {"launcher": {"workers": workers}}}), None, 1, None)
    sweep = GrowingSweep(make_plan([first]), Path("runs"), Settings(False, 0, 20.0, None), adapter, look)
    return sweep, adapter


def said(spec, name: str = "status.json"):
    path = spec.directory / name
    return json.loads(path.read_text()) if path.exists() else {}


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


@pytest.mark.parametrize("kind", [Processes, Rounds])
def test_a_run_is_stopped_on_purpose_others_come_and_it_goes_on_when_it_is_wanted(kind, capsys):
    long, short = run_of(50_000), run_of(300, "seed=2")
    steps = []

    def look(sweep):
        if not steps and said(long).get("global_step", 0) >= 200:
            steps.append("withdrawn")
            sweep.withdraw(long.directory)
            sweep.add(short)
        if steps == ["withdrawn"] and sweep.is_over(long.directory) and sweep.is_over(short.directory):
            assert said(long)["state"] == "stopped"
            # With a checkpoint, from which it goes on here: it is a shorter run now, to come to its end.
            assert (long.directory / "checkpoint").exists()
            steps.append("ended")
        return steps != ["withdrawn", "ended"]

    sweep, adapter = grown(long, look, kind=kind)
    sweep.run()
    assert said(short, "summary.json")["status"] == "complete"
    assert not (long.directory / "summary.json").exists()
    assert adapter.started == 2
    output = capsys.readouterr().out
    assert "stopped on purpose" in output
    assert "failed" not in output

    if kind is Rounds:
        return
    begun, phases = said(long)["global_step"], []

    def look_again(sweep):
        state, step = said(long)["state"], said(long)["global_step"]
        if not phases and state == "running" and step > begun:
            sweep.withdraw(long.directory)
            phases.append("withdrawn")
        elif phases == ["withdrawn"] and state == "stopped":
            # Wanted again, right after it was stopped or while its worker is still at that.
            sweep.add(long)
            phases.append("wanted")
        elif phases == ["withdrawn", "wanted"] and state == "running":
            sweep.withdraw(long.directory)
            phases.append("withdrawn")
        return len(phases) < 3

    sweep, _ = grown(long, look_again, kind=kind)
    sweep.run()
    assert phases == ["withdrawn", "wanted", "withdrawn"]
    assert begun < said(long)["global_step"] < 50_000
    assert said(long)["state"] == "stopped"
    output = (long.directory / "output.log").read_text()
    assert output.count("step 0 of") == 1


def test_who_trains_a_run_on_his_own_is_not_stopped_with_it():
    spec = run_of(6000)
    words = [*TINY, "total_timesteps=6000", "progress=off"]
    own = subprocess.Popen([sys.executable, str(ROOT / "run.py"), *words], stdout=subprocess.DEVNULL)
    while said(spec).get("state") != "running":
        assert own.poll() is None
        time.sleep(0.1)
    begun = time.monotonic()

    def look(sweep):
        if time.monotonic() > begun + 2:
            sweep.withdraw(spec.directory)
        return time.monotonic() < begun + 2

    grown(spec, look)[0].run()
    assert own.poll() is None
    assert own.wait(timeout=120) == 0
    assert said(spec, "summary.json")["status"] == "complete"


def test_a_teacher_that_somebody_waits_for_is_not_withdrawn_and_an_error_ends_all_in_good_order():
    words = ("env=ant_three_legs", "transfer=hidden", "profile=quick", "agent.hidden_sizes=[8,8]", "tracking=off")
    student = expand([[*words, "total_timesteps=20000", "agent.learning_starts=100"]])[0]
    teacher = make_plan([student]).runs[0].spec
    seen = []

    def look(sweep):
        if said(teacher).get("state") == "running" and said(teacher)["global_step"] > 100:
            sweep.withdraw(teacher.directory)
            seen.append(sweep.is_over(teacher.directory))
        if len(seen) == 3:
            raise ConfigError("enough")
        return True

    with pytest.raises(ConfigError, match="enough"):
        grown(student, look)[0].run()
    assert seen == [False] * 3
    # Stopped by the error, not by being withdrawn.
    assert said(teacher)["state"] == "stopped"
    assert not (teacher.directory / "summary.json").exists()
