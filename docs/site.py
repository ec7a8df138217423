"""Builds the documentation as a site that is read offline: ``python -m docs.site`` (``make docs``).

The pages are the Markdown files as they lie here and are read on any forge. The site has them beside a reference, made
from the docstrings without importing the program. A link that leads nowhere ends the build.
"""

from __future__ import annotations

import argparse
import logging
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from docs.rooms import modules

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = ROOT / "docs" / "mkdocs.yml"
#: Where the site has what does not lie in ``docs``, by its path in the checkout.
_MOVED = {"README.md": "index.md", "results/README.md": "published.md", "CHANGELOG.md": "changelog.md"}
#: Folders of ``docs`` with what pages show or offer.
_SHOWN = ("images", "pilots")
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)(?P<path>[^)#\s]+)(?P<anchor>#[^)\s]*)?(?=\))")
_REFERENCE, _NOTEBOOKS = "reference", "notebooks"
#: What the theme would fetch from elsewhere; ours does the same.
_FETCHED = re.compile(r"https://unpkg\.com/iframe-worker/shim")
_WORKER = Path("docs", "worker.js")


def main() -> int:
    """Builds the site; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m docs.site", description="Builds the documentation as a site.")
    parser.add_argument("--out", type=Path, default=ROOT / "site", metavar="FOLDER", help="default: site")
    out = parser.parse_args().out
    try:
        from mkdocs.commands.build import build
        from mkdocs.config import load_config
        from mkdocs.exceptions import Abort, ConfigurationError
    except ImportError:
        print("error: the site needs mkdocs: pip install '.[docs]', or type make docs", file=sys.stderr)
        return 2
    # Which link leads nowhere.
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    with tempfile.TemporaryDirectory() as folder:
        pages = Path(folder) / "docs"
        stage(pages)
        config = load_config(str(SETTINGS), docs_dir=str(pages), site_dir=str(out.resolve()), strict=True)
        config.nav.append({"Reference": [{package: f"{_REFERENCE}/{package}.md"} for package in _packages()]})
        try:
            build(config)
        except (Abort, ConfigurationError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    _keep_offline(out)
    print(f"written: {out / 'index.html'}")
    return 0


def stage(folder: Path) -> None:
    """Lays out the pages as the site has them.

    Args:
        folder: A folder that is not there yet.
    """
    folder.mkdir()
    for name in _SHOWN:
        shutil.copytree(ROOT / "docs" / name, folder / name)
    for source, place in _pages():
        text = (ROOT / source).read_text(encoding="utf-8")
        (folder / place).write_text(_LINK.sub(lambda link, own=source: _moved(own, link), text), encoding="utf-8")
    _stage_notebooks(folder / _NOTEBOOKS)
    (folder / _REFERENCE).mkdir()
    for package, names in _packages().items():
        parts = [f"# {package}", *(f"::: {name}" for name in names)]
        (folder / _REFERENCE / f"{package}.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _keep_offline(site: Path) -> None:
    """Has every page load from the site itself what the theme would have it fetch."""
    shutil.copyfile(ROOT / _WORKER, site / "assets" / _WORKER.name)
    for page in site.rglob("*.html"):
        up = "../" * (len(page.relative_to(site).parts) - 1)
        text = page.read_text(encoding="utf-8")
        page.write_text(_FETCHED.sub(f"{up}assets/{_WORKER.name}", text), encoding="utf-8")


def _stage_notebooks(folder: Path) -> None:
    """Each notebook as a page, with what its cells gave when it was last run."""
    from nbconvert import MarkdownExporter

    folder.mkdir()
    for path in sorted((ROOT / "docs" / _NOTEBOOKS).glob("*.ipynb")):
        text, resources = MarkdownExporter().from_filename(str(path))
        (folder / f"{path.stem}.md").write_text(text, encoding="utf-8")
        for name, content in resources["outputs"].items():
            (folder / name).write_bytes(content)


def _pages() -> Iterator[tuple[str, str]]:
    """Each page: its path in the checkout and its place on the site."""
    yield from _MOVED.items()
    for path in sorted((ROOT / "docs").glob("*.md")):
        yield f"docs/{path.name}", path.name


def _moved(page: str, link: re.Match[str]) -> str:
    """Where a link of a page leads on the site; a file of the code is where its docstrings are."""
    target = _normal(PurePosixPath(page).parent / link["path"])
    anchor = link["anchor"] or ""
    if target in _MOVED:
        return _MOVED[target] + anchor
    if target.startswith("docs/"):
        return target.removeprefix("docs/").replace(".ipynb", ".md") + anchor
    if target.endswith(".py"):
        name = target.removesuffix(".py").replace("/", ".")
        return f"{_REFERENCE}/{_package(name)}.md#{name}"
    # What the site does not have: the strict build says so.
    return target + anchor


def _normal(path: PurePosixPath) -> str:
    parts: list[str] = []
    for part in path.parts:
        if part == "..":
            parts.pop()
        elif part != ".":
            parts.append(part)
    return "/".join(parts)


def _packages() -> dict[str, list[str]]:
    """The modules of each page of the reference: a package's own, the package first."""
    found: dict[str, list[str]] = {}
    for name in sorted(modules()):
        if not name.endswith("__main__"):
            found.setdefault(_package(name), []).append(name)
    return found


def _package(module: str) -> str:
    """The package that a module is, or is in."""
    is_package = (ROOT / Path(*module.split(".")) / "__init__.py").is_file()
    return module if is_package else module.rpartition(".")[0]


if __name__ == "__main__":
    sys.exit(main())
