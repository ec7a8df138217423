"""Every file that may be foreign is read by one reader: whatever lies there is one line, at once, and nothing else."""

from __future__ import annotations

import gzip
import json
import os
import random
import shutil
import signal
import socket
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from test_security_secrets import older

from acmr import foreign
from acmr.config import ConfigError
from acmr.evaluation.evaluate import load_run
from acmr.records import DamagedError
from acmr.storage.run_dir import RunDir
from acmr.text import flatten
from acmr.tracking.mirror import rebuild
from acmr.transfer.teacher import load_teacher
from analysis import publish as publishing
from analysis.analyze import analyze
from analysis.loading.load import InputError, load
from analysis.loading.speed import read_speed
from analysis.publish import PublishError
from analysis.report.stamp import fingerprint
from sweeps.estimate import _finished, _lengths, _speeds
from sweeps.status import main as status

TABLE = "global_step,episodic_return,episode_length\n" + "".join(f"{10 * i},{i}.5,10\n" for i in range(1, 31))
SUMMARY = {
    "status": "complete", "cell": "A2", "run": "ant-none", "profile": "quick", "env": "ant_three_legs",
    "transfer": "hidden", "freeze": True, "seed": 3, "global_step": 300, "total_timesteps": 300,
    "stop": "horizon", "stop_after": None, "episodes": 30, "threshold": 4900.0, "consecutive": 5,
    "steps_to_threshold": None, "censored": True, "final_return": 25.0, "steps_per_second": 300.0,
    "wall_seconds": 1.0, "versions": {"torch": "2"}, "git_commit": "a",
    "machine": {"system": "Linux"}, "physics_warnings": {}, "inexact_resumes": [], "cause": "x", "step": 3, "note": "x",
}  # fmt: skip
STATUS = {
    "state": "running", "global_step": 20, "total_timesteps": 300, "steps_per_second": 5.0, "latest_return": 1.0,
    "process": os.getpid(), "host": "elsewhere", "started": 1.0, "updated": 2.0, "cause": "x",
}  # fmt: skip
FILES = (
    "config.yaml", "summary.json", "status.json", "teacher.json", "teacher.safetensors", "episodes.csv", "metrics.csv",
    "transfer.json", "evaluation.json",
)  # fmt: skip
#: What may stand in the place of anything.
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 2.5, 10**30, -(10**400), 1e308, float("inf"), float("nan"), "", "x", "=1+1", "\x1b[2J\n",
    "3", "../../x", [], [1], ["x", None], {}, {"a": 1}, {"a": {"b": [1, {}]}},
)  # fmt: skip
#: How a refusal comes, and nothing else.
REFUSALS = (ConfigError, DamagedError, PublishError, InputError)


