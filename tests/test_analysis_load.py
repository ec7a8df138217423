"""Run directories of every kind -> frames; nothing vanishes, nothing crashes."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from analysis_runs import HEADER, PAIRS, csv_text, rows_reaching, run_directory, write_matrix, write_run

from acmr.cells import CELLS
from analysis.loading.load import InputError, RunSet, load
from analysis.loading.missing import matrix_command, missing_runs, planned_runs, planned_seeds


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "paper"


def only(data: RunSet) -> dict:
    assert len(data.runs) == 1
    return data.runs.iloc[0].to_dict()


@pytest.mark.parametrize("profile", PAIRS)
def test_all_cells_and_seeds_are_recognized_by_their_summary(root, profile):
    write_matrix(root, dict.fromkeys(CELLS, (6000, 7000, None)), total=20_000, profile=profile)
    data = load(root)
    assert list(zip(data.runs["cell"], data.runs["seed"], strict=True)) == [(c, s) for c in CELLS for s in (1, 2, 3)]
    assert set(data.runs["state"]) == {"complete"}
    assert data.runs["counted"].all()
    assert data.pair == PAIRS[profile]
    assert len(data.episodes) == data.runs["episodes"].sum()


def test_cells_of_unfinished_runs_are_recognized_by_their_settings(root):
    for cell in CELLS:
        write_run(root, cell, 1, rows_reaching(None, 20_000), summary=False)
    data = load(root)
    assert list(data.runs["cell"]) == list(CELLS)
    assert set(data.runs["state"]) == {"unfinished"}
    assert not data.runs["counted"].any()


@pytest.mark.parametrize("name", ["A2", "a2", "armless_humanoid-hidden-frozen", "ant_three_legs-hidden-frozen"])
def test_cells_of_foreign_runs_are_recognized_by_their_directory(root, name):
    directory = root / name / "seed_7"
    directory.mkdir(parents=True)
    (directory / "episodes.csv").write_text(csv_text(rows_reaching(6000, 20_000), columns=3))
    run = only(load(root))
    assert (run["cell"], run["seed"], run["state"], run["counted"]) == ("A2", 7, "foreign", True)
    assert run["horizon"] == 20_000


def test_a_sweep_is_a_group_of_its_own(root):
    directory = write_run(root, "A1", 1, rows_reaching(6000, 20_000), summary=False)
    sweep = root / "armless_humanoid-hidden-q_lr=0.0001" / "seed_1"
    sweep.parent.mkdir()
    directory.rename(sweep)
    run = only(load(root))
    assert (run["cell"], run["group"]) == (None, "armless_humanoid-hidden-q_lr=0.0001")


def test_compressed_episodes_are_read(root):
    directory = write_run(root, "A0", 1, rows_reaching(6000, 20_000))
    plain = load(root).episodes
    content = (directory / "episodes.csv").read_bytes()
    (directory / "episodes.csv").unlink()
    (directory / "episodes.csv.gz").write_bytes(gzip.compress(content))
    assert load(root).episodes.equals(plain)
    (directory / "episodes.csv.gz").write_bytes(gzip.compress(content)[:-20])
    run = only(load(root))
    assert run["state"] == "damaged"
    assert "decompressed" in run["reason"]


def test_values_are_read_to_the_last_bit(root):
    rows = rows_reaching(6000, 20_000)
    rows[:, 1] = np.random.default_rng(0).normal(5000, 1000, len(rows))
    write_run(root, "A0", 1, rows)
    assert load(root).episodes["episodic_return"].to_numpy().tobytes() == rows[:, 1].tobytes()


def test_a_run_cut_off_in_the_middle_of_a_line_keeps_the_lines_before(root):
    directory = write_run(root, "A0", 1, rows_reaching(6000, 20_000), summary=False)
    text = (directory / "episodes.csv").read_text()
    for cut in range(len(text) - 40, len(text)):
        (directory / "episodes.csv").write_text(text[:cut])
        whole = text[:cut].count("\n") - 1
        data = load(root)
        assert len(data.episodes) == whole
        assert only(data)["state"] == "unfinished"
        assert ("cut off in line" in only(data)["reason"]) == (text[cut - 1] != "\n")


DAMAGE = {
    "rows are not in order: line 8": lambda lines: [*lines[:6], lines[7], lines[6], *lines[8:]],
    "rows are not in order: line 4": lambda lines: [*lines[:3], lines[2], *lines[3:]],
    "line 5 holds 5 values, not 6": lambda lines: [*lines[:4], lines[4].rsplit(",", 1)[0], *lines[5:]],
    "line 3: episodic_return is 'abc'": lambda lines: [*lines[:2], "200,abc,100,1,1,1", *lines[3:]],
    "line 3: global_step is 200.5": lambda lines: [*lines[:2], "200.5,1,100,1,1,1", *lines[3:]],
    "line 3: episode_length is 0": lambda lines: [*lines[:2], "200,1,0,1,1,1", *lines[3:]],
    "no column episodic_return": lambda lines: ["global_step,reward,episode_length,a,b,c", *lines[1:]],
    "no column global_step": lambda lines: [],
    "line 3: global_step is '\\x00": lambda lines: [*lines[:2], "\0" * 40 + ",,,,,", *lines[3:]],
}


@pytest.mark.parametrize("reason", DAMAGE)
def test_damaged_episodes_are_refused_with_the_reason(root, reason):
    directory = write_run(root, "A0", 1, rows_reaching(6000, 20_000), summary=False)
    write_run(root, "A0", 2, rows_reaching(6000, 20_000))
    lines = DAMAGE[reason]((directory / "episodes.csv").read_text().splitlines())
    (directory / "episodes.csv").write_text("".join(line + "\n" for line in lines))
    data = load(root)
    run = data.runs.iloc[0]
    assert run["state"] == "damaged"
    assert reason in run["reason"]
    assert "\n" not in run["reason"]
    assert list(data.runs["counted"]) == [False, True]
    assert set(data.episodes["seed"]) == {2}


@pytest.mark.parametrize("name", ["config.yaml", "summary.json"])
@pytest.mark.parametrize(
    "content", [b"{", b"[1, 2]", b"\xff\xfe\x00", b"key: [", b"a: &a {b: *a}", b"a: &a [x]\nb: *a\n"]
)
def test_damaged_settings_are_refused_with_the_reason(root, name, content):
    directory = write_run(root, "A0", 1, rows_reaching(6000, 20_000))
    (directory / name).write_bytes(content)
    run = only(load(root))
    assert run["state"] == "damaged"
    assert name in run["reason"]
    assert run["cell"] == "A0"


def test_no_code_in_settings_is_run(root, tmp_path):
    directory = write_run(root, "A0", 1, rows_reaching(6000, 20_000))
    (directory / "config.yaml").write_text(f"a: !!python/object/apply:os.mkdir ['{tmp_path / 'hacked'}']\n")
    assert only(load(root))["state"] == "damaged"
    assert not (tmp_path / "hacked").exists()


def test_a_summary_that_counts_other_episodes_is_damage(root):
    write_run(root, "A0", 1, rows_reaching(6000, 20_000), summary={"episodes": 3})
    assert "summary.json counts 3 episodes" in only(load(root))["reason"]


CAUSE = {"step": 9050, "cause": "loss"}


def test_a_run_that_diverged_did_not_reach_in_all_its_time(root):
    rows = rows_reaching(None, 9000)
    write_run(root, "A0", 1, rows, total=20_000, summary={"status": "diverged", "global_step": 9050} | CAUSE)
    run = only(load(root))
    assert (run["state"], run["counted"], run["horizon"]) == ("diverged", True, 20_000)
    assert run["reason"] == "at step 9050: loss"


def test_what_a_run_said_last_and_inexact_resumes_are_shown(root):
    directory = write_run(root, "A0", 1, rows_reaching(None, 9000), summary=False)
    (directory / "status.json").write_text('{"state": "stopped", "global_step": 9123, "total_timesteps": 20000}')
    write_run(root, "A0", 2, rows_reaching(None, 9000), summary={"inexact_resumes": [{"step": 5, "differing": "cpu"}]})
    reasons = load(root).runs["reason"].tolist()
    assert reasons[0] == "no summary.json; stopped at step 9,123 of 20,000"
    assert "resumed inexactly" in reasons[1]
    (directory / "status.json").write_text('{"state": "stopped", "global_step": "x"}')
    assert load(root).runs["reason"].iloc[0] == "no summary.json"


def test_a_complete_run_is_known_to_its_last_step(root):
    write_run(root, "A0", 1, rows_reaching(None, 19_900), total=20_000)
    assert (only(load(root))["last_step"], only(load(root))["horizon"]) == (19_900, 20_000)


@pytest.mark.parametrize("state", ["config.yaml", "nothing", "header"])
def test_a_run_without_episodes_is_listed(root, state):
    directory = write_run(root, "A0", 1, rows_reaching(None, 9000), summary=False)
    (directory / "episodes.csv").write_text(HEADER + "\n")
    if state != "header":
        (directory / "episodes.csv").unlink()
    if state == "nothing":
        (directory / "config.yaml").unlink()
    run = only(load(root))
    assert (run["cell"], run["state"], run["episodes"]) == ("A0", "unfinished", 0)


def test_of_two_directories_of_one_cell_and_seed_the_finished_one_counts(root):
    directory = write_run(root, "A0", 1, rows_reaching(6000, 20_000), summary=False)
    directory.rename(directory.with_name("moving"))
    (root / "A0").mkdir()
    (directory.with_name("moving")).rename(root / "A0" / "seed_1")
    write_run(root, "A0", 1, rows_reaching(7000, 20_000))
    data = load(root)
    assert list(data.runs["state"]) == ["duplicate", "complete"]
    assert "armless_humanoid-none/seed_1" in data.runs.iloc[0]["reason"]


def test_infinite_and_missing_returns_are_said(root):
    rows = rows_reaching(6000, 20_000)
    rows[:2, 1] = np.nan, np.inf
    write_run(root, "A0", 1, rows)
    data = load(root)
    assert "2 returns are no finite number" in only(data)["reason"]
    assert data.episodes["episodic_return"].isna().sum() == 2


@pytest.mark.parametrize("speed", ["", "fast"])
def test_a_velocity_that_is_no_number_is_left_out_and_the_returns_are_kept(root, speed):
    directory = write_run(root, "A0", 1, rows_reaching(6000, 20_000))
    text = (directory / "episodes.csv").read_text().replace(",1.5,", f",{speed},", 1)
    (directory / "episodes.csv").write_text(text)
    data = load(root)
    assert only(data)["counted"]
    assert "mean_forward_velocity is left out" in only(data)["reason"]
    assert data.episodes["mean_forward_velocity"].isna().all()


def test_profiles_are_not_mixed(tmp_path):
    for profile in PAIRS:
        write_run(tmp_path / profile, "A0", 1, rows_reaching(6000, 20_000), profile=profile)
    with pytest.raises(InputError, match="profiles paper, quick"):
        load(tmp_path)


def test_files_of_other_tools_are_passed_over(root):
    write_run(root, "A0", 1, rows_reaching(6000, 20_000))
    for folder in ("wandb/offline-run-1/files", ".hydra", "armless_humanoid-none/seed_1/checkpoints/seed_9"):
        (root / folder).mkdir(parents=True)
        (root / folder / "summary.json").write_text("{}")
        (root / folder / "config.yaml").write_text("{}")
    assert len(load(root).runs) == 1


def test_seeds_of_a_cell_beyond_the_paper_are_its_own(root):
    for seed in (1, 2, 3):
        write_run(root, "A0", seed, rows_reaching(6000, 20_000), profile="quick")
    for seed in (1, 2, 5):
        write_run(root, "N1", seed, rows_reaching(6000, 20_000), profile="quick")
    data = load(root)
    assert planned_seeds(data.runs) == [1, 2, 3]
    assert planned_seeds(data.runs, "N1") == [1, 2, 3, 5]
    assert planned_runs(data) == 7 * 3 + 4
    missing = missing_runs(data)
    assert {run.seed for run in missing if run.cell != "N1"} == {1, 2, 3}
    assert [run.seed for run in missing if run.cell == "N1"] == [3]
    assert matrix_command(data) == "python run.py matrix=quick experiment=H0,H1,A0,A1,A2,A3,A4,N1"
    # A seed that only N1 is to have is named with N1's cell, not asked of all.
    (run_directory(root, "N1", 5, "quick") / "summary.json").unlink()
    for cell in ("H0", "H1", "A1", "A2", "A3", "A4"):
        for seed in (1, 2, 3):
            write_run(root, cell, seed, rows_reaching(6000, 20_000), profile="quick")
    assert matrix_command(load(root)) == "python run.py matrix=quick experiment=N1 seed=3,5"


def test_what_is_missing_is_said_with_the_command_that_makes_it(root):
    write_matrix(root, dict.fromkeys(CELLS, (6000, 7000, None)), total=20_000, profile="quick")
    (run_directory(root, "A2", 2, "quick") / "summary.json").unlink()
    (run_directory(root, "H1", 3, "quick") / "episodes.csv").write_text("nonsense\n")
    write_run(root, "A0", 5, rows_reaching(6000, 20_000), profile="quick")
    missing = {(run.cell, run.seed): run for run in missing_runs(load(root))}
    assert len(missing) == 2 + 6  # seed 5 of the paper's other cells
    assert missing["A2", 2].state == "unfinished"
    assert missing["A2", 2].command == "python run.py experiment=A2 seed=2 profile=quick"
    assert missing["H1", 3].command == "python run.py experiment=H1 seed=3 profile=quick force=true"
    assert missing["H0", 5].state == "missing"
