"""Where users come in: the command ``acmr``, what ``run.py`` does, and the functions that ``import acmr`` offers.

The only package that knows the others, and nothing of them knows it but the names that :mod:`acmr` passes on.
"""
