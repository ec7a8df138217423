"""A state goes to the disk and comes back as it was, also that of a part that was added, and that of the guide."""

import json
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from guides import ROOT, blocks, copy_checkout, follow
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from safetensors.numpy import load, save
from torture import ANT, Run, at_step

from acmr.envs import make_env
from acmr.envs.state import NEVER, RestorableEnv, try_resume
from acmr.run.run_state import RunState
from acmr.settings.compose import environment_config
from acmr.storage.checkpoint_store import Snapshot, SnapshotStore
from acmr.storage.state_data import join, split

GUIDE = ROOT / "docs" / "howto-state.md"

plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
numbers = st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_])
array = arrays(numbers, array_shapes(min_dims=0, max_dims=3))
tensor = arrays(st.sampled_from([np.float64, np.float32, np.int64]), array_shapes()).map(torch.from_numpy)
leaf = plain | st.lists(plain | st.lists(plain)) | array | tensor
states = st.dictionaries(st.text(), st.recursive(leaf, lambda inner: st.dictionaries(st.text(), inner)))


def same(first: object, second: object) -> bool:
    if type(first) is not type(second):
        return False
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, torch.Tensor):
        return same(first.numpy(), second.numpy())
    if isinstance(first, np.ndarray):
        return (first.dtype, first.shape, first.tobytes()) == (second.dtype, second.shape, second.tobytes())
    return repr(first) == repr(second)


@settings(max_examples=50)
@given(states)
@pytest.mark.slow
def test_a_state_comes_back_from_the_disk_as_it_was(state):
    values, found = split(state)
    assert same(join(json.loads(json.dumps(values)), load(save(found))), state)


def test_what_comes_back_can_be_written_to():
    values, found = split({"part": {"array": np.zeros(3), "tensor": torch.zeros(3)}})
    state = join(values, load(save(found)))
    state["part"]["array"] += 1
    state["part"]["tensor"] += 1


@pytest.mark.parametrize(
    ("wrong", "place"),
    [
        ({"part": {"mean": np.float64(1)}}, "state/part/mean: a float64"),
        ({"part": {"mean": np.float32(1)}}, "state/part/mean: a float32"),
        ({"part": {"seen": {1, 2}}}, "state/part/seen: a set"),
        ({"part": {"pair": (1, 2)}}, "state/part/pair: a tuple"),
        ({"part": {"list": [np.zeros(2)]}}, "state/part/list: a list"),
        ({"part": {"list": [{"a": 1}]}}, "state/part/list: a list"),
        ({"part": {"things": np.array([None])}}, "state/part/things: a ndarray"),
        ({"part": {3: 1}}, "state/part: the key 3"),
    ],
    ids=str,
)
def test_what_a_file_would_change_is_refused_with_its_place(wrong, place):
    with pytest.raises(TypeError, match=place):
        split(wrong)


@pytest.mark.parametrize(
    "snapshot", [Snapshot({}, {"a": np.zeros(1000)}), Snapshot({"a": "x" * 70_000_000}, {})], ids=["arrays", "values"]
)
def test_a_checkpoint_that_would_not_be_read_again_is_not_made(snapshot, tmp_path):
    store = SnapshotStore(tmp_path, limit=1000)
    with pytest.raises(ValueError, match="would be read again"):
        store.write(7, snapshot)
    assert store.steps() == []


class Tally:
    """A part that nobody foresaw: it counts the steps, and writes each count to a file."""

    def __init__(self, path: Path) -> None:
        self.path, self.state = path, {"steps": 0, "sum": np.zeros(2, np.float32), "tensor": torch.zeros(1)}
        # Larger than all else in a checkpoint of so small a run.
        self.state["large"] = np.zeros(1_000_000)

    def step(self) -> None:
        self.state["steps"] += 1
        self.state["sum"] += 0.1
        self.state["tensor"] += 0.1
        with self.path.open("a") as stream:
            print(self.state["steps"], *self.state["sum"].tolist(), self.state["tensor"].item(), file=stream)

    def state_dict(self) -> dict[str, object]:
        return self.state

    def load_state_dict(self, state: dict[str, object]) -> None:
        self.state = state


def add_a_tally(path: Path, kill: int | None = None) -> None:
    """Registers it as the guide says, and steps it with the environment."""
    tally, parts, step = Tally(path), RunState.parts, RestorableEnv.step

    def counted(env: RestorableEnv, action: object) -> object:
        tally.step()
        return step(env, action)

    RestorableEnv.step = counted
    RunState.parts = lambda state: {"tally": tally, **parts(state)}
    if kill is not None:
        at_step(kill)()


def test_a_part_that_is_added_goes_on_where_it_was(tmp_path):
    whole, killed = Run(tmp_path / "whole", ANT), Run(tmp_path / "killed", ANT)
    assert whole(partial(add_a_tally, tmp_path / "whole.tally")).code == 0
    assert killed(partial(add_a_tally, tmp_path / "killed.tally", 150)).code == -signal.SIGKILL
    # Without the part its checkpoint is not one of this run.
    refused = killed()
    assert (refused.code, "other parts: tally" in refused.said) == (2, True), refused.said
    assert killed(partial(add_a_tally, tmp_path / "killed.tally")).code == 0
    wanted, found = ((tmp_path / f"{name}.tally").read_text().splitlines() for name in ("whole", "killed"))
    assert found == wanted[:150] + wanted[120:]
    assert len(wanted) == 300


@pytest.mark.slow
def test_the_guide_does_what_it_says(tmp_path):
    folder = copy_checkout(tmp_path / "checkout")
    said = follow(GUIDE, folder)
    assert said.count("resumed at step ") == 1
    assert said.count("complete, ") == 2
    (registered,) = [block.text for block in blocks(GUIDE) if block.language == "python" and not block.file]
    assert registered.splitlines()[0] in (ROOT / "acmr" / "run" / "run_state.py").read_text()


def forgetful(text: str) -> str:
    """The guide's wrapper, but what it gives lacks the squares."""
    return text.replace(', "squares": self.squares}', "}").replace('state["squares"]', "self.squares")


def methodless(text: str) -> str:
    return text.replace("state_dict", "other")


@pytest.mark.parametrize("spoiled", [forgetful, methodless])
def test_a_part_that_is_forgotten_is_noticed_before_the_first_step(spoiled, tmp_path, monkeypatch):
    (file,) = [block for block in blocks(GUIDE) if block.file]
    name = f"normalized_{spoiled.__name__}"
    text = spoiled(file.text).replace("NormalizedHopper-v0", f"{name}-v0")
    assert text != file.text
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    config = environment_config(f"{name}:{name}-v0")
    assert try_resume(lambda: make_env(config)).when == NEVER
