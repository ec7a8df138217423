"""The power grid: grid2op's own numbers, its components by name, what goes with those that are gone."""

import csv

import gymnasium as gym
import numpy as np
import pytest
from guides import copy_checkout, follow
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from test_export import needs
from torture import Run, at_step, same

from acmr.config import ConfigError
from acmr.envs import describe, make_env
from acmr.settings.compose import environment_config
from acmr.transfer.name_map import map_names
from docs import grid

pytestmark = pytest.mark.slow
GONE = ["gen_5_3", "storage_5_0", "storage_7_1"]
TINY = (
    "profile=grid", "tracking=off", "progress=off", "agent.hidden_sizes=[16,16]", "agent.batch_size=16",
    "agent.learning_starts=70", "agent.buffer_size=400", "checkpoint_every=100", "total_timesteps=700",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _grid2op() -> None:
    needs("grid2op", "lightsim2grid")


def make(**kwargs):
    return gym.make("acmr.grid:PowerGrid-v0", **kwargs)


def nothing(env) -> np.ndarray:
    """The action that changes nothing."""
    return np.array([name.startswith("curtail") for name in env.unwrapped.action_names], np.float32)


def test_every_number_is_the_librarys():
    env = make()
    inner = env.unwrapped
    simulation = inner._simulation
    rng = np.random.default_rng(0)
    shown, _ = env.reset(seed=0, options={"day": 2})
    for _ in range(60):
        seen = inner._last
        values = dict(zip(inner.observation_names, shown, strict=True))
        for index, name in enumerate(simulation.name_gen):
            assert values[f"gen_p/{name}"] == pytest.approx(seen.gen_p[index] / simulation.gen_pmax[index], rel=1e-5)
        for index, name in enumerate(simulation.name_line):
            assert values[f"rho/{name}"] == pytest.approx(5 * seen.rho[index] - 4, abs=1e-5)
        for index, name in enumerate(simulation.name_storage):
            energy = seen.storage_charge[index] / simulation.storage_Emax[index]
            assert values[f"storage_charge/{name}"] == pytest.approx(energy, rel=1e-5)
        hour = seen.hour_of_day + seen.minute_of_hour / 60
        assert values["clock/cos"] == pytest.approx(np.cos(2 * np.pi * hour / 24), abs=1e-6)
        shown, reward, black, over, _ = env.step(rng.uniform(env.action_space.low, env.action_space.high))
        # The cost of generation that was avoided, a share of the greatest, and lines that have something in hand.
        last, limits = inner._last, simulation.get_thermal_limit()
        saved = 1 - (last.prod_p @ simulation.gen_cost_per_MW) / (simulation.gen_pmax @ simulation.gen_cost_per_MW)
        near = np.sum(last.rho >= np.where(limits < 400, 0.95, 0.975))
        assert reward == pytest.approx(0 if black else (saved + 1 - near / 5) / 2, abs=1e-5)
        if black or over:
            break


def test_commands_reach_the_component_that_they_name():
    env = make()
    names = env.unwrapped.action_names
    for name, value, read, wanted in (
        ("redispatch/gen_2_1", 8.0, lambda seen: seen.target_dispatch[1], 8.0),
        ("redispatch/gen_0_5", -12.0, lambda seen: seen.target_dispatch[5], -12.0),
        ("storage/storage_7_1", 4.0, lambda seen: seen.storage_power[1], 4.0),
        ("storage/storage_5_0", -3.0, lambda seen: seen.storage_power[0], -3.0),
        ("curtail/gen_5_2", 0.25, lambda seen: seen.curtailment_limit[2], 0.25),
    ):
        env.reset(seed=0, options={"day": 0})
        action = nothing(env)
        action[names.index(name)] = value
        env.step(action)
        assert read(env.unwrapped._last) == pytest.approx(wanted, abs=1e-3), name


def test_an_order_is_followed_as_fast_as_a_generator_can():
    env = make()
    env.reset(seed=0, options={"day": 0})
    action = nothing(env)
    action[env.unwrapped.action_names.index("redispatch/gen_2_1")] = 25.0
    dispatched = []
    for _ in range(4):
        env.step(action)
        dispatched.append(env.unwrapped._last.target_dispatch[1])
    np.testing.assert_allclose(dispatched, [10, 20, 25, 25], atol=1e-3)
    # A quarter of an hour of it at most.
    np.testing.assert_array_equal(env.action_space.high[:3], [15, 30, 45])


def test_nothing_done_ends_most_days_in_a_blackout():
    env = make()
    lengths = []
    for day in range(7):
        _, info = env.reset(seed=0, options={"day": day})
        assert info == {"day": day}
        black = over = False
        lengths.append(0)
        while not (black or over):
            _, _, black, over, _ = env.step(nothing(env))
            lengths[-1] += 1
        assert black == (lengths[-1] < 288)
    assert lengths.count(288) == 2


def test_what_is_decommissioned_is_gone_by_name_and_the_rest_is_kept():
    whole, reduced = (describe(environment_config(name)) for name in ("grid14", "grid14_reduced"))
    for before, after in (
        (whole.observation_names, reduced.observation_names),
        (whole.action_names, reduced.action_names),
    ):
        assert after == tuple(name for name in before if name.split("/")[1] not in GONE)
    mapped = map_names(whole.observation_names, reduced.observation_names)
    assert mapped.line("sensors") == "97 of 103 sensors kept, 6 gone, 0 added"


def test_the_others_produce_what_a_plant_that_is_gone_did():
    power = {}
    for gone in ([], GONE):
        env = make(decommissioned=gone)
        env.reset(seed=0, options={"day": 1})
        produced = []
        for _ in range(150):
            env.step(nothing(env))
            produced.append(env.unwrapped._last.gen_p.copy())
        power[bool(gone)] = np.array(produced)
    assert (power[True][:, 3] == 0).all()
    assert power[False][:, 3].max() > 5
    # Losses differ by where it is produced.
    np.testing.assert_allclose(power[True].sum(axis=1), power[False].sum(axis=1), rtol=0.03)


@given(
    arrays(np.float32, (5, 4), elements=st.floats(0.125, 1000, width=32)),
    arrays(bool, 4).filter(lambda gone: not gone.all()),
)
def test_a_schedule_keeps_its_sum(power, gone):
    from acmr.grid.schedule import moved

    after = moved(power, gone)
    np.testing.assert_allclose(after.sum(axis=1), power.sum(axis=1), rtol=1e-5)
    assert (after[:, gone] == 0).all()
    assert (after[:, ~gone] >= power[:, ~gone] * (1 - 1e-6)).all()


@pytest.mark.parametrize(
    ("kwargs", "line"),
    [
        ({"grid": "case9"}, "grid=case9: grid2op brings no such grid; it brings educ_case14_redisp"),
        ({"decommissioned": ["gen_9_9"]}, "decommissioned=[gen_9_9]: this grid has no gen_9_9; it has gen_1_0"),
        ({"decommissioned": "gen_5_3"}, "decommissioned=gen_5_3: a list is needed: [gen_5_3]"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(kwargs, line):
    config = environment_config("grid14")
    config.kwargs.update(kwargs)
    with pytest.raises(ConfigError) as refused:
        make_env(config)
    assert line in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_run_that_is_killed_goes_on_bit_for_bit(untouched, tmp_path):
    run = Run(tmp_path, (*TINY, "env=grid14"))
    for step in (350, 600):
        run(at_step(step))
    assert run.checkpoints
    same(run.finish(), untouched((*TINY, "env=grid14")))


def test_the_tables_of_the_guide_are_what_its_command_prints():
    assert grid.filled() == grid.PAGE.read_text(), "type python -m docs.grid"


def test_the_guide_works(tmp_path):
    said = follow(grid.PAGE, copy_checkout(tmp_path / "copy"))
    assert "redispatch/gen_1_0  [-15, 15]" in said
    # Without its hydro plant: seven commands, the storage units' among them.
    assert sum(line.startswith("action ") for line in said.splitlines()) == 8 + 5 + 7
    assert "storage/storage_5_0" in said


def test_the_published_teachers_do_better_than_who_learned_nothing():
    untaught: dict[str, list[float]] = {"nothing": [], "random": []}
    with grid.UNTAUGHT.open() as file:
        for row in csv.DictReader(file):
            if row["grid"] == "grid14":
                untaught[row["policy"]].append(float(row["return"]))
    taught = {seed: np.mean([earned for earned, _ in days]) for seed, days in grid.evaluated("H0")}
    assert len(taught) == 5
    assert min(taught.values()) > max(map(np.mean, untaught.values()))
