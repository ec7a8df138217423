"""Settings files as people write them: each fault is one line with the file, the place in it and what to write."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from acmr.settings import compose
from acmr.settings.compose import compose_config, parse
from acmr.settings.errors import USER_ERRORS, explain
from acmr.settings.sources import SWEEPS, Sources

ROOT = Path(__file__).resolve().parents[1]
ANT = "name: bad\nid: Ant-v5\nsource: bad\n"
MATRIX = b"# @package _global_\nhydra: {mode: MULTIRUN, sweeper: {params: {sed: '1,2'}}}\n"


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """A copy of conf/ and a folder of the user's own."""
    main, own = tmp_path / "conf", tmp_path / "own"
    shutil.copytree(compose.CONFIG_FOLDER, main)
    own.mkdir()
    monkeypatch.setattr(compose, "_given", Sources((f"file://{main}", f"file://{own}", SWEEPS)))
    return main, own


def refusal(*words: str) -> str:
    with pytest.raises(USER_ERRORS) as caught:
        parse(compose_config(words))
    line = explain(caught.value)
    assert "\n" not in line
    return line


#: Group, what its file holds, and what is said of it behind its name.
FAULTS: dict[str, tuple[str, str | bytes, str]] = {
    "tab": ("env", "name: bad\n\tid: Ant-v5\n", "not readable as YAML: a tab; indent with spaces (line 2, column 1)"),
    "tab in a group": ("agent", "name: sac\noptions:\n\ta: 1\n", "a tab; indent with spaces (line 3, column 1)"),
    "key twice": ("env", f"{ANT}id: Hopper-v5\n", "id is there twice; keep one of them (line 4, column 1)"),
    "key twice below": ("env", f"{ANT}kwargs: {{a: 1, a: 2}}\n",
                        "a is there twice; keep one of them (line 4, column 16)"),
    "latin-1": ("env", f"{ANT}# f\xfcr\n".encode("latin-1"),
                "not written in UTF-8 (line 4, column 4); save it as UTF-8"),
    "latin-1, far below": ("env", ANT.encode() + b"# more\n" * 200 + b"\xe9",
                           "not written in UTF-8 (line 204, column 1)"),
    "utf-16": ("env", ANT.encode("utf-16"), "not written in UTF-8 (line 1, column 1); save it as UTF-8"),
    "unknown key": ("env", f"{ANT}remove_body: [a]\n",
                    "env.remove_body: no such setting; did you mean env.remove_bodies? (line 4, column 1)"),
    "unknown key of a method": ("transfer", "name: hidden\nrules: {min_layers: 3}\n",
                                "did you mean transfer.rules.min_hidden_layers or"),
    "unknown key of all": ("experiment", "# @package _global_\nfreez: true\n",
                           "freez: no such setting; did you mean freeze or force? (line 2, column 1)"),
    "unknown key unlike any": ("env", "zzzzzzzzzzzz: 1\n", "there are env.drop_actuators, env.drop_sensors"),
    "missing default": ("env", "defaults: [humanoyd]\n", "did you mean env=humanoid? (line 1, column 12)"),
    "missing group": ("env", "defaults:\n  - /transfr: hidden\n",
                      "transfr=hidden: there is no group transfr, only agent, env, experiment, freeze, matrix, "
                      "profile, seeding, tracking, transfer; did you mean transfer? (line 2, column 15)"),
    "missing group, as a path": ("env", "defaults: [/transfr/hidden]\n", "there is no group transfr, only agent, env"),
    "missing override": ("experiment", "# @package _global_\ndefaults:\n  - override /evn: ant\n",
                         "override evn: there is no group evn, only agent, env,"),
    "override of nothing": ("env", "defaults: [override /env: ant]\n", "override env: only experiments, profiles and"),
    "defaults that are none": ("env", "defaults: ant\n", "defaults: must be a list, as in defaults: [NAME]"),
    "two defaults in one": ("env", "defaults: [{a: b, c: d}]\n", "must be a name, or GROUP: NAME, one in each entry"),
    "itself": ("env", "defaults: [bad]\n", "defaults: bad: the file builds on itself; name another one"),
    "empty": ("env", "", "is empty; write its settings, as in name: bad, or remove the file"),
    "empty profile": ("profile", "# to be done\n", "is empty; write its settings, as in name: bad, or remove the file"),
    "empty method": ("transfer", "\n\n", "is empty; write its settings, as in name: bad, or remove the file"),
    "no space": ("env", "name:bad\nid: Ant-v5\n", "not readable as YAML: mapping values are not allowed here (line 2"),
    "two documents": ("env", f"{ANT}---\nid: b\n", "but found another document (line 4, column 1)"),
    "a type": ("env", f"{ANT}max_episode_steps: many\n", "env.max_episode_steps: Value 'many' of type 'str' could not"),
    "an object": ("env", "name: !!python/object/apply:os.system [ls]\n",
                  "Python objects are not allowed; write plain text"),
    "a circle": ("env", "name: &a [*a]\n", "not readable as YAML: a part of it holds itself"),
    "a list in the place of settings": ("env", "- a\n", "env: holds settings: write each on a line of its own"),
    "a value in the place of settings": ("experiment", "# @package _global_\nagent: sac\n",
                                         "agent: holds settings: write each on a line of its own below it, as key: "
                                         "value (line 2, column 8)"),
    "a list of arguments": ("env", f"{ANT}kwargs: [a]\n", "env.kwargs: holds settings: write each on a line of its"),
    "settings in the place of a list": ("env", f"{ANT}drop_sensors: {{a: 1}}\n",
                                        "env.drop_sensors: must be a list, as in [a, b] (line 4, column 15)"),
    "a value in the place of a list": ("agent", "defaults: [sac]\nhidden_sizes: 256\n",
                                       "agent.hidden_sizes: must be a list, as in [a, b] (line 2, column 15)"),
    "rules that are none": ("transfer", "name: hidden\nrules: true\n", "transfer.rules: holds settings: write each"),
    "a number without end": ("env", f"{ANT}max_episode_steps: {'9' * 5000}\n", "not readable as YAML: Exceeds the"),
    "half a header": ("env", f"# @package\n{ANT}", "not readable as YAML: Expected header format"),
    "an interpolation": ("env", f"{ANT}kwargs: {{a: '${{nowhere}}'}}\n",
                         "Interpolation key 'nowhere' not found (line 4"),
    "a broken interpolation": ("env", "id: ${nowhere\n", "id: no viable alternative at input '${nowhere' (line 1"),
}  # fmt: skip


