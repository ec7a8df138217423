"""What ``--help`` says beside groups and values: what each setting means, and the words of a sweep."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from omegaconf import OmegaConf

from acmr.config import ExperimentConfig, TransferRules
from acmr.settings.sources import Sources

#: What the template of the help calls: ``${acmr_help:settings}``, ``${acmr_help:sweeps}``.
_RESOLVER = "acmr_help"
_WIDTH, _INDENT = 118, 4
#: A setting in the source of its class, with the comments before it that are meant for users.
_FIELD = re.compile(r"((?:^ +#: .*\n)+)^ +(\w+): ", re.MULTILINE)
_WORDS = {
    "plan=true": "say what would be trained, and what it needs; start nothing",
    "workers=N": "how many runs are trained at a time; as many as there are cores where it is left out",
    "retries=N": "how often a run that failed is tried again; 2",
    "hydra/launcher=NAME": "who starts the workers: {launchers}",
}


def register_help(places: Sources) -> None:
    """Lets the template of ``--help`` ask for what the settings of these places mean."""
    parts = {"settings": lambda: "\n".join(_settings()), "sweeps": lambda: "\n".join(_sweeps(places))}
    OmegaConf.register_new_resolver(_RESOLVER, lambda part: parts[part](), replace=True)


def meanings(kind: type = ExperimentConfig, prefix: str = "") -> dict[str, str]:
    """What each setting means, by its key: the comments in :mod:`acmr.config`."""
    said = {name: _plain(comment) for comment, name in _FIELD.findall(inspect.getsource(kind))}
    found: dict[str, str] = {}
    for entry in fields(kind):
        inner: Any = entry.default_factory
        if inner is TransferRules:
            # Facts of the methods, which nobody sets.
            continue
        if inner is not MISSING and is_dataclass(inner) and isinstance(inner, type):
            found |= meanings(inner, f"{prefix}{entry.name}.")
        else:
            found[f"{prefix}{entry.name}"] = said[entry.name]
    return found


def _plain(comment: str) -> str:
    words = " ".join(line.strip().removeprefix("#:").strip() for line in comment.splitlines())
    # Dollar signs belong to the template.
    return words.replace("``", "").replace("$", "$$")


def _settings() -> Iterator[str]:
    for key, meaning in meanings().items():
        yield key
        yield textwrap.fill(meaning, _WIDTH, initial_indent=" " * _INDENT, subsequent_indent=" " * _INDENT)


def _sweeps(places: Sources) -> Iterator[str]:
    yield f"{'matrix=NAME':<22}a whole study: {', '.join(places.options('matrix'))}"
    launchers = ", ".join(places.options("hydra/launcher"))
    for word, meaning in _WORDS.items():
        yield f"{word:<22}{meaning.format(launchers=launchers)}"
