"""Reads the docstrings as this project writes them: references such as (:mod:`acmr.records`), comments with ``#:``."""

from __future__ import annotations

import re
from itertools import takewhile
from typing import Any

import griffe

_ROLE = re.compile(r":(?:mod|class|func|meth|data|attr|exc):`(?P<short>~?)(?P<name>[\w.]+)`")
_COMMENT = "#:"


class OwnDocstrings(griffe.Extension):
    """Makes a link of every name that a docstring refers to in full, and a docstring of the comment above a value."""

    def on_attribute(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Finds what is said of a value or a setting."""
        if attr.docstring is None and isinstance(attr.lines_collection, griffe.LinesCollection) and attr.lineno:
            lines = attr.lines_collection[attr.filepath][: attr.lineno - 1]
            said = list(takewhile(lambda line: line.startswith(_COMMENT), (line.strip() for line in reversed(lines))))
            if said:
                text = "\n".join(line.removeprefix(_COMMENT).strip() for line in reversed(said))
                attr.docstring = griffe.Docstring(text, lineno=attr.lineno - len(said), parent=attr)

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrites the references of one docstring."""
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub(_link, obj.docstring.value)


def _link(role: re.Match[str]) -> str:
    name = role["name"]
    shown = name.rpartition(".")[2] if role["short"] else name
    return f"[`{shown}`][{name}]" if name.startswith(("acmr.", "sweeps.", "analysis.")) else f"`{shown}`"
