"""``python -m acmr``: the command ``acmr``."""

import sys

from acmr_app.commands import main

sys.exit(main())
