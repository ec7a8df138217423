"""Actor-Critic Model Reuse: transfer in deep reinforcement learning when an agent's body changes."""

__version__ = "0.1.0"
