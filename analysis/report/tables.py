"""Formats tables: CSV with every digit, Markdown and LaTeX to be read."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from acmr.names import csv_cell, latex, markdown
from analysis.statistics.comparisons import PAPER_COLUMNS

#: Columns of the table of runs for print; its CSV has more.
STEPS_COLUMNS = [
    *("group", "seed", "state", "steps_to_threshold", "steps_to_threshold_first", "episodes"),
    *("initial_return", "asymptotic_return", "area_under_curve"),
]
#: What a star behind a mean and a standard deviation means.
FLATTERING = "*Of the runs that reached the threshold; the others need more steps: compare restricted means."
#: Columns beyond which a LaTeX table is made smaller until it fits.
CROWDED = 15
#: Columns beyond which a LaTeX table spans both columns of a paper.
WIDE = 6
#: Letters of a cell beyond which LaTeX breaks its lines.
SENTENCE = 30

_COUNTS = (
    *("n_", "runs", "censored", "seed", "episodes", "reached", "pairs", "unpaired", "shared", "full_", "df_"),
    *("faster", "slower", "undecided", "students"),
)
_STEPS = (
    *("mean_", "std_", "difference", "restricted_", "steps", "low", "high", "horizon", "last_step", "mean", "std"),
    *("asked", "margin", "least_margin", "paired_", "own_", "teacher_", "total_", "baseline_", "saved_", "iqm_"),
)


def write_table(table: pd.DataFrame, out: Path, name: str, caption: str, columns: list[str] | None = None) -> None:
    """Writes ``name.csv`` (all columns, every digit), ``name.md`` and ``name.tex`` (rounded, booktabs).

    Args:
        table: The table.
        out: Folder.
        name: File name without its ending, also the LaTeX label.
        caption: LaTeX caption.
        columns: Those for Markdown and LaTeX; None: all.
    """
    texts = {str(column) for column in table.select_dtypes("object")}
    plain = table.assign(**{column: table[column].map(_csv_value) for column in texts})
    plain.to_csv(out / f"{name}.csv", index=False, na_rep="NaN", lineterminator="\n")
    shown = readable(marked(table) if columns is None else marked(table)[columns])
    alignment = ["left" if name in _text_columns(table) else "right" for name in shown.columns]
    shown.columns = pd.Index([heading(str(name)) for name in shown.columns])
    text = shown.map(markdown).to_markdown(index=False, disable_numparse=True, colalign=alignment)
    note = footnote(table)
    written = f"{text}\n\n{markdown(note)}\n" if note else f"{text}\n"
    (out / f"{name}.md").write_text(written, encoding="utf-8")
    caption = f"{caption} {note}" if note else caption
    (out / f"{name}.tex").write_text(_latex(shown, alignment, name, caption), encoding="utf-8")


def _latex(shown: pd.DataFrame, alignment: list[str], name: str, caption: str) -> str:
    """A table as narrow as it can be: headings one word a line, and smaller letters where there are many columns."""
    sides, wide = [side[0] for side in alignment], len(shown.columns) > WIDE
    longest = [max(map(len, shown[column]), default=0) for column in shown.columns]
    widths = ["p{11em}" if length > SENTENCE else side for length, side in zip(longest, sides, strict=True)]
    cells = shown.style.hide(axis="index").format(_latex_cell)
    escaped = cells.format_index(_latex_cell, axis=1).to_latex(
        hrules=True,
        caption=caption,
        environment="table*" if wide else "table",
        label=f"tab:{name}",
        position_float="centering",
        column_format="".join(widths),
    )
    before, head, after = re.split(r"(?<=\\toprule\n)(.*)(?= \\\\\n)", escaped, maxsplit=1)
    stacks = [_stacked(words, side) for words, side in zip(head.split(" & "), sides, strict=True)]
    small = "\\centering\n\\footnotesize\n\\setlength{\\tabcolsep}{2.5pt}\n"
    whole = (before.replace("\\centering\n", small) if wide else before) + " & ".join(stacks) + after
    if len(shown.columns) > CROWDED:
        whole = whole.replace("\\begin{tabular}", "\\resizebox{\\textwidth}{!}{%\n\\begin{tabular}")
        whole = whole.replace("\\end{tabular}", "\\end{tabular}}")
    return whole


def _latex_cell(text: object) -> str:
    return re.sub(r"^(\(?)[-−](?=\d)", r"\1$-$", latex(str(text)))


def _csv_value(value: object) -> object:
    return csv_cell(value) if isinstance(value, str) else value


def _stacked(words: str, side: str) -> str:
    return rf"\shortstack[{side}]{{{words.replace(' ', chr(92) * 2)}}}" if " " in words else words


def marked(table: pd.DataFrame) -> pd.DataFrame:
    """The table as it is shown, where numbers would say too much.

    The name of a biased group has a word behind it. Where some runs never reached the threshold, the mean and the
    standard deviation of those that did have a star (``FLATTERING`` explains it), and their number says of how many.
    """
    table = table.copy()
    for names, total, missed in _flattering(table):
        for name in names[:-1]:
            star = [
                f"{value:,.0f}*" if flag and pd.notna(value) else value
                for value, flag in zip(table[name], missed, strict=True)
            ]
            table[name] = pd.Series(star, index=table.index, dtype=object)
        if total is not None:
            counts = [
                f"{n} of {runs}" if flag else n for n, runs, flag in zip(table[names[-1]], total, missed, strict=True)
            ]
            table[names[-1]] = pd.Series(counts, index=table.index, dtype=object)
    for name, flag in (("reference", "biased_reference"), ("index", "biased_index"), ("group", "biased")):
        if flag in table:
            table[name] = table[name].where(~table[flag].astype(bool), table[name] + " (biased)")
    return table


def is_censored(table: pd.DataFrame) -> bool:
    """Whether some run of a group in it never reached the threshold."""
    return any(bool(missed.any()) for _, _, missed in _flattering(table))


def footnote(table: pd.DataFrame) -> str:
    """What the stars in it mean, if it has any."""
    stars = [bool((missed & (table[count] > 0)).any()) for (_, _, count), _, missed in _flattering(table)]
    return FLATTERING if any(stars) else ""


def _flattering(table: pd.DataFrame) -> Iterator[tuple[tuple[str, str, str], pd.Series | None, pd.Series]]:
    """Names of mean, deviation and count of each role; of how many (None: said elsewhere); which rows miss some."""
    for role in ("reference", "index"):
        if f"censored_{role}" in table:
            names = (f"mean_{role}", f"std_{role}", f"n_{role}")
            yield names, table[f"runs_{role}"], table[f"censored_{role}"] > 0
    if {"mean", "std", "reached", "runs"} <= set(table):
        yield ("mean", "std", "reached"), None, table["reached"] < table["runs"]


def readable(table: pd.DataFrame, missing: str = "NaN") -> pd.DataFrame:
    """The table as text: steps without decimals, the rest with three, NaN as ``missing``."""
    rows, names = table.itertuples(index=False, name=None), [str(name) for name in table.columns]
    text = [[_cell_text(name, value, missing) for name, value in zip(names, row, strict=True)] for row in rows]
    return pd.DataFrame(text, columns=table.columns, dtype=object)


def paper_columns(table: pd.DataFrame) -> list[str]:
    """Columns of table 3 for print: the paper's, the interval of the difference and the exact p-values.

    Where some run never reached the threshold, what keeps such runs stands beside them: the restricted means with the
    interval of their difference, and the adjusted p-values of both tests of them.
    """
    names = [*PAPER_COLUMNS, "difference_low", "difference_high", "p_holm", "p_permutation", "p_log_rank"]
    if is_censored(table):
        names += ["restricted_mean_reference", "restricted_mean_index"]
        names += ["restricted_difference_low", "restricted_difference_high", "p_restricted_holm", "p_log_rank_holm"]
    return names


def _text_columns(table: pd.DataFrame) -> set[str]:
    return {str(name) for name in table.columns if not pd.api.types.is_numeric_dtype(table[name])}


def _cell_text(column: str, value: object, missing: str) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if value is None or value is pd.NA:
        return ""
    if not isinstance(value, int | float | np.integer | np.floating):
        return str(value)
    if pd.isna(value):
        return missing
    if column == "threshold":
        return f"{value:g}"
    if isinstance(value, int | np.integer) or column.startswith(_COUNTS) or column.startswith(_STEPS):
        return f"{value:,.0f}"
    return f"{value:.3f}"


_WORDS = {
    "std": "SD",
    "t_score": "T-score",
    "p_value": "P-value",
    "p_holm": "P (Holm)",
    "p_permutation": "P (permutation)",
    "p_permutation_holm": "P (permutation, Holm)",
    "p_log_rank": "P (log-rank, permutation)",
    "p_log_rank_asymptotic": "P (log-rank, asymptotic)",
    "p_restricted": "P (restricted means, permutation)",
    "p_restricted_holm": "P (restricted means, Holm)",
    "p_log_rank_holm": "P (log-rank, Holm)",
    "restricted_difference_low": "restricted difference, 95% from",
    "restricted_difference_high": "restricted difference, 95% to",
    "log_rank_z": "log-rank z",
    "welch_t": "Welch's t",
    "welch_df": "Welch's df",
    "welch_p": "Welch's P",
    "hedges_g": "Hedges' g",
    "hedges_g_low": "g, 95% from",
    "hedges_g_high": "g, 95% to",
    "difference_low": "difference, 95% from",
    "difference_high": "difference, 95% to",
    "low": "95% from",
    "high": "95% to",
    "power_large_effect": "power for 0.8 SD",
    "detectable_effect": "effect found in 80% (SD)",
    "area_under_curve": "mean return (area)",
    "p_paired": "P (paired t)",
    "p_paired_holm": "P (paired t, Holm)",
    "p_sign_flip": "P (signs)",
    "p_sign_flip_holm": "P (signs, Holm)",
    "f_score": "F",
    "p_friedman": "P (Friedman, asymptotic)",
    "p_tost": "P (TOST)",
    "p_tost_paired": "P (TOST, paired)",
    "paired_low": "paired, from",
    "paired_high": "paired, to",
    "p_faster": "P(index faster)",
    "p_faster_low": "P(index faster), 95% from",
    "p_faster_high": "P(index faster), 95% to",
    "p_higher_return": "P(higher return)",
    "p_higher_return_low": "P(higher return), 95% from",
    "p_higher_return_high": "P(higher return), 95% to",
}


def heading(name: str) -> str:
    """A column's name as it is read: T-score for t_score."""
    if name in _WORDS:
        return _WORDS[name]
    text = re.sub(r"^std_", "SD ", re.sub(r"^n_", "n ", re.sub(r"^(t|p)_", lambda match: match[0].upper(), name)))
    return text.replace("_", " ")
