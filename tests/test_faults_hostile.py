"""Files from somebody else: whatever they hold, they run nothing, fill nothing and reach nothing outside the run."""

import hashlib
import json
import os
import resource
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from safetensors.numpy import save as save_arrays
from torture import ANT, Run, at_step

from acmr.agent.architecture import Dimensions
from acmr.config import ConfigError
from acmr.storage.checkpoint_store import Snapshot, SnapshotStore
from acmr.storage.run_dir import RunDir
from acmr.transfer.teacher import load_teacher

DIMS, WIDTHS = Dimensions(5, 2), (8, 8)


@pytest.fixture
def teacher(teacher_factory) -> Path:
    return teacher_factory(DIMS, WIDTHS).path.parent


def edit(folder: Path, **entries: object) -> None:
    """Changes a teacher's description as somebody would who knows what they do."""
    path = folder / "teacher.json"
    content = json.loads(path.read_text()) | entries
    rest = {name: value for name, value in content.items() if name != "description_sha256"}
    content["description_sha256"] = hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    "entries",
    [
        {"hidden_sizes": [1_000_000, 1_000_000]},
        {"hidden_sizes": [10**18]},
        {"hidden_sizes": [8, -8]},
        {"hidden_sizes": []},
        {"hidden_sizes": "88"},
        {"hidden_sizes": [8.0, 8.0]},
        {"hidden_sizes": [True, True]},
        {"core": [1_000_000, 1_000_000]},
        {"core": [3]},
        {"observation_names": ["a"] * 50_000},
        {"observation_names": [["a"]] * 5},
        {"observation_names": {"a": 1}},
        {"action_low": [float("nan")] * 2},
        {"action_low": [-1.0]},
        {"log_alpha": float("inf")},
        {"log_alpha": "0"},
        {"log_alpha": -(10**400)},
        {"final_return": 10**400},
        {"observation_names": 0},
        {"action_names": None},
        {"adapter_activation": ["relu"]},
        {"adapter_activation": "__import__('os').system"},
        {"log_std": "linear"},
        {"log_std": None},
        {"imported": 1},
        {"config": "rm"},
        {"seed": "1"},
        {"format_version": 3},
        {"sha256": 7},
    ],
    ids=str,
)
def test_a_wrong_description_is_refused_before_anything_is_made_of_it(entries, teacher):
    edit(teacher, **entries)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ConfigError) as caught:
        load_teacher(teacher)
    assert "\n" not in str(caught.value)
    assert str(teacher) in str(caught.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kilobytes


def test_every_flip_in_a_teacher_is_noticed(teacher):
    rng = np.random.default_rng(0)
    for name in ("teacher.json", "teacher.safetensors"):
        path = teacher / name
        data = path.read_bytes()
        for place in rng.integers(len(data) * 8, size=150):
            flipped = bytearray(data)
            flipped[place // 8] ^= 1 << int(place % 8)
            path.write_bytes(flipped)
            try:
                load_teacher(teacher)
            except ConfigError:
                continue
            # White space between the entries means nothing.
            assert json.loads(flipped) == json.loads(data)
        path.write_bytes(data)
    load_teacher(teacher)


def test_a_pickle_is_never_loaded(teacher, tmp_path):
    import pickle

    class Bomb:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "exploded"),))

    for data in (pickle.dumps(Bomb()), b"\x08\x00\x00\x00\x00\x00\x00\x00" + pickle.dumps(Bomb())):
        (teacher / "teacher.safetensors").write_bytes(data)
        edit(teacher, sha256=hashlib.sha256(data).hexdigest())
        with pytest.raises(ConfigError, match="not a safetensors file"):
            load_teacher(teacher)
    assert not (tmp_path / "exploded").exists()


