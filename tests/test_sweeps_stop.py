"""Sweeps of runs that stop at their threshold: which are made in full, and when they are expected to end."""

import io
import itertools
import json
from pathlib import Path

import pytest
from rich.console import Console

from acmr.cells import plain_name, stops
from acmr.config import ExperimentConfig
from acmr.records import RUNNING
from acmr.settings.compose import compose_config, parse
from acmr.settings.run_spec import RunSpec, specify
from acmr.storage.run_dir import RunDir
from sweeps.estimate import estimate
from sweeps.plan import Plan, entries_of, expand, make_plan
from sweeps.screen.display import print_plan
from sweeps.screen.table import run_table
from sweeps.state import WAITING
from sweeps.status import main
from sweeps.view import Lengths, RunStatus, steps_ahead, view_run

PUBLISHED = Path(__file__).resolve().parent.parent / "results" / "paper"
CELLS = ("H0", "H1", "A0", "A1", "A2", "A3", "A4")


def plan(out: Path, cells: tuple[str, ...], *overrides: str, seeds: tuple[int, ...] = (1,)) -> Plan:
    pairs = itertools.product(cells, seeds)
    jobs = [[f"experiment={cell}", f"seed={seed}", f"output_dir={out}", *overrides] for cell, seed in pairs]
    return make_plan(expand(jobs))


def finish(spec: RunSpec, met: int | None, end: int, speed: float = 100.0) -> None:
    """What a run of these settings leaves behind, without its results."""
    run_dir = RunDir(spec.directory)
    run_dir.path.mkdir(parents=True, exist_ok=True)
    run_dir.start(spec.settings)
    summary = {"status": "complete", "steps_per_second": speed, "global_step": end, "steps_to_threshold": met}
    run_dir.write_json(run_dir.summary_file, summary | {"total_timesteps": spec.config.total_timesteps})


def configs(made: Plan) -> dict[str | None, ExperimentConfig]:
    return {run.spec.cell: run.spec.config for run in made.runs}


def test_the_papers_cells_stop_but_the_teacher_is_made_in_full_and_once(tmp_path, capsys):
    made = plan(tmp_path, CELLS, "stop=threshold", seeds=(1, 2, 3))
    assert len(made.runs) == len(made.missing) == 21
    assert [len(stage) for stage in made.stages] == [6, 15]
    assert {cell: config.stop for cell, config in configs(made).items()} == {
        cell: "horizon" if cell == "H0" else "threshold" for cell in CELLS
    }
    teachers = [run for run in made.runs if run.spec.cell == "H0"]
    assert [run.spec.name for run in teachers] == ["humanoid-none"] * 3
    assert [(run.implied, run.stands_for) for run in teachers] == [(False, ("humanoid-none-stop=threshold",))] * 3
    print_plan(made, estimate(made, tmp_path, 2), 2, tmp_path)
    said = capsys.readouterr().out
    assert said.count("(in full, since it teaches: stands for humanoid-none-stop=threshold)") == 3
    assert "stop: the time counts on runs that meet their threshold as late as they may: none has ended yet" in said


def test_that_command_means_the_same_runs_when_all_is_done(tmp_path):
    for run in plan(tmp_path, ("H0", "A1"), "stop=threshold").runs:
        finish(run.spec, met=5, end=5)
    again = plan(tmp_path, ("H0", "A1"), "stop=threshold")
    assert [(run.spec.name, run.ended) for run in again.runs] == [
        ("humanoid-none", "complete"), ("armless_humanoid-hidden-stop=threshold", "complete")
    ]  # fmt: skip


