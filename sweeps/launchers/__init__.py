"""Launchers: how the workers of a sweep are started, on this machine or on a cluster."""
