"""Planning: which runs, in which order, and what is refused before anything starts."""

import gc
import itertools
import os
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from acmr.config import ConfigError
from acmr.settings.compose import CONFIG_FOLDER, compose_config, parse, register_schema
from acmr.settings.errors import USER_ERRORS, explain
from acmr.settings.run_spec import RunSpec, specify
from acmr.settings.swept import MOST_RUNS, check_counts
from acmr.storage.run_dir import RunDir
from sweeps.estimate import estimate
from sweeps.folder import SweepFolder
from sweeps.job import read_job, write_job
from sweeps.plan import Plan, expand, make_plan

CELLS = ("H0", "H1", "A0", "A1", "A2", "A3", "A4")


def plan(*jobs: list[str]) -> Plan:
    return make_plan(expand(jobs))


def product(*common: str, **swept: list[str]) -> list[list[str]]:
    pairs = [[f"{key}={value}" for value in values] for key, values in swept.items()]
    return [[*common, *chosen] for chosen in itertools.product(*pairs)]


def finish(spec: RunSpec, status: str = "complete", speed: float = 100.0) -> None:
    """What a run of these settings leaves behind, without its results."""
    run_dir = RunDir(spec.directory)
    run_dir.path.mkdir(parents=True, exist_ok=True)
    run_dir.start(spec.settings)
    if status:
        run_dir.write_json(run_dir.summary_file, {"status": status, "steps_per_second": speed})


def refusal(*jobs: list[str]) -> str:
    with pytest.raises(USER_ERRORS) as caught:
        plan(*jobs)
    line = explain(caught.value)
    assert "\n" not in line
    return line


@pytest.fixture
def out(tmp_path: Path) -> str:
    return f"output_dir={tmp_path}"


def test_twelve_students_add_their_three_teachers_and_none_that_is_there(out):
    jobs = product(out, transfer=["hidden", "expand"], freeze=["true", "false"], seed=["1", "2", "3"])
    first = plan(*jobs)
    assert [run.spec.name for run in first.runs if run.implied] == ["humanoid-none"] * 3
    assert [len(stage) for stage in first.stages] == [3, 12]
    for run in first.runs:
        if run.teacher is not None:
            teacher = first.runs[run.teacher]
            assert (teacher.spec.name, teacher.spec.config.seed) == ("humanoid-none", run.spec.config.seed)
            assert teacher.index < run.index
    for run in first.runs[:3]:
        finish(run.spec)
    second = plan(*jobs)
    assert len(second.runs) == len(second.missing) == 12
    assert [len(stage) for stage in second.stages] == [12]


@pytest.mark.parametrize(("matrix", "more"), [("paper", []), ("quick", []), ("demo", ["N1"])])
def test_a_matrix_is_the_seven_cells_on_three_seeds_and_its_teachers_are_among_them(matrix, more, out):
    register_schema()
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        hydra = compose("config", [f"matrix={matrix}"], return_hydra_config=True).hydra
    assert hydra.mode.name == "MULTIRUN"
    swept = {key: values.split(",") for key, values in hydra.sweeper.params.items()}
    made = plan(*product(out, f"matrix={matrix}", **swept))
    found = sorted((run.spec.cell, run.spec.config.seed) for run in made.runs)
    assert found == sorted(itertools.product([*CELLS, *more], [1, 2, 3]))
    assert not any(run.implied for run in made.runs)
    assert {run.spec.config.profile for run in made.runs} == {matrix}
    assert [len(stage) for stage in made.stages] == [6, 15 + 3 * len(more)]
    taken = [made.runs[index].spec.cell for index in made.order]
    assert taken[:3] == ["H0"] * 3


def test_what_is_complete_or_diverged_is_not_trained_again(out):
    jobs = product(out, seed=["1", "2", "3"])
    specs = expand(jobs)
    finish(specs[0])
    finish(specs[1], "diverged")
    finish(specs[2], "")
    made = plan(*jobs)
    assert [run.ended for run in made.runs] == ["complete", "diverged", None]
    assert [run.ended for run in plan(*[[*job, "force=true"] for job in jobs]).runs] == [None] * 3


def test_a_finished_student_needs_no_teacher(out):
    job = [out, "transfer=hidden"]
    finish(expand([job])[0])
    assert [run.implied for run in plan(job).runs] == [False]


