"""The whole analysis of groups with names of every kind; a results folder that is written whole or not at all."""

from __future__ import annotations

import csv
import os
import random
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote_to_bytes

import numpy as np
import pytest
import yaml
from analysis_runs import csv_text, rows_reaching, write_run
from PIL import Image

from acmr.names import archive_keys, csv_cell, distinct, latex, markdown
from analysis.cli import main
from analysis.report import write
from analysis.report.folder import new_results
from sweeps.status import main as status

#: Pieces of names; each means something to one of the places where names are shown.
PIECES = [
    *(
        b"a",
        b"q_lr=1e-05",
        b"_",
        b"$",
        b"\\",
        b"|",
        b"#1",
        b"?",
        b"%20",
        b"&amp;",
        b"<b>",
        b"{",
        b"}",
        b"^",
        b"~",
        b"*",
    ),
    *(
        b" ",
        b"\n",
        b"\t",
        b"\x1b[31m",
        b"\x9b",
        b"\xff",
        b"'",
        b'"',
        b"`",
        b"[x]",
        b"(y)",
        b":",
        b";",
        b",",
        b"=",
        b"-",
    ),
    *("é".encode(), "中文".encode(), "\u202e".encode(), "\u200b".encode(), "\U0001f600".encode(), b"[bold]", b".npy"),
]
CHOSEN = [
    b"a$b_$",
    b"x#1?",
    b"a|b",
    b"_old",
    b"file",
    b"allow_pickle",
    b"setting",
    b"group",
    b"a\nb",
    b"a\\nb",
    b"<img src=x onerror=alert(1)>",
    b"caf\xe9",
    b"=1+1",
    b"x",
    b"x.npy",
]


def names_of(seed: int) -> list[bytes]:
    if seed == 0:
        return CHOSEN
    drawn = random.Random(seed)
    names = {b"".join(drawn.choices(PIECES, k=drawn.randint(1, 6))) for _ in range(9)}
    return sorted(name for name in names if not name.startswith(b"."))


def write_groups(root: Path, names: list[bytes]) -> None:
    write_run(root, "A0", 1, rows_reaching(8000, 20_000), total=20_000, threads=3)
    for number, name in enumerate(names):
        folder = Path(os.fsdecode(os.path.join(os.fsencode(root), name, b"seed_1")))
        folder.mkdir(parents=True)
        (folder / "episodes.csv").write_text(csv_text(rows_reaching(6000 + 100 * number, 20_000), columns=3))
        (folder / "config.yaml").write_text(yaml.safe_dump({"seed": 1, "threads": number + 5}))
        (folder / "summary.json").write_text('{"status": "complete"}' if number % 4 else '{"status": "odd"}')


class Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.links += [value for key, value in attrs if key == "href"]

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.slow
def test_names_of_every_kind_go_through_the_whole_analysis(tmp_path, capsys, recwarn, seed):
    root, out = tmp_path / "runs", tmp_path / "results"
    names = names_of(seed)
    write_groups(root, names)
    assert main([str(root), "--out", str(out), "--no-stills", "--format", "png"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert all(line.isprintable() for line in said.out.split("\n"))
    assert [str(warning.message) for warning in recwarn] == []
    # In the order of the runs' folders, for of two names that look alike the second is changed.
    shown = distinct(sorted(map(os.fsdecode, names)))
    groups = ["A0", *shown.values()]

    page = Page()
    content = (out / "report.html").read_bytes().decode()
    page.feed(content)
    assert all(line.isprintable() for line in content.split("\n"))
    assert not page.tags & {"b>", "bold"}
    assert all(group in page.text for group in groups)
    places = [link for link in page.links if not link.startswith(("#", "data:"))]
    assert len(places) > 4 * len(groups)
    assert all(os.path.exists(os.path.join(os.fsencode(out), unquote_to_bytes(link))) for link in places)

    with np.load(out / "scores.npz") as arrays:
        counted = [shown[os.fsdecode(name)] for number, name in enumerate(names) if number % 4]
        assert set(arrays) == {"A0", *archive_keys(counted).values()}
        assert all(arrays[key].shape == (1, 1) for key in arrays)
    with (out / "cells.csv").open(newline="") as file:
        assert {row["group"] for row in csv.DictReader(file)} == {csv_cell(group) for group in groups}
    lines = (out / "cells.md").read_text().splitlines()
    assert len(lines) == len(groups) + 2
    assert len({len(re.findall(r"(?<!\\)(?:\\\\)*\|", line)) for line in lines}) == 1
    assert all(any(line.startswith(f"| {markdown(group).strip()} ") for line in lines) for group in groups)
    tex = (out / "cells.tex").read_text()
    assert all(f"\n{latex(group)} & " in tex for group in groups)
    for figure in ("steps_per_seed", "differences", "learning_curves", "kaplan_meier"):
        with Image.open(out / f"{figure}.png") as image:
            assert np.asarray(image.convert("L")).std() > 5
    assert main([str(root), "--out", str(out), "--no-stills", "--format", "png", "--if-changed"]) == 0
    assert "nothing has changed" in capsys.readouterr().out
    assert status([str(tmp_path)]) == 0
    assert all(line.isprintable() for line in capsys.readouterr().out.split("\n"))


def test_a_group_that_the_reference_is_not_is_named_on_one_line(tmp_path, capsys):
    write_groups(tmp_path, [b"a\nb", b"\x1b[2J"])
    assert main([str(tmp_path), "--summary", "--reference", "x\ny"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.strip().isprintable()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    write_run(folder / "runs", "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    line = [str(folder / "runs"), "--out", str(folder / "results" / "runs"), "--no-stills", "--format", "svg"]
    assert main(line) == 0
    return folder


@pytest.fixture
def results(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Results, and a file and a folder of the user's among them."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    (tmp_path / "results" / "runs" / "notes.md").write_text("mine")
    (tmp_path / "results" / "runs" / "A0" / "seed_1").mkdir(parents=True)
    write_run(tmp_path / "runs", "A0", 2, rows_reaching(7000, 20_000), total=20_000)
    return tmp_path / "results" / "runs"


def contents(folder: Path) -> dict[str, bytes | None]:
    paths = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in paths}


@pytest.mark.parametrize(
    ("step", "error"),
    [
        ("_write_tables", OSError(28, "No space left on device")),
        ("_write_arrays", KeyboardInterrupt()),
        ("_write_figures", KeyboardInterrupt()),
        ("write_report", ValueError("x")),
    ],
)
@pytest.mark.first_is_fast
def test_a_failure_leaves_the_earlier_results(results, monkeypatch, capsys, step, error):
    def fail(*arguments):
        raise error

    before = contents(results)
    monkeypatch.setattr(write, step, fail)
    if isinstance(error, ValueError):
        with pytest.raises(ValueError, match="x"):
            main(["runs", "--no-stills", "--format", "svg"])
    else:
        assert main(["runs", "--no-stills", "--format", "svg"]) in (2, 130)
    assert contents(results) == before
    # Nor is there a folder where there was none.
    if isinstance(error, OSError):
        assert main(["runs", "--out", "fresh", "--no-stills"]) == 2
        assert not Path("fresh").exists()
    monkeypatch.undo()


@pytest.mark.slow
def test_new_results_take_the_places_of_earlier_ones_and_leave_what_is_not_theirs(results):
    before = contents(results)
    (results / "comparisons.csv").write_text("of a group that is gone")
    (results / "figure_2.png").write_bytes(b"made where there is a GL library")
    assert main(["runs", "--no-stills", "--format", "png"]) == 0
    after = contents(results)
    assert {"notes.md", "A0/seed_1", "figure_2.png"} <= after.keys()
    assert "comparisons.csv" not in after
    assert "figure_4.svg" in before
    assert "figure_4.svg" not in after
    assert not [name for name in after if name.startswith(".unfinished")]
    assert after["cells.csv"] != before["cells.csv"]


@pytest.mark.parametrize("name", ["report.html", "scores.npz", "colorblind/figure_4.svg"])
def test_a_folder_of_the_users_is_not_replaced(tmp_path, name):
    (tmp_path / name / "of the user's").mkdir(parents=True)
    (tmp_path / "cells.csv").write_text("earlier")
    before = contents(tmp_path)
    results = new_results(tmp_path, [])
    folder = results.__enter__()
    for new in ("cells.csv", name):
        (folder / new).parent.mkdir(exist_ok=True)
        (folder / new).write_text("new")
    with pytest.raises(IsADirectoryError, match=name):
        results.__exit__(None, None, None)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("moves", range(1, 9))
def test_an_end_between_any_two_moves_is_undone(tmp_path, monkeypatch, moves):
    out, done = tmp_path / "out", []
    out.mkdir()
    for name in ("a", "b", "gone"):
        (out / name).write_text("old")
    before, replace = contents(out), os.replace

    def replace_or_end(source, target):
        done.append(target)
        if len(done) == moves:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", replace_or_end)
    try:
        with new_results(out, ["gone"]) as folder:
            for name in ("a", "b", "c"):
                (folder / name).write_text("new")
    except KeyboardInterrupt:
        assert contents(out) == before
    else:
        assert contents(out) == dict.fromkeys(("a", "b", "c"), b"new")
        assert moves > 6


def test_the_results_folder_may_be_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").symlink_to("elsewhere")
    with new_results(tmp_path / "out", []) as folder:
        (folder / "cells.csv").write_text("new")
    assert contents(tmp_path / "elsewhere") == {"cells.csv": b"new"}
