"""``python -m acmr``: the command ``acmr``."""

import sys

from acmr.app.commands import main

sys.exit(main())
