"""In which settings the runs differ."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pandas as pd

from acmr.config import schema_defaults
from acmr.text import flatten
from analysis.loading.load import RunSet

#: Settings whose differences make the cells, beside what a cell itself changes.
DEFINING = ("env", "transfer.name", "freeze")
#: What a run's summary tells of where it ran.
CIRCUMSTANCES = ("machine", "git_commit", "versions", "matrix_products")
#: Settings that differ by design, or that change nothing.
SKIPPED = (
    *("seed", "transfer.teacher", "matrix_products.relative_error"),
    *("output_dir", "force", "progress", "log_every", "checkpoint_every", "resume", "tracking"),
)
#: Stands for a setting without a default, such as one of ``env.kwargs``, that only other runs have.
NOT_SET = "not set"


def setting_differences(data: RunSet) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Settings and circumstances that are not the same in all runs.

    Returns:
        Two tables with the column ``setting`` and one for each group: the differences that define the cells, and all
        others, which a fair comparison has to explain. Where a group's runs differ among themselves, each value
        stands with its seeds.
    """
    groups = [group for group in data.groups if set(data.runs.index[data.runs["group"] == group]) & set(data.configs)]
    designed = (*DEFINING, *(key for cell in data.cells for key in cell.changes))
    defining: list[list[str]] = []
    other: list[list[str]] = []
    for key, values in {**_settings(data), **_circumstances(data)}.items():
        if len(set(values.values())) < 2 or _is(key, SKIPPED):
            continue
        # As lists, for a group may be called "setting".
        row = [key, *(_of_group(data, group, values) for group in groups)]
        (defining if _is(key, designed) else other).append(row)
    columns = ["setting", *groups]
    return pd.DataFrame(defining, columns=columns), pd.DataFrame(other, columns=columns)


def _settings(data: RunSet) -> dict[str, dict[str, str]]:
    """Every setting of every run that has settings, by key and run."""
    # A setting that came later had its default before: runs made with it and without it may differ in it.
    known = {run: schema_defaults() | flatten(config) for run, config in data.configs.items()}
    keys = dict.fromkeys(key for settings in known.values() for key in settings)
    return {key: {run: _text(settings.get(key, NOT_SET)) for run, settings in known.items()} for key in keys}


def _circumstances(data: RunSet) -> dict[str, dict[str, str]]:
    """What the summaries tell of where runs ran, by key and run."""
    found: dict[str, dict[str, str]] = {}
    for run, summary in data.summaries.items():
        for key, value in flatten({key: summary[key] for key in CIRCUMSTANCES if key in summary}).items():
            found.setdefault(key, {})[run] = _text(value)
    return found


def _text(value: Any) -> str:
    try:
        return value if isinstance(value, str) else json.dumps(value, default=str)
    except TypeError:  # YAML takes dates and others for keys, JSON does not
        return str(value)


def _is(key: str, names: tuple[str, ...]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _of_group(data: RunSet, group: str, values: Mapping[str, str]) -> str:
    own = data.runs[data.runs["group"] == group]
    seeds: dict[str, list[str]] = {}
    for run, seed in zip(own.index, own["seed"], strict=True):
        if run in values:
            seeds.setdefault(values[run], []).append(str(seed))
    if len(seeds) == 1:
        return next(iter(seeds))
    return "; ".join(f"{value} (seed {', '.join(which)})" for value, which in seeds.items())
