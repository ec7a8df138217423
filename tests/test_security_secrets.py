"""Secrets and places of one machine are no results: refused, or in nothing that goes to others."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from finished_run import ANT, make_run
from tracking_tools import records, spec, start, the_mirror

from acmr.config import ConfigError
from acmr.evaluation.cli import main as evaluation
from acmr.records import description_sha256, portable, portable_settings
from acmr.settings.command_line import hydra_arguments
from acmr.settings.compose import compose_config, parse
from acmr.settings.errors import USER_ERRORS, explain
from acmr.tracking.mirror import main as mirror
from acmr.transfer.teacher import load_teacher
from analysis.publish import PublishError, publish

ROOT = Path(__file__).resolve().parents[1]
SECRET = "hunter2"


def refused(*overrides: str) -> str:
    with pytest.raises(USER_ERRORS) as caught:
        parse(compose_config(overrides))
    said = explain(caught.value)
    assert "\n" not in said
    assert SECRET not in said
    return said


@pytest.mark.parametrize(
    "override",
    [
        "tracking.base_url=http://user:hunter2@127.0.0.1:9",
        "tracking.base_url=https://hunter2@127.0.0.1/wandb",
        "tracking.base_url='http://user:hunt/er2@127.0.0.1'",
        "tracking.base_url='user:hunter2@127.0.0.1:9'",
        "tracking.project='http://user:hunter2@host/x'",
        "tracking.dir='ftp://user:hunter2@host/x'",
        "output_dir='sftp://user:hunter2@host/runs'",
        "+tracking.options.place='postgresql://user:hunter2@host/base'",
        "+tracking.options.places=[1,{at: 'https://hunter2@host/'}]",
        "+env.kwargs.model='https://user:hunter2@host/robot.xml'",
        "transfer.rename=['https://user:hunter2@host:x']",
    ],
)
def test_addresses_with_a_password_are_refused_without_saying_it(override):
    key = override.lstrip("+").partition("=")[0]
    assert f"{key}: an address with a user or a password" in refused(override)


@pytest.mark.parametrize("address", ["127.0.0.1:9", "http://", "http://h/?key=hunter2", "http://h#hunter2", "ftp://h"])
def test_an_address_says_where_a_server_is_and_nothing_else(address):
    assert refused(f"tracking.base_url='{address}'").endswith("and nothing else, as in http://HOST:PORT")


@pytest.mark.parametrize("address", ["http://127.0.0.1:9", "https://wandb.example.org/team", "http://[::1]:8080/"])
def test_addresses_without_one_are_taken(address):
    assert parse(compose_config([f"tracking.base_url='{address}'"])).tracking.base_url == address


@pytest.mark.parametrize(
    "override", ["tracking.base_url=http://user:hunter2@host:{1", "seed=http://user:hunter2@host", "x=y://hunter2@h"]
)
def test_a_mistake_in_a_command_line_repeats_no_password(override):
    refused(override)


@pytest.mark.parametrize("command", [["run.py", "tracking=self_hosted"], ["-m", "acmr.tracking.mirror", "sync"]])
def test_a_password_is_in_nothing_that_a_command_writes(command, tmp_path):
    address = f"http://user:{SECRET}@127.0.0.1:9"
    more = [f"tracking.base_url={address}", f"output_dir={tmp_path}"]
    if "sync" in command:
        more = ["--base-url", address, str(tmp_path)]
    done = subprocess.run([sys.executable, *command, *more], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert SECRET not in done.stdout + done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_variable_with_a_servers_address_is_looked_at_too(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WANDB_BASE_URL", f"http://user:{SECRET}@127.0.0.1:9")
    assert mirror(["sync", str(tmp_path)]) == 2
    assert SECRET not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["tracking.project=${oc.env:PRIVATE}"], "tracking.project"),
        (["env=ant", "+env.kwargs.a=${oc.env:PRIVATE}"], "env.kwargs"),
        (["+tracking.options.key=[{a: '${oc.env:PRIVATE}'}]"], "tracking.options"),
        (["tracking.project='${oc.${transfer.options.a}:PRIVATE}'", "+transfer.options.a=env"], "tracking.project"),
        (["output_dir=${oc.env:PRIVATE}", "tracking.entity=${output_dir}"], "tracking.entity"),
        (["tracking.base_url='http://${oc.env:PRIVATE}/'"], "tracking.base_url"),
        (["pair.source='${oc.env:PRIVATE}'"], "pair.source"),
        (["device=${oc.env:PRIVATE}"], "device"),
        (["progress='x${oc.env:PRIVATE}'"], "progress"),
        (["agent.hidden_sizes=['${oc.env:PRIVATE}']"], "agent.hidden_sizes"),
    ],
)
def test_no_setting_that_is_stored_reads_a_variable(overrides, key, monkeypatch):
    monkeypatch.setenv("PRIVATE", SECRET)
    assert f"{key}=${{oc.env:PRIVATE}}: settings are stored with the run" in refused(*overrides)


def test_a_number_that_a_variable_holds_is_refused_too(monkeypatch):
    monkeypatch.setenv("PRIVATE", "4711")
    for key in ("seed", "total_timesteps", "threshold"):
        assert f"{key}=${{oc.env:PRIVATE}}: settings are stored" in refused(f"{key}=${{oc.env:PRIVATE}}")


@pytest.mark.parametrize(
    "argument",
    [
        "profile=${oc.env:PRIVATE}", "experiment=${oc.env:PRIVATE}", "matrix='${oc.env:PRIVATE}'",
        f"matrix=https://user:{SECRET}@host", f"https://user:{SECRET}@host=3", f"--config-dir=//user:{SECRET}@host/x",
        f"env=//user:{SECRET}@host", f"--config-name=x://{SECRET}@host", f"seed=x://u:{SECRET}@h",
    ],
)  # fmt: skip
def test_what_is_wrong_on_a_command_line_is_not_said_with_its_secrets(argument, monkeypatch):
    monkeypatch.setenv("PRIVATE", SECRET)
    with pytest.raises(ConfigError) as caught:
        hydra_arguments([argument])
    assert SECRET not in str(caught.value)


def test_paths_may_begin_where_a_variable_says(monkeypatch, tmp_path):
    monkeypatch.setenv("SCRATCH", str(tmp_path))
    overrides = ["output_dir=${oc.env:SCRATCH}/runs", "tracking.dir=${oc.env:SCRATCH}", "+tracking.options.a=${seed}"]
    config = parse(compose_config(overrides))
    assert (config.output_dir, config.tracking.dir) == (f"{tmp_path}/runs", str(tmp_path))
    assert config.tracking.options == {"a": 1}


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("/home/me/runs/paper/humanoid-none/seed_1", "humanoid-none/seed_1"),
        ("/home/me/seed_1", "seed_1"),
        ("/home/me", "me"),
        ("~/runs", "runs"),
        ("../../me/x/teacher.safetensors", "teacher.safetensors"),
        ("file:///home/me/robot.xml", "robot.xml"),
        ("results/paper/humanoid-none/seed_1", "results/paper/humanoid-none/seed_1"),
        ("qvel/*", "qvel/*"),
        ("/", "/"),
        ([1, {"a": "/home/me/x"}, None, 2.5], [1, {"a": "x"}, None, 2.5]),
    ],
)
def test_of_a_path_others_are_told_the_end(value, told):
    assert portable(value) == told
    assert portable(told) == told


def test_a_description_and_a_mirror_hold_neither_places_nor_addresses(tmp_path):
    run = spec(tmp_path / "home", dir=str(tmp_path / "private"), base_url="http://private.example.org")
    told = json.dumps(portable_settings(run.settings))
    assert not {"tracking", "private", str(tmp_path)} & set(told.split('"'))
    assert str(tmp_path) not in told
    warnings: list[str] = []
    start(tmp_path, warnings, project="acmr").close(None)
    (stored,) = [record["run"] for record in records(the_mirror(tmp_path)) if record["type"] == "run"]
    assert str(tmp_path) not in json.dumps(stored)
    assert "tracking" not in stored["config"]["update"]
    assert warnings == []


def older(tmp_path: Path) -> Path:
    """A finished run as earlier versions left it, with a password, a variable's value and places in its files."""
    run = make_run(tmp_path / "me" / "runs" / "quick" / "ant-none" / "seed_1")
    settings: dict[str, Any] = {
        **spec(tmp_path / "me", base_url=f"http://user:{SECRET}@host", options={"key": SECRET}).settings,
        "transfer": {"name": "hidden", "teacher": str(tmp_path / "me" / "runs" / "quick" / "ant-x" / "seed_7")},
    }
    settings["env"] = settings["env"] | {"id": ANT.id}
    (run / "config.yaml").write_text(yaml.safe_dump(settings))
    description = json.loads((run / "teacher.json").read_text()) | {"config": settings}
    description["description_sha256"] = description_sha256(description)
    (run / "teacher.json").write_text(json.dumps(description))
    teacher = {"path": settings["transfer"]["teacher"], "environment": "ant", "seed": 7}
    (run / "transfer.json").write_text(json.dumps({"method": "hidden", "teacher": teacher}))
    episode = {"episodic_return": 1.0, "episode_length": 10, "terminated": False, "mean_forward_velocity": None}
    evaluated = {"policy": "deterministic", "seed": 0, "episodes": 20, "fall_rate": 0.0, "run": str(run)}
    evaluated |= {"mean_return": 1.0, "std_return": 0.0, "min_return": 1.0, "max_return": 1.0, "mean_length": 10.0}
    evaluated["each"] = [episode | {"seed": seed} for seed in range(20)]
    (run / "evaluation.json").write_text(json.dumps(evaluated | {"sha256": description["sha256"]}))
    (run / "episodes.csv").write_text("global_step,episodic_return,episode_length\n10,1.0,10\n")
    return run


