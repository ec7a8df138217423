"""Trains one run or many: ``python run.py experiment=A2 seed=3``, ``python run.py matrix=quick``.

``python run.py --help`` lists everything; where the program is installed, ``acmr`` is the same command.
"""

import sys

from acmr.app.training import main

if __name__ == "__main__":
    sys.exit(main())
