"""``stop=threshold``: the run ends with the streak that meets its threshold, and is the beginning of the full run."""

import csv
import json
import os
import signal
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file
from torture import ANT, Run, at_step, parts, same

from acmr.config import ExperimentConfig
from acmr.records import meets_threshold, steps_to_threshold
from acmr.run import checkpointing
from acmr.text import flatten

CONSECUTIVE = 3
#: Twelve episodes of 25 steps; learning starts within the third.
FULL = (*(word for word in ANT if "episode_steps" not in word and "consecutive" not in word),
        "env.max_episode_steps=25", f"consecutive={CONSECUTIVE}")  # fmt: skip


@pytest.fixture(scope="module")
def met(untouched) -> tuple[float, int]:
    """A threshold that the full run meets somewhere in its middle, and the step at which it does."""
    rows = list(csv.DictReader(untouched(FULL)["episodes.csv"].decode().splitlines()))
    steps = [int(row["global_step"]) for row in rows]
    returns = [float(row["episodic_return"]) for row in rows]
    for threshold in sorted(returns, reverse=True):
        found = steps_to_threshold(steps, returns, threshold, CONSECUTIVE)
        if found and steps[4] <= found.last <= steps[-3]:
            return threshold, found.last
    pytest.fail(f"no threshold of {returns} is met in the middle")


@pytest.fixture(scope="module")
def stopped(met) -> tuple[str, ...]:
    return (*FULL, "stop=threshold", f"threshold={met[0]!r}")


def summary_of(run: Run) -> dict:
    return json.loads((run.folder / "summary.json").read_text())


@given(st.lists(st.sampled_from([1.0, 2.0, float("nan")]), max_size=12), st.integers(1, 5))
def test_a_streak_is_seen_at_the_episode_that_the_measure_finds(returns, consecutive):
    seen = [number for number in range(len(returns)) if meets_threshold(returns[: number + 1], 2.0, consecutive)]
    found = steps_to_threshold(range(len(returns)), returns, 2.0, consecutive)
    assert (seen[0] if seen else None) == (found.last if found else None)


def test_it_is_the_beginning_of_the_full_run(stopped, met, untouched, tmp_path):
    step, whole, run = met[1], untouched(FULL), Run(tmp_path / "stopped", stopped)
    left = run.finish()
    for name in ("episodes.csv", "metrics.csv"):
        assert whole[name].startswith(left[name]), name
    rows = left["episodes.csv"].decode().splitlines()
    assert int(rows[-1].split(",")[0]) == step
    # A full run that is killed leaves a checkpoint of the very step: all of the networks are the same.
    full = Run(tmp_path / "full", FULL)
    assert full(at_step(step + 1), f"checkpoint_every={step}").code == -signal.SIGKILL
    state, checkpoints = parts(full)
    assert checkpoints.load(pytest.fail) == step
    agent, ours = state.trainer.agent, load_file(run.folder / "teacher.safetensors")
    theirs = {name: tensor.detach().numpy().tobytes() for name, tensor in agent.networks.state_dict().items()}
    assert {name: array.tobytes() for name, array in ours.items()} == {name: theirs[name] for name in ours}
    assert json.loads((run.folder / "teacher.json").read_text())["log_alpha"] == agent.log_alpha.item()


def test_it_ends_as_a_run_of_so_many_steps_does(stopped, met, untouched):
    """All that is left, the replay memory and the temperature too, but for what tells of the settings."""
    shorter = tuple(word for word in FULL if not word.startswith("total_timesteps"))
    short = untouched((*shorter, f"total_timesteps={met[1]}"))
    left = untouched(stopped)
    assert {name for name in left if left[name] != short[name]} == {"config.yaml", "summary.json", "teacher.json"}


