r"""How a name that somebody else chose is put where it is shown: one function for each place.

A run's or a group's name is a folder's. It may hold whatever a file system takes: line ends, a terminal's commands,
letters that turn the direction of writing, bytes that are no text, and signs that mean something in a table or a link.
Sentences that hold names are put by the same functions. Standard library only.
"""

from __future__ import annotations

import os
import re
from collections.abc import Container, Iterable
from pathlib import PurePath
from urllib.parse import quote

#: Bytes of a file's name that are no text stand in Python's strings as these characters, less this number.
_BYTES, _NO_TEXT = range(0xDC80, 0xDD00), 0xDC00
#: Signs that Markdown, with tables, mathematics and HTML in it, does not leave as they are.
_MARKDOWN = re.compile(r"[\\`*<>\[\]|&~$]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")
#: What a spreadsheet computes: an equal sign and the like where a cell begins, the wide ones of Chinese and Japanese
#: included. Where a spreadsheet of another country parts cells the writer quotes nothing, and quotes that it doubles
#: may be taken for an empty text before the sign.
_FORMULA = re.compile(r"""(^|[;|])([ "]*[=+\-@\uff1d\uff0b\uff0d\uff20])""")
_LATEX = {
    **{sign: f"\\{sign}" for sign in "{}$&#%_"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "|": r"\textbar{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "`": r"\textasciigrave{}",
    '"': "''",
    # At the beginning of a row these would belong to the end of the one before.
    **{sign: f"{{{sign}}}" for sign in "[]*"},
}


def terminal(name: str) -> str:
    r"""A name for a terminal, or a page of HTML, which escapes its own signs: what is no visible letter as ``\n``."""
    return "".join(sign if sign.isprintable() else _escaped(sign) for sign in name)


def figure(name: str, drawn: Container[int]) -> str:
    """A name for a figure whose text is no mathematics (``text.parse_math`` of matplotlib).

    Args:
        name: The name.
        drawn: Numbers of the letters that the figure's font has; others would be empty boxes.
    """
    text = "".join(sign if ord(sign) in drawn else _escaped(sign) for sign in terminal(name))
    # A legend leaves out what begins with an underscore.
    return f" {text}" if text.startswith("_") else text


def link(path: PurePath) -> str:
    """A path as the address of a link."""
    return quote(os.fsencode(path.as_posix()))


def markdown(name: str) -> str:
    """A name for a cell of a Markdown table."""
    return _MARKDOWN.sub(lambda sign: f"\\{sign[0]}", terminal(name))


def latex(name: str) -> str:
    """A name for LaTeX; letters that are not ASCII stay, for XeLaTeX and LuaLaTeX take them all."""
    text = "".join(_LATEX.get(sign, sign) for sign in terminal(name))
    # Two hyphens would become one dash.
    return re.sub(r"-(?=-)", "-{}", text)


def csv_cell(name: str) -> str:
    """A name for a CSV file; what a spreadsheet would compute has an apostrophe before it. Quoting is the writer's."""
    return _FORMULA.sub(r"\1'\2", terminal(name))


def distinct(names: Iterable[str], ending: str | None = None) -> dict[str, str]:
    """Names of visible letters that differ from each other where the names do, by name; without a certain ending."""
    shown: dict[str, str] = {}
    taken: set[str] = set()
    for name in dict.fromkeys(names):
        text = terminal(name)
        while text in taken or (ending and text.endswith(ending)):
            text += "_"
        shown[name] = text
        taken.add(text)
    return shown


def archive_keys(names: Iterable[str]) -> dict[str, str]:
    """Keys in an ``.npz`` archive, by name."""
    # numpy leaves out this ending when it reads.
    return distinct(names, ending=".npy")


def _escaped(sign: str) -> str:
    if ord(sign) in _BYTES:
        return f"\\x{ord(sign) - _NO_TEXT:02x}"
    return sign.encode("unicode_escape").decode()
