"""JSON files that others read while they are written, and the processes that they name."""

import json
import os
import platform
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from acmr.storage.json_files import read_json, replace_json, write_json
from acmr.storage.processes import is_alive


def test_a_reader_sees_the_old_content_or_the_new_one(tmp_path: Path) -> None:
    file, over = tmp_path / "notice.json", threading.Event()
    contents = [{"number": number, "filling": [number] * 20_000} for number in range(2)]
    replace_json(file, contents[0])

    def write() -> None:
        while not over.is_set():
            for content in contents:
                replace_json(file, content)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        seen = [json.loads(file.read_text()) for _ in range(200)]
    finally:
        over.set()
        writer.join()
    assert all(content in contents for content in seen)
    assert [path.name for path in tmp_path.iterdir()] == ["notice.json"]


@pytest.mark.parametrize("write", [write_json, replace_json])
def test_no_link_is_followed(write, tmp_path: Path) -> None:
    theirs, file = tmp_path / "theirs", tmp_path / "ours.json"
    theirs.write_text("theirs")
    file.symlink_to(theirs)
    write(file, {"a": 1})
    assert (read_json(file), file.is_symlink(), theirs.read_text()) == ({"a": 1}, False, "theirs")


def test_a_notice_does_not_go_where_a_planted_link_leads(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    theirs.write_text("theirs")
    (tmp_path / f".ours.json.{os.getpid()}.tmp").symlink_to(theirs)
    with pytest.raises(OSError, match="symbolic links"):
        replace_json(tmp_path / "ours.json", {})
    assert theirs.read_text() == "theirs"


@pytest.mark.parametrize("content", [None, b"", b"[1, 2]", b"{", b"\xff"])
def test_what_is_no_json_object_reads_as_nothing(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "file.json").write_bytes(content)
    assert read_json(tmp_path / "file.json") is None


def test_processes_that_are_there_and_that_are_gone() -> None:
    here = platform.node()
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert is_alive(process.pid, here)
    process.communicate(b"\n")
    assert not is_alive(process.pid, here)
    assert is_alive(process.pid, f"not-{here}")
