"""Files of episodes as people and other programs write them: read to the last bit, or refused with the line."""

from __future__ import annotations

import csv
import gzip
import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from analysis_runs import csv_text, rows_reaching, write_run
from hypothesis import given, settings
from hypothesis import strategies as st

from acmr.records import DamagedError
from analysis.loading.episodes import read_episodes
from analysis.loading.load import load

NAMES = ["global_step", "episodic_return", "episode_length"]
ROWS = [[100, 4899.25, 100], [900, -12.5, 800], [1500, 5003.0625, 600]]
FRAME = pd.DataFrame(ROWS, columns=NAMES)


def text_of(sep: str = ",", end: str = "\n", decimal: str = ".", **more: object) -> str:
    return FRAME.to_csv(sep=sep, lineterminator=end, decimal=decimal, index=False, **more)


def savetxt() -> str:
    buffer = io.StringIO()
    np.savetxt(buffer, np.array(ROWS), header=" ".join(NAMES))
    return buffer.getvalue()


PLAIN = text_of()
READ = {
    "quoted": text_of(quoting=csv.QUOTE_ALL),
    "quoted names": text_of(quoting=csv.QUOTE_NONNUMERIC),
    "spaces": PLAIN.replace(",", " , "),
    "spaces before quotes": text_of(quoting=csv.QUOTE_ALL).replace(",", ", "),
    "semicolons": text_of(";"),
    "decimal commas": text_of(";", decimal=","),
    "quoted decimal commas": text_of(decimal=",", quoting=csv.QUOTE_ALL),
    "tabs": text_of("\t"),
    "tabs and decimal commas": text_of("\t", decimal=","),
    "bars": text_of("|"),
    "blanks": text_of(" "),
    "a printed frame": FRAME.to_string(index=False) + "\n",
    "numpy.savetxt": savetxt(),
    "comments": "# made by hand\n\n" + PLAIN.replace("\n900", "\n  # a remark\n900") + "# the end\n",
    "excel": "\ufeffsep=;\r\n" + text_of(";", "\r\n", ","),
    "windows": text_of(end="\r\n"),
    "old mac": text_of(end="\r"),
    "no final newline": PLAIN[:-1],
    "no final newline, windows": text_of(end="\r\n")[:-2],
    "empty lines": PLAIN.replace("\n", "\n\n") + "\n\n",
    "a delimiter too many": PLAIN.replace("\n", ",\n"),
    "a delimiter too many in the rows": PLAIN.replace("\n", ",\n").replace(",\n", "\n", 1),
    "empty rows": text_of(";") + ";;\n;;\n",
    "an index": FRAME.to_csv(),
    "another order": FRAME[NAMES[::-1]].to_csv(index=False),
    "text in other columns": FRAME.assign(note='a, "b"\nc').to_csv(index=False),
    "doubled columns of no use": PLAIN.replace("\n", ",x,x\n", 1).replace("0\n", "0,1,2\n"),
    "whole numbers with decimals": PLAIN.replace("100,", "100.0,").replace("900,", "9e2,"),
}


def read(tmp_path: Path, content: str | bytes, **more: bool) -> tuple[pd.DataFrame, list[str]]:
    path = tmp_path / "episodes.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_episodes(path, **more)


@pytest.mark.parametrize("kind", READ)
def test_what_people_write_is_read_to_the_last_bit(tmp_path, kind):
    frame, notes = read(tmp_path, READ[kind])
    assert frame[NAMES].to_numpy().tolist() == ROWS
    assert notes == []


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_other_encodings_are_read(tmp_path, encoding):
    frame, _ = read(tmp_path, ("# Größe\n" + text_of("\t")).encode(encoding))
    assert frame[NAMES].to_numpy().tolist() == ROWS


@settings(max_examples=60, deadline=None)
@given(
    returns=st.lists(st.floats(-1e99, 1e99), min_size=1, max_size=20),
    sep=st.sampled_from([",", ";", "\t", "|", " "]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    quoting=st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL, csv.QUOTE_NONNUMERIC]),
    comma=st.booleans(),
)
def test_every_dialect_gives_the_same_bits(tmp_path_factory, returns, sep, end, quoting, comma):
    frame = pd.DataFrame({"episodic_return": [f"{value!r}" for value in returns]})
    if comma and sep != ",":
        # Three decimals might be thousands, which is refused; one number with others says what is meant.
        frame.loc[0, "episodic_return"], returns[0] = "0.5", 0.5
        frame["episodic_return"] = frame["episodic_return"].str.replace(".", ",")
    frame["global_step"] = frame["episode_length"] = np.arange(1, len(frame) + 1)
    content = frame.to_csv(sep=sep, lineterminator=end, quoting=quoting, index=False)
    read_back, _ = read(tmp_path_factory.mktemp("csv"), content)
    assert read_back["episodic_return"].to_numpy().tobytes() == np.array(returns).tobytes()