def test_enormous_and_endless_files_are_not_read(teacher):
    with (teacher / "teacher.safetensors").open("r+b") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(ConfigError, match="1099511627776 bytes"):
        load_teacher(teacher)
    (teacher / "teacher.json").unlink()
    os.mkfifo(teacher / "teacher.json")
    with pytest.raises(ConfigError, match=r"teacher\.json: no regular file"):
        load_teacher(teacher)


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x]\nb: [*a, *a]",
        "!!python/object/apply:os.system ['touch exploded']",
        "a: " + "[" * 20_000,
        "\x00\xff",
        "seed: " + "1" * 2_000_000,
    ],
    ids=["aliases", "object", "deep", "binary", "large"],
)
def test_a_hostile_settings_file(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").write_text(text, encoding="latin-1")
    with pytest.raises(ConfigError, match="not readable; type force=true"):
        RunDir(tmp_path).stored_settings()
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


def test_settings_that_a_run_stores_can_be_read_again(tmp_path):
    run = Run(tmp_path, ANT)
    run.folder.mkdir(parents=True)
    RunDir(run.folder).start(run.spec.settings)
    assert RunDir(run.folder).stored_settings() == yaml.safe_load(yaml.safe_dump(run.spec.settings))


@pytest.fixture
def stopped(tmp_path) -> Run:
    run = Run(tmp_path / "run", ANT)
    assert run(at_step(90)).code == -signal.SIGKILL
    assert run.checkpoints == [40, 80]
    SnapshotStore(run.folder / "checkpoint", 0).discard(40)
    return run


@pytest.mark.parametrize(
    "name", ["../../outside", "/etc/hostname", "segment_0_40.safetensors/../x", "step_80.json\x00", ".", "x" * 5000]
)
def test_a_checkpoint_that_names_other_files_is_refused(name, stopped):
    store = SnapshotStore(stopped.folder / "checkpoint", 1 << 30)
    snapshot = store.read(80)
    replay = snapshot.values["state"]["replay"]
    replay["segments"] = {name: next(iter(replay["segments"].values()))}
    store.write(80, snapshot)
    ended = stopped()
    assert ended.code == 2
    assert "not a part of a replay buffer" in ended.said


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("replay", {"segments": {}}), ("replay", {"segments": []}), ("replay", []), ("replay", {"added": 81}),
        ("replay", {"added": 10**18}), ("replay", {"added": -1}), ("replay", {"added": "80"}),
        ("replay", {"segments": {}, "added": -1}),
        ("replay", {"segments": {"segment_0_80.safetensors": [10**18, "0"]}}),
        ("replay", {"segments": {"segment_40_40.safetensors": [8, "0"]}}),
        ("trainer", {"global_step": "x"}), ("trainer", {"global_step": None}), ("episode", []), ("agent", {}),
        ("episode", {"length": 1, "total": 0.0, "distance": 0.0, "sums": {"other": 0.0}}),
        ("environment", {"random": {"bit_generator": "MT19937"}}), ("environment", 7),
        ("logs", {"episodes": [10**15, "0"]}), ("logs", {"episodes": [-1, "0"], "metrics": ["0", 0]}),
        ("streams", {"replay": {"bit_generator": "PCG64", "state": {"state": -1, "inc": 0}}}), ("clock", {}),
        ("warnings", {"counts": 3}), ("something_else", {}),
    ],
)  # fmt: skip
def test_a_checkpoint_with_impossible_values_is_refused(path, value, stopped):
    store = SnapshotStore(stopped.folder / "checkpoint", 1 << 30)
    snapshot = store.read(80)
    state = snapshot.values["state"]
    state[path] = {**state.get(path, {}), **value} if isinstance(value, dict) and value else value
    store.write(80, snapshot)
    before = (stopped.folder / "episodes.csv").read_bytes()
    ended = stopped()
    assert ended.code == 2, ended.said
    assert "no checkpoint can be used" in ended.said
    assert (stopped.folder / "episodes.csv").read_bytes() == before


def test_arrays_that_do_not_fit_are_refused(stopped):
    store = SnapshotStore(stopped.folder / "checkpoint", 1 << 30)
    snapshot = store.read(80)
    names = (
        "torch/agent/tensors/actor", "numpy/agent/tensors/actor", "numpy/trainer/observation", "numpy/trainer", "numpy",
        "numpy/environment/robot/data/xipos", "numpy/nobody/x", "numpy/environment/random/bit_generator/x",
    )  # fmt: skip
    for name in names:
        store.write(80, Snapshot(snapshot.values, snapshot.arrays | {name: np.zeros(3)}))
        assert stopped().code == 2, name


def test_a_segment_larger_than_the_buffer_is_not_read(stopped):
    from acmr.storage.durable import FileDigest

    folder = stopped.folder / "checkpoint"
    path = folder / "segment_0_40.safetensors"
    path.write_bytes(save_arrays({"rows": np.zeros((10_000, 35), np.float32)}))
    store = SnapshotStore(folder, 1 << 30)
    snapshot = store.read(80)
    snapshot.values["state"]["replay"]["segments"][path.name] = FileDigest.of(path.read_bytes()).to_json()
    store.write(80, snapshot)
    assert "larger than this run's replay buffer" in stopped().said


@pytest.mark.parametrize("name", ["checkpoint", "episodes.csv", "run.log", ".lock", "status.json"])
def test_links_in_a_run_directory_lead_nowhere(name, stopped, tmp_path):
    outside = tmp_path / "outside"
    place = stopped.folder / name
    if place.exists():
        place.rename(outside)
    else:
        outside.write_bytes(b"theirs")
    files = [outside] if outside.is_file() else sorted(outside.iterdir())
    before = [path.read_bytes() for path in files]
    place.symlink_to(outside)
    ended = stopped()
    assert ended.code == (0 if name == "status.json" else 2), ended.said
    assert "Traceback" not in ended.said
    assert [path.read_bytes() for path in files] == before


_NAMES = ("checkpoint", "tensorboard", "episodes.csv", "metrics.csv", "run.log", ".lock", "status.json")


@pytest.mark.parametrize("name", _NAMES)
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_pipes_and_folders_in_a_run_directory_are_not_waited_for(name, make, stopped):
    place = stopped.folder / name
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    if name == "tensorboard":
        # It is removed where the run begins anew.
        shutil.rmtree(stopped.folder / "checkpoint")
    make(place)
    if make is os.mkdir:
        (place / "theirs").touch()
    child = stopped.start()
    deadline = time.monotonic() + 60
    once = os.WEXITED | os.WNOWAIT | os.WNOHANG
    while not (done := os.waitid(os.P_PID, child, once)) and time.monotonic() < deadline:
        time.sleep(0.05)
    if not done:
        os.kill(child, signal.SIGKILL)
    ended = stopped.wait(child)
    # A run without a checkpoint begins anew, a status is written in the place of what is none.
    assert ended.code in ((0, 2, 74) if name in ("checkpoint", "tensorboard", "status.json") else (2, 74)), ended.said
    assert "Traceback" not in ended.said