@pytest.mark.parametrize("whose", [0, 1], ids=["conf", "own"])
@pytest.mark.parametrize(("group", "content", "says"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_one_line(
    group: str, content: str | bytes, says: str, whose: int, folders: tuple[Path, Path]
) -> None:
    file = folders[whose] / group / "bad.yaml"
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    line = refusal(f"{group}=bad", *(["env=ant"] if group == "profile" else []))
    assert line.startswith(f"{file if whose else f'conf/{group}/bad.yaml'}: ")
    assert says in line


CIRCLES = {
    "of two": {"bad": "worse", "worse": "bad"},
    "of three, and a way into it": {"bad": "b1", "b1": "b2", "b2": "b3", "b3": "b1"},
    "through a file of the project": {"bad": "humanoid", "humanoid": "paper_source"},
}


@pytest.mark.parametrize("builds_on", CIRCLES.values(), ids=CIRCLES)
def test_files_that_build_on_each_other_are_named(builds_on: dict[str, str], folders: tuple[Path, Path]) -> None:
    main, own = folders[0] / "env", folders[1] / "env"
    own.mkdir()
    for name, other in builds_on.items():
        (own / f"{name}.yaml").write_text(f"defaults: [{other}]\nname: {name}\n")
    # It would hide the user's own, which closes the circle.
    (main / "humanoid.yaml").unlink()
    start = builds_on["bad"] if "humanoid" in builds_on or "b1" in builds_on else "bad"
    line = refusal("env=bad")
    assert line.startswith(f"{own / start}.yaml: defaults: builds on ")
    assert line.count("builds on") == (3 if start == "b1" else 2)
    assert line.endswith(f", which builds on {own / start}.yaml; name another file in one")


@pytest.mark.parametrize("text", [f"\ufeff{ANT}", ANT.replace("\n", "\r\n"), ANT[:-1], f"# für\n{ANT}"])
def test_what_is_no_fault(text: str, folders: tuple[Path, Path]) -> None:
    (folders[0] / "env" / "bad.yaml").write_bytes(text.encode())
    assert parse(compose_config(["env=bad"])).env.id == "Ant-v5"


@pytest.mark.parametrize(
    ("file", "content", "words", "says"),
    [
        ("env/bad.yaml", b"name: bad\n\tid: x\n", ["env=bad"], "a tab; indent with spaces (line 2, column 1)"),
        ("env/bad.yaml", b"\xfcber: 1\n", ["-m", "env=bad", "seed=1,2"], "not written in UTF-8 (line 1, column 1)"),
        ("env/bad.yaml", b"", ["-m", "env=ant,bad"], "bad.yaml: is empty; write its settings"),
        ("matrix/bad.yaml", b"# @package _global_\nhydra:\n\tmode: MULTIRUN\n", ["matrix=bad"], "a tab; indent with"),
        ("matrix/bad.yaml", MATRIX, ["matrix=bad"],
         "bad.yaml: hydra.sweeper.params: sed: no such setting; did you mean seed or seeding? (line 2, column 44)"),
        ("env/bad.yaml", b"defaults: [/env/bad@_here_]\n", ["env=bad"], "bad.yaml: defaults: builds on "),
        ("env/good.yaml", ANT.encode(), ["env=null"], "env=null: must be one of ant, "),
        ("env/good.yaml", ANT.encode(), ["transfer=3"], "transfer=3: must be one of direct, expand, hidden, named"),
    ],
)  # fmt: skip
def test_as_a_user_sees_it(file: str, content: bytes, words: list[str], says: str, tmp_path: Path) -> None:
    (tmp_path / "own" / file).parent.mkdir(parents=True)
    (tmp_path / "own" / file).write_bytes(content)
    command = [sys.executable, str(ROOT / "run.py"), "--config-dir", "own", *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["own"]
