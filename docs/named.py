"""Tables of ``docs/method.md``, from the published runs; ``python -m docs.results`` writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from acmr.cells import CELLS
from acmr.records import EVALUATION_FILE, SUMMARY_FILE, TRANSFER_FILE
from analysis.analyze import Analysis
from analysis.figures.parts import step_axis
from analysis.figures.style import COLUMN, PALETTES
from docs.markdown import number, p_value, span, steps, table

#: The cells that take by name, as the protocol names them.
NAMED = [cell.name for cell in CELLS.values() if cell.transfer == "named"]


#: Folder of the runs in the body with arms, beside those of the paper's profile: they are of no cell.
ARMS_ADDED = "arms_added"
#: What is said of a comparison, with its interval.
_DIFFERENCES = ("difference", "restricted_difference")
#: What the picture shows, and what it calls it.
_SHOWN = {"A0": "from nothing", "A2": "hidden layers, frozen", "N1": "by name"}
#: Episodes that a point of its curves averages.
_AVERAGED = 5


def runs(found: Analysis, published: Path) -> str:
    """Each run by name: what its trials chose, when it was there, and what its networks do then."""
    rows = []
    measured = found.measured[found.measured["counted"] & found.measured["cell"].isin(NAMED)]
    for name, run in measured.sort_values(["cell", "seed"]).iterrows():
        folder = published / str(name)
        summary, taken = _read(folder / SUMMARY_FILE), _read(folder / TRANSFER_FILE)
        trials = summary["audition"]
        played = sum(map(len, trials["returns"].values()))
        met = summary["steps_to_threshold"]
        rows.append(
            [
                *(run["cell"], int(run["seed"]), taken["teacher"]["seed"]),
                trials["chosen"] if trials["chosen"].isalpha() else f"{trials['chosen']} of the mean",
                *(played, f"{met:,}" if met else "not reached", *_evaluation(folder)),
            ]
        )
    heads = ["cell", "seed", "teacher", "gone counts as", "trials", "steps to threshold"]
    return table([*heads, "then, mean return", "ended in a fall", "m/s"], rows)


def tests(found: Analysis) -> str:
    """The comparisons that the protocol asks for."""
    chances = {(row["reference"], row["index"]): row for row in found.study.improvement.to_dict("records")}
    rows = []
    for row in found.table3.to_dict("records"):
        if row["index"] in NAMED:
            chance = chances[row["reference"], row["index"]]
            rows.append(
                [
                    f"{row['index']} − {row['reference']}",
                    f"{row['runs_index']} + {row['runs_reference']}",
                    *(span(*(row[f"{name}{end}"] for end in ("", "_low", "_high"))) for name in _DIFFERENCES),
                    *(p_value(row[name]) for name in ("p_permutation", "p_permutation_holm", "p_holm")),
                    number(chance["p_faster"], 2),
                ]
            )
    heads = ["index − reference", "runs", "difference (95%)", "restricted to 500,000 (95%)", "p, permutations"]
    return table([*heads, "after Holm", "p, t-test, after Holm", "chance of being faster"], rows)


def medians(found: Analysis) -> str:
    """Median, mean and extremes of each cell's steps to threshold."""
    rows = []
    measured = found.measured[found.measured["counted"]]
    for cell in ["A0", *NAMED]:
        times = measured.loc[measured["cell"] == cell, "time"]
        if len(times):
            numbers = [steps(value) for value in (times.median(), times.mean(), times.min(), times.max())]
            rows.append([cell, len(times), *numbers])
    return table(["cell", "runs", "median", "mean", "least", "most"], rows)


def added(found: Analysis, published: Path) -> str:
    """Runs in the body with arms whose teacher had none, beside H0 of the same seed."""
    baseline = found.measured[found.measured["cell"] == "H0"].set_index("seed")["time"]
    rows = []
    for file in sorted((published.parent / ARMS_ADDED).glob(f"*/*/{SUMMARY_FILE}"), key=lambda file: file.parent.name):
        summary, taken = _read(file), _read(file.with_name(TRANSFER_FILE))
        met = summary["steps_to_threshold"]
        # Where the teacher lay is where it is published, but that its networks are in half precision here.
        teacher = found.measured.loc["/".join(Path(taken["teacher"]["path"]).parts[-3:-1])]
        rows.append(
            [
                *(summary["seed"], f"{teacher['cell']} seed {teacher['seed']}, {steps(teacher['time'])} steps"),
                *(f"{met:,}" if met else "not reached", steps(baseline[summary["seed"]])),
                *_evaluation(file.parent),
            ]
        )
    heads = ["seed", "teacher", "steps to threshold", "H0 of that seed", "then, mean return", "ended in a fall"]
    return table([*heads, "m/s"], rows)


def picture(found: Analysis) -> Figure:
    """Every run's returns until its threshold, or for as long: from nothing, the paper's best, by name."""
    figure, axes = plt.subplots(figsize=(COLUMN * 1.9, 2.3), layout="constrained")
    measured = found.measured[found.measured["counted"]]
    for cell in _SHOWN:
        color = PALETTES[1].color(cell, _SHOWN)
        for name, run in measured[measured["cell"] == cell].iterrows():
            own = found.data.episodes[found.data.episodes["run"] == name]
            own = own[own["global_step"] <= run["time"]]
            curve = own["episodic_return"].rolling(_AVERAGED, min_periods=1).mean()
            axes.plot(own["global_step"], curve, color=color, linewidth=0.9, alpha=0.8)
            axes.plot(
                own["global_step"].iloc[-1], found.threshold, marker="v", markersize=4, color=color, clip_on=False
            )
        axes.plot([], [], color=color, label=f"{cell}: {_SHOWN[cell]} ({(measured['cell'] == cell).sum()} runs)")
    axes.axhline(found.threshold, color="black", linewidth=0.6, linestyle="--")
    axes.set(xlabel="environment steps of the student", ylabel=f"return, mean of {_AVERAGED} episodes")
    axes.set(xlim=(0, None), ylim=(0, 6000))
    step_axis(axes.xaxis)
    figure.legend(loc="outside upper center", ncol=len(_SHOWN))
    return figure


def _evaluation(folder: Path) -> tuple[str, str, str]:
    told = _read(folder / EVALUATION_FILE)
    falls = sum(episode["terminated"] for episode in told["each"])
    return f"{told['mean_return']:,.0f}", f"{falls} of {told['episodes']}", f"{told['mean_forward_velocity']:.2f}"


def _read(file: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return content


def tables(found: Analysis, published: Path) -> dict[str, str]:
    """Each table in Markdown, by its name on the page."""
    return {
        "named_medians": medians(found),
        "named_tests": tests(found),
        "named_runs": runs(found, published),
        "named_added": added(found, published),
    }