REFUSED = {
    "global_step,episodic_return,episodic_return,episode_length\n": "line 1: the column episodic_return is there 2",
    "# x\nglobal_step;global_step;episodic_return;episode_length\n": "line 2: the column global_step is there 2 times",
    "a;b;c\n1;2;3\n": "no column global_step, episodic_return, episode_length (needed: global_step,",
    "1,2,3\n": "no column global_step",
    "": "no column global_step",
    "# nothing but remarks\n": "no column global_step",
    PLAIN.replace("4899.25", "4899,25"): "line 2 holds 4 values, not 3 (decimal commas are read where ;",
    text_of(";").replace("-12.5", "-12,5"): "line 3: episodic_return is '-12,5'; elsewhere the other of . and ,",
    text_of(";", decimal=",").replace("4899,25", "4.899,25"): "line 2: episodic_return is '4.899,25', not a number",
    text_of(";").replace("1500;", "1,500;").replace(".", ""): "line 4: global_step is '1,500', of thousands or with",
    PLAIN.replace("100,", "1.100,").replace("900,", "1.900,"): "line 2: global_step is '1.100', of thousands or with",
    PLAIN.replace("1500,", "1.500,"): "line 4: global_step is 1.5, not a count of steps",
    "global_step;episodic_return;episode_length\n1;4,900;1\n2;5,000;1\n": "line 2: episodic_return is '4,900', of thou",
    PLAIN.replace("-12.5", "12 %"): "line 3: episodic_return is '12 %', not a number",
    PLAIN.replace("-12.5", ""): "line 3: episodic_return is '', not a number",
    PLAIN + PLAIN: "line 5: global_step is 'global_step', not a number",
    PLAIN.replace("-12.5", '"-12.5'): "line 3: unexpected end of data",
    PLAIN.replace("900,-12.5", '900,"-12"5'): "line 3: ',' expected after '\"'",
    "# x\n\n"
    + text_of(";").replace("900;", "90;"): "rows are not in order: line 5 is at step 90, the one before at 100",
    PLAIN + "1600,1\n": "line 5 holds 2 values, not 3",
}


@pytest.mark.parametrize("content", REFUSED)
def test_what_cannot_be_read_is_refused_with_the_line(tmp_path, content):
    with pytest.raises(DamagedError) as refused:
        read(tmp_path, content)
    assert f"episodes.csv: {REFUSED[content]}" in str(refused.value)
    assert "\n" not in str(refused.value)


LENGTHS = "episodes.csv: line 5: an episode"


@pytest.mark.parametrize("last", ["1600,5,10", "1600,5.5,100", "1600,-7.0,1"])
def test_a_last_line_that_does_not_end_counts_unless_a_run_of_ours_was_cut_off(tmp_path, last):
    for more, episodes in (({}, 4), ({"own": True, "ended": True}, 4), ({"own": True}, 3)):
        frame, notes = read(tmp_path, PLAIN + last, **more)
        assert len(frame) == episodes
        # A number of steps that is cut off is found out by the steps that passed.
        odd = [] if not more or last.endswith(",100") else [f"{LENGTHS} of {last.split(',')[2]} steps, 100 after"]
        expected = odd if episodes == 4 else ["cut off in line 5, which is left out"]
        assert len(notes) == len(expected)
        assert all(note.startswith(start) for note, start in zip(notes, expected, strict=True))


@pytest.mark.parametrize("last", ["1600", "1600,", "1600,5.5", "1600,5.5,", "1600,5.5,x", "1600,-,1", '1600,"5.5'])
def test_a_last_line_without_all_its_values_is_left_out(tmp_path, last):
    if '"' in last:
        with pytest.raises(DamagedError, match="line 5"):
            read(tmp_path, PLAIN + last)
        return
    frame, notes = read(tmp_path, PLAIN + last)
    assert frame[NAMES].to_numpy().tolist() == ROWS
    assert notes == ["cut off in line 5, which is left out"]


@pytest.mark.parametrize("steps", [[8, 8, 16], [8, 16, 16], [8, 8, 8]])
def test_episodes_that_end_at_one_step_are_those_of_environments_that_step_together(tmp_path, steps):
    content = "\n".join([",".join(NAMES), *(f"{step},1.0,8" for step in steps)]) + "\n"
    assert read(tmp_path, content)[0]["global_step"].tolist() == steps
    with pytest.raises(DamagedError, match="rows are not in order"):
        read(tmp_path, content, own=True)


def test_foreign_and_own_runs_are_told_apart_by_their_settings(tmp_path):
    rows = rows_reaching(6000, 20_000)
    rows[10:14, 0] = rows[13, 0]
    write_run(tmp_path, "A0", 1, rows)
    (tmp_path / "A2" / "seed_1").mkdir(parents=True)
    (tmp_path / "A2" / "seed_1" / "episodes.csv").write_text(csv_text(rows, columns=3).replace(",", ";")[:-1])
    runs = load(tmp_path).runs.set_index("cell")
    assert (runs.loc["A0", "state"], runs.loc["A2", "state"]) == ("damaged", "foreign")
    assert runs.loc["A2", "episodes"] == len(rows)


def test_a_compressed_file_may_be_written_in_any_way_too(tmp_path):
    path = tmp_path / "episodes.csv.gz"
    path.write_bytes(gzip.compress(READ["excel"].encode()))
    assert read_episodes(path)[0][NAMES].to_numpy().tolist() == ROWS
