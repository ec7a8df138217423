"""Observers of a run: Weights & Biases, progress and the status file."""
