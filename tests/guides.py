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
    """Writes the files of a guide into a folder and runs its bash blocks there in order; returns what they say."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
    said = ""
    for block in blocks(guide):
        if block.file is not None:
            (folder / block.file).parent.mkdir(parents=True, exist_ok=True)
            (folder / block.file).write_text(block.text)
        elif block.language == "bash":
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", block.text], cwd=folder, env=environment, text=True,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=240,
            )  # fmt: skip
            said += done.stdout
            assert done.returncode == 0, f"{guide.name}: {block.text}\n{done.stdout}"
    return said
