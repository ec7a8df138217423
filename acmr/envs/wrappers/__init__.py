"""Layers around an environment: those that the user chooses, and the one that takes sensors and actuators away."""
