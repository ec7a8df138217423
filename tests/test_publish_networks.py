"""The networks that are published with a run: in full or in half precision, to be evaluated and learned from."""

from __future__ import annotations

import contextlib
import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from analysis_runs import rows_reaching, run_directory, write_cut, write_run
from finished_run import ANT, make_run, result

from acmr.config import ConfigError
from acmr.evaluation.cli import main as evaluate
from acmr.transfer.half import main as halve
from acmr.transfer.teacher import load_teacher, save_halved
from analysis import publish as publishing
from analysis.publish import Published, PublishError, publish

pytestmark = pytest.mark.slow

SMALL, WIDE = 32, 300


def with_networks(folder: Path, tmp_path: Path, width: int = SMALL) -> Path:
    """Lays real networks into the directory of a run."""
    made = make_run(tmp_path / f"networks-{len(list(tmp_path.iterdir()))}", width=width)
    for name in ("teacher.safetensors", "teacher.json"):
        shutil.copy(made / name, folder / name)
    return folder


def lay_out(tmp_path: Path) -> Path:
    """A teacher and a student that are large, a student that is small, one that stopped, one that diverged."""
    root, rows, env = tmp_path / "runs" / "quick", rows_reaching(8000, 20_000), asdict(ANT)
    for cell, width in (("H0", WIDE), ("A0", WIDE), ("A1", SMALL)):
        folder = write_run(root, cell, 1, rows, total=20_000, profile="quick", env=env)
        with_networks(folder, tmp_path, width)
    with_networks(write_cut(root, "A2", 1, rows, 20_000, profile="quick", env=env), tmp_path)
    diverged = {"status": "diverged", "step": 9000}
    with_networks(write_run(root, "A3", 1, rows, total=20_000, profile="quick", env=env, summary=diverged), tmp_path)
    return root


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return lay_out(tmp_path)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Published, list[str]]:
    """Runs, the folder they were published to from its parent, what came of it, and what was said meanwhile."""
    folder, said = tmp_path_factory.mktemp("published"), []
    runs = lay_out(folder)
    with contextlib.chdir(folder):
        return runs, folder / "results" / "quick", publish(runs, Path("results/quick"), say=said.append), said


def published(out: Path, cell: str, **stop: object) -> Path:
    return run_directory(out, cell, 1, "quick", **stop)


def precision_of(folder: Path) -> str:
    return load_teacher(folder).description.precision


def test_networks_are_published_in_full_if_they_are_small_or_teach_and_else_in_half(done):
    runs, out, what, said = done
    assert (len(what.added), what.there, what.left_out, len(said)) == (5, [], [], 4)
    for cell in ("H0", "A1"):
        for name in ("teacher.safetensors", "teacher.json"):
            assert (published(out, cell) / name).read_bytes() == (published(runs, cell) / name).read_bytes()
    assert (published(runs, "H0") / "teacher.safetensors").stat().st_size > publishing.LARGE
    full, half = load_teacher(published(runs, "A0")), load_teacher(published(out, "A0"))
    assert (half.description.precision, half.description.full_sha256) == ("float16", full.description.sha256)
    assert half.description.sha256 != full.description.sha256
    sizes = [teacher.path.stat().st_size for teacher in (half, full)]
    assert sizes[0] < 0.51 * sizes[1]
    for name, tensor in full.tensors.items():
        assert half.tensors[name].dtype == torch.float32
        assert torch.equal(half.tensors[name], tensor.half().float())
    # What only the description says of a run stays.
    assert half.description.config == full.description.config
    assert not (published(out, "A3") / "teacher.safetensors").exists()


def test_each_policy_is_evaluated_as_it_is_published(done):
    out = done[1]
    for folder in (*(published(out, cell) for cell in ("H0", "A0", "A1")), published(out, "A2", stop="threshold")):
        content = result(folder)
        assert (content["policy"], content["episodes"], content["run"]) == (
            "deterministic",
            20,
            f"results/quick/{folder.relative_to(out)}",
        )
        assert [episode["seed"] for episode in content["each"]] == list(range(20))
        assert content["sha256"] == load_teacher(folder).description.sha256
        assert (
            content["precision"] == precision_of(folder) == ("float16" if folder == published(out, "A0") else "float32")
        )
        assert content["fall_rate"] == sum(episode["terminated"] for episode in content["each"]) / 20
        assert content["mean_forward_velocity"] is not None
    assert not (published(out, "A3") / "evaluation.json").exists()


def test_what_is_there_is_neither_made_again_nor_touched(runs, tmp_path):
    out, said = tmp_path / "results" / "quick", []
    publish(runs, out)
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.rglob("*") if path.is_file()}
    done = publish(runs, out, say=said.append)
    assert (done.added, len(done.there), said) == ([], 5, [])
    (published(out, "A1") / "evaluation.json").unlink()
    done = publish(runs, out, say=said.append)
    assert (done.added, len(said)) == ([published(out, "A1")], 1)
    after = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in before}
    assert {path for path in before if before[path] != after[path]} == {published(out, "A1") / "evaluation.json"}
    assert (
        before[published(out, "A1") / "evaluation.json"][0] == (published(out, "A1") / "evaluation.json").read_bytes()
    )


