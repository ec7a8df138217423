"""Draws the packages and what they import: ``python -m docs.rooms`` writes ``docs/images/rooms.svg``.

The rows are those of the import rule in ``docs/architecture.md``: a room imports from rows below its own only. Below
its modules each room says which rooms it imports, as the code stands. Lines between the boxes would cross in every row.
"""

from __future__ import annotations

import ast
import re
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "images" / "rooms.svg"
PACKAGES = ("acmr", "analysis", "sweeps")
#: Modules of the ground are one room: everything may import them.
GROUND = "acmr"
#: Where users come in: a room of ``acmr`` that stands above all the others, those of the other packages, too.
TOP = "acmr.app"

_WIDTH, _TITLE, _LINE, _GAP, _ROW_GAP = 168, 22, 13, 16, 16
_COLORS = {"acmr": "#e8f1fa", "analysis": "#eef6e9", "sweeps": "#fbf0e2", TOP: "#f3ecf7"}


def read_rule(package: str) -> list[list[set[str]]]:
    """Levels of a package, lowest first; a level has groups of parts, and a group may not import another one."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    line = re.search(rf"^{package}: +(.+)$", page, re.MULTILINE)
    if line is None:
        raise ValueError(f"docs/architecture.md has no import rule of {package}")
    return [[set(group.split(", ")) for group in level.split(" | ")] for level in line[1].split(" <- ")]


def module_of(path: Path) -> str:
    """Name of the module in a file, ``acmr.run.trainer``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules() -> dict[str, Path]:
    """Every module of the program, with its file."""
    return {module_of(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def imports(path: Path) -> set[str]:
    """Every module that a file imports, wherever in it; what is imported from a package counts as the module it is."""
    known, found = modules().keys(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names} & known
            found |= inner or {node.module}
    return found


def room_of(module: str) -> str:
    """The room that a module lies in: its package (``acmr.run``); in ``analysis`` a single module is its own room."""
    parts = module.split(".")
    if len(parts) > 1 and ((ROOT / parts[0] / parts[1]).is_dir() or parts[0] == "analysis"):
        return f"{parts[0]}.{parts[1]}"
    return parts[0]


def rooms() -> dict[str, list[str]]:
    """Names of the modules in each room."""
    found: dict[str, list[str]] = {}
    for module in modules():
        if not module.endswith("__main__") and module not in PACKAGES:
            inside = found.setdefault(room_of(module), [])
            is_package = modules()[module].name == "__init__.py"
            inside += [] if is_package or module == room_of(module) else [module.removeprefix(f"{room_of(module)}.")]
    return found


def imported_rooms() -> dict[str, list[str]]:
    """Which rooms each room imports, without the ground, which all import."""
    direct: dict[str, set[str]] = {}
    for module, path in modules().items():
        others = {room_of(name) for name in imports(path) if name in modules()}
        # What the ground passes on to users of the package belongs to the room that it comes from.
        others -= {TOP} if room_of(module) == GROUND else set()
        direct.setdefault(room_of(module), set()).update(others - {room_of(module), GROUND, "analysis"})
    return {room: sorted(others) for room, others in direct.items()}


def rows() -> list[list[str]]:
    """Rooms by row, lowest first: ``acmr`` by its rule, ``analysis`` beside, ``sweeps`` and ``acmr.app`` above."""
    names = rooms()
    acmr = [[f"acmr.{part}" for group in level for part in sorted(group)] for level in read_rule("acmr")]
    table = [[room for room in level if room in names and room != TOP] for level in acmr[1:-1]]
    table = [[GROUND], *table, [room for room in names if room.startswith("sweeps")]]
    beside = [[f"analysis.{part}" for group in level for part in sorted(group)] for level in read_rule("analysis")]
    for index, level in enumerate(beside):
        table[min(index + 1, len(table) - 1)] += [room for room in level if room in names]
    return [*table, [TOP]]


def draw() -> str:
    """The picture, as SVG."""
    names, table, others = rooms(), rows(), imported_rooms()
    lines = {room: [*names[room], *(f"\N{RIGHTWARDS ARROW} {other}" for other in others[room])] for room in names}
    heights = [max(_TITLE + _LINE * len(lines[room]) for room in row) + 12 for row in table]
    width = max(len(row) for row in table) * (_WIDTH + _GAP) + _GAP
    total = sum(heights) + _ROW_GAP * (len(table) + 1)
    boxes: dict[str, tuple[float, float, float]] = {}
    top = float(total)
    for row, height in zip(table, heights, strict=True):
        top -= height + _ROW_GAP
        left = (width - len(row) * (_WIDTH + _GAP) + _GAP) / 2
        for index, room in enumerate(row):
            boxes[room] = (left + index * (_WIDTH + _GAP), top, height)
    drawn = [_box(room, lines[room], *boxes[room]) for room in boxes]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {total}" font-family="sans-serif">\n'
        f'<rect width="{width}" height="{total}" fill="white"/>\n'
    )
    return head + "\n".join(drawn) + "\n</svg>\n"


def _box(room: str, inside: list[str], left: float, top: float, height: float) -> str:
    title = f"{GROUND}: the ground" if room == GROUND else room
    lines = [f'<text x="{left + 10:g}" y="{top + 17:g}" font-size="13" font-weight="bold">{escape(title)}</text>']
    for index, name in enumerate(inside):
        color = "#a33" if name.startswith("\N{RIGHTWARDS ARROW}") else "#222"
        place = f'x="{left + 10:g}" y="{top + 19 + _LINE * (index + 1):g}"'
        lines.append(f'<text {place} font-size="11" fill="{color}">{escape(name)}</text>')
    color = _COLORS[room if room in _COLORS else room.split(".")[0]]
    shape = f'<rect x="{left:g}" y="{top:g}" width="{_WIDTH}" height="{height}" rx="6" fill="{color}" stroke="#888"/>'
    return "\n".join([shape, *lines])


if __name__ == "__main__":
    PICTURE.write_text(draw(), encoding="utf-8")
    print(f"written: {PICTURE.relative_to(ROOT)}")
