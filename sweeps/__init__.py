"""Sweeps: plans many runs, trains them by several workers, shows how far they are."""
