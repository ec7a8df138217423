"""Ways in which files of a run change on disk, for the tests of the analysis (helper, no tests)."""

from __future__ import annotations

import copy
import datetime
import gzip
import json
import os
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import yaml

FILES = ("summary.json", "config.yaml", "episodes.csv", "metrics.csv", "status.json")
#: What may stand in the place of any entry.
ODD = (
    None, True, False, -1, 0, 1, 2, 3.5, -0.0, 1e-320, 1e308, -1e308, float("nan"), float("inf"), -float("inf"),
    2**31, 2**53 - 1, 2**53, 2**63 - 1, 2**63, -(2**63), 10**40, 10**400, "", " ", "0", "1", "-1", "nan",
    "x", "x" * 5000,
    "\x00", "\n", "\x1b[31m", "../..", "/etc/passwd", "\u4e2d\u6587", "true", "complete", "diverged", "running",
    "stopped",
    "A0", "A2", "H0", "humanoid", "paper", "quick", "threshold", "policy",
    [], [1], [[1], {}], {}, {"a": 1}, {"a": {"b": [None]}}, {"": ""},
)  # fmt: skip
#: What YAML alone knows.
ODD_YAML = (datetime.date(2020, 1, 1), b"bytes", {1: 2}, {None: 1}, {2.5: []})


@dataclass(frozen=True)
class Mutation:
    """One change.

    Attributes:
        name: What is done, to be found again.
        run: The run's directory, from the folder of all runs.
        apply: Does it; takes the run's directory.
    """

    name: str
    run: str
    apply: Callable[[Path], None]


