"""Errors, durations and sizes as text for the user; the standard library only, so that every part may use it."""

from __future__ import annotations

#: Characters of an error's message that are shown; a server's answer or a list of names can fill pages.
LONGEST_MESSAGE = 400


def message(error: BaseException) -> str:
    """The message of an error on one line, or its type where it has none: ``no such file``."""
    return " ".join(str(error).split())[:LONGEST_MESSAGE] or type(error).__name__


def one_line(error: BaseException) -> str:
    """Type and message of an error on one line: ``OSError: no such file``."""
    kind, text = type(error).__name__, message(error)
    return kind if text == kind else f"{kind}: {text}"


def duration(seconds: float | None) -> str:
    """A time span: ``8 s``, ``12:05`` (minutes), ``3:07:09`` (hours), ``2 d 3 h``; ``-`` where it is not known."""
    if seconds is None:
        return "-"
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    # From here on nobody plans by the minute.
    if hours >= 48:
        return f"{hours // 24} d {hours % 24} h"
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def size(count: float) -> str:
    """Bytes as decimal megabytes or gigabytes: ``8.2 MB``, ``450 MB``, ``1.6 GB``."""
    if count >= 1e9:
        return f"{count / 1e9:.1f} GB"
    return f"{count / 1e6:.{0 if count >= 1e8 else 1}f} MB"
