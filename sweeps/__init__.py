"""Many runs: what has to be trained, in which order, by which processes, and how far it is."""
