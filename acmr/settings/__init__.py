"""From the command line to typed settings; the only part of a run that knows Hydra."""
