"""A stored file never chooses code: whatever a run's files name, nothing runs that the user has not typed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from finished_run import ANT, make_run
from tracking_tools import RUN, spec

from acmr.config import ConfigError
from acmr.evaluation.cli import main as evaluation
from acmr.records import description_sha256
from acmr.settings.compose import CONFIG_FOLDER, compose_config, look_in, parse
from acmr.settings.run_spec import specify
from acmr.settings.sources import SWEEPS, Sources
from acmr.settings.stored import stored_config, stored_environment
from acmr.tracking.mirror import main as mirror
from acmr.transfer.statistics import with_statistics
from acmr.transfer.teacher import load_teacher
from analysis.figures import stills
from analysis.publish import publish

ROOT = Path(__file__).resolve().parents[1]
#: What the environment of a foreign run may say to have code run or a file read, and what the answer names.
CODE: list[tuple[dict[str, Any], str]] = [
    ({"id": "evil_module:Ant-v5"}, "env.id=evil_module:Ant-v5"),
    ({"id": "evil_package.evil_module:Ant-v5"}, "env.id=evil_package"),
    ({"id": ":Ant-v5"}, "env.id=:Ant-v5"),
    ({"kwargs": {"xml_file": "/etc/passwd"}}, "env.kwargs.xml_file"),
    ({"kwargs": {"xml_file": "ant.xml"}}, "env.kwargs.xml_file"),
    ({"kwargs": {"wrappers": ["evil_module.Wrapper"]}}, "env.kwargs.wrappers"),
    ({"kwargs": {"anything": {"at": ["any", "depth"]}}}, "env.kwargs.anything"),
    ({"kwargs": {"frame_skip": 5, "env_id": "evil"}}, "env.kwargs.env_id"),
    # What never ends is no better than what it might run.
    ({"kwargs": {"frame_skip": 10**9}}, "env.kwargs.frame_skip=1000000000"),
    ({"kwargs": {"frame_skip": [1, {"a": -(10**9)}]}}, "env.kwargs.frame_skip=[1, {'a': -1000000000}]"),
    ({"kwargs": {"legs": 10**9}}, "env.kwargs.legs=1000000000"),
    ({"max_episode_steps": 10**15}, "env.max_episode_steps=1000000000000000"),
]


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module in the working folder, as in a folder that somebody sent; the file that it makes when it is run."""
    folder, mark = tmp_path / "sent", tmp_path / "ran"
    (folder / "evil_package").mkdir(parents=True)
    for place in (folder, folder / "evil_package"):
        (place / "evil_module.py").write_text(f"open({str(mark)!r}, 'w').close()\nclass Tracker: ...\n")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "evil_module", raising=False)
    return mark


def choose(run: Path, env: dict[str, Any]) -> Path:
    """Lets both files of a run choose the environment."""
    stored = asdict(ANT) | env
    (run / "config.yaml").write_text(yaml.safe_dump({"env": stored, "seed": 1}))
    description = json.loads((run / "teacher.json").read_text())
    description["config"] = {"env": stored}
    description["description_sha256"] = description_sha256(description)
    (run / "teacher.json").write_text(json.dumps(description))
    return run


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("sent") / "quick" / "ant-none" / "seed_1")


