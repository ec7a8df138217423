"""One run from its settings to its results; start reading at :mod:`acmr.run.experiment`."""
