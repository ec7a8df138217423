"""A run that is killed and started again ends bit for bit as the one that nobody touched."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from torture import ANT, HUMANOID, SMALL, Run, at_step, same

from acmr.storage.checkpoint_store import Snapshot, SnapshotStore

PENDULUM = ("env=gym", "env.id=Pendulum-v1", "env.max_episode_steps=30", "total_timesteps=220", *SMALL)
KINDS = {"humanoid": HUMANOID, "ant": ANT, "pendulum": PENDULUM, "plain": (*ANT, "agent=sac_plain")}


@pytest.fixture(scope="module")
def untouched(tmp_path_factory):
    """What undisturbed runs leave, and their folders."""
    base = tmp_path_factory.mktemp("untouched")
    made = {}

    def of(overrides: tuple[str, ...]) -> tuple[dict[str, bytes], Path]:
        if overrides not in made:
            run = Run(base / str(len(made)), overrides)
            made[overrides] = run.finish(), run.folder
        return made[overrides]

    return of


@pytest.fixture
def stopped(tmp_path) -> Run:
    """A run that was killed at step 150, with checkpoints of the steps 80 and 120."""
    run = Run(tmp_path, ANT)
    assert run(at_step(150)).code == -signal.SIGKILL
    assert run.checkpoints == [80, 120]
    return run


@pytest.mark.parametrize(
    ("kind", "kills", "resumed"),
    [
        ("humanoid", [35], []),  # an episode's end, before there is a checkpoint
        ("humanoid", [54, 119], [40, 80]),  # before learning starts, and soon after
        ("humanoid", [160, 161, 290], [120, 160, 280]),  # on a checkpoint's step; after the ring has wrapped
        ("ant", [90, 91, 299], [80, 80, 280]),  # the step at which the time limit ends an episode; the last step
        ("pendulum", [75, 200], [60, 180]),  # checkpoints at the ends of episodes only
        ("plain", [54, 130], [40, 120]),  # the learner whose state is that of torch's own networks and optimizers
    ],
)
@pytest.mark.first_is_fast
def test_kills_leave_no_trace(kind, kills, resumed, untouched, tmp_path):
    run, seen = Run(tmp_path, KINDS[kind]), []
    for kill in kills:
        ended = run(at_step(kill))
        assert ended.code == -signal.SIGKILL, ended.said
        seen.append(ended.said)
    ended = run()
    assert ended.code == 0, ended.said
    said = "".join([*seen[1:], ended.said])
    assert [f"resumed at step {step} of" in said for step in resumed] == [True] * len(resumed)
    assert ("it had no checkpoint yet" in said) == (not resumed)
    same(run.outcome(), untouched(KINDS[kind])[0])


def test_an_environment_that_is_stored_between_episodes_says_so_once(tmp_path):
    said = Run(tmp_path, PENDULUM)().said
    assert said.count("the state of Pendulum-v1 can be stored between episodes only") == 1


@pytest.mark.parametrize("transfer", ["hidden", "expand"])
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_a_student_with_frozen_layers(transfer, untouched, tmp_path):
    teacher = untouched(ANT)[1]
    overrides = (
        "env=ant_three_legs", f"transfer={transfer}", "freeze=true", f"transfer.teacher={teacher}",
        "total_timesteps=200", "transfer.copy_log_alpha=true", *SMALL,
    )  # fmt: skip
    run = Run(tmp_path, overrides)
    for kill in (130, 190):
        run(at_step(kill))
    same(run.finish(), untouched(overrides)[0])


def test_a_damaged_checkpoint_falls_back_to_the_one_before(stopped, untouched):
    latest = stopped.folder / "checkpoint" / "step_120.json"
    latest.write_bytes(latest.read_bytes().replace(b'"global_step": 120', b'"global_step": 121'))
    ended = stopped(at_step(130))
    assert "warning" in ended.said
    assert (
        f"{latest}: does not hold what was written to it; going on from the checkpoint before, of step 80" in ended.said
    )
    assert "resumed at step 80 of" in ended.said
    same(stopped.finish(), untouched(ANT)[0])


@pytest.mark.parametrize("damage", ["both", "segment", "episodes.csv", "metrics.csv"])
def test_two_damaged_checkpoints_are_refused_and_nothing_is_changed(damage, stopped, untouched):
    folder = stopped.folder / "checkpoint"
    files = {
        "both": [folder / "step_80.safetensors", folder / "step_120.json"],
        "segment": [folder / "segment_0_40.safetensors"],
        "episodes.csv": [stopped.folder / "episodes.csv"],
        "metrics.csv": [stopped.folder / "metrics.csv"],
    }[damage]
    for path in files:
        path.write_bytes(path.read_bytes()[:40])
    before = {path: path.read_bytes() for path in stopped.folder.rglob("*") if path.is_file()}
    ended = stopped()
    (error,) = [line for line in ended.said.splitlines() if line.startswith("error: ")]
    assert ended.code == 2
    for path in files:
        assert str(path) in error
    command = f"python run.py {' '.join(stopped.spec.command.split()[2:])} force=true"
    assert error.endswith(f"to start from the first step again, type: {command}")
    for path, content in before.items():
        if path.name not in ("run.log", "status.json", ".lock"):
            assert path.read_bytes() == content, path
    ended = stopped(lambda: None, "force=true")
    assert ended.code == 0, ended.said
    same_but_forced(stopped.outcome(), untouched(ANT)[0])


def edit(run: Run, step: int, **entries: object) -> None:
    """Changes entries of a checkpoint, with the hash that belongs to them."""
    store = SnapshotStore(run.folder / "checkpoint", 1 << 30)
    snapshot = store.read(step)
    store.write(step, Snapshot(snapshot.values | entries, snapshot.arrays))


def test_another_machine_is_refused_unless_asked_for_and_recorded(stopped):
    here = SnapshotStore(stopped.folder / "checkpoint", 1 << 30).read(120).values["fingerprint"]
    edit(stopped, 120, fingerprint=here | {"torch": "2.0.0", "program": "0" * 16})
    ended = stopped()
    assert ended.code == 2
    assert f"made under other conditions: torch 2.0.0 (now {here['torch']}), program;" in ended.said
    assert "resume=inexact" in ended.said
    # Going on is recorded, and neither a kill nor a later resume forgets it.
    assert stopped(at_step(250), "resume=inexact").code == -signal.SIGKILL
    assert stopped().code == 0
    summary = json.loads((stopped.folder / "summary.json").read_text())
    differing = [f"torch 2.0.0 (now {here['torch']})", "program"]
    assert summary["inexact_resumes"] == [{"step": 120, "differing": differing}]


def test_another_number_of_threads_is_another_machine(stopped):
    ended = stopped(lambda: None, "threads=2")
    assert ended.code == 2
    assert "made under other conditions: threads 1 (now 2)" in ended.said


def test_checkpoints_of_another_format_are_refused_in_one_line(stopped):
    kept = {}
    for path in (stopped.folder / "checkpoint").glob("step_*.json"):
        # What the version before wrote there is of no interest, since nothing of it is read.
        kept[path] = path.read_bytes().replace(b'"format_version": 2', b'"format_version": 1')
        path.write_bytes(kept[path])
    ended = stopped()
    assert ended.code == 2
    (error,) = [line for line in ended.said.splitlines() if line.startswith("error: ")]
    latest = stopped.folder / "checkpoint" / "step_120.json"
    command = f"python run.py {' '.join(stopped.spec.command.split()[2:])} force=true"
    assert error == (
        f"error: a checkpoint of another version of this program, which can finish this run: {latest}: format 1 (this "
        f"version reads 2); to start from the first step again, type: {command}"
    )
    assert {path: path.read_bytes() for path in kept} == kept


def test_a_checkpoint_of_another_run_is_refused(stopped, tmp_path):
    other = Run(tmp_path / "other", (*ANT, "seed=2"))
    other(at_step(150))
    shutil.rmtree(other.folder / "checkpoint")
    shutil.copytree(stopped.folder / "checkpoint", other.folder / "checkpoint")
    ended = other()
    assert ended.code == 2
    assert "a checkpoint of another run" in ended.said


def test_a_complete_run_leaves_no_checkpoint_even_if_it_was_killed_at_the_last_moment(stopped, untouched):
    kept = stopped.output / "kept"
    shutil.copytree(stopped.folder / "checkpoint", kept)
    same(stopped.finish(), untouched(ANT)[0])
    shutil.copytree(kept, stopped.folder / "checkpoint")
    ended = stopped()
    assert (ended.code, "complete already" in ended.said) == (0, True)
    assert not (stopped.folder / "checkpoint").exists()


def test_force_starts_from_the_first_step(stopped, untouched):
    ended = stopped(at_step(60), "force=true")
    assert "run anew; starting from the first step" in ended.said
    assert stopped.checkpoints == [40]
    same_but_forced(stopped.finish(), untouched(ANT)[0])


def same_but_forced(outcome: dict[str, bytes], wanted: dict[str, bytes]) -> None:
    """The settings say that it was forced, in the process that was; all else is the same."""
    assert {name for name in wanted if outcome[name] != wanted[name]} <= {"config.yaml", "teacher.json"}


def test_without_checkpoints_a_run_begins_anew(tmp_path, untouched):
    run = Run(tmp_path, ANT)
    run(at_step(200), "checkpoint_every=0")
    assert not (run.folder / "checkpoint").exists()
    assert "it had no checkpoint yet; starting from the first step" in run().said


def test_seconds_are_those_of_all_processes(stopped):
    state = SnapshotStore(stopped.folder / "checkpoint", 1 << 30).read(120).values["state"]
    edit(stopped, 120, state=state | {"clock": {"seconds": 1e6}})
    stopped.finish()
    assert 1e6 < json.loads((stopped.folder / "summary.json").read_text())["wall_seconds"] < 1e6 + 600


def test_the_mirror_is_one_whole_run(tmp_path):
    run = Run(tmp_path, (*(word for word in ANT if word != "tracking=off"), "tracking=offline"))
    run(at_step(245))
    assert run().code == 0
    (mirror,) = (tmp_path / "wandb").glob("offline-run-*/run-*.wandb")
    assert "resumed at step 240" in (run.folder / "run.log").read_text()
    rows = logged_steps(mirror)
    episodes = [int(line.split(",")[0]) for line in (run.folder / "episodes.csv").read_text().splitlines()[1:]]
    assert [step for step, kind in rows if kind == "episode"] == episodes
    assert [step for step, kind in rows if kind == "metrics"] == list(range(70, 300, 70))


def logged_steps(mirror: Path) -> list[tuple[int, str]]:
    """Steps of all rows in W&B's own file, in order."""
    from wandb.util import get_core_path

    command = [get_core_path(), "leet", "inspect", "--no-observability", "--json", "--run-file", str(mirror)]
    command.append(str(mirror.parent))
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    records = [json.loads(line) for line in lines]
    rows = [record["history"]["item"] for record in records if record["type"] == "history"]
    return [(int(row["global_step"]), "episode" if "episodic_return" in row else "metrics") for row in rows]


@pytest.mark.slow
def test_the_processes_of_these_tests_do_what_run_py_does(stopped, untouched, tmp_path):
    root = Path(__file__).resolve().parent.parent
    command = [sys.executable, str(root / "run.py"), f"output_dir={stopped.output}", *ANT]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    assert "resumed at step 120 of 300" in done.stdout
    (stopped.output / "buffer.sha256").write_bytes(untouched(ANT)[0]["buffer"])
    outcome, wanted = ({**what} for what in (stopped.outcome(), untouched(ANT)[0]))
    for found in (outcome, wanted):
        found["summary.json"] = re.sub(rb'"git_commit": [^,]+,', b"", found["summary.json"])
    same(outcome, wanted)
