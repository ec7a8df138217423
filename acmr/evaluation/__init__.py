"""What a finished run learned: episodes of its policy, and films of them."""