@pytest.mark.parametrize(("env", "named"), CODE, ids=str)
def test_an_evaluation_says_what_to_type(env, named, finished, evil, capsys):
    run = choose(finished, env)
    assert evaluation([str(run), "--episodes", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{run / 'config.yaml'}: {named}" in line
    assert line.endswith("chooses, not you; if you trust it, type --trust")
    assert not evil.exists()


def test_what_is_typed_is_run(finished, evil, capsys):
    run = choose(finished, {"id": "evil_module:Ant-v5"})
    assert evaluation([str(run), "--episodes", "1", "--trust"]) == 0, capsys.readouterr().err
    assert evil.exists()


def test_what_the_users_own_settings_name_is_trusted(finished, evil, tmp_path):
    stored = {"id": "evil_module:Ant-v5", "name": "my_robot", "kwargs": {"xml_file": "x.xml"}}
    (tmp_path / "conf" / "env").mkdir(parents=True)
    own = tmp_path / "conf" / "env" / "my_robot.yaml"
    own.write_text(yaml.safe_dump({"source": "ant", **stored}))
    settings = {"env": asdict(ANT) | stored}
    with pytest.raises(ConfigError, match="if you trust it"):
        stored_environment(settings, "a", "type --trust")
    look_in(Sources((f"file://{CONFIG_FOLDER}", f"file://{tmp_path / 'conf'}", SWEEPS)))
    assert stored_environment(settings, "a", "type --trust").id == stored["id"]
    for other in ({"id": "evil_module:Walker-v5"}, {"kwargs": {"xml_file": "y.xml"}}, {"name": "gym"}):
        with pytest.raises(ConfigError, match="if you trust it"):
            stored_environment({"env": settings["env"] | other}, "a", "type --trust")


@pytest.mark.parametrize(("env", "named"), CODE, ids=str)
def test_a_teacher_is_not_played_where_it_chooses(env, named, finished, evil):
    teacher = load_teacher(choose(finished, env))
    with pytest.raises(ConfigError, match=r"conf/env; else type transfer.impute=zero") as caught:
        with_statistics(teacher)
    assert named in str(caught.value)
    assert not evil.exists()


def test_a_policy_in_another_body_is_not_asked_in_its_own(finished, evil, capsys):
    run = choose(finished, {"id": "evil_module:Ant-v5"})
    (run / "config.yaml").write_text(yaml.safe_dump({"env": asdict(ANT), "seed": 1}))
    assert evaluation([str(run), "--episodes", "1", "--env", "ant"]) == 2
    assert "if you trust it, type --trust, or --impute zero" in capsys.readouterr().err
    assert not evil.exists()


@pytest.mark.parametrize(
    "env",
    [
        {"id": None}, {"id": ["Ant-v5"]}, {"kwargs": [1]}, {"kwargs": {1: 2}}, {"kwargs": "x"},
        {"remove_bodies": "leg"}, {"remove_bodies": [["leg"]]}, {"drop_sensors": [1.5]}, {"drop_actuators": {"a": 1}},
        {"max_episode_steps": 0}, {"max_episode_steps": "many"}, {"gravity": 1}, {1: 2}, {"source": "???"},
    ],
    ids=str,
)  # fmt: skip
def test_settings_of_other_types_are_one_line(env):
    with pytest.raises(ConfigError, match=r"config\.yaml: damaged, its part env cannot be used") as caught:
        stored_environment({"env": asdict(ANT) | env}, "config.yaml", "type --trust")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "settings",
    [
        {"tracking": {"project": "${oc.env:PRIVATE}"}},
        {"env": {"kwargs": {"a": ["${oc.decode:${oc.env:PRIVATE}}"]}}},
        {"transfer": {"options": {"${oc.env:PRIVATE}": 1}}},
        {"profile": "\\${oc.env:PRIVATE}"},
    ],
)
def test_no_stored_setting_reads_the_readers_variables(settings, monkeypatch):
    monkeypatch.setenv("PRIVATE", "hunter2")
    with pytest.raises(ConfigError, match="refers to other settings or variables") as caught:
        stored_config(settings)
    assert "hunter2" not in str(caught.value)


@pytest.fixture
def sent(tmp_path: Path) -> Callable[..., Path]:
    """A run for the mirror, with settings of the sender's choice."""

    def make(**changes: Any) -> Path:
        settings = spec("elsewhere").settings
        settings = {
            **settings,
            **{key: settings[key] | value if isinstance(value, dict) else value for key, value in changes.items()},
        }
        run = tmp_path / "runs" / "quick" / RUN / "seed_3"
        run.mkdir(parents=True)
        (run / "config.yaml").write_text(yaml.safe_dump(settings))
        (run / "episodes.csv").write_text("global_step,episodic_return,episode_length\n10,1.0,10\n")
        return run

    return make


@pytest.mark.parametrize(
    "changes",
    [
        {"profile": "../../victim"},
        {"output_dir": "/nowhere", "profile": "/nowhere"},
        {"tracking": {"tracker": "evil_module.Tracker", "base_url": "http://127.0.0.1:9", "dir": "../victim"}},
        {"env": {"id": "evil_module:Ant-v5"}},
        {"agent": {"name": "evil_module"}, "transfer": {"name": "evil_module"}},
    ],
    ids=str,
)
def test_a_mirror_is_written_beside_its_run_only(changes, sent, evil, tmp_path, capsys):
    run = sent(**changes)
    victim = tmp_path / "victim" / RUN / "seed_3" / "tensorboard"
    victim.mkdir(parents=True)
    (victim / "theirs").write_text("kept")
    assert mirror(["rebuild", "--tracking", "tensorboard", str(run)]) == 0, capsys.readouterr().err
    assert [path.parent for path in tmp_path.rglob("events.out.*")] == [run / "tensorboard"]
    assert [path.name for path in (tmp_path / "victim").rglob("*") if path.is_file()] == ["theirs"]
    assert not evil.exists()


@pytest.mark.parametrize("seed", [4, 0, -3])
def test_a_mirror_of_another_seed_is_refused(seed, sent, capsys):
    assert mirror(["rebuild", "--tracking", "tensorboard", str(sent(seed=seed))]) == 2
    assert f"(its settings are of seed {seed}); give one as in" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["evil_module:Ant-v5", "--out=x.png", "../conf", "a b", "", "ant;x", "evil\n:Ant-v5"])
