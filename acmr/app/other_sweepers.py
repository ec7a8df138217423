"""Hydra's other sweepers, which choose settings in ways of their own: what they need, and what they leave behind.

They run one training after the other through Hydra's own launchers, and are told its ``metric``. Teachers, workers and
what is there already are the business of the sweeper of this program.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from tempfile import TemporaryDirectory

from acmr.config import ConfigError
from acmr.settings.compose import launchers

_SWEEPER, _LAUNCHER, _FOLDER = "hydra/sweeper", "hydra/launcher", "hydra.sweep.dir"
#: Ours; and the one that only tries all combinations, of which it keeps nothing that anybody needs.
_OURS, _BASIC = ("acmr", "tune"), "basic"


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
    if sweeper != _BASIC or _FOLDER in chosen:
        # What a search has found lies in that folder.
        yield [*arguments, *more]
        return
    with TemporaryDirectory(prefix="acmr-") as folder:
        yield [*arguments, *more, f"{_FOLDER}={folder}"]
