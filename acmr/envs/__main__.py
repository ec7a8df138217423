"""Lists the environments, or the observations and actions of one: ``python -m acmr.envs [NAME]``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

from acmr.command import add_own_modules, command, typed
from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe
from acmr.envs.construct import find_spec, gym_ids
from acmr.envs.wrappers.partial import near_matches
from acmr.names import terminal
from acmr.settings.command_line import use_folder
from acmr.settings.compose import environment_config, options
from acmr.settings.errors import USER_ERRORS, explain

#: The file of ``conf/env`` that leaves the Gymnasium id to the user.
ANY = "gym"


def overview() -> Iterator[str]:
    """One line per environment of ``conf/env``: name, dimensions, time limit and what it is."""
    yield f"{'name':<22} {'obs':>4} {'act':>4} {'steps':>6}  environment"
    for name in options("env"):
        if name == ANY:
            yield f"{name:<22} {'':>4} {'':>4} {'':>6}  any Gymnasium id: env={name} env.id=Hopper-v5"
            continue
        config = environment_config(name)
        if config.name != name and config == environment_config(config.name):
            yield f"{name:<22} {'':>4} {'':>4} {'':>6}  = {config.name}"
            continue
        try:
            about = describe(config)
        except ConfigError as error:
            # One that cannot be made here, for want of a package for instance, leaves the others listed.
            yield f"{name:<22} {'-':>4} {'-':>4} {'-':>6}  {error}"
            continue
        sizes = f"{len(about.observation_names):>4} {len(about.action_names):>4}"
        yield f"{name:<22} {sizes} {about.max_episode_steps or '-':>6}  {_what(config)}"


def details(name: str) -> Iterator[str]:
    """Dimensions and time limit, then one line per observation and action: its kind, index, name and range."""
    config = _find(name)
    about = describe(config)
    limit = f"{about.max_episode_steps} steps an episode" if about.max_episode_steps else "no time limit"
    yield f"# {config.name}: {_what(config)}" if _what(config) != config.name else f"# {config.name}"
    yield f"# {len(about.observation_names)} observations, {len(about.action_names)} actions, {limit}"
    yield from (f"# {line}" for line in about.remarks(config.name))
    if about.bodies:
        yield f"# bodies: {' '.join(about.bodies)}"
    for index, label in enumerate(about.observation_names):
        yield f"observation {index:>4}  {label}"
    for index, label in enumerate(about.action_names):
        yield f"action      {index:>4}  {label}  [{about.action_low[index]:g}, {about.action_high[index]:g}]"


@command
def main() -> int:
    """Runs the command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog=typed("envs"), description=__doc__)
    parser.add_argument("name", nargs="?", metavar="NAME", help="an environment of conf/env, or any Gymnasium id")
    parser.add_argument("--config-dir", metavar="FOLDER", help="settings files of your own, as for training")
    given = parser.parse_args()
    name = given.name
    add_own_modules()
    try:
        use_folder(given.config_dir)
        for line in overview() if name is None else details(name):
            print(terminal(line))
    except USER_ERRORS as error:
        print(f"error: {explain(error)}", file=sys.stderr)
        return 2
    return 0


def _find(name: str) -> EnvConfig:
    if name == ANY:
        raise ConfigError(f"{name}: takes any Gymnasium id; type {typed('envs')} Hopper-v5, for instance")
    known = options("env")
    if name not in known:
        try:
            find_spec(name)
        except ConfigError as error:
            if ":" in name:
                raise
            near = near_matches(name, [*known, *gym_ids()])
            hint = f"; near: {', '.join(near)}" if near else ""
            why = f"neither in conf/env nor a Gymnasium id{hint}"
            raise ConfigError(f"{name}: {why}; {typed('envs')} lists") from error
    return environment_config(name)


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