def test_a_full_run_that_is_complete_is_not_made_again(tmp_path, capsys):
    (done,) = plan(tmp_path, ("A0",), seeds=(1,)).runs
    finish(done.spec, met=202_468, end=1_000_000)
    made = plan(tmp_path, ("A0",), "stop=threshold", "stop_after=500000", seeds=(1, 2))
    names = ["armless_humanoid-none", "armless_humanoid-none-stop=threshold-stop_after=500000"]
    assert [(run.spec.name, run.ended) for run in made.runs] == [(names[0], "complete"), (names[1], None)]
    print_plan(made, estimate(made, tmp_path, 2), 2, tmp_path)
    assert f"(in full, and there: stands for {names[1]})" in capsys.readouterr().out
    # What was asked for anew is made, and so is a run that the full one cannot stand for.
    assert [run.ended for run in plan(tmp_path, ("A0",), "stop=threshold", "force=true").runs] == [None]
    assert [run.ended for run in plan(tmp_path, ("A0",), "stop=threshold", "agent.tau=0.1").runs] == [None]


def test_a_full_run_that_diverged_or_is_under_way_stands_for_nothing(tmp_path):
    for seed, summary in ((1, None), (2, {"status": "diverged", "step": 7, "cause": "x"})):
        (begun,) = plan(tmp_path, ("A0",), seeds=(seed,)).runs
        run_dir = RunDir(begun.spec.directory)
        run_dir.path.mkdir(parents=True)
        run_dir.start(begun.spec.settings)
        if summary:
            run_dir.write_json(run_dir.summary_file, summary)
    made = plan(tmp_path, ("A0",), "stop=threshold", seeds=(1, 2))
    assert [stops(run.spec.name) for run in made.runs] == [True, True]


@pytest.mark.parametrize("cells", [("H0",), ("H0", "A0")])
def test_without_a_student_to_teach_the_teacher_may_stop_too(cells, tmp_path):
    assert configs(plan(tmp_path, cells, "stop=threshold"))["H0"].stop == "threshold"


def test_a_teacher_of_others_is_no_full_run_of_this_one(tmp_path):
    # The students' teacher keeps the profile's threshold; the one that was asked for has another.
    made = plan(tmp_path, ("H0", "A1"), "stop=threshold", "threshold=100")
    assert (made.runs[0].spec.name, made.runs[0].implied) == ("humanoid-none", True)
    assert "humanoid-none-stop=threshold-threshold=100.0" in {run.spec.name for run in made.runs}


def test_a_full_run_that_was_asked_for_too_is_there_once(tmp_path):
    jobs = [[f"output_dir={tmp_path}", "experiment=A1"]]
    jobs += [[f"output_dir={tmp_path}", "env=humanoid", f"stop={stop}"] for stop in ("threshold", "horizon")]
    assert [run.spec.name for run in make_plan(expand(jobs)).runs] == ["humanoid-none", "armless_humanoid-hidden"]


@pytest.mark.parametrize(
    ("overrides", "full"),
    [
        (["experiment=A2", "stop=threshold"], ["experiment=A2"]),
        (["stop=threshold", "stop_after=9", "agent.tau=0.1"], ["agent.tau=0.1"]),
        (["stop=threshold", "agent.q_lr=0.1", "threshold=1"], ["agent.q_lr=0.1", "threshold=1"]),
    ],
)
def test_the_name_of_a_run_that_stops_holds_that_of_the_full_one(overrides, full):
    stopped, whole = (specify(parse(compose_config(words))).name for words in (overrides, full))
    assert (stops(stopped), stops(whole)) == (True, False)
    assert plain_name(stopped) == plain_name(whole) == whole


def test_lengths_are_those_of_the_same_cell_else_of_the_profile():
    lengths, stopped = Lengths(), Path("runs/paper/a-stop=threshold/seed_1")
    assert lengths.expect(stopped, 1000) == 1000
    lengths.add(Path("runs/paper/b/seed_1"), 900)
    lengths.add(Path("runs/quick/a/seed_1"), 1)
    assert lengths.expect(stopped, 1000) == 900
    assert lengths.expect(stopped, 500) == 500
    lengths.add(Path("runs/paper/a/seed_2"), 100)
    lengths.add(Path("runs/paper/a-stop=threshold-stop_after=300/seed_3"), 300)
    assert lengths.expect(stopped, 1000) == 200
    # One that has come further than some ends as those that came further, too; or as late as it may.
    assert lengths.expect(stopped, 1000, step=100) == 300
    assert lengths.expect(stopped, 1000, step=300) == 1000
    assert lengths.expect(Path("runs/paper/a/seed_1"), 1000) == 1000


