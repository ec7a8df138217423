"""Rows of cells: consistent, and followed by run names, the analysis and its tables, also where a cell is one's own."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from analysis_runs import csv_text, rows_reaching, run_directory, write_matrix, write_run
from matplotlib.colors import is_color_like
from matplotlib.markers import MarkerStyle
from statsmodels.stats.multitest import multipletests

from acmr import cells
from acmr.cells import CELLS, SOURCE, TARGET, Cell, cell_of, planned_cells, run_name
from acmr.settings.compose import compose_config, parse
from acmr.settings.run_spec import RunSpec, specify
from analysis.analyze import Analysis, analyze
from analysis.figures.style import PALETTES
from analysis.loading.load import load
from analysis.loading.missing import matrix_command, missing_runs
from analysis.loading.setting_differences import setting_differences
from analysis.report.prose import about_n, caveats
from analysis.report.stamp import fingerprint
from analysis.statistics.summaries import table1, table2, transfer_table

PAPER = [cell.name for cell in CELLS.values() if cell.published]
TOTAL = 20_000
TIMES = {
    "A0": (8000, 9900, 9000),
    "A1": (8100, 9200, 9000),
    "A2": (6000, 6300, 5900),
    "A3": (5500, 6000, 6200),
    "A4": (12_000, 13_000, 16_000),
    "B1": (4000, 4500, 4100),
}


@pytest.fixture
def mine(monkeypatch) -> Cell:
    """A cell of one's own: A2 with another learning rate."""
    cell = Cell("B1", TARGET, "hidden", True, "Own", "A0", "transfer", "pink", "*", {"agent.q_lr": 3e-4})
    monkeypatch.setitem(CELLS, cell.name, cell)
    return cell


def spec(*overrides: str) -> RunSpec:
    return specify(parse(compose_config(overrides)))


def analysis_of(root: Path, **options) -> Analysis:
    write_matrix(root, TIMES, total=TOTAL, length=100)
    return analyze(load(root), **options)


def only(root: Path) -> dict:
    (run,) = load(root).runs.to_dict("records")
    return run


def test_rows_are_consistent():
    meant = [(cell.role, cell.transfer, cell.freeze, dict(cell.changes)) for cell in CELLS.values()]
    for name, cell in CELLS.items():
        assert name == cell.name
        assert cell.role in (SOURCE, TARGET)
        assert cell.baseline is None or (cell.baseline in CELLS and cell.baseline != name)
        assert cell.baseline or not cell.family, "a family adjusts comparisons, and it is compared with nothing"
        assert meant.count((cell.role, cell.transfer, cell.freeze, dict(cell.changes))) == 1
        assert all(is_color_like(palette.color(name, [])) for palette in PALETTES)
        assert MarkerStyle(cell.marker)
    for look in ("color", "marker"):
        assert len({getattr(cell, look) for cell in CELLS.values()}) == len(CELLS)
    assert len({name.lower() for name in CELLS}) == len(CELLS)


def test_the_papers_cells_come_first_and_one_of_them_teaches():
    assert [*CELLS][: len(PAPER)] == PAPER == ["H0", "H1", "A0", "A1", "A2", "A3", "A4"]
    assert [cell.name for cell in CELLS.values() if cell.teaches] == ["H0"]


def test_a_run_with_a_cells_settings_is_its_run_however_they_were_said(mine):
    parts = ("transfer=hidden", "freeze=true", "agent.q_lr=3e-4")
    assert spec(*parts).cell == "B1"
    assert spec(*parts, "stop=threshold", "stop_after=9", "seed=7").cell == "B1"
    assert spec(*parts).name == run_name("armless_humanoid", "hidden", True, mine.changes)
    # The paper's own value is no change, and one change more is another experiment.
    assert spec("transfer=hidden", "freeze=true", "agent.q_lr=1e-3").cell == "A2"
    assert spec(*parts, "agent.tau=0.01").cell is None
    assert spec(*parts[1:], "transfer=expand").cell is None
    assert spec(*parts, "env=humanoid").cell is None


def test_lists_are_changes_too(monkeypatch):
    cell = Cell("B2", TARGET, "none", False, "Own", "A0", None, "olive", "*", {"agent.hidden_sizes": [64, 64]})
    monkeypatch.setitem(CELLS, cell.name, cell)
    assert spec("agent.hidden_sizes=[64,64]").cell == "B2"
    assert cell_of(TARGET, "none", False, {"agent.hidden_sizes": [64]}) is None
    assert not cell.teaches
    assert not replace(cell, role=SOURCE).teaches


