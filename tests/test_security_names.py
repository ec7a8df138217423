"""Names that somebody else chose: they run nothing in the report, a terminal, a shell or a spreadsheet."""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import re
import shlex
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote_to_bytes, urljoin, urlsplit

import pytest
import yaml
from analysis_runs import rows_reaching, write_run
from finished_run import ANT, make_run
from test_analysis_report import CHROMIUM, Browser

from acmr.evaluation.cli import main as evaluation
from acmr.settings.errors import explain
from acmr.storage.run_dir import RunDir
from acmr.text import message, one_line
from acmr.tracking.mirror import main as mirror
from analysis.analyze import Analysis, analyze
from analysis.loading.load import load
from analysis.loading.missing import matrix_command, missing_runs
from analysis.report.html import Report, write_report
from analysis.report.write import Written, _write_tables
from sweeps.status import main as status

NAMES = (
    "javascript:alert(1)", "JavaScript:alert(document.domain)", "https:", "data:text,x", "vbscript:x", "file:",
    '"><script>alert(1)<', "' onmouseover='alert(1)", "<img src=x onerror=alert(1)>", "{{ 7 * 7 }}", "{% raw %}",
    "=cmd|' calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "\t=1", "\n=1", "a\x1b[2J\x1b]0;x\x07", "a\rb", "\u202egnp",
)  # fmt: skip
#: What a terminal, or a reader of lines, would act on.
COMMANDS = {chr(number) for number in (*range(32), *range(127, 160))} | {"\u202e", "\u2028"}


