"""The figures: nothing overlaps or leaves the page, captions name what is drawn, colors stay, one run is no test."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from analysis_runs import (
    csv_text,
    realistic_rows,
    rows_reaching,
    write_cut,
    write_matrix,
    write_run,
    write_under_way,
)
from matplotlib.axis import Axis
from matplotlib.colors import same_color
from matplotlib.figure import Figure
from matplotlib.text import Text

from analysis.analyze import analyze
from analysis.figures.data import FigureData, FigureSpec
from analysis.figures.paper import FIGURES
from analysis.figures.style import PALETTES, apply
from analysis.loading.load import load
from analysis.report.write import figure_data

TOTAL = 20_000
#: Shares of the run after which a cell has learned half.
HALF = {"H0": 0.4, "H1": 0.1, "A0": 0.35, "A1": 0.3, "A2": 0.25, "A3": 0.2, "A4": 0.9}
LONG = "armless_humanoid-hidden-q_lr=0.0001-batch_size=512-learning_starts=1000"
SPECS = {spec.name: spec for spec in FIGURES}


def write_hard(root: Path) -> None:
    """What makes figures hard: many runs, one, stopped and biased cells, one that never learns, long names."""
    for cell, share in HALF.items():
        for seed in range(1, {"A0": 13, "H1": 2}.get(cell, 4)):
            rng = np.random.default_rng([seed, ord(cell[1]), ord(cell[0])])
            rows = realistic_rows(rng, TOTAL, share * TOTAL * (1 + 0.06 * rng.standard_normal()), noise=0.05)
            if cell == "A4":
                rows[:, 1] *= 0.2
            if cell == "A3" and seed == 3:
                write_under_way(root, cell, seed, 2000, TOTAL)
            elif cell == "A3" or (cell == "A1" and seed > 1):
                write_cut(root, cell, seed, rows, TOTAL)
            else:
                write_run(root, cell, seed, rows, total=TOTAL)
    for name, seed in itertools.product((LONG, "humanoid-none-tau=0.01"), (1, 2)):
        (root / name / f"seed_{seed}").mkdir(parents=True)
        rows = realistic_rows(np.random.default_rng(seed), TOTAL, 6000)
        (root / name / f"seed_{seed}" / "episodes.csv").write_text(csv_text(rows, columns=3))


def write_few(root: Path) -> None:
    write_matrix(root, {"H0": (9000,), "A0": (8000, 8500), "A2": (6000,)}, total=TOTAL, length=100)


def write_three(root: Path) -> None:
    write_matrix(root, {"A0": (8000, 8500, 8100), "A2": (6000, None, 7000)}, total=TOTAL, length=100)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FigureData]:
    found = {}
    for name, write in (("hard", write_hard), ("few", write_few), ("three", write_three)):
        root = tmp_path_factory.mktemp(name)
        write(root)
        found[name] = drawing(root)
    return found


@pytest.fixture(params=["hard", "few", "three"])
def data(request: pytest.FixtureRequest, folders: dict[str, FigureData]) -> FigureData:
    return folders[request.param]


def drawing(root: Path) -> FigureData:
    apply()
    return figure_data(analyze(load(root)))


def texts(figure: Figure) -> Iterator[Text]:
    """Every text that is drawn; of tick labels those within the axis."""
    figure.draw_without_rendering()
    hidden = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            hidden |= set(outside(axis)) if axes.axison else set(axis.findobj(Text))
    for text in figure.findobj(Text):
        there = text.axes is None or text.axes.get_visible()
        if there and text.get_visible() and text.get_text().strip() and text not in hidden:
            yield text


def outside(axis: Axis) -> Iterator[Text]:
    low, high = sorted(axis.get_view_interval())
    room = 1e-6 * (high - low)
    for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
        if not low - room <= tick.get_loc() <= high + room:
            yield from (tick.label1, tick.label2)


@pytest.mark.parametrize("palette", PALETTES, ids=lambda palette: palette.name)
@pytest.mark.parametrize("spec", FIGURES, ids=lambda spec: spec.name)
@pytest.mark.first_is_fast
def test_no_text_overlaps_another_or_leaves_the_figure(data: FigureData, spec: FigureSpec, palette):
    figure = spec.draw(data, palette)
    if figure is None:
        return
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts(figure)]
    page = figure.bbox
    plt.close(figure)
    assert len(boxes) > 3
    for said, box in boxes:
        within = page.x0 - 1 <= box.x0 and box.x1 <= page.x1 + 1 and page.y0 - 1 <= box.y0 and box.y1 <= page.y1 + 1
        assert within, f"{said!r} leaves the figure"
    for (one, first), (other, second) in itertools.combinations(boxes, 2):
        wide = min(first.x1, second.x1) - max(first.x0, second.x0)
        high = min(first.y1, second.y1) - max(first.y0, second.y0)
        assert wide < 1 or high < 1, f"{one!r} lies on {other!r}"


@pytest.mark.parametrize("name", ["figure_4", "figure_5", "figure_6"])
def test_a_cell_has_one_color_in_all_figures(data: FigureData, name: str):
    for palette in PALETTES:
        figure = SPECS[name].draw(data, palette)
        if figure is None:
            continue
        drawn = {line.get_label().split(" ")[0].rstrip(","): line.get_color() for line in figure.axes[0].lines}
        cells = [label for label in drawn if label in HALF]
        assert cells
        for cell in cells:
            assert same_color(drawn[cell], palette.color(cell, data.groups)), cell
        plt.close(figure)


def test_captions_name_what_is_drawn(folders):
    hard, few = folders["hard"], folders["few"]
    assert SPECS["figure_4"].said(hard).endswith("Drawn: A0 (12 runs), H0 (3 runs).")
    assert SPECS["figure_6"].said(hard).endswith("Drawn: H0 (3 runs), H1 (1 run).")
    said = SPECS["figure_5"].said(hard)
    assert "A1 (3 runs, 2 stopped at their threshold), A2 (3 runs), A3 (2 runs, 2 stopped" in said
    assert "biased), A4 (3 runs)." in said
    assert "H0" not in said
    assert "A2 − A0, 3 and 12 runs, " in SPECS["differences"].said(hard)
    assert LONG in SPECS["learning_curves"].said(hard)
    assert "A2 − A0" in SPECS["sensitivity"].said(hard)
    assert SPECS["figure_5"].said(few).endswith("Drawn: A0 (2 runs), A2 (1 run).")
    assert SPECS["return_profiles"].said(few).endswith("Drawn: H0 (1 full run), A0 (2 full runs), A2 (1 full run).")


@pytest.mark.slow
def test_a_difference_of_a_single_run_is_not_drawn_like_a_tested_one(tmp_path):
    write_matrix(tmp_path, {"A0": (8000, 8500), "A1": (7000, 7900), "A2": (6000,)}, total=TOTAL, length=100)
    figure = SPECS["differences"].draw(drawing(tmp_path), PALETTES[0])
    marks = {line.get_ydata()[0]: line for line in figure.axes[0].lines if line.get_marker() in ("D", "o")}
    tested, alone = marks[0], marks[1]
    assert tested.get_marker() != alone.get_marker()
    assert alone.get_markerfacecolor() == "white"
    # Two points a line: intervals; only the tested one has one, beside the line at zero.
    intervals = [line.get_ydata()[0] for line in figure.axes[0].lines if len(line.get_xdata()) == 2]
    assert 0 in intervals[:-1]
    assert 1 not in intervals[:-1]
    plt.close(figure)


@pytest.mark.parametrize("sign", [1.0, -1.0, 0.0])
def test_axes_of_returns_begin_at_zero_and_means_have_intervals(tmp_path, sign):
    for seed in (1, 2, 3):
        rows = rows_reaching(8000 + 500 * seed, TOTAL)
        rows[:, 1] = sign * (4000 + 100 * seed) - (1000 if sign == 0 else 0) * (seed - 2)
        write_run(tmp_path, "A0", seed, rows, total=TOTAL)
    figure = SPECS["transfer_metrics"].draw(drawing(tmp_path), PALETTES[0])
    for axes in figure.axes:
        low, high = axes.get_xlim()
        assert low <= 0 <= high
        assert (low == 0) == (sign > 0)
        bars = [line for line in axes.lines if len(line.get_xdata()) == 2]
        assert len(bars) == 1
    plt.close(figure)


@pytest.mark.slow
def test_the_wall_clock_of_stopped_and_full_runs_is_not_averaged(tmp_path):
    for seed in (1, 2, 3):
        write_run(tmp_path, "A0", seed, rows_reaching(8000, TOTAL), total=TOTAL)
        write_cut(tmp_path, "A1", seed, rows_reaching(7000, TOTAL), TOTAL)
    write_run(tmp_path, "A2", 1, rows_reaching(6000, TOTAL), total=TOTAL)
    for seed in (2, 3):
        write_cut(tmp_path, "A2", seed, rows_reaching(6000, TOTAL), TOTAL)
    figure = SPECS["wall_clock"].draw(drawing(tmp_path), PALETTES[0])
    assert len(figure.axes[0].patches) == 2
    plt.close(figure)
