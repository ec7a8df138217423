"""Where users come in: the command ``acmr``, what ``run.py`` does, and the functions that ``import acmr`` offers.

The only room of this package that knows ``sweeps`` and ``analysis``; nothing knows it but :mod:`acmr`, which passes its
functions on.
"""
