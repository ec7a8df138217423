"""``python -m acmr.evaluation``: see :mod:`acmr.evaluation.cli`."""

import sys

from acmr.evaluation.cli import main

sys.exit(main())
