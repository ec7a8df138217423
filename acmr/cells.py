"""The experiments, one row a cell; their runs' names, tables, comparisons and figures follow from the rows.

A cell of one's own is one row of ``CELLS`` and one file in ``conf/experiment`` (docs/howto-cell.md). Like
:mod:`acmr.records` it needs the standard library only: ``acmr`` names runs by it, ``sweeps`` and ``analysis`` know them
again.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from acmr.config import INDEPENDENT, STOP_KEYS, TransferConfig

#: Environments of a profile's pair, by what they are in a transfer.
SOURCE, TARGET = "source", "target"
#: What cells of the target are compared with; another group may take its place (``--reference`` of the analysis).
REFERENCE = "A0"

_LONGEST_NAME = 120
_PLAIN = re.compile(r"[A-Za-z0-9_.+-]{1,32}")
#: Settings that say which run of a cell it is, like its seed, and not which cell: when it ends, how it uses its seed.
_OF_NO_CELL = (*STOP_KEYS, "seeding")
#: How a name says that the run stops at its threshold.
_STOP = re.compile(r"-stop=threshold(-stop_after=\d+)?(?=-|$)")
#: How a name says that the run draws from random numbers of its own.
_SEEDING = re.compile(rf"-seeding={INDEPENDENT}(?=-|$)")


@dataclass(frozen=True)
class Cell:
    """One experiment: runs that differ in nothing but their seeds.

    Attributes:
        name: As in ``experiment=A2``; its file in ``conf/experiment`` has the same.
        role: Where it learns: in the ``source`` or the ``target`` environment of the profile's pair.
        transfer: What it takes from its teacher, a name in ``conf/transfer``.
        freeze: Whether that stays as it is.
        configuration: What tables 1 and 2 call it.
        baseline: Cell that it is compared with in table 3; None: it is itself only compared with.
        family: Question that it answers with others of the same family: their p-values are adjusted together (Holm).
        color: In figures: a name in ``analysis/figures/style.py``, or any color of matplotlib.
        marker: In the figures that can do without color, one of matplotlib's.
        changes: Further settings that define it, as ``{"agent.q_lr": 3e-4}``; each differs from its profile's own.
        published: Whether it is the paper's. Such cells are planned in every profile, others only where they have runs.
    """

    name: str
    role: str
    transfer: str
    freeze: bool
    configuration: str
    baseline: str | None
    family: str | None
    color: str
    marker: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    published: bool = False

    @property
    def teaches(self) -> bool:
        """Whether it is the run that students learn from unless another teacher is named."""
        # By default nothing is transferred.
        return self.role == SOURCE and self.transfer == TransferConfig().name and not self.changes


#: What is taken by name, in the beginning that the paper's students have.
_WEIGHTS_ALONE = {
    "agent.kickstart": 0.0,
    "agent.start": "random",
    "agent.warmup": 0,
    "transfer.copy_log_alpha": False,
    "transfer.impute": "mean",
}

#: Every cell by its name, in the order of tables: first the paper's (paper, table 2), then those that go beyond it.
CELLS = {
    cell.name: cell
    for cell in (
        Cell("H0", SOURCE, "none", False, "Baseline", "A0", None, "brown", "P", published=True),
        Cell("H1", SOURCE, "direct", False, "POC", "H0", None, "cyan", "X", published=True),
        Cell("A0", TARGET, "none", False, "Baseline", None, None, "blue", "o", published=True),
        Cell("A1", TARGET, "hidden", False, "Conf. 1", "A0", "transfer", "orange", "s", published=True),
        Cell("A2", TARGET, "hidden", True, "Conf. 2", "A0", "transfer", "green", "^", published=True),
        Cell("A3", TARGET, "expand", False, "Conf. 3", "A0", "transfer", "red", "D", published=True),
        Cell("A4", TARGET, "expand", True, "Conf. 4", "A0", "transfer", "purple", "v", published=True),
        Cell("N0", TARGET, "named", False, "By name, weights", "A0", "named", "olive", "d", _WEIGHTS_ALONE),
        Cell("N1", TARGET, "named", False, "By name", "A0", "named", "pink", "*"),
        Cell("N2", TARGET, "named", False, "By name, random", "A0", "named", "gray", "p", {"agent.start": "random"}),
    )
}


def cell_of(role: str | None, transfer: str, freeze: bool, changes: Mapping[str, Any]) -> str | None:
    """The cell that a run belongs to, if there is one; where the run stops and how it uses its seed do not matter.

    Args:
        role: What its environment is in its profile's pair; None: neither source nor target.
        transfer: Its method.
        freeze: Whether it freezes what it took.
        changes: All settings, as ``group.key``, in which it differs from its profile's own.
    """
    meant = (role, transfer, freeze, without_kind(changes))
    found = (cell for cell in CELLS.values() if (cell.role, cell.transfer, cell.freeze, cell.changes) == meant)
    return next((cell.name for cell in found), None)


def planned_cells(groups: Iterable[str]) -> list[Cell]:
    """The cells that a folder of runs should have: the paper's, and others of which there is a run.

    Args:
        groups: What there are runs of.
    """
    found = set(groups)
    return [cell for cell in CELLS.values() if cell.published or cell.name in found]


def run_name(env: str, transfer: str, freeze: bool, changes: Mapping[str, Any]) -> str:
    """Name of a run's directory: ``<env>-<transfer>[-frozen][-<key>=<value>...]``.

    Args:
        env: Its environment.
        transfer: Its method.
        freeze: Whether it freezes what it took.
        changes: All settings, as ``group.key``, in which it differs from its profile's own.
    """
    parts = [re.sub(r"[^A-Za-z0-9_.-]", "_", env), transfer, *(["frozen"] if freeze else [])]
    rest = _said(without_kind(changes))
    if len("-".join([*parts, *rest])) <= _LONGEST_NAME:
        return "-".join([*parts, *_said(changes)])
    # Where it ends and how it uses its seed stay to be read, so that its kin can be found by their names.
    kind = {key: value for key, value in changes.items() if key in _OF_NO_CELL}
    return "-".join([*parts, digest(rest), *_said(kind)])


def _said(changes: Mapping[str, Any]) -> list[str]:
    leaves = sorted(((key.split(".")[-1], value) for key, value in changes.items()), key=lambda leaf: leaf[0])
    return [f"{key}={_short(value)}" for key, value in leaves]


def without_kind(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Of the settings in which a run differs from its profile those that more than its own seed depends on."""
    return {key: value for key, value in changes.items() if key not in _OF_NO_CELL}


def stops(name: str) -> bool:
    """Whether a run of this name ends at its threshold."""
    return _STOP.search(name) is not None


def draws_apart(name: str) -> bool:
    """Whether a run of this name draws from random numbers of its own (``seeding=independent``)."""
    return _SEEDING.search(name) is not None


def plain_name(name: str) -> str:
    """The name of runs like this one, whether or not they stop at the threshold and however they use their seeds."""
    return _SEEDING.sub("", _STOP.sub("", name))


def digest(value: object) -> str:
    """Eight characters that stand for a value in a name."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:8]


def _short(value: object) -> str:
    if isinstance(value, list | tuple):
        text = "+".join(_short(entry) for entry in value) if value else "none"
    else:
        text = str(value).lower() if isinstance(value, bool) else str(value)
    # What is long, or means something to a shell or a file system, is hashed.
    return text if _PLAIN.fullmatch(text) else digest(value)
