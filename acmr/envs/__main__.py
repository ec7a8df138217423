"""Lists the environments, or the observations and actions of one: ``python -m acmr.envs [NAME]``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import mujoco
import yaml
from gymnasium.spaces import Box

from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe, make_env
from acmr.envs.construct import find_spec, gym_ids
from acmr.envs.naming import part_names
from acmr.envs.wrappers import near_matches
from acmr.text import message

LEAVES = Path(__file__).resolve().parents[2] / "conf" / "env"


def read_leaf(name: str, folder: Path = LEAVES) -> EnvConfig:
    """Reads ``conf/env/<name>.yaml``, with the leaves that its ``defaults`` name.

    Raises:
        ConfigError: If a key is unknown, or if it leaves the id open.
    """
    values = _values(name, folder)
    known = [field.name for field in fields(EnvConfig)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ConfigError(f"conf/env/{name}.yaml: {unknown[0]} is no setting; there are {', '.join(known)}")
    if values.get("id", "???") == "???":
        raise ConfigError(f"{name}: takes any Gymnasium id; type python -m acmr.envs Hopper-v5, for instance")
    return EnvConfig(**values)


def leaves(folder: Path = LEAVES) -> dict[str, str | None]:
    """The names of all leaves, each with the leaf it stands for, if it says nothing of its own."""
    names = sorted(path.stem for path in folder.glob("*.yaml"))
    return {name: _alias(_load(name, folder)) for name in names}


def overview() -> Iterator[str]:
    """One line per environment: name, dimensions, time limit and what it is."""
    yield f"{'name':<22} {'obs':>4} {'act':>4} {'steps':>6}  environment"
    for name, alias in leaves().items():
        if alias is not None:
            yield f"{name:<22} {'':>4} {'':>4} {'':>6}  = {alias}"
        elif _load(name, LEAVES).get("id") == "???":
            yield f"{name:<22} {'':>4} {'':>4} {'':>6}  any Gymnasium id: env={name} env.id=Hopper-v5"
        else:
            config = read_leaf(name)
            env = make_env(config)
            observations, actions = _sizes(env)
            yield f"{name:<22} {observations:>4} {actions:>4} {_limit(env) or '-':>6}  {_what(config)}"
            env.close()


def details(name: str) -> Iterator[str]:
    """Dimensions and time limit, then one line per observation and action: its kind, index, name and range."""
    config = _find(name)
    env = make_env(config)
    description = describe(config)
    observations, actions = _sizes(env)
    limit = f"{_limit(env)} steps an episode" if _limit(env) else "no time limit"
    yield f"# {config.name}: {_what(config)}" if _what(config) != config.name else f"# {config.name}"
    yield f"# {observations} observations, {actions} actions, {limit}"
    model = getattr(env.unwrapped, "model", None)
    if isinstance(model, mujoco.MjModel):
        yield f"# bodies: {' '.join(part_names(model).bodies[1:])}"
    for index, label in enumerate(description.observation_names):
        yield f"observation {index:>4}  {label}"
    assert isinstance(env.action_space, Box)
    for index, label in enumerate(description.action_names):
        yield f"action      {index:>4}  {label}  [{env.action_space.low[index]:g}, {env.action_space.high[index]:g}]"
    env.close()


def main(arguments: list[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m acmr.envs", description=__doc__)
    parser.add_argument("name", nargs="?", metavar="NAME", help="an environment of conf/env, or any Gymnasium id")
    name = parser.parse_args(arguments).name
    try:
        for line in overview() if name is None else details(name):
            print(line)
        sys.stdout.flush()
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # Whoever read this (head, less) has seen enough; Python would complain again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _find(name: str) -> EnvConfig:
    known = leaves()
    if name in known:
        return read_leaf(name)
    try:
        find_spec(name)
    except ConfigError as error:
        if ":" in name:
            raise
        near = near_matches(name, [*known, *gym_ids()])
        hint = f"; near: {', '.join(near)}" if near else ""
        raise ConfigError(f"{name}: neither in conf/env nor a Gymnasium id{hint}; python -m acmr.envs lists") from error
    return EnvConfig(name=name, id=name, source=name)


def _load(name: str, folder: Path) -> dict[str, Any]:
    try:
        return dict(yaml.safe_load((folder / f"{name}.yaml").read_text(encoding="utf-8")) or {})
    except (OSError, ValueError, TypeError, yaml.YAMLError) as error:
        raise ConfigError(f"conf/env/{name}.yaml cannot be read: {message(error)}") from error


def _values(name: str, folder: Path) -> dict[str, Any]:
    own = _load(name, folder)
    values: dict[str, Any] = {}
    for base in own.pop("defaults", []):
        if base != "_self_":
            values.update(_values(base, folder))
    kwargs = {**values.get("kwargs", {}), **own.get("kwargs", {})}
    return {**values, **own, **({"kwargs": kwargs} if kwargs else {})}


def _alias(own: dict[str, Any]) -> str | None:
    return str(own["defaults"][0]) if set(own) == {"defaults"} else None


def _sizes(env: Any) -> tuple[int, int]:
    return env.observation_space.shape[0], env.action_space.shape[0]


def _limit(env: Any) -> int | None:
    return env.spec.max_episode_steps


def _what(config: EnvConfig) -> str:
    parts = [config.id, *(f"{key}={value}" for key, value in config.kwargs.items())]
    for text, entries in (
        ("without bodies", config.remove_bodies),
        ("without sensors", config.drop_sensors),
        ("without actuators", config.drop_actuators),
    ):
        if entries:
            parts.append(f"{text} {' '.join(map(str, entries))}")
    if config.source != config.name:
        parts.append(f"taught by {config.source}")
    return ", ".join(parts)


if __name__ == "__main__":
    sys.exit(main())