@pytest.fixture(autouse=True)
def _nothing_hangs() -> Iterator[None]:
    def late(number: int, frame: object) -> None:
        raise AssertionError("it hangs")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with every file that it can have."""
    folder = tmp_path_factory.mktemp("original")
    run = older(folder)
    shutil.move(run, folder / "seed_3")
    run = folder / "seed_3"
    settings = yaml.safe_load((run / "config.yaml").read_text())
    settings["transfer"]["teacher"], settings["total_timesteps"] = None, SUMMARY["total_timesteps"]
    (run / "config.yaml").write_text(yaml.safe_dump(settings))
    for name, content in (("summary.json", SUMMARY), ("status.json", STATUS)):
        (run / name).write_text(json.dumps(content))
    (run / "episodes.csv").write_text(TABLE)
    (run / "metrics.csv").write_text("global_step,steps_per_second\n100,200.0\n200,300.0\n")
    return run


@pytest.fixture
def run(original: Path, tmp_path: Path) -> Path:
    copied = tmp_path / "runs" / "quick" / "ant-none" / "seed_3"
    shutil.copytree(original, copied)
    return copied


def read_analysis(run: Path) -> object:
    data = load(run.parents[1])
    assert len(data.runs) == 1
    fingerprint(data, run / "out", {})
    read_speed(run)
    return analyze(data) if len(data.episodes) else None


READERS: dict[str, Callable[[Path], object]] = {
    "evaluation": load_run,
    "teacher": load_teacher,
    "settings": lambda run: (RunDir(run).stored_settings(), RunDir(run).summary(), RunDir(run).is_complete()),
    "mirror": lambda run: rebuild(run, "tensorboard", lambda line: None),
    "publish": lambda run: publishing._files(run, run.parent / "none", run.parent, False),
    "evaluation of a publication": lambda run: publishing._json(run / "evaluation.json"),
    "analysis": read_analysis,
    "status": lambda run: status([str(run.parents[2])]),
    "estimate": lambda run: (_speeds(_finished(run.parents[2])), _lengths(_finished(run.parents[2]))),
}


def read(kind: str, run: Path) -> str:
    """What a reader says of a run that it refuses; empty if it takes it. Anything else that it raises is a fault."""
    try:
        READERS[kind](run)
    except REFUSALS as error:
        return str(error)
    return ""


def as_pipe(path: Path) -> None:
    os.mkfifo(path)


def as_socket(path: Path) -> None:
    # Names of sockets are short.
    os.chdir(path.parent)
    socket.socket(socket.AF_UNIX).bind(path.name)


def as_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def as_link_out(path: Path) -> None:
    outside = path.parents[4] / f"outside-{path.name}"
    outside.write_text("root:secret of the reader")
    path.symlink_to(outside)


def as_link_within_a_link(path: Path) -> None:
    path.with_name("first").unlink(missing_ok=True)
    as_link_out(path.with_name("first"))
    path.symlink_to("first")


def as_huge(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(1 << 42)


def as_deep(path: Path) -> None:
    path.write_text('{"a":' * 200_000 if path.suffix == ".json" else "a: " + "[" * 200_000)


def as_deep_blocks(path: Path) -> None:
    path.write_text("\n".join(" " * depth + "a:" for depth in range(1_000)))


SHAPES = {
    "pipe": as_pipe, "socket": as_socket, "folder": Path.mkdir, "device": as_device, "link out": as_link_out,
    "link to a link out": as_link_within_a_link, "link to itself": lambda path: path.symlink_to(path.name),
    "link nowhere": lambda path: path.symlink_to("gone"), "huge": as_huge, "deep": as_deep,
    "deep blocks": as_deep_blocks, "empty": Path.touch, "bytes": lambda path: path.write_bytes(bytes(range(256)) * 9),
    "a list": lambda path: path.write_text("[1, 2]"), "a number": lambda path: path.write_text("1e400"),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.first_is_fast
def test_whatever_lies_in_the_place_of_a_file_costs_a_line(shape, run, original, monkeypatch, capsys):
    monkeypatch.chdir(run)
    for name in FILES:
        (run / name).unlink()
        SHAPES[shape](run / name)
        said = {kind: read(kind, run) for kind in READERS}
        assert "\n" not in "".join(said.values())
        assert "secret of the reader" not in json.dumps(said) + "".join(capsys.readouterr())
        if name in ("teacher.json", "teacher.safetensors") and shape != "deep blocks":
            assert name in said["teacher"], said
        if name == "config.yaml":
            assert "config.yaml" in said["evaluation"], said
            assert "config.yaml" in said["publish"] or shape == "empty", said
        path = run / name
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        shutil.copy(original / name, path)
    assert all(read(kind, run) == "" for kind in READERS)


#: Who reads a file's values, for the quick look at them.
WHO = {
    "summary.json": ("settings", "mirror", "publish", "analysis", "status", "estimate"),
    "status.json": ("analysis", "status"),
    "config.yaml": ("evaluation", "settings", "mirror", "publish", "analysis"),
    "teacher.json": ("teacher", "publish"),
    "transfer.json": ("publish",),
}


@pytest.mark.parametrize("count", [30, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", WHO)
@pytest.mark.first_is_fast
def test_values_of_other_types_cost_a_line(name, count, run, capsys):
    signal.alarm(600)
    rng = random.Random(name)
    plain = yaml.safe_load((run / name).read_text())
    keys = [key.split(".") for key in flatten(plain)] + [[key] for key in plain]
    cases = [(key, value) for key in keys for value in VALUES]
    for key, value in rng.sample(cases, min(len(cases), count)):
        content = json.loads(json.dumps(plain))
        place = content
        for part in key[:-1]:
            place = place[part]
        place[key[-1]] = value
        (run / name).write_text(json.dumps(content) if name.endswith("json") else yaml.safe_dump(content))
        for kind in WHO[name] if count < 100 else READERS:
            try:
                read(kind, run)
            except Exception as error:
                raise AssertionError(f"{kind}: {'.'.join(key)} = {value!r}") from error
    assert "Traceback" not in "".join(capsys.readouterr())


@pytest.mark.parametrize("name", ["episodes.csv", "metrics.csv"])
@pytest.mark.parametrize("cell", ["", "x", "nan", "inf", "-1", "1e400", "2.5", '"', "=1", "\x00", "9" * 400, "1,2"])
@pytest.mark.first_is_fast
def test_cells_of_other_types_cost_a_line(name, cell, run):
    lines = (run / name).read_text().splitlines()
    for line in (0, 1):
        for column in range(2):
            values = lines[line].split(",")
            values[column] = cell
            (run / name).write_text("\n".join([*lines[:line], ",".join(values), *lines[line + 1 :], ""]))
            for kind in READERS:
                read(kind, run)


@pytest.mark.parametrize("name", ["episodes.csv.gz", "metrics.csv.gz"])
def test_a_small_file_that_holds_gigabytes_is_not_unpacked(name, run):
    (run / name.removesuffix(".gz")).unlink()
    block = gzip.compress(bytes(1 << 24), mtime=0)
    with (run / name).open("wb") as stream:
        for _ in range(512):
            stream.write(block)  # members that follow on each other: 8 GB in 8 MB
    assert (run / name).stat().st_size < 10_000_000
    tracemalloc.start()
    said = [read(kind, run) for kind in ("analysis", "publish", "mirror")]
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 2.5 * foreign.TABLES
    assert said[1:] == ["", ""]
    (reason,) = load(run.parents[1]).runs["reason"]
    assert name.startswith("metrics") or "holds more than the 268435456 bytes that are expected" in reason


def test_links_within_a_run_and_to_runs_are_followed(run, tmp_path):
    (run / "episodes.csv").rename(run / "all.csv")
    (run / "episodes.csv").symlink_to("all.csv")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "seed_3").symlink_to(run)
    (run / "teacher.json").rename(run / "description.json")
    (run / "teacher.json").symlink_to(run / "description.json")
    assert load(tmp_path / "linked").runs["state"].tolist() == ["complete"]
    assert load_teacher(tmp_path / "linked" / "seed_3").description.seed == 1
    # One that the user types may lead anywhere.
    (tmp_path / "best.safetensors").symlink_to(run / "teacher.safetensors")
    assert load_teacher(tmp_path / "best.safetensors").description.seed == 1


def test_what_cannot_be_published_leaves_nothing(run, tmp_path):
    (run / "config.yaml").unlink()
    as_link_out(run / "config.yaml")
    with pytest.raises(PublishError, match=r"config\.yaml: a link that leaves its folder; move that run away"):
        publishing.publish(run.parents[1], tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x]\nb: [*a, *a]", "a: &a {b: *a}", "!!python/object/apply:os.system ['touch ran']", "? [1]\n: 2",
        "a: !!binary aGk=", "a: !!set {x, y}", "a: 2026-99-99", "a: 0x" + "f" * 5_000, "a: " + "9" * 5_000,
        "<<: [1]", "%YAML 9.9\n---\na: 1", "a: 1\n---\nb: 2", "\ufeff", "a: \ud800",
    ],
    ids=range(14),
)  # fmt: skip
def test_yaml_is_plain_data(text, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_bytes(text.encode("utf-8", errors="surrogatepass"))
    with pytest.raises(DamagedError, match=r"^config\.yaml: "):
        foreign.read_mapping(path, path.name)
