"""The learner's arithmetic, written out: parameters as flat vectors, passes without autograd, the squashed policy."""
