"""SAC models of Stable-Baselines3: their networks, out of the zip file, without Stable-Baselines3."""

from __future__ import annotations

import math
import re
from itertools import count
from pathlib import Path
from typing import Any

from torch import Tensor

from acmr.agent.architecture import CLAMP
from acmr.config import ConfigError
from acmr.exchange.archive import NAMED, Archive, checked_tensors, parse_torch, read_archive
from acmr.exchange.imported import Imported
from acmr.exchange.layers import renamed_layers
from acmr.foreign import parse_mapping
from acmr.records import MOST_SEED, DamagedError

_SETTINGS, _NETWORKS, _OTHERS = "data", "policy.pth", "pytorch_variables.pth"
_VERSION = "_stable_baselines3_version"
#: The module of the policy whose functions these networks are; a class of somebody's own may compute others.
_POLICY = "stable_baselines3.sac.policies"
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def read_sb3(path: Path) -> Imported:
    """The networks of a model that ``SAC.save`` has written. Its targets, optimizers and buffer stay behind.

    Raises:
        ConfigError: If the file is damaged, of another algorithm, or of networks that there are none of here.
    """
    archive = read_archive(path)
    for name in (_SETTINGS, _NETWORKS):
        if name not in archive.names:
            raise ConfigError(f"{path}: no model of Stable-Baselines3 (there is no {name} in it)")
    settings = _settings(archive, path)
    _check_settings(settings, path)
    given = checked_tensors(parse_torch(archive.read(_NETWORKS), f"{path}: {_NETWORKS}"), f"{path}: {_NETWORKS}")
    tensors, sizes = _networks(given, path)
    bounds = _bounds(settings.get("action_space"))
    remarks = (
        [] if bounds else ["the bounds of its actions are not stored readably; those of the environment are taken"]
    )
    return Imported(
        program=f"stable-baselines3 {_version(archive)}".strip(),
        tensors=tensors,
        hidden_sizes=sizes,
        log_std=CLAMP,
        scaled_actions=True,
        log_alpha=_log_alpha(archive, path),
        bounds=bounds,
        global_step=_count(settings.get("num_timesteps")),
        seed=_count(settings.get("seed")),
        remarks=remarks,
    )


def _settings(archive: Archive, path: Path) -> dict[str, Any]:
    """The member ``data``: JSON in which objects stand as pickles, too. Those are texts, and stay texts."""
    try:
        return parse_mapping(f"{_SETTINGS}.json", archive.read(_SETTINGS), f"{path}: {_SETTINGS}")
    except DamagedError as error:
        raise ConfigError(str(error)) from error


def _check_settings(settings: dict[str, Any], path: Path) -> None:
    policy, options = settings.get("policy_class"), settings.get("policy_kwargs")
    module = policy.get("__module__") if isinstance(policy, dict) else None
    if module is not None and module != _POLICY:
        raise ConfigError(
            f"{path}: a policy of {str(module)[:NAMED]}; only that of SAC ({_POLICY}) is one like those here"
        )
    options = options if isinstance(options, dict) else {}
    if settings.get("use_sde") or options.get("use_sde"):
        raise ConfigError(
            f"{path}: trained with use_sde=True; noise that depends on the state is none of the policies here"
        )
    activation = str(options.get("activation_fn", "ReLU"))
    if "ReLU" not in re.findall(r"\w+", activation):
        raise ConfigError(f"{path}: its activation is {activation[:NAMED]}; all networks here have ReLU")


def _networks(given: dict[str, Tensor], path: Path) -> tuple[dict[str, Tensor], tuple[int, ...]]:
    if "actor.mu.weight" not in given or "critic.qf0.0.weight" not in given:
        raise ConfigError(f"{path}: no actor and critics of SAC; other algorithms cannot be imported")
    critics = {name.split(".")[1] for name in given if name.startswith("critic.qf")}
    if critics != {"qf0", "qf1"}:
        raise ConfigError(
            f"{path}: {len(critics)} critics ({', '.join(sorted(critics))[:NAMED]}); networks here have two"
        )
    kept = {name: tensor for name, tensor in given.items() if not name.startswith("critic_target.")}
    heads = {"actor.mu": "actor.mean", "actor.log_std": "actor.log_std"}
    trunks = {"actor.latent_pi": "actor", "critic.qf0": "critic_1", "critic.qf1": "critic_2"}
    # Between two layers stands their activation, which has a number, too.
    return renamed_layers(kept, trunks, heads, count(0, 2), str(path))


def _log_alpha(archive: Archive, path: Path) -> float | None:
    """Learned, it stands there as its logarithm; fixed, as it is; None where neither is stored."""
    if _OTHERS not in archive.names:
        return None
    given = checked_tensors(parse_torch(archive.read(_OTHERS), f"{path}: {_OTHERS}"), f"{path}: {_OTHERS}")
    single = {name: tensor.item() for name, tensor in given.items() if tensor.numel() == 1}
    if "log_ent_coef" in single:
        return single["log_ent_coef"]
    fixed = single.get("ent_coef_tensor", 0.0)
    return math.log(fixed) if fixed > 0 else None


def _bounds(space: object) -> tuple[list[float], list[float]] | None:
    """Bounds as NumPy prints them, which is how they stand there beside their pickle; it leaves out much of many."""
    if not isinstance(space, dict):
        return None
    low, high = (str(space.get(key, "...")) for key in ("low", "high"))
    if "..." in low + high:
        return None
    return [float(number) for number in _NUMBER.findall(low)], [float(number) for number in _NUMBER.findall(high)]


def _version(archive: Archive) -> str:
    said = archive.read(_VERSION)[:40].decode("ascii", "replace") if _VERSION in archive.names else ""
    return said.strip() if re.fullmatch(r"[\w.+-]+\s*", said) else ""


def _count(value: object) -> int:
    return value if isinstance(value, int) and 0 <= value <= MOST_SEED else 0
