"""What checkpoints cost a run of the paper: time, disk, and what they leave."""

import shutil
import time

import numpy as np
import pytest
from torture import Run, parts

#: Steps per second of a paper run that is fast for the hardware of CI: the faster it is, the more checkpoints weigh.
SPEED = 350


@pytest.mark.slow
def test_checkpoints_take_under_two_percent_of_a_paper_run_and_under_2_5_gb(tmp_path):
    if shutil.disk_usage(tmp_path).free < 4e9:
        pytest.skip("4 GB of disk are needed")
    run = Run(tmp_path, ("env=humanoid", "tracking=off"))
    config = run.spec.config
    state, checkpoints = parts(run)
    buffer, trainer = state.trainer.buffer, state.trainer
    run.folder.mkdir(parents=True)
    state.logs.begin()
    trainer.observation, _ = trainer.env.reset(seed=1)
    # The memory of numbers that are never the same costs what it costs in a run.
    noise = np.random.default_rng(0).standard_normal((25_000, buffer.rows.shape[1])).astype(np.float32)
    ended = np.zeros(len(noise), np.uint8)
    # An episode of a young policy takes 25 steps.
    ended[24::25] = 1
    chunk = {
        "rows": noise, "rewards": noise[:, 0], "terminated": noise[:, 1], "ended": ended,
        "last_observations": noise[: ended.sum(), :376], "next_observation": noise[0, :376],
    }  # fmt: skip
    took, most = [], 0
    for step in range(25_000, config.total_timesteps + 1, 25_000):
        buffer._extend(chunk)
        trainer.global_step = step
        began = time.perf_counter()
        assert checkpoints.save()
        took.append(time.perf_counter() - began)
        most = max(most, sum(path.stat().st_size for path in run.folder.rglob("*") if path.is_file()))
    share = sum(took) / (config.total_timesteps / SPEED)
    began = time.perf_counter()
    fresh, again = parts(run)
    assert again.load(print) == config.total_timesteps
    loading = time.perf_counter() - began
    assert np.array_equal(fresh.trainer.buffer.rows[:-1], buffer.rows[:-1])
    checkpoints.clear()
    left = sum(path.stat().st_size for path in run.folder.rglob("*") if path.is_file())
    print(
        f"\n{len(took)} checkpoints: median {np.median(took) * 1e3:.0f} ms, longest {max(took) * 1e3:.0f} ms, "
        f"{100 * share:.2f}% of a run at {SPEED} steps/s; {most / 1e9:.2f} GB at most; "
        f"taken up in {loading:.1f} s; {left} bytes left"
    )
    assert share < 0.02
    assert most < 2.5e9
    assert left < 10_000
