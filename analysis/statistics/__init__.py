"""From frames of runs to metrics, tests and comparisons."""
