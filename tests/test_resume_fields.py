"""Leaves each entry of a checkpoint out in turn; the run that goes on must then be another one, or be refused."""

import json
import math
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from torture import ANT, HUMANOID, Run, at_step, parts

from acmr.storage.checkpoint_store import Snapshot, SnapshotStore

#: Before learning starts random actions are drawn, after it nets are learned: an entry must matter at one of them.
STEPS = (40, 120)
#: Entries that are of use to environments of other kinds; tests/test_resume_env.py leaves each of them out.
ROBOT = "environment/robot"
ELSEWHERE = (f"numpy/{ROBOT}/arrays/", f"state/{ROBOT}/numbers/", f"numpy/{ROBOT}/data/")
#: MuJoCo's arrays are looked at one by one there, too; as a whole they matter here.
PHYSICS = f"numpy/{ROBOT}/data/*"


def leaves(values: Any, path: str = "") -> Iterator[str]:
    """Paths of all entries of nested dictionaries."""
    # The numbers of one generator are one entry.
    if isinstance(values, dict) and "bit_generator" not in values:
        for name, value in values.items():
            yield from leaves(value, f"{path}/{name}" if path else name)
    else:
        yield path


def entry(values: dict[str, Any], path: str) -> tuple[dict[str, Any], str]:
    *groups, name = path.split("/")
    for group in groups:
        values = values.get(group, {})
    return values, name


def put(values: dict[str, Any], path: str, fresh: dict[str, Any]) -> None:
    """Sets an entry to what it is in a run that has not begun; removes it where there is none."""
    (target, name), (source, _) = entry(values, path), entry(fresh, path)
    if name in source:
        target[name] = source[name]
    else:
        # The checkpoints of other steps have other segments.
        target.pop(name, None)


@pytest.fixture(scope="module", params=["ant", "humanoid", "plain"])
def base(request, tmp_path_factory) -> tuple[Run, dict[int, dict[str, bytes]], Snapshot]:
    """A run killed at step 130, what it comes to from each of its checkpoints, and the state of a fresh one."""
    overrides = {"ant": ANT, "humanoid": HUMANOID, "plain": (*ANT, "agent=sac_plain")}[request.param]
    # The plain learner has three times as many entries and takes three times as long for a step.
    overrides = (*overrides, "total_timesteps=150" if request.param == "plain" else "total_timesteps=210")
    folder = tmp_path_factory.mktemp(request.param)
    run = Run(folder / "base", overrides)
    for step in STEPS:
        assert run(at_step(step + 10)).code == -signal.SIGKILL
        store = SnapshotStore(run.folder / "checkpoint", 1 << 30)
        snapshot = store.read(step)
        # What is empty in most runs must not be lost either.
        snapshot.values["state"] |= {"warnings": {"counts": {"badqacc": 3}}, "clock": {"seconds": 1e6}}
        snapshot.values["inexact"] = [{"step": 7, "differing": ["something"]}]
        store.write(step, snapshot)
        shutil.copytree(run.output, folder / f"at_{step}")
    state, _ = parts(Run(folder / "fresh", overrides))
    state.logs._run_dir.path.mkdir(parents=True)
    state.logs.begin()
    fresh = state.capture()
    # All but the time stands in MuJoCo's arrays as well, so that another moment's would change nothing here.
    del fresh.arrays[f"numpy/{ROBOT}/integration"]
    state.environment.reset(seed=0)
    physics = {
        f"numpy/{ROBOT}/data/{name}": array for name, array in state.environment.state_dict()["robot"]["data"].items()
    }
    fresh.arrays.update(physics)
    made = {step: outcome(folder, step, overrides, None, fresh) for step in STEPS}
    return Run(folder / "base", overrides), made, fresh


def outcome(folder: Path, step: int, overrides: tuple[str, ...], path: str | None, fresh: Snapshot) -> dict[str, bytes]:
    """What comes of going on from a checkpoint, with one entry left out; ``{}`` if that is refused."""
    work = folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(folder / f"at_{step}", work)
    run = Run(work, overrides)
    store = SnapshotStore(run.folder / "checkpoint", 1 << 30)
    for earlier in store.steps()[1:]:
        # Nothing to fall back to.
        store.discard(earlier)
    if path is not None:
        snapshot = store.read(step)
        arrays = dict(snapshot.arrays)
        if path in arrays:
            arrays.pop(path)
            arrays |= {name: array for name, array in fresh.arrays.items() if name == path}
        elif path == PHYSICS:
            arrays.update({name: array for name, array in fresh.arrays.items() if name.startswith(PHYSICS[:-1])})
        else:
            put(snapshot.values, path, {"state": fresh.values, "inexact": []})
        store.write(step, Snapshot(snapshot.values, arrays))
    if run().code != 0:
        return {}
    found = run.outcome()
    wall = json.loads((run.folder / "summary.json").read_text())["wall_seconds"]
    return found | {"wall": str(math.floor(math.log10(wall))).encode()}


@pytest.mark.slow
def test_each_entry_matters(base):
    run, made, fresh = base
    folder = run.output.parent
    store = SnapshotStore(folder / f"at_{STEPS[1]}" / run.folder.relative_to(run.output) / "checkpoint", 1 << 30)
    snapshot = store.read(STEPS[1])
    names = [*snapshot.arrays, PHYSICS, *leaves(snapshot.values)]
    names = [name for name in names if not name.startswith(ELSEWHERE) or name == PHYSICS]
    names = [name for name in names if not name.startswith("fingerprint/")]
    if "agent=sac_plain" in run.overrides:
        # All else is the same code as with the other learner.
        names = [name for name in names if name.startswith(("torch/agent/", "state/agent/"))]
    assert len(names) > 40
    # Most entries matter at the later step already, from which there is less to train.
    later_first = STEPS[::-1]
    without_effect = [
        name
        for name in names
        if all(outcome(folder, step, run.overrides, name, fresh) == made[step] for step in later_first)
    ]
    assert without_effect == []
    # With nothing left out nothing changes: it was the entries that mattered.
    assert all(outcome(folder, step, run.overrides, None, fresh) == made[step] for step in STEPS)
