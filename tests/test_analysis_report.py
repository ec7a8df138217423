"""All results of one command, and the report in a real browser: figures load, the table sorts, nothing fails."""

from __future__ import annotations

import json
import os
import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from analysis_outputs import FIGURES, TABLES
from analysis_runs import csv_text, realistic_rows, run_directory, write_realistic
from PIL import Image

#: One analysis with all its pictures, and a browser.
pytestmark = pytest.mark.slow
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
OPTIONS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--remote-debugging-pipe"),
]


class Browser:
    """Chromium, driven over a pipe by the DevTools protocol."""

    def __init__(self, profile: Path):
        assert CHROMIUM
        ours, theirs = os.pipe(), os.pipe()
        # Chromium reads commands from descriptor 3 and answers on 4.
        script = f'exec "$0" "$@" 3<&{ours[0]} 4>&{theirs[1]}'
        self.process = subprocess.Popen(
            ["bash", "-c", script, CHROMIUM, *OPTIONS, f"--user-data-dir={profile}"],
            pass_fds=(ours[0], theirs[1]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(ours[0])
        os.close(theirs[1])
        self.commands, self.answers, self.unread = ours[1], theirs[0], b""
        self.events: list[dict[str, Any]] = []
        self.number, self.session = 0, None
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.commands, json.dumps(message).encode() + b"\0")
        while True:
            answer = self.receive()
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]
            assert answer["method"] != "Page.javascriptDialogOpening", answer
            self.events.append(answer)

    def receive(self) -> dict[str, Any]:
        while b"\0" not in self.unread:
            assert select.select([self.answers], [], [], 120)[0], "the browser does not answer"
            more = os.read(self.answers, 1 << 16)
            assert more, "the browser ended"
            self.unread += more
        message, _, self.unread = self.unread.partition(b"\0")
        return json.loads(message)

    def open(self, page: Path) -> None:
        self.events.clear()
        self.send("Page.navigate", url=page.as_uri())
        until = time.monotonic() + 30
        while self.run("document.readyState") != "complete" or self.run("location.href") == "about:blank":
            assert time.monotonic() < until
        self.run("Promise.all([...document.images].map(image => image.decode().catch(() => {}))).then(() => 1)")

    def run(self, expression: str) -> Any:
        result = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def press(self, key: str, code: int, text: str = "") -> None:
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code, text=text)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.commands)
        os.close(self.answers)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    browser = Browser(tmp_path / "profile")
    yield browser
    browser.close()


@dataclass
class Done:
    out: Path
    said: str


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, testrun_uid: str) -> Done:
    """Results of a matrix in which everything goes wrong; made once, whichever worker comes first."""
    folder = tmp_path_factory.getbasetemp().parent / f"report-{testrun_uid}"
    said = folder / "said.txt"
    try:
        folder.mkdir()
    except FileExistsError:
        until = time.monotonic() + 300
        while not said.exists():
            assert time.monotonic() < until, "the other worker made no results"
            time.sleep(0.2)
    else:
        lay_out(folder / "runs" / "quick")
        line = [sys.executable, "-m", "analysis", "runs/quick", "--out", "results/deep", "--no-stills"]
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parent.parent), "COLUMNS": "100"}
        run = subprocess.run(line, capture_output=True, text=True, cwd=folder, env=environment, check=False)
        (folder / "unfinished.txt").write_text(f"{run.returncode}\n{run.stderr}\n{run.stdout}")
        (folder / "unfinished.txt").rename(said)
    code, errors, output = said.read_text().split("\n", 2)
    assert code == "0", output
    assert errors == ""  # no warning of any library
    return Done(folder / "results" / "deep", output)


def lay_out(root: Path) -> None:
    """A matrix with unfinished, missing and damaged runs, a sweep and a foreign, hostile run."""
    write_realistic(root, total=20_000, profile="quick")
    (run_directory(root, "A1", 3, "quick") / "summary.json").unlink()
    shutil.rmtree(run_directory(root, "H1", 1, "quick"))
    damaged = run_directory(root, "A2", 2, "quick") / "episodes.csv"
    damaged.write_text(damaged.read_text().replace("\n", "\n9,9\n", 5))
    for name in ("ant_three_legs-hidden-q_lr=0.0001", "<img src=x onerror=alert(1)>"):
        (root / name / "seed_1").mkdir(parents=True)
        rows = realistic_rows(np.random.default_rng(0), 20_000, 8000)
        rows[:, 1] *= -1 if "img" in name else -0.1  # negative returns, which only sort rightly as numbers
        (root / name / "seed_1" / "episodes.csv").write_text(csv_text(rows, columns=3))


@pytest.fixture
def page(done: Done) -> Path:
    return done.out / "report.html"


def test_every_table_and_figure_is_written(done):
    for folder in (done.out, done.out / "colorblind"):
        for kind in ("pdf", "png", "svg"):
            assert {path.stem for path in folder.glob(f"*.{kind}")} == FIGURES
    for kind in ("csv", "md", "tex"):
        assert {path.stem for path in done.out.glob(f"*.{kind}")} == TABLES
    assert len(pd.read_csv(done.out / "table3.csv")) == 6
    assert len(pd.read_csv(done.out / "steps_to_threshold.csv")) == 22
    with np.load(done.out / "scores.npz") as arrays:
        assert arrays["A0"].shape == (3, 1)


