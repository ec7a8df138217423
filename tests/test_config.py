"""Settings: every leaf composes, what cannot be run is refused in one line, and a run's name follows from it."""

import itertools
import re
from copy import deepcopy
from functools import reduce
from operator import getitem

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from acmr.cells import CELLS
from acmr.config import (
    NEUTRAL_KEYS,
    TEACHER_CHOICE,
    ConfigError,
    SACConfig,
    plain_settings,
    schema_defaults,
)
from acmr.settings.compose import CONFIG_FOLDER, compose_config, parse
from acmr.settings.errors import USER_ERRORS, check_booleans, explain
from acmr.settings.run_spec import specify, teacher_spec
from acmr.storage.run_dir import differing_keys
from acmr.text import flatten

LEAVES = [
    f"{path.parent.name}={path.stem}"
    for path in sorted(CONFIG_FOLDER.glob("*/*.yaml"))
    if path.parent.name not in ("hydra",)
]


def spec(*overrides: str):
    return specify(parse(compose_config(overrides)))


def refusal(*overrides: str) -> str:
    def start() -> None:
        check_booleans(overrides)
        spec(*overrides)

    with pytest.raises(USER_ERRORS) as caught:
        start()
    line = explain(caught.value)
    assert "\n" not in line
    return line


@pytest.mark.parametrize("leaf", LEAVES)
def test_every_leaf_of_every_group_composes(leaf):
    needs = {
        "env=gym": ["env.id=Hopper-v5"],
        "tracking=self_hosted": ["tracking.base_url=http://127.0.0.1:1"],
        "freeze=true": ["transfer=hidden"],
        "freeze=gradual": ["transfer=hidden"],
    }
    assert spec(leaf, *needs.get(leaf, [])).config.seed == 1


@pytest.mark.parametrize(("profile", "cell"), [*itertools.product(["paper", "quick", "demo", "paper_v5"], CELLS)])
def test_a_cell_is_what_its_file_says(profile, cell):
    made = spec(f"experiment={cell}", f"profile={profile}")
    row = CELLS[cell]
    assert made.cell == cell
    assert made.config.env.name == getattr(made.config.pair, row.role)
    assert (made.config.transfer.name, made.config.freeze) == (row.transfer, row.freeze)
    assert made.changes == row.changes


def test_paper_profile_has_the_papers_values():
    config = spec().config
    assert config.total_timesteps == 1_000_000
    assert (config.threshold, config.consecutive) == (4900, 5)
    assert config.agent == SACConfig(
        hidden_sizes=[256, 256], gamma=0.99, tau=0.005, batch_size=256, buffer_size=1_000_000, learning_starts=5000,
        start="random", policy_lr=3e-4, q_lr=1e-3, policy_frequency=2, target_network_frequency=1, autotune=True,
        alpha=0.2,
    )  # fmt: skip
    assert not config.transfer.copy_log_alpha
    assert config.transfer.adapter_activation == "relu"