def test_what_it_says_of_itself(stopped, met, tmp_path):
    (threshold, step), run = met, Run(tmp_path, stopped)
    ended = run()
    assert ended.code == 0, ended.said
    assert f"return {threshold:g} reached at step {step}; stopped there" in ended.said
    said = summary_of(run)
    assert (said["status"], said["stop"], said["stop_after"]) == ("complete", "threshold", None)
    assert (said["global_step"], said["total_timesteps"]) == (step, 300)
    assert (said["censored"], said["steps_to_threshold"]) == (False, step)
    assert json.loads((run.folder / "teacher.json").read_text())["global_step"] == step
    again = run()
    assert (again.code, "stopped there; force=true" in again.said) == (0, True), again.said


def test_one_that_has_not_met_it_ends_at_stop_after_and_is_censored(stopped, met, untouched, tmp_path):
    after = met[1] - 10
    run = Run(tmp_path, (*stopped, f"stop_after={after}"))
    ended = run()
    assert f"not reached by step {after}; stopped there" in ended.said
    said = summary_of(run)
    assert (said["status"], said["global_step"], said["stop_after"]) == ("complete", after, after)
    assert (said["censored"], said["steps_to_threshold"]) == (True, None)
    assert json.loads((run.folder / "status.json").read_text())["total_timesteps"] == after
    assert untouched(FULL)["episodes.csv"].startswith((run.folder / "episodes.csv").read_bytes())


def test_one_that_meets_it_before_takes_no_notice_of_stop_after(stopped, met, untouched, tmp_path):
    left = Run(tmp_path, (*stopped, f"stop_after={met[1] + 1}")).finish()
    wanted = untouched(stopped)
    for name in ("episodes.csv", "metrics.csv", "teacher.safetensors", "buffer"):
        assert left[name] == wanted[name], name


def test_kills_leave_no_trace(stopped, met, untouched, tmp_path):
    step, run = met[1], Run(tmp_path, stopped)
    # Within the streak, just before its end, and in the very step that ends the run.
    for kill in (step - 30, step - 1, step):
        assert run(at_step(kill)).code == -signal.SIGKILL
    same(run.finish(), untouched(stopped))


def terminate() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def test_a_signal_makes_a_checkpoint_within_the_streak_and_none_at_its_end(stopped, met, untouched, tmp_path):
    step, run = met[1], Run(tmp_path, stopped)
    within = step - 25
    assert run(at_step(within, terminate)).code == 128 + signal.SIGTERM
    assert within in run.checkpoints
    ended = run(at_step(step, terminate))
    assert f"resumed at step {within} of 300" in ended.said
    # With the last step taken there is nothing left to stop.
    assert ended.code == 0, ended.said
    same(run.outcome(), untouched(stopped))


def test_a_run_that_was_made_before_there_was_a_choice_is_still_that_run(untouched, tmp_path):
    run = Run(tmp_path, FULL)
    assert run(at_step(150)).code == -signal.SIGKILL
    forget(run.folder / "config.yaml", "stop", "stop_after")
    # Also its checkpoint is taken up; force=true alone would begin anew.
    ended = run()
    assert (ended.code, "resumed at step 120 of 300" in ended.said) == (0, True), ended.said
    assert run.outcome()["episodes.csv"] == untouched(FULL)["episodes.csv"]
    assert "complete already" in run().said


def test_a_setting_that_is_added_to_the_schema_voids_no_checkpoint(tmp_path, monkeypatch):
    @dataclass
    class Later(ExperimentConfig):
        noise: float = 0.0

    def digest(config: ExperimentConfig) -> str:
        run = Run(tmp_path, FULL)
        run.spec = replace(run.spec, config=config)
        return parts(run)[1]._key.digest

    config = Run(tmp_path, FULL).spec.config
    before = digest(config)
    assert digest(replace(config, threshold=1.0)) != before
    monkeypatch.setattr(checkpointing, "schema_defaults", lambda: flatten(asdict(Later())))
    assert digest(Later(**vars(config))) == before
    assert digest(Later(**vars(config), noise=0.1)) != before


def forget(path: Path, *keys: str) -> None:
    lines = path.read_text().splitlines(keepends=True)
    kept = [line for line in lines if line.partition(":")[0] not in keys]
    assert len(kept) == len(lines) - len(keys)
    path.write_text("".join(kept))
