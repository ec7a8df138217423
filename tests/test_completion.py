"""Completion with Tab, asked of a real bash: what its function for ``acmr`` answers to what is typed so far."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from guides import ROOT

from acmr.app.completion import shell_code
from acmr.command import SUBCOMMANDS
from acmr.config import ConfigError

#: Sources the completion and calls the function that bash calls, found by what is registered for the command.
ASK = """
eval "$(acmr -sc install=bash)"
complete -p acmr >/dev/null || exit 1
registered=($(complete -p acmr))
for (( at=0; at < ${#registered[@]}; at++ )); do [[ ${registered[at]} == -F ]] && function=${registered[at+1]}; done
while IFS= read -r COMP_LINE; do
  COMP_POINT=${#COMP_LINE} COMP_TYPE=9 COMPREPLY=()
  $function acmr
  (IFS=' '; echo "${COMPREPLY[*]}")
done
"""


@pytest.fixture
def asked(tmp_path: Path):
    if find_spec("argcomplete") is None:
        assert not os.environ.get("ACMR_REQUIRE_EXTRAS"), "argcomplete is to be installed here"
        pytest.skip("argcomplete not installed; type make setup")
    script = tmp_path / "bin" / "acmr"
    script.parent.mkdir()
    # As pip writes it for the installed command.
    script.write_text(f"#!{sys.executable}\nimport sys\nfrom acmr.app.commands import main\nsys.exit(main())\n")
    script.chmod(0o755)

    def ask(*lines: str) -> list[set[str]]:
        environment = os.environ | {"PYTHONPATH": str(ROOT), "PATH": f"{script.parent}:{os.environ['PATH']}"}
        done = subprocess.run(
            ["bash", "-c", ASK], input="\n".join(lines) + "\n", cwd=tmp_path, env=environment, text=True,
            capture_output=True, check=True,
        )  # fmt: skip
        assert done.stderr == ""
        assert [path.name for path in tmp_path.iterdir()] == ["bin"]
        return [set(line.split()) for line in done.stdout.split("\n")[:-1]]

    return ask


def test_tab_completes_subcommands_settings_and_options(asked):
    first, chosen, options = asked("acmr st", "acmr -m seed=1 env=an", "acmr status --")
    # Bash takes what stands before the equal sign for a word of its own.
    assert first >= {"status", "stop="}
    assert chosen == {path.stem for path in (ROOT / "conf" / "env").glob("an*.yaml")} >= {"ant", "ant_three_legs"}
    assert options == {"--help", "--watch"}


@pytest.mark.slow
def test_tab_completes_nested_settings_words_of_a_search_files_and_folders_of_ones_own(asked, tmp_path):
    folder = tmp_path / "bin" / "conf" / "env"
    folder.mkdir(parents=True)
    (folder / "mine.yaml").write_text("name: mine\nid: Ant-v5\nsource: ant\n")
    empty, nested, search, own, file = asked(
        "acmr ", "acmr agent.q", "acmr tune tri", "acmr --config-dir bin/conf env=mi", "acmr export bi"
    )
    assert empty >= {*SUBCOMMANDS, "env=", "transfer=", "seed="}
    assert (nested, search, own, file) == ({"agent.q_lr="}, {"trials="}, {"mine"}, {"bin/"})


@pytest.mark.slow
def test_options_of_every_subcommand_are_there_and_none_begins_its_work(asked):
    names = [name for name in SUBCOMMANDS if name not in ("train", "tune")]
    for name, found in zip(names, asked(*(f"acmr {name} --" for name in names)), strict=True):
        assert "--help" in found, name


def test_what_a_shell_evaluates():
    assert shell_code("uninstall=bash") == "complete -r acmr"
    for action in ("install=tcsh", "instal=bash", ""):
        with pytest.raises(ConfigError, match="must be one of install=bash, install=zsh, install=fish, or uninstall"):
            shell_code(action)