def test_a_teacher_is_trained_the_way_its_student_is(out):
    made = plan([out, "transfer=hidden", "tracking=off", "threads=2", "progress=off"])
    assert made.runs[0].implied
    config = made.runs[0].spec.config
    assert (config.tracking.tracker, config.threads, config.progress) == (None, 2, "off")
    assert made.runs[0].spec.directory == plan([out, "env=humanoid"]).runs[0].spec.directory


def test_teachers_come_first_and_the_long_before_the_short(out):
    made = plan(
        [out, "total_timesteps=5"],
        [out, "total_timesteps=2000000"],
        [out, "transfer=hidden", "seed=1"],
        [out, "env=humanoid", "seed=1"],
    )
    assert [made.runs[index].spec.name for index in made.order] == [
        "humanoid-none",
        "armless_humanoid-none-total_timesteps=2000000",
        "armless_humanoid-hidden",
        "armless_humanoid-none-total_timesteps=5",
    ]


def test_two_jobs_for_one_directory_are_refused(out):
    assert "tracking=off and tracking=offline are one run" in refusal(*product(out, tracking=["off", "offline"]))
    assert "the same run twice" in refusal(*product(out, seed=["1", "1"]))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["seed=range(3,1)"], "seed=range(3,1): holds no value; type them one by one"),
        (["agent.q_lr=range(1e-3,1e-4,1e-4)"], "holds no value"),
        (["seed=range(0,1,0)"], "seed=range(0,1,0): range() arg 3 must not be zero; type a step other than 0"),
        (["seed=range(0,1000000000)"], "these are more than 100,000 runs; sweep fewer values"),
        (["seed=shuffle(range(0,1000000000))"], "these are more than 100,000 runs"),
        (["seed=range(400)", "agent.q_lr=range(0.001,0.4,0.001)"], "these are more than 100,000 runs"),
        (["seed=interval(1,2)"], "seed=interval(1,2): has no end; sweep a list, as in seed=1,2, or range(1,3)"),
    ],
)
def test_what_is_swept_has_values_and_an_end(words, says):
    began = time.perf_counter()
    with pytest.raises(ConfigError) as caught:
        check_counts(OverridesParser.create().parse_overrides(words))
    assert says in str(caught.value)
    assert time.perf_counter() - began < 2


def test_as_many_runs_as_can_be_planned_are_swept():
    for words in (["seed=1,2", "env=ant"], ["env=ant"], ["freeze=true,false", f"seed=range({MOST_RUNS // 2})"]):
        check_counts(OverridesParser.create().parse_overrides(words))


def test_a_directory_with_other_settings_is_refused(out):
    spec = expand([[out]])[0]
    finish(replace(spec, config=replace(spec.config, threshold=1.0)))
    assert "holds a run with other settings (threshold)" in refusal([out])


def test_a_teacher_that_is_named_but_not_there_is_refused(out, tmp_path):
    assert "there is no such file or run" in refusal([out, "transfer=hidden", f"transfer.teacher={tmp_path}/none"])


@pytest.mark.parametrize(
    ("jobs", "says"),
    [
        (product(transfer=["hiden", "expand"]), "did you mean transfer=hidden?"),
        (product(experiment=["H0", "B7"]), "experiment=B7: must be one of A0"),
        (product(freeze=["true", "2"], transfer=["hidden"]), "freeze=2: must be one of false, gradual, true"),
        (product(transfer=["none", "hidden"], freeze=["true"]), "nothing to freeze"),
        (product(sed=["1", "2"]), "did you mean seed or seeding?"),
        (product(seed=["1", "x"]), "seed=x"),
    ],
)
def test_one_wrong_value_refuses_the_sweep_in_one_line(jobs, says):
    assert says in refusal(*jobs)


OVERRIDES = st.fixed_dictionaries(
    {},
    optional={
        "experiment": st.sampled_from(CELLS),
        "profile": st.sampled_from(["paper", "quick", "paper_v5"]),
        "env": st.sampled_from(["humanoid", "ant", "env=gym env.id=Hopper-v5"]),
        "tracking": st.sampled_from(["off", "offline"]),
        "seed": st.integers(0, 99),
        "agent.q_lr": st.floats(1e-5, 1e-1),
        "agent.hidden_sizes": st.sampled_from(["[32,32]", "[8,8,8]"]),
        "total_timesteps": st.integers(1, 10**7),
        "env.drop_sensors": st.sampled_from(["[0,3]", "['qpos/*']"]),
        "+env.kwargs.healthy_reward": st.floats(0, 5),
        "transfer.adapter_activation": st.sampled_from(["none", "relu"]),
        "output_dir": st.just("'a b'"),
    },
)


