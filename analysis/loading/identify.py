"""Which cell, group and seed a run directory holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acmr.cells import CELLS, SOURCE, Cell, plain_name, run_name
from acmr.foreign import real_path
from acmr.records import SEED_FOLDER
from acmr.text import flatten
from analysis.loading.values import MOST_SEED

#: (source, target) environments of the profiles, for runs of which only the directory's name is left.
PAIRS = (
    ("humanoid", "armless_humanoid"),
    ("humanoid_v5", "armless_humanoid_v5"),
    ("ant", "ant_three_legs"),
)


@dataclass(frozen=True)
class Identity:
    """What a run is.

    Attributes:
        group: Name of the runs that differ only in their seed: the cell's, or else the directory's.
        cell: One of ``acmr.cells.CELLS``; None for other groups.
        seed: None where neither the directory nor its files say.
        profile: None for foreign runs.
    """

    group: str
    cell: str | None
    seed: int | None
    profile: str | None
    env: str | None
    transfer: str | None
    freeze: bool | None


def identify(directory: Path, name: str, config: Mapping[str, Any], summary: Mapping[str, Any]) -> Identity:
    """Recognizes a run by its summary, else its settings, else its directory's name.

    Args:
        directory: ``.../<name>/seed_<n>``.
        name: The directory above the seed, as seen from the runs folder (``armless_humanoid-hidden-frozen``).
        config: Contents of ``config.yaml``; empty if there is none.
        summary: Contents of ``summary.json``; empty if there is none.
    """
    settings = flatten(config)
    env, transfer = (summary.get(key, settings.get(f"{key}.name")) for key in ("env", "transfer"))
    freeze = summary.get("freeze", settings.get("freeze"))
    told = CELLS.get(_text(summary.get("cell")) or "")
    if told and (not config or _fits(told, settings)):
        cell: str | None = told.name
    elif config:
        cell = _cell_of(settings, name)
    else:
        cell = dict(_names()).get(plain_name(name).lower())
    # A link may have any name; what it leads to tells the seed.
    match = SEED_FOLDER.fullmatch(directory.name) or SEED_FOLDER.fullmatch(real_path(directory).name)
    said = (summary.get("seed"), settings.get("seed"), int(match[1]) if match else None)
    seed = next((value for value in said if isinstance(value, int) and not isinstance(value, bool)), None)
    return Identity(
        group=cell or name,
        cell=cell,
        seed=seed if seed is not None and seed <= MOST_SEED else None,
        profile=_text(summary.get("profile", settings.get("profile"))),
        env=_text(env),
        transfer=_text(transfer),
        freeze=freeze if isinstance(freeze, bool) else None,
    )


def _cell_of(settings: Mapping[str, Any], name: str) -> str | None:
    """The cell with a run's settings, as far as the directory's name says nothing else.

    Settings that differ from the profile's are part of the name, and the profile itself is not at hand.
    """
    env, transfer, freeze = settings.get("env.name"), settings.get("transfer.name"), bool(settings.get("freeze"))
    own = plain_name(Path(name).name)
    # Of two cells that a directory by a mere cell's name could hold, the one that asks for more.
    for cell in sorted(CELLS.values(), key=lambda cell: -len(cell.changes)):
        meant = (settings.get(f"pair.{cell.role}"), cell.transfer, cell.freeze)
        names = (*CELLS, run_name(str(env), cell.transfer, cell.freeze, cell.changes))
        if meant == (env, transfer, freeze) and _fits(cell, settings) and own in names:
            return cell.name
    return None


def _fits(cell: Cell, settings: Mapping[str, Any]) -> bool:
    """Whether settings have all that a cell changes."""
    return all(settings.get(key) == value for key, value in cell.changes.items())


def _names() -> Iterator[tuple[str, str]]:
    """What a directory may be called, in lower case, that holds a cell's runs; and the cell."""
    yield from ((name.lower(), name) for name in CELLS)
    for source, target in PAIRS:
        for cell in CELLS.values():
            env = source if cell.role == SOURCE else target
            yield run_name(env, cell.transfer, cell.freeze, cell.changes), cell.name


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None
