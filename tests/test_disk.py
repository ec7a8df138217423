"""What a run is expected to take on its disk, against what it takes."""

from pathlib import Path

from torture import ANT, HUMANOID, Run, at_step, found_out

from acmr.run.run_state import arrays_bytes, space_needed
from acmr.storage.checkpoint_store import SnapshotStore


def test_a_run_takes_at_most_what_was_expected_and_not_much_less(tmp_path):
    for overrides in (ANT, HUMANOID):
        run = Run(tmp_path / overrides[0][4:], overrides)
        networks = found_out(overrides).networks
        run(at_step(281))
        held = sum(path.stat().st_size for path in (run.folder / "checkpoint").iterdir())
        needed = space_needed(run.spec.config, networks)
        assert held < needed < 1.5 * held + (1 << 20)
        arrays = run.folder / "checkpoint" / "step_280.safetensors"
        assert arrays.stat().st_size < arrays_bytes(networks)
        assert SnapshotStore(run.folder / "checkpoint", arrays_bytes(networks)).read(280).values


def test_a_paper_run_is_expected_to_take_under_2_5_gb():
    config = Run(Path("unused"), ("env=humanoid", "tracking=off"))
    needed = space_needed(config.spec.config, found_out(config.overrides).networks)
    assert 1.6e9 < needed < 2.0e9