def unfinished(folder: Path) -> None:
    (folder / "summary.json").unlink()


def before_the_row(folder: Path) -> None:
    summary = json.loads((folder / "summary.json").read_text())
    (folder / "summary.json").write_text(json.dumps(summary | {"cell": None}))


def stopped(folder: Path) -> None:
    unfinished(folder)
    folder.parent.rename(folder.parent.with_name(f"{folder.parent.name}-stop=threshold-stop_after=900"))


def foreign(folder: Path) -> None:
    unfinished(folder)
    (folder / "config.yaml").unlink()


def by_name(folder: Path) -> None:
    foreign(folder)
    folder.parent.rename(folder.parent.with_name("b1"))


def by_name_with_settings(folder: Path) -> None:
    unfinished(folder)
    folder.parent.rename(folder.parent.with_name("B1"))


@pytest.mark.parametrize("change", [None, unfinished, before_the_row, stopped, foreign, by_name, by_name_with_settings])
def test_runs_of_an_own_cell_are_known_again(mine, change, tmp_path):
    folder = write_run(tmp_path, "B1", 1, rows_reaching(6000, TOTAL), total=TOTAL)
    if change:
        change(folder)
    assert (only(tmp_path)["cell"], only(tmp_path)["group"]) == ("B1", "B1")


def test_a_run_that_only_says_it_is_the_cell_is_not(mine, tmp_path):
    agent = {"q_lr": 0.5, "learning_starts": 100}
    folder = write_run(tmp_path, "B1", 1, rows_reaching(6000, TOTAL), total=TOTAL, agent=agent)
    folder.parent.rename(folder.parent.with_name("armless_humanoid-hidden-frozen-q_lr=0.5"))
    assert only(tmp_path)["cell"] is None
    assert only(tmp_path)["group"] == "armless_humanoid-hidden-frozen-q_lr=0.5"


def test_settings_that_are_cut_off_leave_it_to_the_directory_s_name(tmp_path):
    folder = write_run(tmp_path, "A2", 1, rows_reaching(6000, TOTAL), total=TOTAL, summary={"cell": ["A2"]})
    stored = yaml.safe_load((folder / "config.yaml").read_text())
    (folder / "config.yaml").write_text(yaml.safe_dump(stored | {"env": []}))
    assert only(tmp_path)["cell"] == "A2"
    assert "config.yaml is cut off, it has no env" in only(tmp_path)["doubts"]


@pytest.mark.parametrize("odd", [{"pair": {"source": ["a"], "target": 3}}, {"transfer": {"name": {}}}])
def test_settings_of_any_shape_are_no_cell(odd, tmp_path):
    folder = write_run(tmp_path, "A2", 1, rows_reaching(6000, TOTAL), total=TOTAL, summary={"cell": ["A2"]})
    stored = yaml.safe_load((folder / "config.yaml").read_text())
    (folder / "config.yaml").write_text(yaml.safe_dump(stored | odd))
    assert only(tmp_path)["cell"] is None


@pytest.mark.slow
def test_an_own_cell_is_planned_where_it_has_runs(mine, tmp_path):
    assert [cell.name for cell in planned_cells([])] == PAPER
    write_run(tmp_path, "A0", 1, rows_reaching(6000, TOTAL), total=TOTAL)
    assert not [run for run in missing_runs(load(tmp_path)) if run.cell == "B1"]
    write_run(tmp_path, "B1", 2, rows_reaching(6000, TOTAL), total=TOTAL)
    data = load(tmp_path)
    assert [run.command for run in missing_runs(data) if run.cell == "B1"] == [
        "python run.py experiment=B1 seed=1",
        "python run.py experiment=B1 seed=3",
    ]
    assert matrix_command(data) == "python run.py matrix=paper experiment=H0,H1,A0,A1,A2,A3,A4,B1"
    assert analyze(data).planned_runs == 24
    assert table2(data).set_index("Experiment").loc["B1", ["settings", "runs"]].tolist() == ["agent.q_lr=0.0003", 1]
    assert table1().to_numpy().tolist() == [["No", "Conf. 1", "Conf. 3"], ["Yes", "Conf. 2", "Conf. 4"]]


