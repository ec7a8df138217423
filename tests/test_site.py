"""The documentation as a site: no link leads nowhere, nothing is fetched, all that is public is there; the notebook."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import pytest

from docs.rooms import ROOT, modules

DOCS = ROOT / "docs"
NOTEBOOK = DOCS / "notebooks" / "first_steps.ipynb"
NEEDED = ("mkdocs", "material", "mkdocstrings", "nbconvert", "ipykernel")


def needs_extra() -> None:
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        assert not os.environ.get("ACMR_REQUIRE_EXTRAS"), f"{missing} are to be installed here"
        pytest.skip(f"{', '.join(missing)} not installed; type pip install '.[docs]'")


def build(checkout: Path, out: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "docs.site", "--out", str(out)]
    return subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    needs_extra()
    out = tmp_path_factory.mktemp("site")
    done = build(ROOT, out)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"written: {out / 'index.html'}\n"
    return out


class Fetches(HTMLParser):
    """What a browser gets on its own when it shows a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.anchors.add(given.get("id") or "")
        if tag in ("script", "img", "iframe", "source", "video", "link"):
            self.found.append(given.get("src") or given.get("href") or "")


@pytest.mark.slow
def test_every_page_and_every_module_is_there(site):
    for page in DOCS.glob("*.md"):
        assert (site / f"{page.stem}.html").is_file(), page
    assert (site / "notebooks" / "first_steps.html").is_file()
    anchors = {anchor for page in (site / "reference").glob("*.html") for anchor in Fetches(page.read_text()).anchors}
    assert {name for name in modules() if not name.endswith("__main__")} <= anchors
    # A setting is told of by the comment above it.
    assert "acmr.config.SACConfig.gamma" in anchors
    assert "Discount of future rewards, per step." in (site / "reference" / "acmr.html").read_text()


@pytest.mark.slow
def test_nothing_is_fetched_from_elsewhere_and_nothing_is_missing(site):
    for page in site.rglob("*.html"):
        for address in Fetches(page.read_text()).found:
            assert not re.match(r"\w+:|//", address) or address.startswith("data:"), f"{page.name}: {address}"
            place = address.partition("#")[0].partition("?")[0]
            assert not place or (page.parent / place).exists() or page.name == "404.html", f"{page.name}: {address}"


@pytest.mark.slow
def test_a_search_finds_something_in_a_page_that_is_a_file(site):
    chromium = shutil.which("chromium")
    if chromium is None:
        assert not os.environ.get("ACMR_REQUIRE_SLURM"), "Chromium is to be installed here"
        pytest.skip("chromium not installed")
    command = [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=10000", "--dump-dom"]
    address = f"{(site / 'index.html').as_uri()}?q=kickstart"
    done = subprocess.run([*command, address], capture_output=True, text=True, timeout=120, check=True)
    found = re.search(r"(\d+) matching document", done.stdout)
    assert found
    assert int(found[1]) > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "wrong"),
    [
        ("docs/analysis.md", "[a](no-such-page.md)"),
        ("README.md", "[a](docs/analysis.md#no-such-part)"),
        ("docs/method.md", "![a](images/no_such.png)"),
        ("acmr/records.py", ":func:`acmr.records.no_such_function`"),
    ],
)
def test_what_leads_nowhere_ends_the_build(page, wrong, tmp_path):
    needs_extra()
    aside = shutil.ignore_patterns(".*", "runs", "site", "tests", "paper", "arms_added")
    copy = shutil.copytree(ROOT, tmp_path / "copy", ignore=aside)
    path = copy / page
    text = path.read_text()
    path.write_text(text.replace('"""', f'"""See {wrong}. ', 1) if page.endswith(".py") else f"{text}\n{wrong}\n")
    done = build(copy, tmp_path / "site")
    assert done.returncode == 1
    assert "no" in done.stderr
    assert Path(page).name.partition(".")[0].replace("README", "index") in done.stderr


def test_every_page_has_its_place():
    text = (DOCS / "mkdocs.yml").read_text()
    for page in [*DOCS.glob("*.md"), *(DOCS / "notebooks").glob("*.ipynb")]:
        assert f"{page.stem}.md" in text, f"docs/mkdocs.yml does not have {page.name}"


def test_without_the_extra_one_line_says_what_to_type(tmp_path):
    hidden = tmp_path / "mkdocs"
    hidden.mkdir()
    (hidden / "__init__.py").write_text("raise ImportError('as if it were not installed')\n")
    command = [sys.executable, "-m", "docs.site", "--out", str(tmp_path / "site")]
    env = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 2
    assert done.stderr == "error: the site needs mkdocs: pip install '.[docs]', or type make docs\n"


@pytest.mark.slow
def test_the_notebook_runs_from_its_first_cell_to_its_figure(tmp_path):
    needs_extra()
    import nbformat

    # In a folder of its own, where its runs go.
    shutil.copy(NOTEBOOK, tmp_path)
    command = [sys.executable, "-m", "nbconvert", "--to", "notebook", "--execute", NOTEBOOK.name, "--output", "done"]
    env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    given = nbformat.read(tmp_path / "done.ipynb", as_version=4)
    outputs = [output for cell in given.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output.output_type == "error" or output.get("name") == "stderr" for output in outputs)
    kept = nbformat.read(NOTEBOOK, as_version=4)
    assert [cell.source for cell in kept.cells] == [cell.source for cell in given.cells]
    # What it shows to a reader who does not run it is of these cells.
    shown = [bool(cell.outputs) for cell in kept.cells if cell.cell_type == "code"]
    assert shown == [bool(cell.outputs) for cell in given.cells if cell.cell_type == "code"]