@pytest.mark.parametrize(
    ("arguments", "taken"),
    [(["--episodes", "20"], True), (["--episodes", "3"], False), (["--episodes", "20", "--stochastic"], False)],
)
@pytest.mark.first_is_fast
def test_an_evaluation_that_a_run_has_is_taken_if_it_is_the_one_that_is_wanted(runs, tmp_path, arguments, taken):
    said: list[str] = []
    assert evaluate([str(published(runs, "A1")), *arguments]) == 0
    (published(runs, "H0") / "evaluation.json").write_text("{")
    own = published(runs, "A1").parent
    done = publish(own, tmp_path / "out", say=said.append)
    assert (len(done.added), len(said)) == (1, 0 if taken else 1)
    assert (result(done.added[0]) == result(published(runs, "A1"))) == taken


def test_networks_are_added_to_a_run_that_was_published_without(runs, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(published(runs, "A0"), published(out, "A0"))
    for name in ("teacher.safetensors", "teacher.json", "run.log"):
        (published(out, "A0") / name).unlink()
    done = publish(published(runs, "A0").parent, published(out, "A0").parent)
    assert done.added == [published(out, "A0")]
    assert precision_of(published(out, "A0")) == "float16"


def test_other_networks_of_a_run_are_not_overwritten(runs, tmp_path):
    out, own = tmp_path / "out", published(runs, "A0").parent
    publish(own, published(out, "A0").parent)
    with_networks(published(runs, "A0"), tmp_path, WIDE + 1)
    before = (published(out, "A0") / "teacher.json").read_bytes()
    with pytest.raises(PublishError, match=r"teacher.safetensors, teacher.json of another run there; remove"):
        publish(own, published(out, "A0").parent)
    assert (published(out, "A0") / "teacher.json").read_bytes() == before


def test_what_would_be_too_large_for_a_clone_is_refused_before_anything_is_written(runs, tmp_path, monkeypatch, capsys):
    out = tmp_path / "results" / "quick"
    other = tmp_path / "results" / "paper" / "x" / "seed_1"
    other.mkdir(parents=True)
    (other / "episodes.csv").write_bytes(bytes(59_000_000))
    # Figures beside the runs are not committed.
    (tmp_path / "results" / "paper" / "figure_4.png").write_bytes(bytes(59_000_000))
    monkeypatch.setattr("sys.argv", ["analysis.publish", str(runs), str(out)])
    assert publishing.main() == 2
    said = capsys.readouterr().err
    assert "results: would hold 6" in said
    assert "60.0 MB are the most" in said
    assert said.count("\n") == 1
    assert not out.exists()
    (other / "episodes.csv").write_bytes(bytes(50_000_000))
    assert len(publish(published(runs, "A1").parent, out).added) == 1


def test_networks_that_cannot_be_evaluated_are_named_and_the_rest_is_published(runs, tmp_path, capsys, monkeypatch):
    path = published(runs, "A1") / "teacher.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    monkeypatch.setattr("sys.argv", ["analysis.publish", str(runs), str(tmp_path / "out")])
    assert publishing.main() == 0
    said = capsys.readouterr().out
    assert f"no evaluation.json in {published(tmp_path / 'out', 'A1')}: " in said
    assert "damaged or exchanged" in said
    assert (published(tmp_path / "out", "A2", stop="threshold") / "evaluation.json").exists()


def test_damaged_networks_cannot_be_halved(runs, tmp_path):
    path = published(runs, "A0") / "teacher.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(PublishError, match=r"^[^\n]*damaged or exchanged[^\n]*$"):
        publish(runs, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def spoil(folder: Path, **entries: object) -> None:
    path = folder / "teacher.json"
    content = json.loads(path.read_text()) | entries
    del content["description_sha256"]
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"precision": "float32"}, "not of the precision that teacher.json says"),
        ({"precision": "int8"}, "entries precision are not what"),
        ({"full_sha256": 3}, "entries full_sha256 are not what"),
    ],
)
def test_a_file_of_another_precision_than_it_says_is_refused(tmp_path, entries, said):
    save_halved(tmp_path, load_teacher(make_run(tmp_path / "run")))
    spoil(tmp_path, **entries)
    with pytest.raises(ConfigError, match=said):
        load_teacher(tmp_path)


def test_half_of_a_half_is_the_same_and_what_does_not_fit_is_refused(tmp_path, monkeypatch, capsys):
    run = make_run(tmp_path / "run")
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    save_halved(tmp_path / "one", load_teacher(run))
    save_halved(tmp_path / "two", load_teacher(tmp_path / "one"))
    assert [(tmp_path / "two" / name).read_bytes() for name in ("teacher.safetensors", "teacher.json")] == [
        (tmp_path / "one" / name).read_bytes() for name in ("teacher.safetensors", "teacher.json")
    ]
    teacher = load_teacher(run)
    next(iter(teacher.tensors.values()))[0] = 1e6
    with pytest.raises(ConfigError, match="holds numbers that half precision does not; keep it in full"):
        save_halved(tmp_path / "two", teacher)
    monkeypatch.setattr("sys.argv", ["half", str(tmp_path / "nowhere"), str(tmp_path)])
    assert halve() == 2
    assert capsys.readouterr().err.startswith("error: ")