def test_python_defaults_say_what_the_files_of_the_paper_say():
    """Every value that the paper's files state; a setting of their own that Python knows nothing of fails, too."""
    profile, agent = (yaml.safe_load((CONFIG_FOLDER / f).read_text()) for f in ("profile/paper.yaml", "agent/sac.yaml"))
    said, defaults = flatten(profile) | flatten({"agent": agent}), schema_defaults()
    assert len(said) == 20
    for key, value in said.items():
        # PyYAML takes 3e-4, without a point, for a text.
        assert (float(value) if key.endswith("_lr") else value) == defaults[key], key


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["sed=1"], "sed: no such setting; did you mean seed or seeding?"),
        (["q_lr=1e-4"], "did you mean agent.q_lr?"),
        (["trasfer=hidden"], "did you mean transfer"),
        (["+foo=1"], "foo: no such setting"),
        (["+seed=2"], "+seed: this setting is there already; type seed=VALUE"),
        (["env.kwargs.a=1"], "env.kwargs.a: there is no such entry yet; type +env.kwargs.a=VALUE to add it"),
        (["env.kwargs={a:1}"], "env.kwargs: entries are added one by one; type +env.kwargs.NAME=VALUE"),
        (["+agent.foo=1"], "agent.foo: no such setting"),
        (["transfer=hiden"], "must be one of direct, expand, hidden, named, none; did you mean transfer=hidden?"),
        (["agent.precision=half"], "agent.precision=half: must be one of float32, bfloat16"),
        (["env=humanoyd"], "did you mean env=humanoid?"),
        (["experiment=A9"], "must be one of A0, A1, A2, A3, A4, H0, H1"),
        (["transfer=none", "freeze=true"], "type freeze=false, or type transfer=hidden or transfer=expand"),
        (["transfer=direct", "freeze=true"], "nothing could learn"),
        (["transfer.teacher=runs/x"], "without a transfer no teacher is read; leave it out, or type transfer=hid"),
        (["transfer.copy_log_alpha=true"], "without a transfer no temperature is copied; leave it out, or type"),
        (["transfer=hidden", "agent.hidden_sizes=[64]"],
         "hidden_sizes=[64]: it needs 2 hidden layers or more; type agent.hidden_sizes=[64,64], or type transfer=exp"),
        (["transfer=direct", "freeze=true"], "type freeze=false, or type transfer=hidden or transfer=expand"),
        (["total_timesteps=-1"], "total_timesteps=-1: an integer of at least 1"),
        (["total_timesteps=1e6"], "type total_timesteps=1000000"),
        (["seed=-1"], "seed=-1: an integer of at least 0"),
        (["seed=abc"], "seed=abc"),
        (["seed=9007199254740992"], "seed=9007199254740992: an integer of at most 9007199254740991 is needed"),
        ([f"seed={10**38}"], f"seed={10**38}: an integer of at most"),
        ([f"total_timesteps={10**38}"], "an integer of at most"),
        ([f"agent.buffer_size={2**64}"], f"agent.buffer_size={2**64}: an integer of at most"),
        ([f"agent.batch_size={2**63}"], f"agent.batch_size={2**63}: an integer of at most"),
        ([f"agent.hidden_sizes=[8,{2**63}]"], f"agent.hidden_sizes=[8, {2**63}]: integers of at most"),
        (["threads=100000"], "threads=100000: an integer of at most 4096"),
        (["freeze=2"], "freeze=2: must be one of false, gradual, true"),
        (["force=2"], "force=2: must be true or false"),
        (["agent.tau=0"], "agent.tau=0.0: a number in (0, 1]"),
        (["agent.gamma=1.5"], "agent.gamma=1.5: a number in [0, 1]"),
        (["agent.q_lr=nan"], "agent.q_lr=nan"),
        (["agent.hidden_sizes=[]"], "agent.hidden_sizes=[]"),
        (["agent.hidden_sizes=[64,0]"], "widths of at least 1"),
        (["agent.batch_size=0"], "agent.batch_size=0"),
        (["threads=0"], "threads=0"),
        (["threshold=nan"], "threshold=nan"),
        (["progress=loud"], "must be one of auto, bar, lines, off"),
        (["tracking=self_hosted"], "tracking.base_url=http://HOST:PORT"),
        (["env=gym"], "env.id has no value: type env.id=VALUE"),
        (["seed=="], "not of the form key=value"),
        (["seeding=pared"], "seeding=pared: must be one of independent, paired; did you mean seeding=paired?"),
        (["seeding="], "seeding=: must be one of independent, paired"),
        (["stop=never"], "stop=never: must be one of horizon, threshold"),
        (["stop=treshold"], "must be one of horizon, threshold"),
        (["stop=threshold", "stop_after=0"], "stop_after=0: an integer of at least 1"),
        (["stop_after=9"], "type stop=threshold stop_after=9, or total_timesteps=9 for a shorter run"),
        (["stop=threshold", "stop_after=1000000"], "the run has ended by then (total_timesteps=1000000)"),
        (["env.source=nowhere", "transfer=expand", "output_dir=x"], None),
    ],
)  # fmt: skip
def test_what_cannot_be_run_is_refused_in_one_line(overrides, says):
    if says is None:
        assert spec(*overrides).changes == {"env.source": "nowhere"}
    else:
        assert says in refusal(*overrides)


