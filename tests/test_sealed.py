"""A finished run is complete only as long as it is what its summary says it was."""

import gzip
import json
import os
import re
from pathlib import Path

import pytest
from finished_run import make_run

from acmr.config import ConfigError
from acmr.evaluation.evaluate import load_run
from acmr.records import SEALED_FILES
from acmr.run_folders import changes, sealed
from acmr.settings.compose import compose_config, parse
from acmr.settings.run_spec import specify
from acmr.storage.durable import FileDigest
from acmr.storage.run_dir import RunDir, holds_run
from sweeps.plan import expand, make_plan
from sweeps.view import view_run

SUMMARY = {"status": "complete", "episodes": 3, "final_return": 12.5, "machine": {"node": "ä"}, "note": None}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "seed_1"
    folder.mkdir()
    for name in SEALED_FILES:
        (folder / name).write_text(f"{name}\n" * 300)
    seal(folder, SUMMARY)
    assert found(folder) == []
    return folder


def seal(folder: Path, summary: dict) -> None:
    digests = {name: FileDigest.of((folder / name).read_bytes()) for name in SEALED_FILES}
    RunDir(folder).finish(summary, digests)


def found(folder: Path) -> list[str]:
    return list(changes(folder, json.loads((folder / "summary.json").read_text())).values())


def flip(path: Path, at: int, into: bytes) -> None:
    data = bytearray(path.read_bytes())
    assert data[at : at + 1] != into
    data[at : at + 1] = into
    path.write_bytes(data)


@pytest.mark.parametrize("name", SEALED_FILES)
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda path: flip(path, 100, b"\0"), "was changed since the run ended"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "bytes, not the"),
        (lambda path: path.write_bytes(path.read_bytes() + b"1\n"), "bytes, not the"),
        (lambda path: path.write_bytes(b""), "has 0 bytes"),
        (lambda path: path.unlink(), "is missing"),
        (lambda path: (path.unlink(), os.mkfifo(path)), ": no regular file"),
        (lambda path: (path.unlink(), path.mkdir()), ": no regular file"),
        (lambda path: (path.unlink(), path.symlink_to(path)), ": no regular file"),
        (lambda path: (path.unlink(), path.symlink_to("gone")), ": No such file"),
        (lambda path: (path.unlink(), path.symlink_to("/dev/zero")), ": a link that leaves its folder"),
        (lambda path: (path.rename(path.parents[1] / "same"), path.symlink_to("../same")), ": a link that leaves"),
    ],
)
def test_every_change_of_a_file_is_found(name, change, said, run):
    change(run / name)
    assert len(found(run)) == 1
    assert name in found(run)[0]
    assert re.search(said, found(run)[0])
    assert not RunDir(run).is_complete()


def test_every_changed_character_of_a_summary_is_found(run):
    path = run / "summary.json"
    text = path.read_text()
    whole = json.loads(text)
    missed = []
    for place, letter in enumerate(text):
        if letter.isalnum():
            path.write_text(text[:place] + ("7" if letter != "7" else "3") + text[place + 1 :])
            try:
                content = json.loads(path.read_text())
            except ValueError:
                continue
            if content != whole and not found(run):
                missed.append((place, letter))
    assert missed == []


@pytest.mark.parametrize(
    "files",
    [None, [], "x", 1, {}, {"/etc/passwd": {"size": 1, "sha256": ""}}, {"../x": {}}, {"episodes.csv": None},
     {"episodes.csv": {"size": "1", "sha256": ""}}, {"episodes.csv": {"size": 1e9, "sha256": []}}],
)  # fmt: skip
def test_digests_of_other_shapes_are_a_change(files, run):
    path = run / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"files": files}))
    assert found(run)[0] == "summary.json was changed since the run ended"


def test_a_compressed_table_is_judged_by_what_it_holds(run):
    table = run / "episodes.csv"
    packed = run / "episodes.csv.gz"
    packed.write_bytes(gzip.compress(table.read_bytes()))
    table.unlink()
    assert found(run) == []
    data = packed.read_bytes()
    for other, said in (
        (gzip.compress(b"another"), "was changed"),
        (data[:-9], "cannot be read"),
        (b"no gzip", "Not a gzipped file"),
        # What grows to ten thousand times its size is not unpacked to its end.
        (gzip.compress(bytes(1 << 27)), "was changed"),
    ):
        packed.write_bytes(other)
        assert said in found(run)[0]


def test_older_runs_have_nothing_to_be_judged_by(run):
    (run / "summary.json").write_text(json.dumps(SUMMARY))
    (run / "episodes.csv").write_text("x")
    assert found(run) == []
    assert RunDir(run).is_complete()


@pytest.mark.parametrize("name", SEALED_FILES)
def test_a_changed_run_is_refused_in_one_line(name, tmp_path):
    run = make_run(tmp_path / "seed_1")
    for table in SEALED_FILES[1:]:
        (run / table).write_text("global_step\n1\n")
    seal(run, {"status": "complete"})
    load_run(run)
    flip(run / name, 5, b"x")
    with pytest.raises(ConfigError, match=f"a finished run, but {name} was changed .* or type force=true to run it"):
        load_run(run)


def test_a_seal_needs_no_certain_order_and_no_certain_layout(run):
    content = json.loads((run / "summary.json").read_text())
    assert changes(run, dict(reversed(content.items()))) == {}
    assert sealed({**SUMMARY}, content["files"])["sha256"] == content["sha256"]


@pytest.mark.parametrize("name", SEALED_FILES)
def test_a_sweep_and_its_status_say_what_was_changed(name, tmp_path):
    overrides = [f"output_dir={tmp_path}", "experiment=A0"]
    spec = specify(parse(compose_config(overrides)))
    run_dir = RunDir(spec.directory)
    run_dir.path.mkdir(parents=True)
    run_dir.start(spec.settings)
    for table in SEALED_FILES[1:]:
        (run_dir.path / table).write_text("global_step\n1\n")
    seal(run_dir.path, {"status": "complete", "global_step": 1, "steps_per_second": 1.0})
    assert view_run(run_dir.path, "A0", 1).state == "complete"
    assert make_plan(expand([overrides])).missing == []
    flip(run_dir.path / name, 3, b"x")
    seen = view_run(run_dir.path, "A0", 1)
    assert (seen.state, f"it ended, but {name} was changed since" in seen.reason) == ("failed", True)
    with pytest.raises(ConfigError, match=f"{run_dir.path}: a finished run, but {name} was changed since"):
        make_plan(expand([overrides]))
    assert len(make_plan(expand([[*overrides, "force=true"]])).missing) == 1


def test_settings_that_are_gone_do_not_make_a_finished_run_one_that_is_to_be_begun(tmp_path):
    overrides = [f"output_dir={tmp_path}", "experiment=A0"]
    spec = specify(parse(compose_config(overrides)))
    run_dir = RunDir(spec.directory)
    run_dir.path.mkdir(parents=True)
    run_dir.start(spec.settings)
    for table in SEALED_FILES[1:]:
        (run_dir.path / table).write_text("global_step\n1\n")
    seal(run_dir.path, {"status": "complete"})
    run_dir.config_file.unlink()
    with pytest.raises(ConfigError, match=r"config\.yaml is missing"):
        holds_run(run_dir, spec.config)
