"""Checkpoints with flipped bits and missing ends: taken up exactly, or the one before exactly, or refused."""

import os
import random
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from torture import ANT, Run, at_step, content_hash, parts

from acmr.config import ConfigError
from acmr.run.checkpointing import Checkpoints
from acmr.run.run_state import RunState
from acmr.storage.checkpoint_store import Snapshot, SnapshotStore

ROUNDS = int(os.environ.get("ACMR_TORTURE", "1"))
FLIPS, CUTS = 300 * ROUNDS, 60 * ROUNDS


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> tuple[Run, Path]:
    """A run killed at step 250, and a copy of what it left."""
    run = Run(tmp_path_factory.mktemp("damaged") / "run", ANT)
    assert run(at_step(250)).code == -signal.SIGKILL
    assert run.checkpoints == [200, 240]
    copy = run.output.parent / "copy"
    shutil.copytree(run.folder, copy)
    return run, copy


def state_of(state: RunState) -> dict[str, bytes]:
    """All that a checkpoint puts back, as bytes; the times aside."""
    snapshot = state.capture()
    snapshot.values.pop("clock")
    found = {name: array.tobytes() for name, array in snapshot.arrays.items()}
    found |= {name: repr(value).encode() for name, value in snapshot.values.items()}
    return found | {"buffer": content_hash(state.trainer.buffer).encode()}


def restore(run: Run, copy: Path) -> None:
    shutil.rmtree(run.folder)
    shutil.copytree(copy, run.folder)


def taken_up(state: RunState, checkpoints: Checkpoints) -> tuple[int, dict[str, bytes]] | None:
    """The step that was taken up and the state that was put back; None if that was refused."""
    scramble(state)
    said: list[str] = []
    try:
        step = checkpoints.load(said.append)
    except ConfigError:
        return None
    assert step is not None
    assert bool(said) == (step == 200)
    return step, state_of(state)


def scramble(state: RunState) -> None:
    """Makes sure that whatever is right afterwards was put back."""
    buffer = state.trainer.buffer
    for array in (buffer.rows, buffer.rewards, buffer.terminated, buffer.last_observations):
        array[...] = 7.0
    buffer.endings[...] = -1
    for tensor in state.trainer.agent._state_tensors().values():
        tensor.fill_(7.0)
    state.trainer.observation = np.zeros(3)
    state.trainer.global_step = -1


def segments(snapshot: Snapshot) -> dict[str, object]:
    """The files of the replay buffer that a checkpoint needs."""
    return snapshot.values["state"]["replay"]["segments"]


def damage_to(path: Path, rng: random.Random, kind: str) -> str:
    data = bytearray(path.read_bytes())
    if kind == "flip":
        place = rng.randrange(len(data) * 8)
        data[place // 8] ^= 1 << place % 8
    else:
        place = rng.randrange(len(data))
        del data[place:]
    path.write_bytes(data)
    return f"{kind} of {path.name} at {place}"


@pytest.mark.slow
def test_flips_and_cuts_are_never_silently_wrong(stored):
    run, copy = stored
    state, checkpoints = parts(run)
    exact = {}
    for step in (240, 200):
        restore(run, copy)
        if step == 200:
            (run.folder / "checkpoint" / "step_240.json").write_bytes(b"")
        found = taken_up(state, checkpoints)
        assert found is not None
        assert found[0] == step
        exact[step] = found[1]
    assert exact[200] != exact[240]
    store = SnapshotStore(run.folder / "checkpoint", 1 << 30)
    restore(run, copy)
    needed = {
        step: {f"step_{step}.json", f"step_{step}.safetensors", *segments(store.read(step))} for step in (200, 240)
    }
    rng, counts = random.Random(1), {240: 0, 200: 0, None: 0}
    names = sorted(path.name for path in (copy / "checkpoint").iterdir())
    for number in range(FLIPS + CUTS):
        restore(run, copy)
        name = names[number % len(names)]
        what = damage_to(run.folder / "checkpoint" / name, rng, "flip" if number < FLIPS else "cut")
        found = taken_up(state, checkpoints)
        assert found is None or found[1] == exact[found[0]], what
        expected = next((step for step in (240, 200) if name not in needed[step]), None)
        assert (found[0] if found else None) == expected, what
        counts[expected] += 1
    assert min(counts.values()) > 0, counts


@pytest.mark.parametrize("name", ["step_240.json", "step_240.safetensors", "segment_200_240.safetensors"])
def test_every_byte_of_a_header_counts(stored, name):
    run, copy = stored
    state, checkpoints = parts(run)
    path = run.folder / "checkpoint" / name
    restore(run, copy)
    data = path.read_bytes()
    for place in [*range(0, 120, 3), len(data) - 1]:
        restore(run, copy)
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x10]) + data[place + 1 :])
        found = taken_up(state, checkpoints)
        assert found is not None, place
        assert found[0] == 200, place


def test_a_missing_file_counts_as_damage(stored):
    run, copy = stored
    state, checkpoints = parts(run)
    for name, expected in (("step_240.safetensors", 200), ("segment_200_240.safetensors", 200)):
        restore(run, copy)
        (run.folder / "checkpoint" / name).unlink()
        found = taken_up(state, checkpoints)
        assert found is not None
        assert found[0] == expected
    restore(run, copy)
    for name in ("step_200.safetensors", "step_240.safetensors"):
        (run.folder / "checkpoint" / name).unlink()
    assert taken_up(state, checkpoints) is None
