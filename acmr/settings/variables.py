"""Which settings read variables of the environment: what a run stores with its results may be no secret."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from omegaconf.resolvers import oc

from acmr.config import ConfigError

#: OmegaConf's reference to a variable, ``${oc.env:NAME}``.
_REFERENCE = "oc.env"
#: What may be one, however it is written: a reference that calls something.
_CALL = re.compile(r"""\$\{[^'"]*:""")


def refuse_variables(cfg: DictConfig, allowed: tuple[str, ...]) -> None:
    """Refuses settings whose value comes from a variable of the environment, by whatever way.

    Args:
        cfg: The composed settings.
        allowed: Settings that may: a run needs them as they are here, and gives them to nobody.

    Raises:
        ConfigError: Naming the setting and the variable.
    """
    # Nearly always: working out every setting one by one takes milliseconds, and a sweep has thousands of them.
    if not _CALL.search(str(OmegaConf.to_container(cfg, resolve=False))):
        return
    with _watched() as asked:
        for key in _settings(cfg):
            if asked and key not in allowed:
                raise ConfigError(
                    f"{key}=${{{_REFERENCE}:{asked[0]}}}: settings are stored with the run, variables may be secrets; "
                    f"type the value, or let the code that needs it read {asked[0]} itself, as W&B does WANDB_API_KEY"
                )
            asked.clear()


def _settings(cfg: DictConfig) -> Iterator[str]:
    """Every setting, as ``group.key``, after it has been worked out."""
    for group in map(str, cfg):
        value = _worked_out(cfg, group)
        if OmegaConf.is_interpolation(cfg, group) or not isinstance(value, DictConfig):
            if OmegaConf.is_config(value):
                _all_of(value)
            yield group
            continue
        for key in map(str, cfg[group]):
            value = _worked_out(cfg[group], key)
            if OmegaConf.is_config(value):
                _all_of(value)
            yield f"{group}.{key}"


def _worked_out(node: DictConfig, key: str) -> Any:
    try:
        return node[key]
    except OmegaConfBaseException:
        # What is missing or wrong is said when the settings are typed.
        return None


def _all_of(value: Any) -> None:
    try:
        OmegaConf.to_container(value, resolve=True)
    except OmegaConfBaseException:
        return


@contextmanager
def _watched() -> Iterator[list[str]]:
    """The names of the variables that are asked for meanwhile."""
    asked: list[str] = []

    def read(*arguments: Any) -> Any:
        asked.append(str(arguments[0]))
        return oc.env(*arguments)

    OmegaConf.register_new_resolver(_REFERENCE, read, replace=True)
    try:
        yield asked
    finally:
        OmegaConf.register_new_resolver(_REFERENCE, oc.env, replace=True)
