"""Errors, durations, sizes, names and settings as text for the user; standard library only, so that all may use it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile
from typing import Any

from acmr.names import terminal

#: Characters of an error's message that are shown; a server's answer or a list of names can fill pages.
LONGEST_MESSAGE = 400
#: Columns of a pipe or a file, where nothing has to fit.
UNLIMITED = 10_000
#: What stands before the host of an address; a password that is not quoted may hold a slash. Without a scheme it is one
#: only where there is a password.
_USERINFO = re.compile(r"(?:(?<=:)//(?:[^\s/?#]*|[^\s@]*:[^\s@]*)|(?<![\w:/.])//[^\s/?#@:]+:[^\s/?#@]+)@")
#: Where a run's name may be parted: before a setting, but not within a number such as 1e-05.
_PARTS, _SEPARATORS = re.compile(r"(?=-[A-Za-z]|  |/)"), "- /"


def message(error: BaseException) -> str:
    """The message of an error on one line of visible letters, or its type where it has none: ``no such file``."""
    return without_userinfo(terminal(" ".join(_said(error, str).split())))[:LONGEST_MESSAGE] or type(error).__name__


def brief(value: object, longest: int = 60) -> str:
    """Type and value on one line of at most so many letters and the type: ``list [1, 2]``."""
    text = " ".join(_said(value, repr).split())
    return f"{type(value).__name__} {text if len(text) <= longest else text[: longest - 3] + '...'}".rstrip()


def _said(value: object, how: Callable[[object], str]) -> str:
    """What an object says of itself; nothing where its own code fails at that, as somebody else's may."""
    try:
        return how(value)
    except Exception:
        return ""


def typed_mapping(settings: Mapping[str, Any]) -> str:
    """Some settings as they are typed: ``{name:FrameStackObservation,stack_size:3}``."""
    return "{" + ",".join(f"{key}:{value}" for key, value in settings.items()) + "}"


def holds_userinfo(value: object) -> bool:
    """Whether a value holds an address with a user or a password, ``http://user:password@host``."""
    if isinstance(value, Mapping):
        return any(map(holds_userinfo, (*value, *value.values())))
    if isinstance(value, list | tuple):
        return any(map(holds_userinfo, value))
    return isinstance(value, str) and _USERINFO.search(value) is not None


def without_userinfo(text: str) -> str:
    """A text whose addresses say neither user nor password."""
    return _USERINFO.sub("//***@", text)


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


def shorten(names: Sequence[str], width: int, mark: str = "…") -> list[str]:
    """Names of at most ``width`` characters, cut in the middle so that they can be told apart, if that is possible."""
    if max(map(len, names), default=0) <= width:
        return list(names)
    short = _fit(list(dict.fromkeys(names)), width, mark)
    return [short[name] for name in names]


def _fit(names: Sequence[str], width: int, mark: str) -> dict[str, str]:
    """A short version of each name; they are different names."""
    parts = _what_differs(names, mark)
    # All are cut at the same place: in the middle or, if that makes them all alike, where most can be told apart.
    places = sorted(range(width), key=lambda place: abs(place - width // 2))
    candidates = [{name: _cut(*parts[name], place, width, mark) for name in names} for place in places]
    best = candidates[0]
    if len(set(best.values())) == 1:
        best = max(candidates, key=lambda short: len(set(short.values())))
    alike: dict[str, list[str]] = {}
    for name, short in best.items():
        alike.setdefault(short, []).append(name)
    for group in alike.values():
        # Runs of one kind that differ in one setting begin and end alike; among them other parts matter.
        if 1 < len(group) < len(names):
            best |= _fit(group, width, mark)
    return best


def _what_differs(names: Sequence[str], mark: str) -> dict[str, tuple[str, str]]:
    """For each name how it begins where all do, and the rest, with a mark for the parts that all have."""
    found = {}
    parts = {name: _PARTS.split(name) for name in names}
    common = set.intersection(*map(set, parts.values()))
    for name, own in parts.items():
        start = "".join(takewhile(common.__contains__, own))
        rest = "".join("\0" if part in common else part for part in own).lstrip("\0")
        # A name that the others go on from has nothing of its own.
        found[name] = (start, re.sub("\0+[- /]*", mark, rest)) if rest else ("", name)
    return found


def _cut(start: str, rest: str, place: int, width: int, mark: str) -> str:
    if len(start) + len(rest) <= width:
        return start + rest
    rest = rest.lstrip(_SEPARATORS)
    if len(rest) < width:
        return start[: width - 1 - len(rest)] + mark + rest
    return f"{rest[:place]}{mark}{rest[len(rest) - (width - 1 - place) :]}"


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as ``{"agent.q_lr": 0.001, ...}``; lists are values."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        elif not isinstance(value, Mapping):
            flat[f"{prefix}{key}"] = value
    return flat
