"""Which cell, group and seed a run directory holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acmr.records import CELLS, SEED_FOLDER

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
        cell: One of ``CELLS``; None for other groups.
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
    env, transfer = _mapping(config, "env").get("name"), _mapping(config, "transfer").get("name")
    env, transfer = summary.get("env", env), summary.get("transfer", transfer)
    freeze = summary.get("freeze", config.get("freeze"))
    if "cell" in summary:
        cell = summary["cell"] if summary["cell"] in CELLS else None
    elif config:
        cell = _cell_of(config, name)
    else:
        cell = dict(_names()).get(name) or (name.upper() if name.upper() in CELLS else None)
    match = SEED_FOLDER.fullmatch(directory.name)
    seed = summary.get("seed", config.get("seed", int(match.group(1)) if match else None))
    return Identity(
        group=cell or name,
        cell=cell,
        seed=seed if isinstance(seed, int) else None,
        profile=_text(summary.get("profile", config.get("profile"))),
        env=_text(env),
        transfer=_text(transfer),
        freeze=freeze if isinstance(freeze, bool) else None,
    )


def run_name(env: str, transfer: str, freeze: bool) -> str:
    """The directory's name of a run whose other settings are its profile's."""
    return f"{env}-{transfer}" + ("-frozen" if freeze else "")


def _cell_of(config: Mapping[str, Any], name: str) -> str | None:
    pair = _mapping(config, "pair")
    environments = {"source": pair.get("source"), "target": pair.get("target")}
    env, transfer, freeze = (_mapping(config, "env").get("name"), _mapping(config, "transfer").get("name"), False)
    freeze = bool(config.get("freeze"))
    # A setting that differs from the profile's is part of the directory's name: then it is no cell of the paper.
    if Path(name).name not in (run_name(str(env), str(transfer), freeze), *CELLS):
        return None
    for cell, (role, method, frozen) in CELLS.items():
        if (environments[role], method, frozen) == (env, transfer, freeze):
            return cell
    return None


def _names() -> Iterator[tuple[str, str]]:
    for source, target in PAIRS:
        for cell, (role, method, frozen) in CELLS.items():
            yield run_name(source if role == "source" else target, method, frozen), cell


def _mapping(config: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = config.get(key)
    return value if isinstance(value, Mapping) else {}


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None
