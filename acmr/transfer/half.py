"""The networks of a finished run in half the bytes: ``python -m acmr.transfer.half RUN_DIR OUT``.

For runs that are published: to act and to be transferred from, numbers of 11 binary digits do.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from acmr.command import command
from acmr.config import ConfigError
from acmr.names import terminal
from acmr.storage.durable import WriteError
from acmr.transfer.teacher import load_teacher, save_halved


@command
def main() -> int:
    """Entry of the module; returns the exit code: 2 for what cannot be done, with one line that says why."""
    parser = argparse.ArgumentParser(prog="python -m acmr.transfer.half", description="Networks in half precision.")
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR", help="a finished run, as in runs/paper/.../seed_1")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for the two files, which must exist")
    given = parser.parse_args()
    try:
        save_halved(given.out, load_teacher(given.run_dir))
    except (ConfigError, WriteError) as error:
        print(terminal(f"error: {error}"), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
