"""Models as other programs store them, made without those programs (helpers, no tests)."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from acmr.envs import EnvDescription
from acmr.exchange.imports import main

PENDULUM = "Pendulum-v1"

#: What Stable-Baselines3 says of a model of Pendulum's, as far as somebody reads it; its pickles are texts of base 64.
SETTINGS: dict[str, Any] = {
    "policy_class": {":type:": "<class 'abc.ABCMeta'>", "__module__": "stable_baselines3.sac.policies"},
    "policy_kwargs": {"net_arch": [8, 6], "use_sde": False},
    "use_sde": False,
    "num_timesteps": 60,
    "seed": 3,
    "action_space": {":type:": "<class 'Box'>", ":serialized:": "gASVAAA=", "low": "[-2.]", "high": "[2.]"},
}


def chain(name: str, sizes: list[int], numbers: list[int], generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Linear layers with these numbers."""
    made = {}
    for number, inputs, outputs in zip(numbers, sizes, sizes[1:], strict=False):
        made[f"{name}{number}.weight"] = torch.randn(outputs, inputs, generator=generator) / inputs**0.5
        made[f"{name}{number}.bias"] = torch.randn(outputs, generator=generator)
    return made


def sb3_networks(actor: list[int] | None = None, critic: list[int] | None = None, critics: int = 2) -> dict[str, Any]:
    """The state_dict of a policy of SAC, for 3 sensors and 1 actuator."""
    g, actor, critic = torch.Generator().manual_seed(1), actor or [3, 8, 6], critic or [4, 8, 6, 1]
    made = chain("actor.latent_pi.", actor, [0, 2, 4, 6], g)
    made |= {
        f"actor.{name}": tensor for head in ("mu", "log_std") for name, tensor in _head(head, actor[-1], g).items()
    }
    for kind in ("critic", "critic_target"):
        for index in range(critics):
            made |= chain(f"{kind}.qf{index}.", critic, [0, 2, 4, 6], g)
    return made


def _head(name: str, inputs: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
    return {key.replace("0", name, 1): tensor for key, tensor in chain("", [inputs, 1], [0], generator).items()}


def saved(content: object, **options: Any) -> bytes:
    """What ``torch.save`` writes."""
    stream = io.BytesIO()
    torch.save(content, stream, **options)
    return stream.getvalue()


def write_sb3_model(path: Path, settings: dict[str, Any] | None = None, **members: Any) -> Path:
    """A model; ``policy``, ``variables``, ``data`` as bytes stand in for its own members, None leaves one out."""
    content = {
        "data": members.get("data", json.dumps(SETTINGS | (settings or {})).encode()),
        "policy.pth": members.get("policy", saved(sb3_networks())),
        "pytorch_variables.pth": members.get("variables", saved({"log_ent_coef": torch.tensor([-0.5])})),
        "_stable_baselines3_version": b"2.9.2",
    }
    with zipfile.ZipFile(path, "w") as file:
        for name, data in content.items():
            if data is not None:
                file.writestr(name, data)
    return path


def cleanrl_networks(width: int = 8) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """The state_dicts of CleanRL's actor and critics, for 3 sensors and 1 actuator within [-2, 2]."""
    g = torch.Generator().manual_seed(2)
    actor = chain("fc", [3, width, width], [1, 2], g)
    for name in ("mean", "logstd"):
        actor |= _head(f"fc_{name}", width, g)
    actor |= {"action_scale": torch.tensor([2.0]), "action_bias": torch.tensor([0.0])}
    return actor, chain("fc", [4, width, width, 1], [1, 2, 3], g), chain("fc", [4, width, width, 1], [1, 2, 3], g)


def described(observations: int, low: list[float], high: list[float]) -> EnvDescription:
    """An environment that is not there."""
    names = tuple(f"obs/{row}" for row in range(observations)), tuple(f"action/{row}" for row in range(len(low)))
    return EnvDescription(*names, tuple(low), tuple(high), 200, (), (), False, "0" * 64)


def rows(count: int, width: int, seed: int = 0) -> np.ndarray:
    """Observations."""
    return np.random.default_rng(seed).normal(size=(count, width)).astype(np.float32)


def refused(words: list[object], says: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Sees that an import ends with one line and leaves nothing."""
    code = main([*map(str, words), "--env", PENDULUM, "--out", str(folder / "out")])
    said = capsys.readouterr()
    assert (code, said.out) == (2, "")
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1, said.err
    assert says in said.err, said.err
    assert not (folder / "out").exists()
