"""What the numbers can and cannot show, in words."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from acmr.cells import Cell
from acmr.records import CONFIG_FILE, SUMMARY_FILE
from analysis.statistics.comparisons import LARGE_EFFECT
from analysis.statistics.two_samples import ALPHA, detectable_effect, power, smallest_permutation_p


def about_n(table3: pd.DataFrame, cells: Sequence[Cell]) -> list[str]:
    """What the number of runs allows, for the smallest comparison that there is.

    Args:
        table3: Rows with ``runs_reference`` and ``runs_index``.
        cells: The cells that there should be.
    """
    tested = table3[~table3["biased_reference"] & ~table3["biased_index"]]
    sizes = [(int(a), int(b)) for a, b in zip(tested["runs_reference"], tested["runs_index"], strict=True) if a and b]
    if not sizes:
        return ["No two groups have runs that can be compared yet."]
    n, m = min(sizes, key=lambda pair: (sum(pair), pair))
    if min(n, m) < 2:
        return [
            f"The smallest comparison has {n} against {m} runs. One run says nothing about how much runs differ: no "
            "test is made, and a difference of the means may be chance entirely."
        ]
    least = smallest_permutation_p(n, m)
    can = "cannot be significant at 5%, whatever the data are" if least >= ALPHA else "can be significant at 5%"
    return [
        f"The smallest comparison has {n} against {m} runs. An exact permutation test, which takes nothing for granted "
        f"but that runs are exchangeable, gives no p-value below {least:.3g} there: it {can}.",
        f"Student's t-test at this size rests on normality and equal variances, which {min(n, m)} values cannot show. "
        f"It finds a large effect ({LARGE_EFFECT} standard deviations) in {power(LARGE_EFFECT, n, m):.0%} of all "
        f"cases; to find it in 80% the true effect must be {detectable_effect(n, m):.1f} standard deviations. A result "
        "that is not significant therefore says little, and one that is overstates the size of the effect.",
        _least_n(max(map(len, _families(cells)))),
    ]


def caveats(threshold: float, cells: Sequence[Cell]) -> list[str]:
    """What a careful reader should know, whatever the numbers are.

    Args:
        threshold: Return to reach.
        cells: The cells that there should be.
    """
    families = " ".join(
        f"The p-values of {', '.join(family)} answer one question {_times(len(family))}." for family in _families(cells)
    )
    others = " and ".join(cell.name for cell in cells if cell.baseline and not cell.family)
    survival = (
        f"The threshold of {threshold:g} is close to mere survival: standing upright for 1,000 steps earns a Humanoid "
        "5,000 of healthy reward, less the cost of control. Look at episode length and forward velocity beside it."
    )
    one_number = (
        f"The threshold of {threshold:g} is one number: episode length and forward velocity show whether reaching it "
        "means walking or surviving."
    )
    return [
        survival if 4000 <= threshold <= 5200 else one_number,
        "The paper calls A2 the best method, slightly ahead of A3, but tests neither against the other. Two "
        "comparisons with A0 do not order A2 and A3.",
        "The paper takes p = .54 between H0 and A0 for no difference. A test that finds none is no proof of "
        "equivalence: the interval of the difference says which differences remain possible.",
        f"{families} Holm's adjustment stands beside them; it leaves out {others}, which are other questions. A cell "
        "that never reached the threshold stays in the family.",
        "Students of one seed share a teacher, and H1 continues H0; the tests take cells as independent, as the "
        "paper does. Unless they were made with seeding=independent, runs of one seed share its random numbers, too.",
    ]


def how_runs_count(consecutive: int) -> list[str]:
    """How states and censoring are treated."""
    return [
        f"Steps to threshold: the step at the end of {consecutive} consecutive episodes whose raw return meets the "
        "threshold. One number a run; a run, not an episode, is the unit of every test.",
        "Comparisons take the runs that came to their end. An unfinished run is listed, with its steps to threshold if "
        "it has reached it, but does not enter means and tests: of unfinished runs the fast ones are known first, and "
        "a cell would look faster than it is. The Kaplan-Meier curves include it, censored at its latest step.",
        "A run that stopped at its threshold (stop=threshold) is the beginning of a full one: it counts with its steps "
        "to threshold, or as not reached by stop_after. What comes after its end is not known: it has no asymptotic "
        "return and no area under the curve, its curve ends, and where a full run of its seed lies beside it, that one "
        "counts. Asked for a higher threshold than its own it counts as not reached by its end.",
        "While such runs are under way the fast ones have ended and the slow ones have not. A group enters means and "
        "tests once every planned seed has ended or is past the slowest that has (it then counts as not reached by its "
        "latest step); failing that with the paper's seeds alone, if these are known; failing that it is biased: "
        "described, marked and not tested.",
        "A run that diverged will never reach the threshold: it counts as not reached over its whole length (or with "
        "its steps to threshold, if it diverged later).",
        "Where some runs of a cell never reached the threshold, its mean is of the others and has a star, and no "
        "t-test is made, because dropping the slowest runs flatters a cell. Restricted means (steps within the "
        "horizon), the interval of their difference and the log-rank test keep every run; both p-values come from "
        "permutations, and both are adjusted like those of the t-test.",
        f"Runs without {CONFIG_FILE} and {SUMMARY_FILE} (foreign) are taken as complete. Damaged and duplicate runs "
        "are listed and not used.",
    ]


def _families(cells: Sequence[Cell]) -> list[list[str]]:
    """Cells whose p-values are adjusted together."""
    names = dict.fromkeys(cell.family for cell in cells if cell.family)
    return [[cell.name for cell in cells if cell.family == name] for name in names]


def _times(count: int) -> str:
    words = {1: "once", 2: "twice", 3: "three times", 4: "four times", 5: "five times", 6: "six times"}
    return words.get(count, f"{count} times")


def _least_n(comparisons: int) -> str:
    n = next(n for n in range(2, 20) if comparisons * smallest_permutation_p(n, n) < ALPHA)
    least = smallest_permutation_p(n, n)
    return (
        f"{n} runs a cell are the least with which the exact test can pass Holm's adjustment over {comparisons} "
        f"comparisons (least p-value {least:.4f}, adjusted {comparisons * least:.3f})."
    )
