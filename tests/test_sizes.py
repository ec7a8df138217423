"""Seeds and sizes at the ends of their ranges: what can be run is run, the rest is one line."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import pytest
from torture import SMALL, Run

from acmr.agent import memory
from acmr.config import ConfigError
from acmr.evaluation.cli import main as evaluate
from acmr.records import MOST_SEED
from acmr.storage.processes import free_memory

PENDULUM = ("env=gym", "env.id=Pendulum-v1", "env.max_episode_steps=30", "total_timesteps=150", *SMALL)
MEBI = 1 << 20


def test_a_buffer_that_the_run_cannot_fill_is_not_asked_for(tmp_path: Path) -> None:
    made = []
    # 1e9 transitions are 36 GB of a pendulum's, and 9e15 are more than there are addresses.
    for size in (150, 1_000_000_000, MOST_SEED):
        words = [word for word in PENDULUM if not word.startswith("agent.buffer_size")]
        run = Run(tmp_path / str(size), (*words, f"agent.buffer_size={size}"))
        ended = run()
        assert ended.code == 0, ended.said
        made.append([(run.folder / name).read_bytes() for name in ("episodes.csv", "teacher.safetensors")])
    assert made[0] == made[1] == made[2]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["agent.buffer_size=1000000000000", "total_timesteps=1000000000000"], "agent.buffer_size=1000000000000"),
        (["agent.hidden_sizes=[1000000,1000000]"], "agent.hidden_sizes=[1000000, 1000000]"),
        (["agent.batch_size=1000000000000"], "agent.batch_size=1000000000000"),
        (["agent.hidden_sizes=[9007199254740991,9007199254740991]"], "agent.hidden_sizes=[9007199254740991"),
    ],
)
def test_what_memory_cannot_take_is_refused_before_anything_is_made(
    words: list[str], named: str, tmp_path: Path
) -> None:
    with pytest.raises(
        ConfigError, match=r"takes [\d.]+ GB of memory, .* GB are free; type a smaller agent\."
    ) as caught:
        Run(tmp_path / "runs", (*PENDULUM, *words))()
    assert str(caught.value).startswith(named)
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "runs").glob("*/"))


def test_a_limit_of_the_shell_is_one_line_too(tmp_path: Path) -> None:
    def limit() -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        held = pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + 100 * MEBI, resource.RLIM_INFINITY))

    run = Run(tmp_path, (*PENDULUM, "agent.buffer_size=10000000", "total_timesteps=10000000"))
    ended = run(limit)
    assert ended.code == 2, ended.said
    assert "error: agent.buffer_size=10000000: Unable to allocate" in ended.said
    assert "Traceback" not in ended.said


def test_memory_is_what_is_free_and_not_what_the_machine_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    total = next(line for line in Path("/proc/meminfo").read_text().splitlines() if line.startswith("MemTotal"))
    assert MEBI < free_memory() < 1024 * int(total.split()[1])
    words = ("env=humanoid", "total_timesteps=1000", "tracking=off")
    # 1,000 transitions of 376 + 17 + 3 numbers are 1.6 MB, networks with 13 layers of 256 four times as much and more.
    monkeypatch.setattr(memory, "free_memory", lambda: 5 * MEBI)
    with pytest.raises(ConfigError, match=r"agent.hidden_sizes=\[256, 256\]: takes [\d.]+ MB .* but 5.2 MB are free"):
        Run(tmp_path, words)()


def test_the_greatest_seed_goes_through_training_and_evaluation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(tmp_path, (*PENDULUM, f"seed={MOST_SEED}"))
    assert run().code == 0
    assert json.loads((run.folder / "summary.json").read_text())["seed"] == MOST_SEED
    assert evaluate([str(run.folder), "--episodes", "1", "--seed", str(MOST_SEED)]) == 0
    assert json.loads((run.folder / "evaluation.json").read_text())["seed"] == MOST_SEED
    for words in (["--seed", str(2**64)], ["--seed", str(MOST_SEED)], ["--seed", "-1"], ["--seed", "9" * 39]):
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            evaluate([str(run.folder), *words])
        assert ended.value.code == 2
        assert f"--seed {words[1]}" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--width", "1000000000"], "at most 8192 pixels"),
        (["--height", "0"], "an integer of at least 1"),
        (["--episodes", "9" * 5000], "--episodes"),
        (["--video", "a.gif", "--seconds", "1e308"], "at most 1e+06"),
        (["--seed", "9" * 5000], "--seed"),
    ],
    ids=lambda words: "",
)
def test_sizes_of_an_evaluation_out_of_range_are_one_line(
    words: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        evaluate(["runs/none", *words])
    assert ended.value.code == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
