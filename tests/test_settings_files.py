"""The files of conf/: one that builds on another, ones that are wrong, those of the guide."""

import shutil
from dataclasses import fields
from pathlib import Path

import hydra
import pytest
from guides import ROOT, blocks
from omegaconf import OmegaConf

from acmr.config import (
    EnvConfig,
    ExperimentConfig,
    PairConfig,
    SACConfig,
    TrackingConfig,
    TransferConfig,
    TransferRules,
)
from acmr.envs import describe
from acmr.settings import compose
from acmr.settings.compose import compose_config, environment_config, options
from acmr.settings.errors import USER_ERRORS, explain


@pytest.fixture
def conf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of conf/ to write into."""
    folder = tmp_path / "conf"
    shutil.copytree(compose.CONFIG_FOLDER, folder)
    monkeypatch.setattr(compose, "CONFIG_FOLDER", folder)
    return folder


def refusal(name: str) -> str:
    with pytest.raises(USER_ERRORS) as caught:
        environment_config(name)
    line = explain(caught.value)
    assert "\n" not in line
    return line


def test_a_file_builds_on_another(conf: Path) -> None:
    (conf / "env" / "base.yaml").write_text("name: base\nid: Ant-v5\nsource: base\nkwargs: {a: 1, b: 2}\n")
    (conf / "env" / "limp.yaml").write_text("defaults: [base]\nname: limp\nkwargs: {b: 3}\ndrop_actuators: [hip_1]\n")
    config = environment_config("limp")
    assert (config.name, config.id, config.source) == ("limp", "Ant-v5", "base")
    assert config.kwargs == {"a": 1, "b": 3}
    assert config.drop_actuators == ["hip_1"]
    assert "limp" in options("env")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id: Ant-v5\nremove_body: [a]\n",
         "conf/env/bad.yaml: env.remove_body: no such setting; did you mean env.remove_bodies?"),
        ("remove_bodies: 3\n", "conf/env/bad.yaml: env.remove_bodies: must be a list, as in [a, b]"),
        ("id: [Ant-v5]\n", "conf/env/bad.yaml: env.id: Cannot convert"),
        ("- a\n- b\n", "conf/env/bad.yaml: env: holds settings: write each on a line"),
        ("id: [", "not readable as YAML: while parsing"),
        ("id: \0", "not readable as YAML: unacceptable character"),
        ("defaults: [humanoyd]\n", "conf/env/bad.yaml: env=humanoyd: must be one of "),
        ("defaults: [humanoyd]\n", "; did you mean env=humanoid?"),
        ("id: Ant-v5\nsource: bad\n", "env.name has no value: type env.name=VALUE"),
        ("id: ${nowhere}\n", "Interpolation key 'nowhere' not found"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_one_line(text: str, message: str, conf: Path) -> None:
    (conf / "env" / "bad.yaml").write_text(text)
    assert message in refusal("bad")


def test_the_files_of_the_guide_are_environments(conf: Path) -> None:
    written = {block.file: block.text for block in blocks(ROOT / "docs" / "howto-environment.md") if block.file}
    named = [Path(file) for file in written if file.startswith("conf/env/")]
    assert len(named) == 3
    for file in named:
        (conf.parent / file).write_text(written[str(file)])
    for file in named:
        config = environment_config(file.stem)
        assert config.name == file.stem
        about, source = describe(config), describe(environment_config(config.source))
        assert (len(about.action_names) < len(source.action_names)) == (config.source != config.name)


def test_files_that_are_read_once_make_what_hydra_makes_of_them() -> None:
    """Of groups, values in them, added entries, removed settings: what compose_config takes from Hydra's inside."""
    for overrides in (
        ["profile=quick", "transfer=hidden", "freeze='true'", "agent.q_lr=1e-4", "agent.hidden_sizes=[8,8]"],
        [
            "env=gym",
            "env.id=Hopper-v5",
            "+env.kwargs.healthy_reward=2.0",
            "+env.kwargs.a=1",
            "~env.kwargs.a",
            "++seed=3",
        ],
    ):
        compose.register_schema()
        with hydra.initialize_config_dir(str(compose.CONFIG_FOLDER), version_base="1.3"):
            theirs = hydra.compose("config", overrides=overrides)
        ours = [OmegaConf.to_container(compose_config(overrides)) for _ in range(2)]
        assert ours == [OmegaConf.to_container(theirs)] * 2


def test_every_setting_says_in_a_comment_what_it_means() -> None:
    lines = (ROOT / "acmr" / "config.py").read_text().splitlines()
    silent, seen = [], set()
    for kind in (EnvConfig, SACConfig, TransferConfig, TransferRules, TrackingConfig, PairConfig, ExperimentConfig):
        start = lines.index(f"class {kind.__name__}:")
        for entry in fields(kind):
            row = next(row for row in range(start, len(lines)) if lines[row].startswith(f"    {entry.name}: "))
            seen.add(row)
            # A group of settings is described by its class.
            if not str(entry.type).endswith(("Config", "Rules")) and not lines[row - 1].startswith("    #: "):
                silent.append(f"{kind.__name__}.{entry.name}")
    assert silent == []
    assert len(seen) > 50
