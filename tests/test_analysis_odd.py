"""One odd run among others: it is listed with the reason, and the others are analyzed as if it were not there."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import yaml
from analysis_runs import rows_reaching, run_directory, write_run
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from analysis.analyze import analyze
from analysis.cli import main
from analysis.loading.load import load
from sweeps.estimate import _finished, _speeds
from sweeps.status import main as status

ROWS = rows_reaching(6000, 20_000)
SEED = 123456789012345678901234567890123456789
#: What is odd in one file of a run, and the reason that is given.
SUMMARY = {
    "seed": (SEED, "summary.json: seed is 123456789012… (39 characters), not a whole number from 0 to"),
    "total_timesteps": (1e300, "summary.json: total_timesteps is 1e+300, not a whole number from 0 to 9.0072e+15"),
    "global_step": (math.inf, "summary.json: global_step is inf, not a whole number from 0"),
    "threshold": (math.nan, "summary.json: threshold is nan, not a number from -1e+100 to 1e+100"),
    "consecutive": (0, "summary.json: consecutive is 0, not a whole number from 1"),
    "stop_after": (-5, "summary.json: stop_after is -5, not a whole number from 0"),
    "episodes": (10**400, "summary.json: episodes is 100000000000… (401 characters), not a whole"),
}
CONFIG = {
    "seed": (SEED, "config.yaml: seed is 123456789012…"),
    "total_timesteps": (-(10**30), "config.yaml: total_timesteps is -10000000000… (32 characters), not a whole"),
    "threshold": (-math.inf, "config.yaml: threshold is -inf"),
    "consecutive": (2.5, "config.yaml: consecutive is 2.5, not a whole number from 1"),
    "agent": ({"learning_starts": 1e20}, "config.yaml: agent.learning_starts is 1e+20, not a whole number from 0"),
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for cell in ("A0", "A2"):
        for seed in (1, 2):
            write_run(tmp_path / "runs", cell, seed, ROWS, total=20_000)
    return tmp_path / "runs"


def write_odd(root: Path, cell: str, seed: int, more: dict) -> None:
    """A run with these settings beside or in place of its own."""
    path = write_run(root, cell, seed, ROWS, total=20_000) / "config.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | more))


def check(
    root: Path, reason: str, capsys: pytest.CaptureFixture[str], counted: bool = False, told: bool = False
) -> None:
    """Sees that the run of seed 3 is listed, and that the four others count."""
    runs = load(root).runs
    odd = runs.loc[f"{run_directory(root, 'A0', 3).relative_to(root)}"]
    assert reason in odd["reason"]
    assert (odd["state"], bool(odd["counted"])) == (("complete", True) if counted else ("damaged", False))
    assert int(runs["counted"].sum()) == 4 + counted
    assert main([str(root), "--summary"]) == 0
    said = capsys.readouterr()
    assert (reason in said.out) == (not counted or told)
    assert said.err == ""


@pytest.mark.parametrize("key", SUMMARY)
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_a_number_out_of_range_in_a_summary_is_listed(root, capsys, key):
    value, reason = SUMMARY[key]
    write_run(root, "A0", 3, ROWS, total=20_000, summary={key: value})
    check(root, reason, capsys)


@pytest.mark.parametrize("key", CONFIG)
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_a_number_out_of_range_in_settings_is_listed(root, capsys, key):
    value, reason = CONFIG[key]
    write_odd(root, "A0", 3, {key: value})
    check(root, reason, capsys)


@pytest.mark.parametrize(("key", "value"), [("wall_seconds", -1e300), ("steps_per_second", math.nan)])
@pytest.mark.slow
def test_a_number_that_can_be_left_out_is(root, capsys, key, value):
    write_run(root, "A0", 3, ROWS, total=20_000, summary={key: value})
    check(root, f"summary.json: {key} is {value}, not a number from 0 to 1e+12, and is left out", capsys, counted=True)
    assert load(root).runs[key].notna().sum() == 4


def nested(depth: int) -> dict:
    value: dict = {}
    for _ in range(depth):
        value = {"a": value}
    return value


@pytest.mark.parametrize("depth", [40, 200, 900, 100_000])
@pytest.mark.parametrize("name", ["summary.json", "config.yaml"])
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_settings_within_settings_are_listed(root, capsys, depth, name):
    folder = write_run(root, "A0", 3, ROWS, total=20_000)
    (folder / name).write_text('{"a": ' * depth + "1" + "}" * depth)
    check(root, f"{name}: ", capsys)


@pytest.mark.parametrize("number", ["0x" + "f" * 5000, "9" * 5000, "1" + "0" * 2000])
@pytest.mark.first_is_fast
def test_a_number_that_cannot_be_printed_is_listed(root, capsys, number):
    folder = write_run(root, "A0", 3, ROWS, total=20_000)
    with (folder / "config.yaml").open("a") as file:
        file.write(f"more: {number}\n")
    check(root, "config.yaml: ", capsys)


@pytest.mark.parametrize("name", [f"seed_{SEED}", "seed_99999999999999999999"])
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_a_folder_with_a_seed_out_of_range_is_listed(root, capsys, name):
    (root / "A0" / name).mkdir(parents=True)
    (root / "A0" / name / "episodes.csv").write_text("global_step,episodic_return,episode_length\n10,1.0,10\n")
    assert main([str(root), "--summary"]) == 0
    assert f"not used: A0/{name} (damaged): its seed is not known" in capsys.readouterr().out


@pytest.mark.parametrize("seed", ["three", True, 3.0, None])
def test_a_seed_that_is_no_number_is_that_of_the_folder(root, seed):
    write_odd(root, "A0", 3, {"seed": seed})
    summary = run_directory(root, "A0", 3) / "summary.json"
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"seed": seed}))
    assert load(root).runs.loc["armless_humanoid-none/seed_3", "seed"] == 3


@pytest.mark.slow
def test_an_odd_run_decides_neither_threshold_nor_profile(root, capsys):
    folder = write_run(root, "A0", 3, ROWS, total=20_000, summary={"threshold": 7.0, "profile": "other"})
    (folder / "episodes.csv").write_text("nonsense\n")
    check(root, "summary.json says profile other, config.yaml profile paper; summary.json says threshold 7.0", capsys)


@pytest.mark.slow
def test_a_report_is_made_of_any_of_them(root, tmp_path, capsys):
    for number, (key, (value, _)) in enumerate(SUMMARY.items(), start=10):
        write_run(root, "A1", number, ROWS, total=20_000, summary={key: value})
    for number, (key, (value, _)) in enumerate(CONFIG.items(), start=30):
        write_odd(root, "A3", number, {key: value})
    odd = {"pair": {"source": "a\0b", "target": "x" * 10_000}, "list": [{3: [1]}], "machine": nested(25)}
    folder = write_run(root, "A0", 50, ROWS, total=20_000, summary={"cause": "x" * 10_000, "status": "diverged"}, **odd)
    with (folder / "config.yaml").open("a") as file:
        file.write("dates: [{2020-01-01: 1}]\n2020-01-02: 3\n")
    out = tmp_path / "out"
    assert main([str(root), "--out", str(out), "--format", "svg"]) == 0
    assert capsys.readouterr().err == ""
    page = (out / "report.html").read_text()
    assert all(key in page for key in SUMMARY)


@pytest.mark.parametrize("value", [1e308, -1e200, math.inf])
@pytest.mark.first_is_fast
@pytest.mark.slow
def test_absurd_returns_meet_no_threshold_and_spoil_no_number(root, capsys, value):
    rows = ROWS.copy()
    rows[::2, 1] = value
    write_run(root, "A0", 3, rows, total=20_000)
    check(root, f"{len(rows[::2])} returns are no finite number below 1e+100", capsys, counted=True, told=True)
    assert math.isfinite(analyze(load(root)).measured["area_under_curve"].max())


@pytest.mark.parametrize(
    "odd",
    [{"global_step": math.inf}, {"steps_per_second": "fast"}, {"final_return": math.nan}, {"total_timesteps": [1]}],
)
def test_make_status_and_estimates_pass_over_numbers_out_of_range(root, capsys, odd):
    write_run(root, "A0", 3, ROWS, total=20_000, summary=odd)
    assert status([str(root)]) == 0
    assert "5 runs: 5 complete" in capsys.readouterr().out
    assert len(_finished(root)) == 5
    assert len(_speeds(_finished(root))) == 2


@pytest.mark.parametrize(
    "odd", [{"global_step": math.inf}, {"latest_return": {}}, {"updated": "now"}, {"process": None}]
)
def test_make_status_passes_over_what_a_running_run_cannot_mean(root, capsys, odd):
    folder = write_run(root, "A0", 3, ROWS, total=20_000, summary=False)
    (folder / "status.json").write_text(json.dumps({"state": "running", "updated": 1.0, "process": 1, **odd}))
    assert status([str(root)]) == 1
    assert "1 lost" in capsys.readouterr().out


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.integers(0, 3).map(lambda n: 10 ** (n * 40)),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=4,
)
KEYS = [
    *("status", "cell", "env", "transfer", "freeze", "seed", "profile", "global_step", "total_timesteps", "episodes"),
    *("threshold", "consecutive", "steps_per_second", "wall_seconds", "versions", "git_commit", "machine", "stop"),
    *("stop_after", "steps_to_threshold", "cause", "step", "inexact_resumes", "physics_warnings", "pair", "agent"),
]


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
)
@given(st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=6), st.sampled_from(["summary.json", "config.yaml"]))
def test_no_contents_of_a_file_end_the_analysis(tmp_path_factory, content, name):
    root = tmp_path_factory.mktemp("runs")
    write_run(root, "A0", 1, ROWS, total=20_000)
    folder = write_run(root, "A0", 2, ROWS, total=20_000)
    path = folder / name
    before = json.loads(path.read_text()) if name.endswith("json") else yaml.safe_load(path.read_text())
    path.write_text(json.dumps(before | content))
    # A profile or threshold of its own is another experiment, which is refused in one line.
    content.pop("profile", None)
    before_threshold = before["threshold"]
    path.write_text(json.dumps(before | content | {"threshold": before_threshold, "consecutive": 5}))
    data = load(root)
    assert data.runs.loc["armless_humanoid-none/seed_1", "counted"]
    analyze(data, 4900, 5)
    assert (data.runs["counted"] | (data.runs["reason"] != "")).all()
