"""Settings and summaries as other programs and editors write them: read, or refused with the reason and its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from acmr.foreign import read_mapping
from acmr.records import DamagedError


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("config.yaml", b"seed: 1\nagent: {q_lr: 1, q_lr: 2}\n", "line 2: q_lr is there twice"),
        ("config.yaml", b"seed: 1\nseed: 1\n", "line 2: seed is there twice"),
        ("summary.json", b'{"seed": 1, "status": "complete", "seed": 2}', "seed is there twice"),
        ("summary.json", b'{"seed": 1', "line 1 column 11"),
        ("config.yaml", "name: über\n".encode("latin-1"), "not UTF-8 at byte 6"),
        ("summary.json", '{"seed": 1}'.encode("utf-16"), "not UTF-8 at byte 0"),
        ("config.yaml", b"a: &x [1]\nb: *x\n", "aliases"),
        ("config.yaml", b"seed: 1\n---\nseed: 2\n", "line 2: but found another document"),
        ("config.yaml", b"a: !!python/object/apply:os.system ['true']\n", "line 1: could not determine a constructor"),
        ("config.yaml", b"a: 1\n\tb: 2\n", "line 2: found a tab character"),
        ("config.yaml", b"a: !<\\e[31m> 1\n", "line 1: "),
    ],
)
def test_what_cannot_be_read_says_why_and_where(name: str, content: bytes, says: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DamagedError, match="^" + name) as refused:
        read_mapping(tmp_path / name, name)
    assert "cannot be read (" in str(refused.value)
    assert says in str(refused.value)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(("name", "text"), [("config.yaml", "seed: 3\n"), ("summary.json", '{"seed": 3}')])
def test_a_mark_of_the_encoding_is_no_part_of_a_key(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(text.encode("utf-8-sig"))
    assert read_mapping(tmp_path / name) == {"seed": 3}