def test_fonts_are_embedded_and_pictures_are_not_blank(done):
    for path in done.out.rglob("*.pdf"):
        content = path.read_bytes()
        assert b"/FontFile2" in content, path  # TrueType, embedded
        assert b"/Type3" not in content, path
    for path in done.out.rglob("*.png"):
        with Image.open(path) as image:
            assert image.width == pytest.approx(1020, abs=2)  # a column at 300 dpi
            assert np.asarray(image.convert("L")).std() > 5


def test_what_is_said_at_the_end(done):
    assert "not used: ant_three_legs-hidden-frozen/seed_2 (damaged): episodes.csv: line 2 holds 2 values" in done.said
    assert "A1 seed 3 (unfinished): python run.py experiment=A1 seed=3 profile=quick" in done.said
    assert "report:  results/deep/report.html" in done.said
    assert len(done.said.splitlines()) < 25


def column(browser: Browser, number: int) -> list[str]:
    return browser.run(
        f"[...document.querySelectorAll('#run-table tbody tr')].map(row => row.cells[{number}].innerText.trim())"
    )


def number(text: str) -> float:
    return float(text.replace(",", "")) if text != "–" else float("inf")


def test_the_report_in_a_browser(browser, page):
    browser.open(page)
    images = browser.run("[...document.images].map(image => [image.alt, image.naturalWidth, image.complete])")
    assert len(images) == 2 * len(FIGURES)
    assert all(width > 0 and complete and alt for alt, width, complete in images)

    # Sorting by mouse: numbers as numbers, unknown ones last both ways.
    before = column(browser, 3)
    browser.run("document.querySelectorAll('#run-table th button')[3].click()")
    steps = column(browser, 3)
    assert sorted(before) == sorted(steps)
    assert [number(text) for text in steps] == sorted(map(number, before))
    assert steps[-1] == "–"
    browser.run("document.querySelectorAll('#run-table th button')[3].click()")
    down = [number(text) for text in column(browser, 3) if text != "–"]
    assert down == sorted(down, reverse=True)
    assert column(browser, 3)[-1] == "–"
    sorts = "[...document.querySelectorAll('#run-table th')].map(head => head.getAttribute('aria-sort'))"
    assert browser.run(sorts).count("descending") == 1
    assert browser.run(sorts).count("ascending") == 0

    browser.run("document.querySelectorAll('#run-table th button')[7].click()")
    finals = [number(text) for text in column(browser, 7)]
    assert finals == sorted(finals)
    assert finals[0] < finals[1] < 0

    # By keyboard: Tab goes from heading to heading, Enter sorts.
    browser.run("document.querySelectorAll('#run-table th button')[0].focus()")
    browser.press("Tab", 9)
    browser.press("Enter", 13, "\r")
    assert browser.run("document.activeElement.innerText") == "Seed"
    assert browser.run(sorts)[1] == "ascending"
    assert column(browser, 1) == sorted(column(browser, 1))

    # Light and dark, paper's colors and safe ones.
    paint = "getComputedStyle(document.body).backgroundColor"
    browser.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    dark = browser.run(paint)
    browser.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}])
    light = browser.run(paint)
    assert dark != light
    browser.run("document.getElementById('theme').click()")
    assert browser.run(paint) == light
    browser.run("document.getElementById('theme').click()")
    assert browser.run(paint) == dark
    shown = "[...document.images].filter(image => image.offsetWidth > 0).map(image => image.className)"
    assert set(browser.run(shown)) == {"paper"}
    browser.run("document.getElementById('colors').click()")
    assert set(browser.run(shown)) == {"colorblind"}

    # Narrow: the page itself does not scroll sideways.
    browser.send("Emulation.setDeviceMetricsOverride", width=400, height=800, deviceScaleFactor=1, mobile=False)
    assert browser.run("document.documentElement.scrollWidth") <= 400

    asked = [
        event["params"]["request"]["url"] for event in browser.events if event["method"] == "Network.requestWillBeSent"
    ]
    assert all(url.startswith(("file:", "data:")) for url in asked)
    wrong = [event for event in browser.events if event["method"] in ("Runtime.exceptionThrown", "Log.entryAdded")]
    assert not wrong, wrong
    assert not [event for event in browser.events if event["method"].startswith("Runtime.consoleAPI")]


def test_every_link_leads_somewhere(page):
    text = page.read_text()
    links = [link.split("#")[0] for link in re.findall(r'href="([^"]*)"', text) if not link.startswith(("data:", "#"))]
    assert len(links) > 100
    missing = [link for link in links if not (page.parent / unquote(unescape(link))).exists()]
    assert not missing
    anchors = re.findall(r'href="#([^"]*)"', text)
    assert all(f'id="{anchor}"' in text for anchor in anchors)
    assert "<img src=x" not in text


def test_the_report_says_what_a_reader_must_know(page):
    text = " ".join(page.read_text().split())
    for words in (
        "3 of 21 planned runs are missing",
        "python run.py experiment=H1 seed=1 profile=quick",
        "gives no p-value below",
        "tests neither against the other",
        "no proof of equivalence",
        "5 runs a cell are the least",
        "neither confirms nor contradicts the paper",
    ):
        assert words in text, words
