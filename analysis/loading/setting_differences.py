"""In which settings the runs differ."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from analysis.loading.load import RunSet

#: Settings whose differences make the cells.
DEFINING = ("env", "transfer.name", "freeze")
#: What a run's summary tells of where it ran.
CIRCUMSTANCES = ("machine", "git_commit", "versions", "matrix_products")
#: Settings that differ by design, or that change nothing.
SKIPPED = (
    *("seed", "transfer.teacher", "matrix_products.relative_error"),
    *("output_dir", "force", "progress", "log_every", "checkpoint_every", "resume", "tracking"),
)


def setting_differences(data: RunSet) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Settings and circumstances that are not the same in all runs.

    Returns:
        Two tables with the column ``setting`` and one for each group: the differences that define the cells, and all
        others, which a fair comparison has to explain. Where a group's runs differ among themselves, each value
        stands with its seeds.
    """
    table: dict[str, dict[str, str]] = {}
    for run in data.runs.index:
        for key, value in _known(data, run):
            table.setdefault(key, {})[run] = value
    groups = [group for group in data.groups if set(data.runs.index[data.runs["group"] == group]) & set(data.configs)]
    defining: list[dict[str, str]] = []
    other: list[dict[str, str]] = []
    for key, values in table.items():
        if len(set(values.values())) < 2:
            continue
        row = {"setting": key} | {group: _of_group(data, group, values) for group in groups}
        (defining if _is(key, DEFINING) else other).append(row)
    columns = ["setting", *groups]
    return pd.DataFrame(defining, columns=columns), pd.DataFrame(other, columns=columns)


def flatten(value: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Dotted keys and values as text of nested settings."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from flatten(inner, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, value if isinstance(value, str) else json.dumps(value, default=str)


def _known(data: RunSet, run: str) -> Iterator[tuple[str, str]]:
    for key, value in flatten(data.configs.get(run, {})):
        if key and not _is(key, SKIPPED):
            yield key, value
    summary = data.summaries.get(run, {})
    for key, value in flatten({key: summary[key] for key in CIRCUMSTANCES if key in summary}):
        if not _is(key, SKIPPED):
            yield key, value


def _is(key: str, names: tuple[str, ...]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _of_group(data: RunSet, group: str, values: dict[str, str]) -> str:
    own = data.runs[data.runs["group"] == group]
    seeds: dict[str, list[str]] = {}
    for run, seed in zip(own.index, own["seed"], strict=True):
        if run in values:
            seeds.setdefault(values[run], []).append(str(seed))
    if len(seeds) == 1:
        return next(iter(seeds))
    return "; ".join(f"{value} (seed {', '.join(which)})" for value, which in seeds.items())