class Page(HTMLParser):
    """The elements of a page, and the texts of its styles and scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {"style": [], "script": []}
        self._within = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._within = tag

    def handle_endtag(self, tag: str) -> None:
        self._within = ""

    def handle_data(self, data: str) -> None:
        if self._within in self.texts:
            self.texts[self._within].append(data)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Page, Analysis]:
    """Results that lie in the folder of the runs, so that links begin with their names."""
    root = tmp_path_factory.mktemp("runs")
    for number, name in enumerate(NAMES):
        run = write_run(root / "aside", "A0", 1, rows_reaching(6000, 20_000), total=20_000)
        settings = yaml.safe_load((run / "config.yaml").read_text())
        settings["agent"][name] = settings["agent"]["note"] = name
        (run / "config.yaml").write_text(yaml.safe_dump(settings))
        summary = json.loads((run / "summary.json").read_text())
        (run / "summary.json").write_text(json.dumps(summary | {"cause": name, "machine": name, "cell": name}))
        (root / name).mkdir()
        run.rename(root / name / f"seed_{number}")
    write_run(root, "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    analysis = analyze(load(root))
    tables = _write_tables(analysis, root, Written())
    path = write_report(Report(analysis, tables, [], list(NAMES)), root, root)
    return root, Page(path.read_text(encoding="utf-8")), analysis


@pytest.mark.slow
def test_every_link_of_the_report_leads_to_what_it_names(results):
    root, page, _ = results
    links = [attributes["href"] or "" for tag, attributes in page.elements if tag == "a"]
    runs = [link for link in links if "seed_" in link]
    assert len({link.partition("/seed_")[0] for link in runs}) == len(NAMES) + 1
    for link in runs:
        assert link.startswith("./")
        address = urlsplit(urljoin(f"{root.as_uri()}/", link))
        assert address.scheme == "file"
        assert Path(unquote_to_bytes(address.path).decode()).exists(), link
    assert all(link.startswith(("./", "#")) or link.partition(".")[0].isidentifier() for link in links)


def test_no_name_becomes_a_part_of_the_page(results):
    _, page, _ = results
    assert [tag for tag, _ in page.elements].count("script") == 1
    assert not [tag for tag, attributes in page.elements if any(name.startswith("on") for name in attributes)]
    assert not [tag for tag, attributes in page.elements if "style" in attributes]
    assert {tag for tag, _ in page.elements} & {"img", "iframe", "base", "form", "object"} == set()


def test_the_policy_allows_the_pages_own_style_and_script_and_nothing_else(results):
    _, page, _ = results
    (policy,) = [attributes["content"] or "" for tag, attributes in page.elements if "http-equiv" in attributes]
    assert "unsafe" not in policy
    for kind, texts in page.texts.items():
        digest = base64.b64encode(hashlib.sha256("".join(texts).encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
        assert len("".join(texts)) > 1_000


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
def test_nothing_but_the_pages_own_script_runs(results, tmp_path):
    # As if a name had become a part of the page after all.
    ways = """
        window.blocked = []
        document.addEventListener("securitypolicyviolation", event => window.blocked.push(event.effectiveDirective))
        const script = document.createElement("script")
        script.textContent = "window.ran = 1"
        const place = document.createElement("div")
        place.innerHTML = `<b class=evil onclick="window.ran = 2"></b><p style="color: red"></p>
            <a class=evil href="javascript:window.ran = 3"></a><img src="http://127.0.0.1:9/x">
            <iframe srcdoc="<script>parent.ran = 4</script>"></iframe>`
        document.body.append(script, place)
        for (const evil of document.querySelectorAll(".evil")) evil.click()
        new Promise(then => setTimeout(() => then([window.ran || 0, [...new Set(window.blocked)]]), 500))
    """
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(results[0] / "report.html")
        assert set(browser.run("[...document.links].map(link => link.protocol)")) == {"file:"}
        ran, blocked = browser.run(ways)
    finally:
        browser.close()
    assert ran == 0
    assert {"script-src-elem", "script-src-attr", "style-src-attr", "img-src"} <= set(blocked), blocked


def test_tables_compute_nothing_and_stay_tables(results):
    root, _, _ = results
    for path in root.glob("*.csv"):
        for row in csv.reader(path.open(newline="", encoding="utf-8")):
            for cell in row:
                assert not cell.startswith(("=", "+", "@", "\t", "\r")), path
                assert not cell.startswith("-") or float(cell) < 0, path
                assert not COMMANDS & set(cell), path
    for path in root.glob("*.md"):
        assert not COMMANDS - {"\n"} & set(path.read_text(encoding="utf-8")), path
        assert not re.search(r"(?<!\\)<[a-z]", path.read_text(encoding="utf-8")), path


@pytest.mark.parametrize(
    "profile", ["x; touch ran", "$(touch ran)", "`touch ran`", "a b", "x'y", "quick\n&& touch ran"]
)
def test_a_command_to_be_typed_runs_nothing_else(profile, tmp_path):
    write_run(tmp_path, "A0", 1, rows_reaching(6000, 20_000), total=20_000)
    (path,) = tmp_path.rglob("config.yaml")
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"profile": profile}))
    (summary,) = tmp_path.rglob("summary.json")
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"profile": profile}))
    data = load(tmp_path)
    for command in (matrix_command(data), *(run.command for run in missing_runs(data))):
        words = shlex.split(command)
        assert words[:2] == ["python", "run.py"]
        assert {f"profile={profile}", f"matrix={profile}"} & set(words)
        assert all("=" in word for word in words[2:])


@pytest.mark.parametrize("name", ["\x1b[2J", "a\x1b]0;title\x07", "a\nerror: b", "\x9b31m", "\u202e"])
def test_no_message_acts_on_a_terminal(name, tmp_path, capsys):
    error = ValueError(f"no {name}")
    for said in (message(error), one_line(error), explain(OSError(f"no {name}"))):
        assert not COMMANDS & set(said)
    run = make_run(tmp_path / "quick" / "ant-none" / "seed_1")
    (run / "config.yaml").write_text(yaml.safe_dump({"env": vars(ANT) | {"id": f"Ant{name}-v5"}, "seed": 1}))
    assert evaluation([str(run)]) == 2
    (run / "status.json").write_text(json.dumps({"state": "failed", "cause": name, "host": name}))
    (run / "summary.json").write_text(json.dumps({"status": name}))
    status([str(tmp_path)])
    assert mirror(["rebuild", str(tmp_path / name)]) == 2
    said = "".join(capsys.readouterr())
    assert not (COMMANDS - {"\n"}) & set(said), repr(said)
    assert "\nerror: b" not in said


def test_a_runs_log_has_a_line_for_each_line(tmp_path):
    said: list[str] = []
    with RunDir(tmp_path).log(said.append) as say:
        say("one\nerror: two\x1b[2J")
    assert said == ["one\\nerror: two\\x1b[2J"]
    assert (tmp_path / "run.log").read_text().count("\n") == 1
