"""``python -m acmr.evaluation``: see :mod:`acmr.evaluation.cli`."""

import sys

from acmr.command import command


@command
def main() -> int:
    """Runs the command line; returns the exit code."""
    # Here, so that Ctrl-C while torch is being loaded costs one line, too.
    from acmr.evaluation import cli

    return cli.main()


sys.exit(main())