def test_the_time_needed_follows_from_where_runs_stopped(tmp_path, capsys):
    overrides = ("profile=quick", "total_timesteps=1000", "stop=threshold", "stop_after=500")
    made = plan(tmp_path, ("A0",), *overrides)
    (other,) = plan(tmp_path, ("A1",), "profile=quick", "total_timesteps=1000").runs[1:]
    finish(other.spec, met=None, end=1000)
    needs = estimate(made, tmp_path, 1)
    # All that is known is a run that never met its threshold: none can end later than it may.
    assert (needs.seconds, needs.stops_like) == (pytest.approx(5), 1)
    (full,) = plan(tmp_path, ("A0",), *overrides[:2], seeds=(2,)).runs
    finish(full.spec, met=200, end=1000, speed=50.0)
    needs = estimate(made, tmp_path, 1)
    assert (needs.seconds, needs.stops_like, needs.measured_on) == (pytest.approx(4), 1, 1)
    print_plan(made, needs, 1, tmp_path)
    assert "stop: the time counts on runs that meet their threshold as 1 run did" in capsys.readouterr().out
    assert estimate(plan(tmp_path, ("A0",), *overrides[:2]), tmp_path, 1).stops_like is None
    # The replay memory never holds more than the run can take steps.
    assert needs.memory == pytest.approx(450e6 + 4 * (23 + 6 + 3) * 500, rel=0.001)


def test_the_published_runs_say_how_long_it_takes(tmp_path):
    (tmp_path / "paper").symlink_to(PUBLISHED)
    made = plan(tmp_path, ("H0", "A0", "A2"), "stop=threshold", seeds=(1, 9))
    assert [run.ended for run in made.runs if run.spec.config.seed == 1] == ["complete"] * 3
    (baseline,) = (run for run in made.runs if run.spec.cell == "A0" and run.spec.config.seed == 9)
    files = PUBLISHED.glob("armless_humanoid-none*/seed_*/summary.json")
    told = [json.loads(file.read_text()) for file in files]
    seconds = [each["steps_to_threshold"] / each["steps_per_second"] for each in told]
    needs = estimate(make_plan([baseline.spec]), tmp_path, 1)
    assert len(told) >= 3
    assert min(seconds) <= needs.seconds <= max(seconds)


def test_the_sweep_and_its_table_know_the_last_step_that_may_come(tmp_path):
    made = plan(tmp_path, ("A0",), "stop=threshold", "stop_after=700")
    assert [run.total_timesteps for run in entries_of(made, tmp_path)] == [700]
    spec = made.runs[0].spec
    finish(spec, met=400, end=400)
    ended = view_run(spec.directory, spec.name, 1)
    assert (ended.step, ended.total, ended.met) == (400, 400, 400)
    folder = spec.directory.parent
    running = RunStatus(spec.name, 2, folder / "seed_2", RUNNING, step=100, total=700, speed=1.0)
    waiting = RunStatus(spec.name, 3, folder / "seed_3", WAITING, total=700)
    # 300 more for the one, 400 for the other; at the latest, 10 minutes are left for the first.
    assert steps_ahead([ended, running, waiting]) == 700
    assert steps_ahead([running]) == 600
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(run_table([running], console))
    assert " <10:00 " in console.export_text()


def test_make_status_tells_the_time_that_is_expected(tmp_path, capsys):
    made = plan(tmp_path, ("A0",), "stop=threshold", seeds=(1, 2))
    finish(made.runs[0].spec, met=400, end=400)
    RunDir(made.runs[1].spec.directory).path.mkdir(parents=True)
    status = {"state": "running", "global_step": 100, "total_timesteps": 1000, "steps_per_second": 10.0}
    status |= {"host": "elsewhere", "process": 1, "updated": 9e9}
    (made.runs[1].spec.directory / "status.json").write_text(json.dumps(status))
    assert main([str(tmp_path)]) == 0
    assert "1 complete, 1 running; 10 steps/s, 30 s left" in capsys.readouterr().out
