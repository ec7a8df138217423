"""The protocol of everything that watches a run: CSV logs, trackers, progress, status file, checkpoint schedule."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar

from acmr.records import EpisodeRecord
from acmr.text import one_line

if TYPE_CHECKING:
    # Whoever only reads what an observer writes need not load Hydra.
    from acmr.settings.run_spec import RunSpec

#: Takes one line for the user.
Say = Callable[[str], None]


class Observer:
    """Is told how a run goes on. A subclass overrides what it wants to hear; this one hears nothing.

    What a method raises ends the run, unless the observer is :class:`Guarded`.
    """

    #: What warnings call it.
    title: ClassVar[str] = "observer"

    def on_step(self, step: int) -> None:
        """Hears that a step is done, all that belongs to it included.

        It is called hundreds of times a second, so whoever overrides it has to be quick.

        Args:
            step: Environment steps taken so far.
        """

    def on_episode(self, record: EpisodeRecord) -> None:
        """Hears of an episode as it ends; :meth:`on_step` of its last step follows."""

    def on_metrics(self, step: int, values: Mapping[str, float]) -> None:
        """Hears of a row of ``metrics.csv``; :meth:`on_step` of that step follows.

        Args:
            step: Environment steps taken so far.
            values: The other columns: means since the last row, ``steps_per_second`` among them.
        """

    def close(self, summary: Mapping[str, Any] | None) -> None:
        """Hears that the run has ended; called once, and nothing is called after it.

        Args:
            summary: The content of ``summary.json``; None if the run did not come to its end.
        """


class Tracker(Observer):
    """An observer that a file in ``conf/tracking`` can name, so that ``tracking=`` chooses it.

    Args:
        spec: The run. Its directory is there, and may hold what an earlier process has shown of it.
        say: Takes a line for the user.
    """

    def __init__(self, spec: RunSpec, say: Say) -> None:
        pass


class Guarded(Observer):
    """Keeps an observer from ending the run: after its first error it is closed, one line says so, the run goes on.

    Args:
        observer: What only shows the run to people.
        say: Takes that line.
    """

    def __init__(self, observer: Observer, say: Say) -> None:
        self._observer, self._say = observer, say

    def on_step(self, step: int) -> None:
        """Passes it on."""
        try:
            self._observer.on_step(step)
        except Exception as error:
            self._drop(error)

    def on_episode(self, record: EpisodeRecord) -> None:
        """Passes it on."""
        try:
            self._observer.on_episode(record)
        except Exception as error:
            self._drop(error)

    def on_metrics(self, step: int, values: Mapping[str, float]) -> None:
        """Passes it on."""
        try:
            self._observer.on_metrics(step, values)
        except Exception as error:
            self._drop(error)

    def close(self, summary: Mapping[str, Any] | None) -> None:
        """Passes it on."""
        try:
            self._observer.close(summary)
        except Exception as error:
            self._warn(error)

    def _drop(self, error: Exception) -> None:
        self._warn(error)
        # It has missed something, so that to it the run did not come to its end.
        with suppress(Exception):
            self._observer.close(None)
        self._observer = Observer()

    def _warn(self, error: Exception) -> None:
        line = f"{self._observer.title} stopped: {one_line(error)}. The run goes on; its own files are complete."
        # Where even that cannot be said, the run goes on in silence.
        with suppress(Exception):
            self._say(line)


def close_all(observers: Iterable[Observer], summary: Mapping[str, Any] | None) -> None:
    """Closes every observer, in their order, whatever happens to the others; raises the first error there was."""
    errors: list[BaseException] = []
    for observer in observers:
        try:
            observer.close(summary)
        # A second Ctrl-C, too, must not keep the others from being closed.
        except BaseException as error:
            errors.append(error)
    if errors:
        raise errors[0]