def test_the_analysis_draws_no_robot_that_runs_code(name, evil, tmp_path):
    rendering = stills.start((name, name), tmp_path)
    assert [still.process for still in rendering] == [None, None]
    assert stills.finish(rendering[0])[1].startswith(f"no picture of {name}: runs can name")
    stills.stop(rendering)


@pytest.mark.slow
def test_publishing_runs_no_code_of_a_run(evil, tmp_path):
    run = make_run(tmp_path / "runs" / "quick" / "ant-none" / "seed_1")
    (run / "episodes.csv").write_text("global_step,episodic_return,episode_length\n10,1.0,10\n")
    choose(run, {"id": "evil_module:Ant-v5"})
    done = publish(run.parents[2], tmp_path / "out")
    (line,) = done.left_out
    assert "env.id=evil_module:Ant-v5 would run code" in line
    assert "type --trust" in line
    assert not evil.exists()
    assert publish(run.parents[2], tmp_path / "out", trust=True).left_out == []
    assert evil.exists()


@pytest.mark.slow
def test_a_command_in_a_folder_that_was_sent_runs_nothing_of_it(evil, tmp_path):
    run = choose(make_run(Path("run")), {"id": "evil_module:Ant-v5"})
    for command in (
        ["acmr.evaluation", str(run)],
        ["acmr.transfer.half", str(run), "."],
        ["sweeps.status", "."],
        ["analysis", ".", "--out", "out", "--no-stills"],
        ["acmr.tracking.mirror", "rebuild", str(run)],
        ["analysis.publish", ".", "out"],
    ):
        done = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, check=False)
        assert "Traceback" not in done.stderr, command
        assert not evil.exists(), command


def test_the_schema_is_complete_for_what_older_versions_stored():
    stored = {"env": {key: value for key, value in asdict(ANT).items() if key not in ("drop_sensors", "kwargs")}}
    assert stored_environment(stored, "a", "b") == replace(ANT, kwargs={})


@pytest.mark.parametrize("sha256", ["../../..", "/", 7, None, ["a"], "x" * 64, "A" * 64, "0" * 8 + "/" * 56])
def test_a_teachers_hash_is_no_path(sha256, tmp_path):
    run = make_run(tmp_path / "seed_1")
    content = json.loads((run / "teacher.json").read_text()) | {"sha256": sha256}
    (run / "teacher.json").write_text(json.dumps(content))
    config = parse(compose_config(["transfer=hidden", "env=ant_three_legs", f"transfer.teacher={run}"]))
    assert "/" not in specify(config).name
    assert ".." not in specify(config).name


@pytest.mark.parametrize("threshold", [10**400, -(10**400), "x", [1], {"a": 1}, None])
def test_a_number_that_is_none_costs_a_line(threshold):
    with pytest.raises(ConfigError) as caught:
        stored_config({"threshold": threshold})
    assert "\n" not in str(caught.value)
