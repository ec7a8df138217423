"""Which sensors and actuators a teacher and its student have in common, by their names."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from acmr.config import ConfigError


@dataclass(frozen=True)
class PartMap:
    """How the teacher's sensors, or actuators, lie among the student's; all of them are rows, counted from 0.

    Attributes:
        ours: The student's rows of what both have, ascending.
        theirs: The teacher's rows of the same.
        gone: The teacher's rows of what the student has not.
        added: The student's rows of what the teacher had not.
    """

    ours: tuple[int, ...]
    theirs: tuple[int, ...]
    gone: tuple[int, ...]
    added: tuple[int, ...]

    def line(self, what: str) -> str:
        """``270 of 376 sensors kept, 106 gone, 0 added``."""
        before = len(self.theirs) + len(self.gone)
        return f"{len(self.ours)} of {before} {what} kept, {len(self.gone)} gone, {len(self.added)} added"


@dataclass(frozen=True)
class NameMap:
    """Sensors and actuators of two bodies."""

    sensors: PartMap
    actuators: PartMap

    @property
    def is_less(self) -> bool:
        """Whether the student lacks something that the teacher had."""
        return bool(self.sensors.gone or self.actuators.gone)

    def lines(self) -> list[str]:
        """What is kept, gone and added."""
        return [self.sensors.line("sensors"), self.actuators.line("actuators")]


def map_names(theirs: Sequence[str], ours: Sequence[str], rename: Mapping[str, str] | None = None) -> PartMap:
    """Finds each of the student's names among the teacher's.

    Args:
        theirs: The teacher's names, each once.
        ours: The student's names, each once.
        rename: What a part that the teacher knew by one name is called in the student's body.
    """
    renamed = [(rename or {}).get(name, name) for name in theirs]
    rows = {name: row for row, name in enumerate(renamed)}
    kept = [(row, rows[name]) for row, name in enumerate(ours) if name in rows]
    found = set(ours)
    return PartMap(
        ours=tuple(row for row, _ in kept),
        theirs=tuple(row for _, row in kept),
        gone=tuple(row for row, name in enumerate(renamed) if name not in found),
        added=tuple(row for row, name in enumerate(ours) if name not in rows),
    )


def map_bodies(
    theirs: tuple[Sequence[str], Sequence[str]],
    ours: tuple[Sequence[str], Sequence[str]],
    rename: Mapping[str, str],
    or_instead: str = "",
) -> NameMap:
    """Maps sensors and actuators.

    Args:
        theirs: Names of the teacher's sensors and of its actuators.
        ours: The same of the student.
        rename: The teacher's names -> the student's, for sensors and actuators alike.
        or_instead: End of the message where nothing is common: what else to type.

    Raises:
        ConfigError: If a name that is to be changed is not there, if two parts would have one name, or if the bodies
            have no sensor or no actuator in common.
    """
    for old, new in rename.items():
        _known(f"transfer.rename={{{old}: {new}}}", "the teacher", old, [*theirs[0], *theirs[1]])
        _known(f"transfer.rename={{{old}: {new}}}", "the student", new, [*ours[0], *ours[1]])
    for part in theirs:
        called = [rename.get(name, name) for name in part]
        if len(set(called)) < len(called):
            twice = next(name for name in called if called.count(name) > 1)
            raise ConfigError(f"transfer.rename: two of the teacher's parts would be called {twice}; rename both")
    names = NameMap(*(map_names(*pair, rename) for pair in zip(theirs, ours, strict=True)))
    for found, what in ((names.sensors, "sensor"), (names.actuators, "actuator")):
        if not found.ours:
            raise ConfigError(
                f"transfer: teacher and student have no {what} of the same name; "
                f"type 'transfer.rename={{THEIRS: OURS}}' for what is only called differently{or_instead}"
            )
    return names


def parse_renames(pairs: Sequence[str]) -> dict[str, str]:
    """The setting ``transfer.rename`` as a mapping.

    Raises:
        ConfigError: If an entry is not ``old:new``.
    """
    wrong = [pair for pair in pairs if pair.count(":") != 1 or not all(pair.split(":"))]
    if wrong:
        raise ConfigError(f"transfer.rename: {wrong[0]}: names are given as in 'transfer.rename={{old: new}}'")
    return {old.strip(): new.strip() for old, new in (pair.split(":") for pair in pairs)}


def _known(given: str, who: str, name: str, names: Sequence[str]) -> None:
    if name in names:
        return
    near = difflib.get_close_matches(name, names, 3)
    raise ConfigError(f"{given}: {who} has no {name}" + (f"; is it {' or '.join(near)}?" if near else ""))
