"""The benchmark of structural shifts: what each environment has lost or gained, and which runs it is made of."""

from __future__ import annotations

import re

import pytest
import yaml
from hydra import compose, initialize_config_dir

from acmr.envs import describe
from acmr.settings.compose import CONFIG_FOLDER, environment_config, register_schema
from acmr.settings.run_spec import teacher_spec
from acmr.transfer.name_map import map_bodies
from docs.shifts import runs
from sweeps.estimate import estimate
from sweeps.plan import expand, make_plan
from sweeps.screen.display import print_plan

#: Of each environment the sensors and the actuators that differ from its teacher's, and whether they are lost.
SHIFTS = {
    "ant_leg_lost": ({"qpos/hip_3", "qvel/hip_3", "qpos/ankle_3", "qvel/ankle_3"}, {"hip_3", "ankle_3"}),
    "walker2d_foot_lost": ({"qpos/foot_left_joint", "qvel/foot_left_joint"}, {"foot_left_joint"}),
    "halfcheetah_motor_failed": (set(), {"bthigh"}),
    "hopper_sensors_failed": ({"qvel/thigh_joint", "qvel/leg_joint", "qvel/foot_joint"}, set()),
    "humanoid_arm_lost": (
        {f"{kind}/left_{joint}" for kind in ("qpos", "qvel") for joint in ("shoulder1", "shoulder2", "elbow")},
        {"left_shoulder1", "left_shoulder2", "left_elbow"},
    ),
}
WHOLE = {"ant": (27, 8), "walker2d": (17, 6), "halfcheetah": (17, 6), "hopper": (11, 3), "humanoid": (45, 17)}
METHODS = ("A0", "A2", "A3", "N0", "N1")


def added(lost: str) -> str:
    return re.sub("lost|failed", "added", lost)


def names_of(environment: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    about = describe(environment_config(environment))
    return about.observation_names, about.action_names


def differing(teacher: str, student: str) -> list[set[str]]:
    """The sensors and the actuators that the student lacks, then those that its teacher lacks."""
    theirs, ours = names_of(teacher), names_of(student)
    found = map_bodies(theirs, ours, {})
    parts = (found.sensors, found.actuators)
    gone = [{names[row] for row in part.gone} for part, names in zip(parts, theirs, strict=True)]
    return gone + [{names[row] for row in part.added} for part, names in zip(parts, ours, strict=True)]


@pytest.mark.parametrize("lost", SHIFTS)
def test_each_environment_has_lost_or_gained_what_its_name_says(lost):
    whole = f"whole_{lost.split('_')[0]}"
    sensors, actuators = SHIFTS[lost]
    assert tuple(map(len, names_of(whole))) == WHOLE[lost.split("_")[0]]
    assert environment_config(lost).source == whole
    assert differing(whole, lost) == [sensors, actuators, set(), set()]
    assert environment_config(added(lost)).source == lost
    assert differing(lost, added(lost)) == [set(), set(), sensors, actuators]


def test_the_matrix_is_whole_pairs_with_every_method_and_ten_seeds():
    register_schema()
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        composed = compose("config", ["matrix=shifts"], return_hydra_config=True)
    params = composed.hydra.sweeper.params
    assert (composed.profile, composed.tracking.tracker) == ("shifts", None)
    # Both directions of a robot, in the order of the page.
    swept = [each for lost in SHIFTS for each in (lost, added(lost)) if lost in params["env"]]
    assert params["env"].replace(" ", "").split(",") == swept
    assert (params["experiment"], params["seed"]) == (",".join(METHODS), "range(1,11)")
    assert tuple(METHODS) == tuple(runs.METHODS)
    assert [each for lost in SHIFTS for each in (lost, added(lost))] == list(runs.PAIRS)


def test_runs_of_one_shift_have_directories_of_their_own_and_the_values_of_their_profile(tmp_path):
    jobs = [["profile=shifts", "env=hopper_sensors_failed", f"experiment={cell}", "seed=3"] for cell in METHODS]
    specs = expand(jobs)
    names = [spec.name.removeprefix("hopper_sensors_failed-") for spec in specs]
    weights = "named-copy_log_alpha=false-impute=mean-kickstart=0.0-start=random-warmup=0"
    assert names == ["none", "hidden-frozen", "expand", weights, "named"]
    assert {spec.cell for spec in specs} == {None}
    teacher = teacher_spec(specs[1].config)
    assert teacher.name == "whole_hopper-none"
    for spec in (*specs, teacher):
        assert (spec.config.env.max_episode_steps, spec.config.agent.hidden_sizes) == (250, [64, 64])
        assert str(spec.directory.parent.parent) == "runs/shifts"


@pytest.mark.parametrize("lost", ["hopper_sensors_failed"])
def test_a_baseline_is_the_teacher_of_the_other_direction_and_trained_once(lost, tmp_path, capsys):
    out = f"output_dir={tmp_path}"
    jobs = [
        [out, "profile=shifts", f"env={env}", f"experiment={cell}", "seed=1"]
        for env in (lost, added(lost))
        for cell in ("A0", "N1")
    ]
    made = make_plan(expand(jobs))
    found = [(run.spec.name, run.implied, run.stands_for) for run in made.runs]
    assert found == [
        (f"{lost}-none", False, ()),
        ("whole_hopper-none", False, (f"{added(lost)}-none",)),
        (f"{lost}-named", False, ()),
        (f"{added(lost)}-named", False, ()),
    ]
    teachers = [made.runs[run.teacher].spec.name for run in made.runs if run.teacher is not None]
    assert teachers == ["whole_hopper-none", f"{lost}-none"]
    # Of one direction alone it is the same run.
    alone = make_plan(expand(jobs[2:]))
    assert [run.spec.name for run in alone.runs if run.teacher is None] == [f"{lost}-none", "whole_hopper-none"]
    print_plan(alone, estimate(alone, tmp_path, 1), 1, tmp_path)
    assert f"whole_hopper-none/seed_1  (the same body: stands for {added(lost)}-none)" in capsys.readouterr().out


@pytest.mark.parametrize(
    "word", ["agent.tau=0.01", "env.max_episode_steps=100", "stop=threshold", "env.source=nowhere"]
)
def test_a_baseline_with_settings_of_its_own_is_a_run_of_its_own(word, tmp_path):
    job = [f"output_dir={tmp_path}", "profile=shifts", "env=hopper_sensors_added", "experiment=A0", word]
    assert [run.spec.config.env.name for run in make_plan(expand([job])).runs] == ["hopper_sensors_added"]


def test_what_is_added_to_is_the_whole_robot_again_under_another_name():
    said = {path.stem: yaml.safe_load(path.read_text()) for path in (CONFIG_FOLDER / "env").glob("*.yaml")}
    for lost in SHIFTS:
        assert said[added(lost)]["defaults"] == [f"whole_{lost.split('_')[0]}"]
        assert set(said[added(lost)]["env"]) == {"name", "source"}
