"""How much memory the sizes of a run ask for, and the refusal of those that this machine does not have."""

from __future__ import annotations

from acmr.agent.architecture import Architecture
from acmr.config import ConfigError, ExperimentConfig
from acmr.storage.processes import free_memory
from acmr.text import size

#: Bytes of a float32.
_FLOAT = 4


def memory_needed(config: ExperimentConfig, architecture: Architecture) -> dict[str, int]:
    """Bytes that a run fills at least, by the setting that decides it.

    Args:
        config: The run's settings.
        architecture: Of its networks.
    """
    dims, agent = architecture.dims, config.agent
    row = dims.observation + dims.action
    # Only what the run can fill; of the last observations of episodes nobody knows how many there will be.
    held = min(agent.buffer_size, config.most_steps)
    return {
        f"agent.buffer_size={agent.buffer_size}": _FLOAT * held * (row + 3),
        # Weights, most of their targets, and two moments each.
        f"agent.hidden_sizes={agent.hidden_sizes}": 4 * _FLOAT * architecture.parameter_count,
        f"agent.batch_size={agent.batch_size}": _FLOAT * agent.batch_size * (2 * row + sum(architecture.hidden_sizes)),
    }


def check_memory(config: ExperimentConfig, architecture: Architecture) -> None:
    """Refuses a run that the memory of this machine cannot take.

    Raises:
        ConfigError: With the setting that asks for most, what the run needs and what there is.
    """
    needed, free = memory_needed(config, architecture), free_memory()
    if sum(needed.values()) > free:
        largest = max(needed, key=lambda setting: needed[setting])
        raise ConfigError(
            f"{largest}: takes {size(needed[largest])} of memory, and the whole run {size(sum(needed.values()))}, but "
            f"{size(free)} are free; type a smaller {largest.partition('=')[0]}"
        )
