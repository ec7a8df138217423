"""Names that somebody else chose, in each place where they are shown: read back there, they are what was meant."""

from __future__ import annotations

import csv
import io
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote_to_bytes, urljoin, urlsplit

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from acmr.names import archive_keys, csv_cell, distinct, figure, latex, link, markdown, terminal
from analysis.figures.style import apply, letters

#: Names as a file system gives them: any bytes, those that are no text included.
NAMES = st.one_of(
    st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1, max_size=30),
    st.text("ab_$|*`~^[]<>&#?%{}\\\"'=+-@!:; .\n\t\x1b\u202e", min_size=1, max_size=12),
    st.binary(min_size=1, max_size=12).filter(lambda name: not set(name) & set(b"/\0")).map(os.fsdecode),
)
LATEX_WORDS = {
    "textbackslash": "\\",
    "textasciitilde": "~",
    "textasciicircum": "^",
    "textbar": "|",
    "textless": "<",
    "textgreater": ">",
    "textasciigrave": "`",
}


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("q_lr=0.0001", "q_lr=0.0001"),
        ("Größe 中", "Größe 中"),
        ("a\nb\tc", r"a\nb\tc"),
        ("\x1b[31mred\x07", r"\x1b[31mred\x07"),
        ("\x9b2J", r"\x9b2J"),
        ("\u202egnp.exe", r"\u202egnp.exe"),
        ("a\u2028b\u00a0c\ufeff", r"a\u2028b\xa0c\ufeff"),
        (os.fsdecode(b"caf\xe9"), r"caf\xe9"),
    ],
)
def test_what_no_eye_sees_is_written_out(name, shown):
    assert terminal(name) == shown


@settings(deadline=None)
@given(NAMES)
def test_a_terminal_gets_one_line_of_visible_letters_that_every_file_takes(name):
    assert terminal(name).isprintable()
    terminal(name).encode()


@settings(deadline=None)
@given(NAMES, st.sampled_from(["../../runs", "runs", "."]))
def test_a_link_leads_to_the_file(name, folder):
    assume(name not in (".", ".."))
    address = urlsplit(urljoin("file:///results/paper/report.html", link(Path(folder) / name / "seed_1")))
    assert (address.query, address.fragment) == ("", "")
    wanted = os.path.normpath(os.path.join("/results/paper", folder, name, "seed_1"))
    assert unquote_to_bytes(address.path) == os.fsencode(wanted)


class _Cells(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.text += data


@settings(deadline=None)
@given(NAMES)
@example("_old_")
@example("a|b")
@example("<b>&lt;*x*`y`[z](w)")
def test_a_markdown_table_shows_the_name_in_one_cell(name):
    page = MarkdownIt("gfm-like", {"linkify": False}).render(f"| group | n |\n|:--|--:|\n| {markdown(name)} | 7 |\n")
    cells = _Cells()
    cells.feed(page)
    assert cells.tags == ["table", "thead", "tr", "th", "th", "tbody", "tr", "td", "td"]
    assert re.sub(r"\s+", "", cells.text) == re.sub(r"\s+", "", f"groupn{terminal(name)}7")


def _meant(found: re.Match[str]) -> str:
    word, *signs = found.groups()
    return LATEX_WORDS[word] if word else next(filter(None, signs))


@settings(deadline=None)
@given(NAMES)
@example("[x]*")
@example("a$b_$ --frozen 50% {x}")
@example("'\"")
def test_latex_prints_the_name(name):
    text = latex(name)
    # What is left once all that was written for LaTeX is read back must mean nothing to it.
    bare = re.sub(r"\\text\w+\{\}|\\[{}$&#%_]|\{[\[\]*]\}|-\{\}", "", text)
    assert not set(bare) & set('{}$&#%_\\~^<>|`"[]*')
    assert "--" not in text
    read = re.sub(r"\\(text\w+)\{\}|\\([{}$&#%_])|\{([\[\]*])\}|(-)\{\}", _meant, text)
    assert read == terminal(name).replace('"', "''")


@settings(deadline=None)
@given(st.lists(NAMES, min_size=1, max_size=6, unique=True))
@example(["file", "allow_pickle", "a\nb", r"a\nb", r"a\nb_", "x", "x.npy"])
def test_keys_of_an_archive_differ_and_hold_what_they_stand_for(names):
    keys = archive_keys(names)
    assert list(keys) == names
    assert len(set(keys.values())) == len(names)
    assert all(key.isprintable() and not key.endswith(".npy") for key in keys.values())
    assert all(keys[name].startswith(terminal(name)) for name in names)
    shown = distinct(names)
    assert len(set(shown.values())) == len(names)
    assert distinct(shown.values()) == dict(zip(shown.values(), shown.values(), strict=True))


@settings(deadline=None)
@given(st.lists(NAMES, min_size=1, max_size=4))
@example(["=1+1", "@SUM(1)", "-2", "+3", 'a,"b"\r\nc'])
@example(["0", ';"@', ';""=1', '; "+1'])
@example(["a;=cmd|' /C calc'!A0", 'x";=1', "a; @SUM(1);-2", "a|+1", "a\t=1", " =1", "\uff1d1+1", "a;\uff20x"])
def test_csv_gives_the_name_back_and_no_spreadsheet_computes_it(names):
    cells = [csv_cell(name) for name in names]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    assert next(csv.reader([text.getvalue()])) == cells
    # Whichever sign parts the cells of the spreadsheet that it is opened in.
    for sign in ",;|\t":
        for cell in next(csv.reader([text.getvalue()], delimiter=sign)):
            assert not cell.lstrip(" ").startswith(tuple("=+-@\t\r\uff1d\uff0b\uff0d\uff20")), (sign, cell)
    added = re.compile(r"""(^|[;|])'(?=[ "]*[=+\-@\uff1d\uff0b\uff0d\uff20])""")
    assert [added.sub(r"\1", cell) for cell in cells] == [added.sub(r"\1", terminal(name)) for name in names]


@pytest.mark.parametrize(
    "name", ["a$b_$", "_old", "$", r"\$x$", "{", "$\\frac{", "a_b^c", "\u202eabc", "中\U0001f600", "a\nb"]
)
def test_a_figure_shows_the_name_in_its_legend_and_at_its_axes(name, recwarn):
    apply()
    shown = figure(name, letters())
    drawing, axes = plt.subplots()
    axes.plot([0, 1], label=shown)
    axes.set_yticks([0], [shown])
    legend = axes.legend()
    drawing.canvas.draw()
    assert [text.get_text() for text in legend.get_texts()] == [shown]
    assert all(text.get_parse_math() is False for text in (*legend.get_texts(), *axes.get_yticklabels()))
    assert [str(warning.message) for warning in recwarn] == []
    plt.close(drawing)


@settings(deadline=None)
@given(NAMES)
def test_a_figure_has_all_letters_of_a_name(name):
    shown = figure(name, letters())
    assert not shown.startswith("_")
    assert np.isin([ord(sign) for sign in shown], list(letters())).all()