def mutations(root: Path, runs: list[str], count: int, seed: int = 0) -> Iterator[Mutation]:
    """So many changes of runs below a folder, the same for the same seed: half of them systematic.

    Args:
        root: The folder, unchanged.
        runs: Directories of runs in it.
        count: How many.
        seed: Of the random choice.
    """
    rng = random.Random(seed)
    kinds = [[mutation for run in runs for mutation in kind(root / run, run)] for kind in (_whole, _lines, _entries)]
    for kind in kinds:
        rng.shuffle(kind)
    # In turn, for there are many more values than files.
    systematic = [mutation for each in zip_longest(*kinds) for mutation in each if mutation is not None]
    yield from systematic[: count // 2]
    for number in range(count - min(count // 2, len(systematic))):
        run = rng.choice(runs)
        names = [name for name in FILES if (root / run / name).is_file()]
        yield _random(run, rng.choice(names), rng.choice(list(RANDOM)), seed * 1_000_000 + number)


def _there(folder: Path) -> Iterator[Path]:
    return (folder / name for name in FILES if (folder / name).is_file())


def _whole(folder: Path, run: str) -> Iterator[Mutation]:
    for path in _there(folder):
        yield from (Mutation(f"{path.name}: {kind}", run, _on(path.name, change)) for kind, change in WHOLE.items())


def _lines(folder: Path, run: str) -> Iterator[Mutation]:
    for path in _there(folder):
        lines = len(path.read_bytes().splitlines())
        for number in range(0, lines, max(1, lines // 40)):
            yield Mutation(f"{path.name}: cut after line {number}", run, _on(path.name, _cut(number)))
            yield Mutation(f"{path.name}: without line {number}", run, _on(path.name, _without(number)))


def _entries(folder: Path, run: str) -> Iterator[Mutation]:
    for path in _there(folder):
        if path.suffix != ".csv":
            odd = (*ODD, *ODD_YAML) if path.suffix == ".yaml" else ODD
            for place in _places(_load(path)):
                yield Mutation(f"{path.name}: without {place}", run, _on(path.name, _without_entry(place)))
                for value in odd:
                    yield Mutation(
                        f"{path.name}: {place} = {str(value)[:40]!r}", run, _on(path.name, _set(place, value))
                    )


def _on(name: str, change: Callable[[Path], None]) -> Callable[[Path], None]:
    return lambda folder: change(folder / name)


def _load(path: Path) -> Any:
    text = path.read_text()
    return json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)


def _store(path: Path, content: Any) -> None:
    text = json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content, sort_keys=False)
    path.write_text(text)


def _places(content: Any, before: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield (*before, key)
        yield from _places(value, (*before, key))


def _set(place: tuple[Any, ...], value: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        content = _load(path)
        part = content
        for key in place[:-1]:
            part = part[key]
        part[place[-1]] = copy.deepcopy(value)
        _store(path, content)

    return change


def _without_entry(place: tuple[Any, ...]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        content = _load(path)
        part = content
        for key in place[:-1]:
            part = part[key]
        del part[place[-1]]
        _store(path, content)

    return change


def _cut(number: int) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:number])) and None


def _without(number: int) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        lines = path.read_bytes().splitlines(keepends=True)
        path.write_bytes(b"".join(lines[:number] + lines[number + 1 :]))

    return change


def _exchange(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        path.unlink()
        make(path)

    return change


def _of_another(path: Path) -> None:
    others = path.parent.parent.parent.glob(f"*/seed_1/{path.name}")
    path.write_bytes(next((other for other in others if other.parent != path.parent), path).read_bytes())


#: What may become of a file as a whole.
WHOLE: dict[str, Callable[[Path], None]] = {
    "gone": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b"") and None,
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)) and None,
    "a folder": _exchange(Path.mkdir),
    "a pipe": _exchange(os.mkfifo),
    "a link to itself": _exchange(lambda path: path.symlink_to(path)),
    "a link to nowhere": _exchange(lambda path: path.symlink_to("nowhere")),
    "endless": _exchange(lambda path: path.symlink_to("/dev/zero")),
    "its parent": _exchange(lambda path: path.symlink_to("..")),
    "twice": lambda path: path.write_bytes(path.read_bytes() * 2) and None,
    "deep": lambda path: path.write_bytes(b"[" * 100_000) and None,
    "deep mappings": lambda path: path.write_bytes(b'{"a":' * 5_000) and None,
    "no text": lambda path: path.write_bytes(bytes(range(256)) * 20) and None,
    "compressed": lambda path: path.write_bytes(gzip.compress(path.read_bytes())) and None,
    "moved to .gz": lambda path: path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
    and path.unlink(),
    "a .gz that is none": lambda path: path.rename(path.with_name(f"{path.name}.gz")) and None,
    "UTF-16": lambda path: path.write_bytes(path.read_text().encode("utf-16")) and None,
    "another order": lambda path: path.write_bytes(b"\n".join(reversed(path.read_bytes().splitlines()))) and None,
    "of another run": lambda path: _of_another(path),
}  # fmt: skip


def _flip(data: bytearray, rng: random.Random) -> None:
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _digit(data: bytearray, rng: random.Random) -> None:
    digits = [place for place, letter in enumerate(data) if 48 <= letter < 58]
    data[rng.choice(digits)] = 48 + rng.randrange(10)


def _remove(data: bytearray, rng: random.Random) -> None:
    start = rng.randrange(len(data))
    del data[start : start + rng.choice((1, 2, 10, 100, 4096))]


def _insert(data: bytearray, rng: random.Random) -> None:
    start = rng.randrange(len(data))
    data[start:start] = rng.choice((b"0", b"9", b"-", b",", b"\n", b"{", b'"', b"\x00", b"e9", b": ", rng.randbytes(8)))


def _shorten(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def _blank(data: bytearray, rng: random.Random) -> None:
    start = rng.randrange(len(data))
    size = min(rng.choice((1, 16, 512, 4096)), len(data) - start)
    data[start : start + size] = bytes(size)


def _line_twice(data: bytearray, rng: random.Random) -> None:
    lines = bytes(data).splitlines(keepends=True)
    place = rng.randrange(len(lines))
    data[:] = b"".join(lines[: place + 1] + lines[place:])


def _lines_exchanged(data: bytearray, rng: random.Random) -> None:
    lines = bytes(data).splitlines(keepends=True)
    one, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[one], lines[other] = lines[other], lines[one]
    data[:] = b"".join(lines)


RANDOM = {
    change.__name__.strip("_"): change
    for change in (_flip, _digit, _remove, _insert, _shorten, _blank, _line_twice, _lines_exchanged)
}


def _random(run: str, name: str, kind: str, seed: int) -> Mutation:
    def change(path: Path) -> None:
        data = bytearray(path.read_bytes())
        RANDOM[kind](data, random.Random(seed))
        path.write_bytes(data)

    return Mutation(f"{name}: {kind} {seed}", run, _on(name, change))
