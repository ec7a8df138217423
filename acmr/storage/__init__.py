"""What survives a crash: durable writes, the run directory and checkpoints."""