@settings(max_examples=12, deadline=None)
@given(OVERRIDES)
@pytest.mark.slow
def test_composing_from_copies_gives_what_hydra_gives(values):
    # Some values bring their own words.
    words = [word for key, value in values.items() for word in (f"{value}" if "=" in f"{value}" else f"{key}={value}",)]
    words = [part for word in words for part in (word.split() if word.startswith("env=gym") else [word])]
    register_schema()
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        expected = compose("config", words)
    ours = compose_config(words)
    assert OmegaConf.to_yaml(ours, resolve=False) == OmegaConf.to_yaml(expected, resolve=False)
    assert asdict(parse(ours)) == asdict(parse(expected))
    # The copy that others are made of has not been touched.
    assert compose_config(words) == expected


def test_a_job_file_gives_back_the_run(tmp_path, out):
    for job in ([out, "experiment=A2", "agent.q_lr=0.1"], [out, "env.drop_sensors=[0,'qpos/*']", "+env.kwargs.x=.1"]):
        spec = specify(parse(compose_config(job)))
        write_job(tmp_path / "job.json", spec)
        assert read_job(tmp_path / "job.json") == spec


@pytest.mark.slow
def test_planning_costs_less_than_60_ms_a_run(out):
    jobs = product(out, experiment=list(CELLS), seed=[str(seed) for seed in range(20)])
    plan(*jobs[:2])
    # What thousands of tests before it have left in memory is none of its business.
    gc.freeze()
    try:
        before = time.process_time()
        assert len(plan(*jobs).runs) == 140
        assert (time.process_time() - before) / 140 < 0.060
    finally:
        gc.unfreeze()


def test_the_time_needed_comes_from_finished_runs(tmp_path, out):
    common = [out, "profile=quick", "total_timesteps=1000"]
    jobs = product(*common, experiment=["H0", "A1"], seed=["1", "2"])
    assert estimate(plan(*jobs), tmp_path, 2).seconds is None
    finish(expand([[*common, "experiment=A0"]])[0], speed=10.0)
    needs = estimate(plan(*jobs), tmp_path, 2)
    # Two teachers at a time for 100 s, then their two students.
    assert needs.seconds == pytest.approx(200)
    assert estimate(plan(*jobs), tmp_path, 1).seconds == pytest.approx(400)
    assert estimate(plan(*jobs), tmp_path, 4).seconds == pytest.approx(200)
    # Runs of another profile are no model; those that differ in the seed only are the best one.
    finish(expand([[common[0], "experiment=A0"]])[0], speed=1.0)
    assert estimate(plan(*jobs), tmp_path, 2) == needs
    for seed in (4, 5):
        finish(expand([[*common, "experiment=H0", f"seed={seed}"]])[0], speed=20.0)
    some = estimate(plan([*common, "experiment=H0", "seed=1"]), tmp_path, 1)
    assert (some.seconds, some.measured_on) == (pytest.approx(50), 2)
    row = 4 * (27 + 8 + 3)
    assert needs.memory == pytest.approx(2 * (450e6 + row * 1000), rel=0.01)


def test_a_damaged_summary_is_named(out, tmp_path):
    spec = expand([[out]])[0]
    finish(spec)
    (spec.directory / "summary.json").write_text("{")
    with pytest.raises(ConfigError, match=r"summary\.json"):
        make_plan([spec])


def test_a_run_that_is_to_be_made_anew_is_begun_anew_once(tmp_path, out):
    (run,) = plan([out, "force=true"]).runs
    folder = SweepFolder.create(tmp_path, {}, [], [], CONFIG_FOLDER)
    write_job(folder.job_file(0), run.spec)
    code = (
        "import sys; from pathlib import Path; from sweeps.job import adopt; spec, begun = adopt(Path({!r}))\n"
        "print(spec.config.force); begun() if sys.argv[1:] else None"
    )
    command = [sys.executable, "-c", code.format(str(folder.job_file(0)))]

    def forced(*begin: str) -> str:
        return subprocess.run([*command, *begin], capture_output=True, text=True, check=True).stdout.strip()

    finish(run.spec)
    # Whatever clock wrote it: from the past, or from a machine whose clock is ahead.
    for clock in (1, time.time() + 86_400, 2**33):
        os.utime(run.spec.directory / "config.yaml", (clock, clock))
        assert forced() == "True"
    assert forced("begun") == "True"
    assert forced() == "False"