@pytest.mark.parametrize(
    ("overrides", "directory"),
    [
        ([], "runs/paper/armless_humanoid-none/seed_1"),
        (["env=humanoid"], "runs/paper/humanoid-none/seed_1"),
        (["experiment=H0", "seed=7"], "runs/paper/humanoid-none/seed_7"),
        (["experiment=A2", "seed=3"], "runs/paper/armless_humanoid-hidden-frozen/seed_3"),
        (["transfer=hidden", "freeze=true", "seed=3"], "runs/paper/armless_humanoid-hidden-frozen/seed_3"),
        (["experiment=A4", "profile=quick"], "runs/quick/ant_three_legs-expand-frozen/seed_1"),
        (["agent.q_lr=1e-4"], "runs/paper/armless_humanoid-none-q_lr=0.0001/seed_1"),
        (["agent.q_lr=0.001"], "runs/paper/armless_humanoid-none/seed_1"),
        (["agent.hidden_sizes=[64,64]"], "runs/paper/armless_humanoid-none-hidden_sizes=64+64/seed_1"),
        (["device=cuda", "threads=2", "tracking=off", "progress=off", "log_every=7"],
         "runs/paper/armless_humanoid-none/seed_1"),
        (["experiment=A2", "stop=threshold"], "runs/paper/armless_humanoid-hidden-frozen-stop=threshold/seed_1"),
        (["stop=horizon", "stop_after=null"], "runs/paper/armless_humanoid-none/seed_1"),
        (["stop=threshold", "stop_after=9"], "runs/paper/armless_humanoid-none-stop=threshold-stop_after=9/seed_1"),
        (["env=gym", "env.id=Hopper-v5", "output_dir=elsewhere"], "elsewhere/paper/Hopper-v5-none/seed_1"),
        (["env=gym", "env.id=Hopper-v5", "env.drop_sensors=[0,3]"],
         "runs/paper/Hopper-v5-none-drop_sensors=0+3/seed_1"),
        (["seed=9007199254740991"], "runs/paper/armless_humanoid-none/seed_9007199254740991"),
    ],
)  # fmt: skip
def test_a_run_has_one_directory(overrides, directory):
    assert str(spec(*overrides).directory) == directory


def test_long_values_are_hashed_and_stay_apart():
    names = {spec("env=humanoid", f"env.drop_sensors=['qpos/{joint}/*']").name for joint in "abc"}
    assert len(names) == 3
    assert all(re.fullmatch(r"humanoid-none-drop_sensors=[0-9a-f]{8}", name) for name in names)


def test_a_cell_with_other_settings_is_not_the_papers():
    assert spec("experiment=A2", "agent.q_lr=1e-4").cell is None
    assert spec("experiment=A2", "transfer.adapter_activation=none").cell is None
    assert spec("env=humanoid", "transfer=hidden").cell is None


def test_the_beginning_of_a_cell_is_that_cell(tmp_path):
    for cell in CELLS:
        assert spec(f"experiment={cell}", "stop=threshold").cell == cell
        assert spec(f"experiment={cell}", "stop=threshold", "stop_after=9").cell == cell
    assert spec("experiment=A2", "stop=threshold", "agent.q_lr=1e-4").cell is None
    assert spec("experiment=A2", "stop=threshold", "threshold=1").cell is None
    assert spec("experiment=A2", "stop=threshold", f"transfer.teacher={tmp_path}").cell is None


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**12), st.sampled_from(["none", "hidden", "expand"]), st.booleans(), st.integers(1, 10**7))
def test_the_command_of_a_run_leads_back_to_it(seed, transfer, freeze, steps):
    freeze = freeze and transfer != "none"
    made = spec(f"seed={seed}", f"transfer={transfer}", f"freeze={freeze}", f"total_timesteps={steps}")
    again = spec(*made.command.split()[2:])
    assert again.directory == made.directory


