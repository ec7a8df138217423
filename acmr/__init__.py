"""Actor-Critic Model Reuse: transfer in deep reinforcement learning when an agent's body changes."""

from acmr.command import open_closed_streams

__version__ = "0.1.0"

# Before anything else is imported: some libraries cannot be where a stream is closed.
open_closed_streams()
