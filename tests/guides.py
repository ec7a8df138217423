"""The code blocks of a guide, and a place to do literally what it says."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
#: Parts of a checkout that the program does not need.
_ASIDE = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "runs", "results", "tests", "docs")
_BLOCK = re.compile(
    r"^(?P<fence>```+)(?P<language>\w+)(?: +file=(?P<file>\S+))? *\n(?P<text>.*?)^(?P=fence) *$", re.M | re.S
)


class Block(NamedTuple):
    """One fenced block: its language, the file that it is the content of, and its text."""

    language: str
    file: str | None
    text: str


def blocks(path: Path) -> list[Block]:
    """The blocks of a Markdown file that name a language, opened as ```python or ```yaml file=conf/env/mine.yaml."""
    return [Block(found["language"], found["file"], found["text"]) for found in _BLOCK.finditer(path.read_text())]


def copy_checkout(folder: Path) -> Path:
    """Copies this checkout, as far as the program needs it; whatever runs there imports the copy."""
    return shutil.copytree(ROOT, folder, ignore=_ASIDE)


def follow(guide: Path, folder: Path) -> str:
    """Does in a folder what a guide says, block by block in order; returns what its commands say."""
    return "".join(do(block, folder) for block in blocks(guide))


def do(block: Block, folder: Path) -> str:
    """Writes the file of a block, makes its change to a file (diff), or runs it (bash); returns what it says."""
    if block.file is not None:
        path = folder / block.file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(patched(path.read_text(), block.text) if block.language == "diff" else block.text)
    elif block.language == "bash":
        environment = {
            **os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "OMP_NUM_THREADS": "1",
        }  # fmt: skip
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block.text], cwd=folder, env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=240,
        )  # fmt: skip
        assert done.returncode == 0, f"{block.text}\n{done.stdout}"
        return done.stdout
    return ""


def patched(text: str, diff: str) -> str:
    """A text after a change that is written as lines with a blank, minus or plus before them, without line numbers."""
    lines = [(line[:1], f"{line[1:]}\n") for line in diff.splitlines()]
    before, after = ("".join(line for sign, line in lines if sign != other) for other in "+-")
    assert text.count(before) == 1, f"not once in the file:\n{before}"
    return text.replace(before, after)