@pytest.mark.parametrize(
    ("overrides", "command"),
    [
        (["experiment=A2", "seed=3"], "python run.py env=humanoid seed=3"),
        (["experiment=A2", "profile=quick"], "python run.py profile=quick env=ant seed=1"),
        (["experiment=A1", "total_timesteps=20000"], "python run.py env=humanoid total_timesteps=20000 seed=1"),
        (["experiment=A1", "agent.q_lr=1e-4"], "python run.py env=humanoid seed=1"),
        (["experiment=A1", "stop=threshold", "stop_after=9"], "python run.py env=humanoid seed=1"),
        (["env=gym", "env.id=Hopper-v5", "env.drop_sensors=[0]", "transfer=expand"],
         "python run.py env=gym env.id=Hopper-v5 seed=1"),
    ],
)  # fmt: skip
def test_a_students_teacher_is_the_source_run_of_its_seed(overrides, command):
    teacher = teacher_spec(spec(*overrides).config)
    assert teacher.command == command
    assert teacher.config.transfer.name == "none"
    assert spec(*command.split()[2:]).directory == teacher.directory


def without(stored: dict, key: str) -> dict:
    *groups, leaf = key.split(".")
    copy = deepcopy(stored)
    del reduce(getitem, groups, copy)[leaf]
    return copy


@pytest.mark.parametrize("overrides", [["experiment=A3"], ["experiment=H0", "profile=quick"]])
def test_a_setting_that_a_stored_run_lacks_had_its_default(overrides):
    config, defaults = spec(*overrides).config, schema_defaults()
    stored = plain_settings(config)
    assert differing_keys(stored, config) == []
    for key, value in flatten(stored).items():
        neutral = key.split(".")[0] in NEUTRAL_KEYS or key in TEACHER_CHOICE
        same = neutral or (key in defaults and value == defaults[key])
        assert differing_keys(without(stored, key), config) == ([] if same else [key])
    for group in ("agent", "transfer"):
        assert set(differing_keys({key: stored[key] for key in stored if key != group}, config)) <= {
            key for key in flatten(stored) if key.startswith(group)
        }


@pytest.mark.parametrize(("seed", "turns", "teacher"), [(1, 3, 1), (3, 3, 3), (4, 3, 1), (101, 3, 2), (7, None, 7)])
def test_students_take_teachers_in_turn(seed, turns, teacher):
    words = [f"seed={seed}", *([f"transfer.teacher_seeds={turns}"] if turns else [])]
    student = spec("experiment=N1", *words)
    assert teacher_spec(student.config).config.seed == teacher
    # Whose turn it is says the teacher's hash in transfer.json, not the name.
    assert (student.cell, student.name) == ("N1", "armless_humanoid-named")
    assert ("transfer.teacher_seeds=3" in student.command) == (turns == 3)


def test_the_papers_random_start_is_a_cell_of_its_own():
    student = spec("experiment=N2", "stop=threshold")
    by_hand = spec("env=armless_humanoid", "transfer=named", "agent.start=random", "stop=threshold")
    for found in (student, by_hand):
        assert (found.cell, found.name) == ("N2", "armless_humanoid-named-start=random-stop=threshold")
    assert student.config == by_hand.config
    assert (student.config.agent.warmup, student.config.agent.kickstart) == (5000, 10)


def test_no_turn_is_none():
    with pytest.raises(ConfigError, match=r"transfer\.teacher_seeds=0: an integer of at least 1"):
        spec("experiment=N1", "transfer.teacher_seeds=0")


def test_a_setting_that_only_a_stored_run_knows_is_a_difference_if_it_was_set():
    config = spec().config
    stored = plain_settings(config)
    assert differing_keys({**stored, "noise": 0.1}, config) == ["noise"]
    assert differing_keys({**stored, "agent": {**stored["agent"], "layer_norm": False}}, config) == ["agent.layer_norm"]
    assert differing_keys({**stored, "noise": None}, config) == []
    assert differing_keys({}, config) != []
