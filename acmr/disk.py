"""Whether a run fits on its disk, found out before it starts."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

from acmr.config import ConfigError, ExperimentConfig
from acmr.networks import Networks
from acmr.segments import replay_bytes
from acmr.snapshots import KEPT

#: Logs, settings and whatever is small, in bytes.
_SMALL = 1 << 20


def arrays_bytes(networks: Networks) -> int:
    """At most this much do the arrays of one checkpoint take: weights, targets, two moments each, and the rest."""
    return 5 * 4 * sum(parameter.numel() for parameter in networks.parameters()) + (4 << 20)


def space_needed(config: ExperimentConfig, networks: Networks) -> int:
    """Bytes that a run takes on the disk while it goes on."""
    weights = 4 * sum(parameter.numel() for parameter in networks.parameters())
    if config.checkpoint_every == 0:
        return weights + _SMALL
    dims, agent = networks.dims, config.agent
    replay = replay_bytes(agent.buffer_size, config.total_timesteps, dims.observation, dims.action)
    # One checkpoint more while the oldest is still there; each holds weights, most of their targets, two moments.
    return replay + (KEPT + 1) * 4 * weights + _SMALL


def check_space(config: ExperimentConfig, networks: Networks, run_dir: Path, checkpoint_folder: Path) -> None:
    """Refuses a run that its disk cannot take.

    Raises:
        ConfigError: With what it needs and what there is.
    """
    place = next((folder for folder in (run_dir, *run_dir.absolute().parents) if folder.is_dir()), Path("/"))
    needed = space_needed(config, networks)
    free = shutil.disk_usage(place).free
    if needed > free + _held(checkpoint_folder):
        raise ConfigError(
            f"{run_dir}: takes up to {_size(needed)} while it runs, but its disk has {_size(free)} free; free some, "
            "type output_dir=FOLDER on another disk, or checkpoint_every=0 (it cannot be resumed then)"
        )


def _held(folder: Path) -> int:
    total = 0
    # Another process may be at work there, and remove what is looked at.
    with suppress(FileNotFoundError, NotADirectoryError):
        for path in folder.iterdir():
            with suppress(FileNotFoundError):
                total += path.lstat().st_size
    return total


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e8 else f"{count / 1e6:.1f} MB"
