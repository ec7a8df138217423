"""Run directories to tidy frames; what cannot be used is listed with the reason."""
