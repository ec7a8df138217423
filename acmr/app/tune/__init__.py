"""Searches for settings with Optuna: ``acmr tune 'agent.q_lr=interval(1e-4,1e-3)' seed=1,2,3 trials=40``."""
