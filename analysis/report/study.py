"""The study beyond table 3 in words, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import pandas as pd

from analysis.statistics.study.study import Study

#: What is said of the sensitivity of all comparisons.
SENSITIVITY = (
    "Index less reference, in steps: below 0 the index is faster. In brackets: restricted means, for some run never "
    "met the criterion. Empty: some run stopped at its own threshold before it met the criterion, or none met it; "
    "criteria of which nothing is known are left out. Rows of full runs are of those alone that took all their steps. "
    "One threshold and one criterion were chosen before the runs; the others show how far the answer hangs on that "
    "choice, and are no tests."
)

#: What the analysis by seeds takes for granted, and what the other one does.
PAIRED = (
    "Runs of one seed share the seed of the environment, the random first actions and the streams of fresh weights, "
    "and students of one seed their teacher: shared episodes counts the first ones that are equal. Table 3, as the "
    "paper has it, takes all runs as independent: if runs of one seed are alike (a correlation above 0), its p-values "
    "are too large, and too small if they are opposite. The paired t-test takes the differences within the seeds as "
    "normal, and pays with half of the degrees of freedom; the test of the signs takes nothing but that each sign is "
    "as likely as the other, and with n seeds gives no p-value below 2/2^n: 0.25 with three. The blocked analysis "
    "sets the steps equal to a part of the cell and a part of the seed. Which of them is to count has to be settled "
    "before one sees them."
)
#: What the test for equivalence asks.
EQUIVALENCE = (
    "Two one-sided tests (Welch's): the null hypothesis is a difference of the margin or more, and alike is what lies "
    "within the margin with its whole 90% interval. Not shown is no proof of a difference either. The least margin "
    "says from which margin on the two cells would have passed for alike. The paper takes A1 and A0, and H0 and A0, "
    "for alike because a test found no difference."
)
#: What replication means here.
REPLICATION = (
    "Published t-tests as effects: Hedges' g, the interval of the true difference in standard deviations, and the "
    "interval in which g of a study of our size lies in 95% of all cases if both studies draw from the same runs "
    "(predicted). Ours inside is what had to be expected; with three runs a cell that interval is so wide that it "
    "excludes little."
)
#: What rliable's measures need.
AGGREGATES = (
    "Interquartile means (of the middle half of the runs) of the steps within the horizon and of the asymptotic "
    "return of full runs; chances that a run of the index is faster or ends higher than one of the reference (ties "
    "count half). Bootstrap intervals are given from 10 runs a group on: of fewer they are too narrow."
)
#: What the costs are.
COST = (
    "Steps to threshold of a cell's own runs, and with the steps that their teachers were trained for. Students to "
    "repay: how many students of one teacher save as many steps as it took; empty where none are saved."
)
#: Columns of the comparisons by seed for print; the CSV has more.
PAIRED_COLUMNS = [
    *("index", "reference", "pairs", "shared_episodes", "faster", "slower", "correlation", "difference", "low", "high"),
    *("p_paired", "p_paired_holm", "p_sign_flip", "p_value", "restricted_difference", "p_restricted"),
]


def study_lines(study: Study) -> dict[str, list[str]]:
    """What ``--summary`` prints of the study: lines by their title."""
    margin = study.equivalence["margin"].max()
    parts = {
        "Sensitivity to threshold and criterion": sensitivity_lines(study.overview),
        "By seed": paired_lines(study.paired),
        f"Alike within {margin:,.0f} steps": equivalence_lines(study.equivalence),
        "With the teacher's steps": cost_lines(study.cost),
    }
    return {title: lines for title, lines in parts.items() if lines}


def paired_lines(paired: pd.DataFrame) -> list[str]:
    """A line for each comparison by seed."""
    lines = []
    for row in paired.to_dict("records"):
        counts = f"faster on {row['faster']:g}, slower on {row['slower']:g} of {row['pairs']} seeds"
        line = f"{row['index']} − {row['reference']}: {counts}" if row["pairs"] else _name(row)
        if pd.notna(row["difference"]):
            line += f"; {steps(row['difference'])} ({steps(row['low'])} to {steps(row['high'])})"
            line += f", paired p = {_p(row['p_paired'])}, by signs {_p(row['p_sign_flip'])}"
            line += f", not paired {_p(row['p_value'])}"
        elif pd.notna(row["restricted_difference"]):
            line += f"; restricted {steps(row['restricted_difference'])}, by signs p = {_p(row['p_restricted'])}"
        lines.append(f"{line}; {row['note']}" if row["note"] else line)
    return lines


def equivalence_lines(equivalence: pd.DataFrame) -> list[str]:
    """A line for each comparison as a question of likeness."""
    lines = []
    for row in equivalence.to_dict("records"):
        if not row["equivalent"]:
            lines.append(f"{_name(row)}: {row['note']}")
            continue
        interval = f"90% interval {steps(row['low'])} to {steps(row['high'])}"
        margin = f"least margin {steps(row['least_margin'])}"
        lines.append(f"{_name(row)}: {row['equivalent']}, p = {_p(row['p_tost'])}; {interval}; {margin}")
    return lines


def cost_lines(cost: pd.DataFrame) -> list[str]:
    """A line for each group that had a teacher."""
    taught = cost[cost["teacher_steps"] > 0]
    return [
        f"{row['group']}: {steps(row['own_steps'])} of its own, {steps(row['total_steps'])} with its teacher's; "
        + (
            f"{row['students_to_repay']:,.0f} students make up for one teacher"
            if pd.notna(row["students_to_repay"])
            else f"saves nothing against {row['baseline']}"
            if pd.notna(row["saved_steps"])
            else f"not known against {row['baseline']}"
        )
        for row in taught.to_dict("records")
    ]


def _name(row: dict[Hashable, Any]) -> str:
    return f"{row['index']} − {row['reference']}"


def _p(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.3f}"


def sensitivity_lines(overview: pd.DataFrame) -> list[str]:
    """A line for each comparison: at how many thresholds and criteria the index is ahead, and by how much.

    Args:
        overview: :func:`analysis.statistics.study.sensitivity.overview`.
    """
    lines = []
    for row in overview.to_dict("records"):
        name = (
            f"{row['index']} − {row['reference']}, {row['basis']} runs ({row['runs_index']} + {row['runs_reference']})"
        )
        if not row["known"]:
            lines.append(f"{name}: not known at any of {row['settings']} settings")
            continue
        lines.append(
            f"{name}: index faster at {row['faster']} of {row['known']} settings known of {row['settings']}; "
            f"from {steps(row['lowest'])} to {steps(row['highest'])}, as asked {steps(row['asked'])}"
        )
    return lines


def steps(value: float) -> str:
    """A difference in steps with its sign; a dash if it is not known."""
    return "–" if pd.isna(value) else f"{value:,.0f}".replace("-", "−")
