"""What became of each layer of a student: the content of ``transfer.json``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from acmr.agent.networks import Networks
from acmr.config import TransferConfig
from acmr.transfer.teacher import Teacher


@dataclass(frozen=True)
class TransferReport:
    """Names of the copied, fitted, fresh and frozen layers, and how many parameters that is.

    ``details`` is what else the method has to say, ``notes`` the same in words.
    """

    method: str
    freeze: bool
    teacher: dict[str, Any] | None
    copied: list[str]
    fitted: list[str]
    fresh: list[str]
    frozen: list[str]
    parameters: dict[str, int]
    details: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The report for a reader, one fact a line."""
        said = [f"transfer: {self.method}" + (", copied layers frozen" if self.freeze else "")]
        if self.teacher is not None:
            said.append(
                f"  teacher: {self.teacher['path']} ({self.teacher['environment']}, seed {self.teacher['seed']}, "
                f"{self.teacher['global_step']:,} steps)"
            )
        said += [f"  {note}" for note in self.notes]
        for kind in ("copied", "fitted", "fresh", "frozen"):
            names: list[str] = getattr(self, kind)
            if kind == "fitted" and not names:
                continue
            said.append(f"  {kind}: {self.parameters[kind]:,} parameters: {', '.join(names) if names else 'no layer'}")
        said.append(f"  learning: {self.parameters['trainable']:,} of {self.parameters['total']:,} parameters")
        return said


def report_transfer(
    networks: Networks,
    teacher: Teacher | None,
    config: TransferConfig,
    freeze: bool,
    layers: tuple[list[str], list[str], list[str]],
) -> TransferReport:
    """Counts what was done.

    Args:
        networks: The networks to learn with.
        teacher: Whom they have something from, if anybody.
        config: The method.
        freeze: Whether the copied layers were to be frozen.
        layers: Names of those that hold the teacher's values, of those that hold what fits of them, and of those that
            do not learn.
    """
    sizes, (copied, fitted, frozen) = networks.architecture.sizes, layers
    fresh = [name for name in sizes if name not in (*copied, *fitted)]

    def count(names: Iterable[str]) -> int:
        return sum(sizes[name] for name in names)

    parameters = {
        "total": count(sizes),
        "trainable": count(sizes) - count(frozen),
        "copied": count(copied),
        "fitted": count(fitted),
        "fresh": count(fresh),
        "frozen": count(frozen),
    }
    origin = _origin(teacher) if teacher is not None else None
    return TransferReport(config.name, freeze, origin, copied, fitted, fresh, frozen, parameters)


def _origin(teacher: Teacher) -> dict[str, Any]:
    about = teacher.description
    return {
        "path": str(teacher.path),
        "environment": about.environment,
        "seed": about.seed,
        "global_step": about.global_step,
        "sha256": about.sha256,
    }