def test_an_own_cell_is_compared_with_its_baseline_in_its_family(mine, tmp_path):
    analysis = analysis_of(tmp_path)
    table = analysis.table3.set_index("index")
    assert [*table.index] == ["A1", "A2", "A3", "A4", "B1", "H0", "H1"]
    assert table.loc["B1", "reference"] == "A0"
    family = ["A1", "A2", "A3", "A4", "B1"]
    adjusted = multipletests(table.loc[family, "p_value"], method="holm")[1]
    assert table.loc[family, "p_holm"].tolist() == pytest.approx(adjusted.tolist())
    assert len(analysis.others) == 0
    transfer = transfer_table(analysis.measured, analysis.data.groups).set_index("group")
    assert transfer.loc["B1", "baseline"] == "A0"
    assert "A1, A2, A3, A4, B1 answer one question five times" in " ".join(caveats(1.0, analysis.data.cells))
    assert "over 5 comparisons" in about_n(analysis.table3, analysis.data.cells)[-1]


@pytest.mark.slow
def test_another_baseline_and_a_family_of_its_own(mine, monkeypatch, tmp_path):
    monkeypatch.setitem(CELLS, "B1", replace(mine, baseline="A2", family="rates"))
    analysis = analysis_of(tmp_path)
    table = analysis.table3.set_index("index")
    assert table.loc["B1", "reference"] == "A2"
    assert table.loc["B1", "p_holm"] == table.loc["B1", "p_value"]
    family = ["A1", "A2", "A3", "A4"]
    adjusted = multipletests(table.loc[family, "p_value"], method="holm")[1]
    assert table.loc[family, "p_holm"].tolist() == pytest.approx(adjusted.tolist())
    transfer = transfer_table(analysis.measured, analysis.data.groups).set_index("group")
    assert transfer.loc["B1", "baseline"] == "A2"
    # Another reference takes A0's place, and no other's.
    again = analyze(load(tmp_path), reference="B1").table3
    assert list(zip(again["reference"], again["index"], strict=True)) == [
        *(("B1", cell) for cell in ("A0", *family)), ("A2", "B1"), ("B1", "H0"), ("H0", "H1"),
    ]  # fmt: skip


def test_returns_are_measured_against_a_baseline_in_the_same_environment_only(tmp_path):
    write_matrix(tmp_path, {"H0": (9000,), "H1": (2000,), "A0": (8000,)}, total=TOTAL, length=100)
    analysis = analyze(load(tmp_path))
    transfer = transfer_table(analysis.measured, analysis.data.groups).set_index("group")
    assert transfer["baseline"].to_dict() == {"H0": "", "H1": "H0", "A0": ""}
    assert math.isnan(transfer.loc["H0", "jumpstart"])


def test_what_defines_an_own_cell_is_no_difference_to_explain(mine, tmp_path):
    for cell in ("A2", "B1"):
        write_run(tmp_path, cell, 1, rows_reaching(6000, TOTAL), total=TOTAL)
    defining, differing = setting_differences(load(tmp_path))
    assert defining["setting"].tolist() == ["agent.q_lr"]
    assert differing.empty


def test_a_foreign_directory_may_have_any_cells_name(mine, tmp_path):
    folder = tmp_path / "ant_three_legs-hidden-frozen-q_lr=0.0003" / "seed_1"
    folder.mkdir(parents=True)
    (folder / "episodes.csv").write_text(csv_text(rows_reaching(6000, TOTAL), columns=3))
    assert only(tmp_path)["cell"] == "B1"
    assert run_directory(tmp_path, "B1", 1, "quick") == folder


def test_results_are_made_again_for_another_row(monkeypatch, tmp_path):
    rows = tmp_path / "ground" / "cells.py"
    rows.parent.mkdir()
    rows.write_text(Path(cells.__file__).read_text())
    monkeypatch.setattr(cells, "__file__", str(rows))
    data = load(tmp_path)
    before = fingerprint(data, tmp_path, {})
    assert fingerprint(data, tmp_path, {}) == before
    rows.write_text(rows.read_text().replace('"Conf. 4"', '"Conf. 5"'))
    assert fingerprint(data, tmp_path, {}) != before
