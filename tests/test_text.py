"""Errors, durations and sizes as the user reads them."""

import pytest

from acmr.text import LONGEST_MESSAGE, duration, message, one_line, size


@pytest.mark.parametrize(
    ("error", "text", "line"),
    [
        (ValueError("no\n  such\tthing "), "no such thing", "ValueError: no such thing"),
        (KeyError("a"), "'a'", "KeyError: 'a'"),
        (TimeoutError(), "TimeoutError", "TimeoutError"),
        (
            OSError(2, "No such file", "x"),
            "[Errno 2] No such file: 'x'",
            "FileNotFoundError: [Errno 2] No such file: 'x'",
        ),
    ],
)
def test_an_error_is_one_line(error: Exception, text: str, line: str) -> None:
    assert (message(error), one_line(error)) == (text, line)


def test_a_page_of_an_error_is_cut() -> None:
    assert message(ValueError("ab " * 1000)) == ("ab " * 1000)[:LONGEST_MESSAGE]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *((None, "-"), (-3, "0 s"), (0.2, "0 s"), (59.4, "59 s"), (59.6, "1:00"), (725, "12:05"), (3599.6, "1:00:00")),
        *((11229, "3:07:09"), (48 * 3600 - 1, "47:59:59"), (48 * 3600, "2 d 0 h"), (200_000, "2 d 7 h")),
    ],
)
def test_duration(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0.0 MB"), (8_240_000, "8.2 MB"), (99_900_000, "99.9 MB"), (450e6, "450 MB"), (1_644_000_000, "1.6 GB")],
)
def test_size(count: float, text: str) -> None:
    assert size(count) == text
