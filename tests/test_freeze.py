"""Freezing as a choice of settings: how it is typed, what it means, what runs are called."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from test_config import refusal, spec

from acmr.agent.fine_tuning import thaw_schedule
from acmr.cells import CELLS
from acmr.settings import compose
from acmr.settings.command_line import hydra_arguments
from acmr.settings.compose import options
from acmr.settings.sources import SWEEPS, Sources
from acmr.settings.stored import stored_config
from sweeps.plan import expand

ROOT = Path(__file__).parents[1]
GRADUAL = [10_000, 12_500, 15_000]
HIDDEN = "armless_humanoid-hidden"


@pytest.mark.parametrize(
    ("typed", "hydras"),
    [
        ("freeze=true", "freeze='true'"),
        ("freeze=True,FALSE,gradual", "freeze='true','false',gradual"),
        ("freeze=choice(true,false)", "freeze=choice('true','false')"),
        ("freeze='true',\"false\"", "freeze='true',\"false\""),
        ("freeze=gradual", "freeze=gradual"),
        # Nothing but a choice by that name is touched.
        ("force=true", "force=true"),
        ("transfer.copy_log_alpha=true", "transfer.copy_log_alpha=true"),
        ("+env.kwargs.freeze=true", "+env.kwargs.freeze=true"),
    ],
)
def test_a_bare_true_is_quoted_at_the_border(typed, hydras):
    assert hydra_arguments([typed]) == [hydras]


@pytest.mark.parametrize(
    ("words", "freeze", "thaw", "name"),
    [
        (["transfer=hidden"], False, [], HIDDEN),
        (["transfer=hidden", "freeze=true"], True, [], f"{HIDDEN}-frozen"),
        (["transfer=hidden", "freeze=gradual"], True, GRADUAL, f"{HIDDEN}-frozen-thaw=10000+12500+15000"),
        (["transfer=hidden", "freeze=gradual", "thaw=[500]"], True, [500], f"{HIDDEN}-frozen-thaw=500"),
        (["transfer=hidden", "freeze=true", "thaw=[500]"], True, [500], f"{HIDDEN}-frozen-thaw=500"),
        # What an experiment says holds until something is typed.
        (["experiment=A2"], True, [], f"{HIDDEN}-frozen"),
        (["experiment=A2", "freeze=false"], False, [], HIDDEN),
        (["freeze=false", "experiment=A2"], False, [], HIDDEN),
        (["experiment=A1", "freeze=true"], True, [], f"{HIDDEN}-frozen"),
        (["experiment=A2", "freeze=gradual"], True, GRADUAL, f"{HIDDEN}-frozen-thaw=10000+12500+15000"),
    ],
)
def test_a_choice_means(words, freeze, thaw, name):
    made = spec(*words)
    assert (made.config.freeze, made.config.thaw, made.name) == (freeze, thaw, name)
    # And its command leads back to it.
    assert spec(*made.command.split()[2:]).directory == made.directory


def test_true_and_false_are_the_cells_that_they_were_and_others_none():
    assert [spec("experiment=A1", f"freeze={choice}").cell for choice in options("freeze")] == ["A1", None, "A2"]


def test_a_cell_of_ones_own_may_thaw(monkeypatch):
    row = replace(CELLS["A2"], name="A6", changes={"thaw": GRADUAL}, published=False)
    monkeypatch.setitem(CELLS, "A6", row)
    assert [spec("experiment=A2", f"freeze={choice}").cell for choice in options("freeze")] == ["A1", "A6", "A2"]


def test_a_run_that_was_stored_before_there_was_thawing_reads_as_it_was():
    published = ROOT / "results" / "paper" / f"{HIDDEN}-frozen" / "seed_1" / "config.yaml"
    stored = stored_config(yaml.safe_load(published.read_text()))
    assert (stored.freeze, stored.thaw) == (True, [])


def test_choices_of_the_users_own(tmp_path, monkeypatch):
    (tmp_path / "freeze").mkdir()
    (tmp_path / "freeze" / "late.yaml").write_text("# @package _global_\nfreeze: true\nthaw: [700]\n")
    (tmp_path / "experiment").mkdir()
    experiment = tmp_path / "experiment" / "mine.yaml"
    chosen = "# @package _global_\ndefaults:\n  - override /transfer: hidden\n  - override /freeze: {}\n"
    experiment.write_text(chosen.format("late"))
    places = Sources((f"file://{compose.CONFIG_FOLDER}", f"file://{tmp_path}", SWEEPS))
    monkeypatch.setattr(compose, "_given", places)
    assert options("freeze") == ["false", "gradual", "late", "true"]
    assert spec("experiment=A2", "freeze=late").name == f"{HIDDEN}-frozen-thaw=700"
    assert spec("experiment=mine").name == f"{HIDDEN}-frozen-thaw=700"
    assert spec("experiment=mine", "freeze=false").name == HIDDEN
    # Hydra itself would pass over it.
    compose._composed.cache_clear()
    experiment.write_text(chosen.format("latte"))
    assert refusal("experiment=mine") == "freeze=latte: must be one of false, gradual, late, true"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["freeze=nope"], "freeze=nope: must be one of false, gradual, true"),
        (["freeze=null"], "freeze=null: must be one of false, gradual, true"),
        (["thaw=[5]"], "thaw=[5] freeze=false: nothing is frozen that could thaw; type freeze=true, or thaw=[]"),
        (["freeze=true", "thaw=[7,5]"], "thaw=[7,5]: steps are needed that ascend from 1 or more, as in thaw="),
        (["freeze=true", "thaw=[5,5]"], "thaw=[5,5]: steps are needed that ascend"),
        (["freeze=true", "thaw=[0,5]"], "thaw=[0,5]: steps are needed that ascend"),
        (
            ["freeze=gradual", "total_timesteps=9000"],
            "nothing would thaw before the run ends, at step 9000; type thaw=[4500], or freeze=true thaw=[]",
        ),
    ],
)
def test_what_cannot_thaw_is_refused_in_one_line(words, says):
    assert says in refusal("transfer=hidden", *words)


def test_a_matrix_may_sweep_it_as_yaml_has_it():
    jobs = [["experiment=A1", f"freeze={value}"] for value in ("true", "false", "gradual", "'true'")]
    assert [made.config.thaw for made in expand(jobs[:3])] == [[], [], GRADUAL]
    assert expand(jobs[3:])[0].directory == expand(jobs[:1])[0].directory


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("run.py freeze=", "freeze=false freeze=gradual freeze=true"),
        ("run.py freeze=true transfer=h", "transfer=hidden"),
        ("run.py freeze=g", "freeze=gradual"),
    ],
)
@pytest.mark.first_is_fast
def test_a_shell_completes_it(line, answer):
    words = [sys.executable, str(ROOT / "run.py"), "-sc", "query=bash"]
    done = subprocess.run(words, env={"COMP_LINE": line, "PATH": ""}, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == answer


def test_a_command_line_composes_and_sweeps_as_typed(tmp_path):
    words = ["-m", "experiment=A2", "freeze=true,false,gradual", "plan=true", f"output_dir={tmp_path}"]
    done = subprocess.run(
        [sys.executable, str(ROOT / "run.py"), *words], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    for name in (HIDDEN, f"{HIDDEN}-frozen", f"{HIDDEN}-frozen-thaw=10000+12500+15000"):
        assert f"/{name}/seed_1" in done.stdout


@given(
    hidden=st.integers(0, 3),
    heads=st.booleans(),
    steps=st.lists(st.integers(1, 10**6), min_size=1, max_size=6, unique=True).map(sorted),
)
def test_layers_thaw_from_the_output_down_and_all_of_them_do(hidden, heads, steps):
    inner = ["input", *(f"hidden_{index}" for index in range(1, hidden + 1))]
    frozen = [f"actor.{name}" for name in [*inner, *(["mean", "log_std"] if heads else [])]]
    frozen += [f"critic_{number}.{name}" for number in (1, 2) for name in [*inner, *(["output"] if heads else [])]]
    schedule = thaw_schedule(frozen, steps)
    assert set(schedule) == set(frozen)
    ways = [["output"] * heads + inner[::-1], ["mean"] * heads + inner[::-1]]
    for part, way in (("critic_1", ways[0]), ("critic_2", ways[0]), ("actor", ways[1])):
        expected = [*steps, *[steps[-1]] * len(way)][: len(way)]
        assert [schedule[f"{part}.{name}"] for name in way] == expected
    if heads:
        assert schedule["actor.log_std"] == schedule["actor.mean"]
    assert thaw_schedule(frozen, []) == {}
