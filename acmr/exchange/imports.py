"""Teachers from other programs: ``acmr import sb3 model.zip --env NAME --out FOLDER``, or ``cleanrl FILE.pt``."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from acmr.command import add_own_modules, command, typed
from acmr.config import ConfigError, EnvConfig
from acmr.envs import describe
from acmr.exchange.archive import read_numbers
from acmr.exchange.cleanrl import read_cleanrl
from acmr.exchange.imported import Imported, Normalization, make_teacher
from acmr.exchange.sb3_reader import read_sb3
from acmr.names import terminal
from acmr.settings.command_line import use_folder
from acmr.settings.compose import environment_config
from acmr.storage.durable import WriteError
from acmr.text import one_line
from acmr.transfer.description import PolicyStatistics, TeacherDescription
from acmr.transfer.statistics import EPISODES, measure_policy
from acmr.transfer.teacher import save_teacher

_READERS: dict[str, tuple[Callable[[Path], Imported], str]] = {
    "sb3": (read_sb3, "a model that SAC.save of Stable-Baselines3 has written (.zip)"),
    "cleanrl": (read_cleanrl, "actor and critics of CleanRL's SAC (.pt)"),
}
#: What an array of statistics may be called, and what else may lie beside the two.
_STATISTICS, _BESIDE = ("mean", "var"), ("epsilon", "clip_obs", "count")


def import_teacher(
    found: Imported, env: EnvConfig, out: Path, normalization: Normalization | None, say: Callable[[str], None]
) -> None:
    """Makes a teacher of what another program trained.

    Args:
        found: What its file holds.
        env: The environment that it was trained in, whose names its sensors and actuators get.
        out: Folder of the teacher, which holds nothing yet.
        normalization: Of the observations that the networks saw, if they were normalized.
        say: Where lines go.

    Raises:
        ConfigError: If it does not fit the environment, or the folder cannot be made.
    """
    networks, description = make_teacher(found, env, describe(env), normalization)
    for remark in found.remarks:
        say(f"note: {remark}")
    if description.log_alpha is None:
        say("note: its temperature is not stored: type --alpha VALUE here, or transfer.copy_log_alpha=false later")
    elif more := _more_entropy(description) if found.scaled_actions else 0.0:
        say(f"note: students aim at {abs(more):.1f} nats {'more' if more > 0 else 'less'} entropy than it did")
    if normalization is not None:
        say("note: the normalization is part of the first layers now; observations are no longer clipped by it")
    say(f"playing {EPISODES} episodes, so that students can be told what it sees and does on average")
    statistics: PolicyStatistics | None = None
    try:
        statistics = measure_policy(networks.actor, env, {})
    except Exception as error:
        # Whatever the environment does: the networks are what was asked for.
        say(f"warning: it could not be played ({one_line(error)}); its students cannot be told means")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {out}: cannot be made ({error.strerror})") from error
    save_teacher(out, networks, replace(description, statistics=statistics))
    sizes = " and ".join(map(str, description.hidden_sizes))
    say(f"written: {out} ({description.dims} of {env.name}; hidden layers of {sizes}; {found.program})")


def _more_entropy(about: TeacherDescription) -> float:
    """Nats by which the target of the entropy, minus the number of actions, lies higher than for actions in [-1, 1]."""
    halves = (np.asarray(about.action_high) - np.asarray(about.action_low)) / 2
    return float(-np.log(halves).sum())


def read_normalization(path: Path) -> Normalization:
    """Statistics from an ``.npz`` file: ``mean`` and ``var``, and ``epsilon`` where it is not 1e-8.

    Raises:
        ConfigError: If it cannot be read, or holds something else.
    """
    arrays = read_numbers(path)
    if missing := [name for name in _STATISTICS if name not in arrays]:
        raise ConfigError(f"{path}: there is no {missing[0]} in it; it needs mean and var (docs/exchange.md)")
    if strange := sorted(arrays.keys() - {*_STATISTICS, *_BESIDE}):
        raise ConfigError(f"{path}: holds {strange[0]}; it needs mean and var, and may have {', '.join(_BESIDE)}")
    mean, var, epsilon = (arrays.get(name, np.array(1e-8)) for name in (*_STATISTICS, "epsilon"))
    if epsilon.size != 1 or not np.isfinite([*mean.ravel(), *var.ravel(), *epsilon.ravel()]).all():
        raise ConfigError(f"{path}: mean, var and epsilon have to be finite numbers, and epsilon a single one")
    if not (var + epsilon.item() > 0).all():
        raise ConfigError(f"{path}: var + epsilon has to be above zero")
    return Normalization(mean, var, epsilon.item())


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog=typed("import"), description=__doc__, epilog="docs/exchange.md")
    programs = "; ".join(f"{name}: {what}" for name, (_, what) in _READERS.items())
    parser.add_argument("program", choices=_READERS, metavar="PROGRAM", help=programs)
    parser.add_argument("file", type=Path, metavar="FILE", help="what it has written")
    parser.add_argument("--env", required=True, metavar="NAME", help="the environment that it learned in")
    parser.add_argument("--out", required=True, type=Path, metavar="FOLDER", help="of the teacher")
    parser.add_argument("--normalization", type=Path, metavar="FILE.npz", help="mean and var of its observations")
    parser.add_argument("--alpha", type=float, metavar="VALUE", help="its temperature, if the file does not say it")
    parser.add_argument("--config-dir", metavar="FOLDER", help="settings files of your own, as for training")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    add_own_modules()
    try:
        if given.out.is_file() or (given.out.is_dir() and any(given.out.iterdir())):
            raise ConfigError(f"--out {given.out}: holds something already; give a folder that is new or empty")
        use_folder(given.config_dir)
        normalization = read_normalization(given.normalization) if given.normalization else None
        env = environment_config(given.env)
        found = _READERS[given.program][0](given.file)
        if given.alpha is not None:
            if not 0 < given.alpha < math.inf:
                raise ConfigError(f"--alpha {given.alpha}: a number above zero is needed")
            found = replace(found, log_alpha=math.log(given.alpha))
        import_teacher(found, env, given.out, normalization, lambda line: print(terminal(line)))
    except (ConfigError, WriteError) as error:
        print(terminal(f"error: {error}"), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
