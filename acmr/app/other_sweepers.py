"""Hydra's other sweepers, which choose settings in ways of their own: what they need, and what they leave behind.

They run one training after the other through Hydra's own launchers, and are told its ``metric``. Teachers, workers and
what is there already are the business of the sweeper of this program.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from tempfile import TemporaryDirectory

from acmr.config import ConfigError
from acmr.settings.compose import launchers
from acmr.text import one_line

_SWEEPER, _LAUNCHER, _FOLDER = "hydra/sweeper", "hydra/launcher", "hydra.sweep.dir"
#: Ours; and the one that only tries all combinations, of which it keeps nothing that anybody needs.
_OURS, _BASIC = ("acmr", "tune"), "basic"
#: Packages of plugins, and of this program.
_PLUGINS, _PROGRAM = "hydra_plugins", {"acmr", "analysis", "sweeps"}


@contextmanager
def with_their_words(arguments: Sequence[str]) -> Iterator[list[str]]:
    """The command line with what another sweeper needs, if it chooses one.

    Raises:
        ConfigError: If it chooses a launcher that works for our own sweeper only.
    """
    words = [word.partition("=") for word in arguments]
    chosen = {key.lstrip("+"): value for key, _, value in words}
    sweeper, launcher = chosen.get(_SWEEPER, _OURS[0]), chosen.get(_LAUNCHER)
    if sweeper in _OURS:
        yield list(arguments)
        return
    if launcher in launchers():
        raise ConfigError(
            f"{_LAUNCHER}={launcher}: trains for the sweeper of this program only; with {_SWEEPER}={sweeper} type "
            f"{_LAUNCHER}={_BASIC}, or leave it out"
        )
    more = [] if launcher else [f"{_LAUNCHER}={_BASIC}"]
    # What a search has found lies in that folder; the one that only tries all combinations has found nothing.
    is_kept = sweeper != _BASIC or _FOLDER in chosen
    with nullcontext() if is_kept else TemporaryDirectory(prefix="acmr-") as folder:
        try:
            yield [*arguments, *more, *([] if folder is None else [f"{_FOLDER}={folder}"])]
        except Exception as error:
            if _is_theirs(error):
                raise ConfigError(f"{_SWEEPER}={sweeper}: {one_line(error)}") from error
            raise


def _is_theirs(error: Exception) -> bool:
    """Whether an error comes from a plugin of Hydra's, or from what that called, and from no part of this program."""
    frames = traceback.walk_tb(error.__traceback__)
    tops = [str(frame.f_globals.get("__name__")).partition(".")[0] for frame, _ in frames]
    return _PLUGINS in tops and not _PROGRAM & {*tops[tops.index(_PLUGINS) :]}
