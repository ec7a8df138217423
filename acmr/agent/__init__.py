"""Soft Actor-Critic: networks, learner and replay buffer."""
