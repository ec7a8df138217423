"""SAC agents of CleanRL (``sac_continuous_action.py``): the state_dicts of its actor and its critics."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

from torch import Tensor

from acmr.agent.architecture import TANH
from acmr.config import ConfigError
from acmr.exchange.archive import checked_tensors, read_torch
from acmr.exchange.imported import Imported
from acmr.exchange.layers import renamed_layers

_PARTS = ("actor", "qf1", "qf2")
#: Layers are called ``fc1`` and so on, heads ``fc_mean``.
_NUMBERED = re.compile(r"^fc(?=\d)")
_HOW = "torch.save((actor.state_dict(), qf1.state_dict(), qf2.state_dict()), FILE)"


def read_cleanrl(path: Path) -> Imported:
    """The networks that a script of CleanRL's has saved: actor and both critics in one file.

    A tuple, as its other scripts save theirs; or a mapping of ``actor``, ``qf1``, ``qf2`` and perhaps ``log_alpha``.

    Raises:
        ConfigError: If the file is damaged or holds other networks.
    """
    parts, log_alpha = _parts(read_torch(path), path)
    actor, *critics = (checked_tensors(part, f"{path}: {name}") for name, part in zip(_PARTS, parts, strict=True))
    scale, bias = (actor.pop(f"action_{kind}", None) for kind in ("scale", "bias"))
    if scale is None or bias is None or scale.shape != bias.shape:
        raise ConfigError(f"{path}: its actor has no action_scale and action_bias, as that of CleanRL's SAC has")
    # One environment of several that are stepped together may have left its row.
    scale, bias = scale.flatten().double(), bias.flatten().double()
    given = {
        f"{part}.{_NUMBERED.sub('', name)}": tensor
        for part, layers in zip(_PARTS, (actor, *critics), strict=True)
        for name, tensor in layers.items()
    }
    heads = {"actor.fc_mean": "actor.mean", "actor.fc_logstd": "actor.log_std"}
    trunks = {"actor": "actor", "qf1": "critic_1", "qf2": "critic_2"}
    tensors, sizes = renamed_layers(given, trunks, heads, count(1), str(path))
    return Imported(
        program="cleanrl",
        tensors=tensors,
        hidden_sizes=sizes,
        log_std=TANH,
        scaled_actions=False,
        log_alpha=log_alpha,
        bounds=((bias - scale).tolist(), (bias + scale).tolist()),
    )


def _parts(content: Any, path: Path) -> tuple[list[Any], float | None]:
    if isinstance(content, tuple | list) and len(content) == len(_PARTS):
        return list(content), None
    if isinstance(content, Mapping) and all(part in content for part in _PARTS):
        return [content[part] for part in _PARTS], _number(content.get("log_alpha"), path)
    raise ConfigError(f"{path}: not an actor and two critics; save them with {_HOW}")


def _number(given: Any, path: Path) -> float | None:
    if given is None:
        return None
    value = given.item() if isinstance(given, Tensor) and given.numel() == 1 else given
    if type(value) is not float or not math.isfinite(value):
        raise ConfigError(f"{path}: log_alpha is no number")
    return value