def test_what_is_published_tells_nothing_of_the_machine(tmp_path):
    run, out = older(tmp_path), tmp_path / "out"
    done = publish(run.parents[2], out)
    assert (len(done.added), done.left_out) == (1, [])
    (folder,) = out.rglob("seed_1")
    for path in folder.iterdir():
        assert SECRET not in path.read_text("latin-1"), path
        assert str(tmp_path) not in path.read_text("latin-1"), path
    settings = yaml.safe_load((folder / "config.yaml").read_text())
    assert settings.pop("output_dir") == "runs"
    assert settings["transfer"]["teacher"] == "ant-x/seed_7"
    assert "tracking" not in settings
    # All that decides the result stays.
    whole = yaml.safe_load((run / "config.yaml").read_text())
    assert {key: whole[key] for key in settings if key != "transfer"} == {
        key: value for key, value in settings.items() if key != "transfer"
    }
    assert load_teacher(folder).description.config["agent"] == whole["agent"]
    assert json.loads((folder / "evaluation.json").read_text())["run"] == "ant-none/seed_1"
    assert json.loads((folder / "transfer.json").read_text())["teacher"]["path"] == "ant-x/seed_7"
    assert publish(run.parents[2], out).added == []


def test_what_earlier_versions_published_is_left_as_it_is(tmp_path):
    run = older(tmp_path)
    out = tmp_path / "out" / run.parent.relative_to(run.parents[2])
    run.parent.rename(tmp_path / "aside")
    out.parent.mkdir(parents=True)
    (tmp_path / "aside").rename(out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    again = older(tmp_path)
    done = publish(again.parents[2], tmp_path / "out")
    assert (done.added, len(done.there)) == ([], 1)
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("name", ["config.yaml", "transfer.json", "teacher.json"])
@pytest.mark.parametrize("content", ["{", "[1]", "7", "a: [", ""])
def test_what_cannot_be_read_is_not_published(name, content, tmp_path):
    run = older(tmp_path)
    (run / name).write_text(content)
    with pytest.raises(PublishError, match=f"seed_1: {name}: (cannot be read .*|holds no settings); move that run"):
        publish(run.parents[2], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_damaged_description_stays_one(tmp_path):
    run = older(tmp_path)
    content = json.loads((run / "teacher.json").read_text()) | {"seed": 8}
    (run / "teacher.json").write_text(json.dumps(content))
    publish(run.parents[2], tmp_path / "out")
    (folder,) = (tmp_path / "out").rglob("seed_1")
    assert SECRET not in (folder / "teacher.json").read_text()
    with pytest.raises(ConfigError, match="do not have the sha256 that stands in it"):
        load_teacher(folder)


def test_an_evaluation_tells_of_a_run_where_it_is_among_runs(tmp_path):
    run = make_run(tmp_path / "me" / "ant-none" / "seed_1")
    assert evaluation([str(run), "--episodes", "1"]) == 0
    assert json.loads((run / "evaluation.json").read_text())["run"] == "ant-none/seed_1"


@pytest.mark.slow
def test_a_whole_run_from_a_home_and_its_publication(tmp_path):
    home = tmp_path / "home" / "somebody"
    command = ["run.py", "experiment=A0", "profile=quick", "total_timesteps=300", "agent.learning_starts=100"]
    command += [f"output_dir={home}/runs", f"tracking.dir={home}/private", "tracking.project=acmr"]
    done = subprocess.run(
        [sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False, env=dict(os.environ)
    )
    assert done.returncode == 0, done.stderr
    (run,) = home.glob("runs/quick/*/seed_1")
    assert str(home) not in (run / "teacher.json").read_text()
    (mirrored,) = home.glob("private/wandb/*run-*/*.wandb")
    assert b"somebody" not in mirrored.read_bytes()
    publish(home / "runs" / "quick", tmp_path / "out")
    for path in (tmp_path / "out").rglob("*"):
        assert not path.is_file() or b"somebody" not in path.read_bytes(), path
