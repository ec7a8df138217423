"""The guide to a tracker of one's own, done literally."""

import csv
import json
from itertools import accumulate
from pathlib import Path

import pytest
from guides import ROOT, copy_checkout, follow


@pytest.mark.slow
def test_the_tracker_of_the_guide_works(tmp_path: Path) -> None:
    checkout = copy_checkout(tmp_path / "checkout")
    said = follow(ROOT / "docs" / "howto-tracking.md", checkout)
    listed = []
    for seed, above in ((1, -100.0), (2, 0.0)):
        run = checkout / "runs" / "quick" / "ant-none-total_timesteps=1500" / f"seed_{seed}"
        returns = [float(row["episodic_return"]) for row in csv.DictReader((run / "episodes.csv").open())]
        best = sorted({value for value in accumulate(returns, max, initial=above) if value > above})
        assert best
        lines = (run / "best.jsonl").read_text().splitlines()
        assert [json.loads(line)["return"] for line in lines] == best
        listed += lines
    assert [line for line in said.splitlines() if line.startswith("{")] == listed
