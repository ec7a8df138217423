"""Transfer methods in a module of the user's own: how they are found, refused, and what checkpoints make of them."""

import sys

import pytest

import acmr
from acmr.config import ConfigError, TransferConfig
from acmr.run.reproducibility import _program
from acmr.transfer.methods import find_method, hidden

METHOD = """
from acmr.transfer.methods import Taken, copy_layers

PLAIN = 3


def mine(student, teacher, config, generator):
    return Taken(student.networks, copy_layers(student.networks, teacher, ["critic_1.output"]))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The user's folder, current and on the path as the command puts it there."""
    (tmp_path / "methods_of_mine.py").write_text(METHOD)
    (tmp_path / "broken_of_mine.py").write_text("import no_such_library")
    (tmp_path / "failing_of_mine.py").write_text("1 / 0")
    (tmp_path / "own" / "transfer").mkdir(parents=True)
    (tmp_path / "own" / "transfer" / "mine.yaml").write_text("name: mine\nmethod: methods_of_mine:mine\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in ("methods_of_mine", "broken_of_mine", "failing_of_mine"):
        sys.modules.pop(name, None)


def test_it_is_found_where_it_is_and_the_project_s_own_by_their_names(folder):
    assert find_method(TransferConfig(name="mine", method="methods_of_mine:mine")).__name__ == "mine"
    assert find_method(TransferConfig(name="hidden")) is hidden


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("methods_of_mine", "MODULE:NAME is needed, as in transfer.method=my_methods:values"),
        ("methods of mine:mine", "MODULE:NAME is needed"),
        ("nowhere_of_mine:mine", "there is no module nowhere_of_mine; it is looked for in the current folder"),
        ("broken_of_mine:mine", r"broken_of_mine cannot be imported .*no_such_library"),
        ("failing_of_mine:mine", r"failing_of_mine cannot be imported .*division by zero"),
        ("methods_of_mine:yours", "methods_of_mine has no yours; there are mine"),
        ("methods_of_mine:PLAIN", "no function"),
    ],
)
def test_what_stands_for_nothing_is_one_line_before_any_teacher_is_looked_for(folder, place, says):
    settings = {"profile": "quick", "transfer.method": place}
    with pytest.raises(ConfigError, match=says) as raised:
        acmr.train("transfer=mine", config_dir="own", **settings)
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(f"transfer.method={place}: ")


def test_a_student_of_it_asks_for_its_teacher_with_the_folder_in_the_command(folder):
    with pytest.raises(ConfigError, match=r"or both, one after the other: \S+ \S+ -m --config-dir own .*transfer=mine"):
        acmr.train("transfer=mine", config_dir="own", profile="quick")


def test_a_checkpoint_depends_on_the_method_in_use_and_on_no_other(folder):
    plain = _program(("acmr.agent.sac", "acmr.transfer.hidden"))
    used = {line.split()[0] for line in plain.decode().splitlines()}
    assert {"acmr.agent.sac", "acmr.transfer.methods", "acmr.run.trainer", "acmr.envs.bodies"} <= used
    assert not used & {"acmr.transfer.named", "acmr.agent.sac_plain", "acmr.cells", "acmr.tracking.observer"}
    # What users come in by is passed on by the package itself, and computes nothing.
    assert "acmr" in used
    assert not {name for name in used if name.startswith("acmr.app")}
    named = _program(("acmr.agent.sac", "acmr.transfer.named"))
    more = {line.split()[0] for line in named.decode().splitlines()} - used
    assert more == {"acmr.transfer.named"}


def test_a_checkpoint_depends_on_what_the_user_s_method_does(folder, monkeypatch):
    before = _program(("acmr.agent.sac", "methods_of_mine"))
    assert "methods_of_mine" in before.decode()
    (folder / "other").mkdir()
    found = []
    for number, text in enumerate((f"# A remark.\n{METHOD}", METHOD.replace("critic_1", "critic_2"))):
        place = folder / "other" / str(number)
        place.mkdir()
        (place / "methods_of_mine.py").write_text(text)
        monkeypatch.syspath_prepend(place)
        found.append(_program(("acmr.agent.sac", "methods_of_mine")))
    assert found[0] == before
    assert found[1] != before
