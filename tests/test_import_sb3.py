"""Models of the real Stable-Baselines3, imported, and what was exported to it."""

import shlex

import gymnasium as gym
import numpy as np
import pytest
import torch
from finished_run import make_run
from foreign_models import PENDULUM, cleanrl_networks, described, refused, rows
from guides import ROOT, blocks
from gymnasium.spaces import Box
from test_export import needs

import acmr
from acmr.config import EnvConfig
from acmr.exchange.imported import make_teacher
from acmr.exchange.imports import main, read_normalization
from acmr.exchange.sb3_reader import read_sb3
from acmr.exchange.sb3_writer import write_sb3
from acmr.transfer.teacher import Teacher, load_teacher

LOW, HIGH = [-1.0, -0.4, 0.0, -3.0], [1.0, 0.4, 2.0, 1.0]


class Spaces:
    """An environment of Gymnasium that has these spaces and ends at once."""

    def __new__(cls, observations: int, low: list[float], high: list[float]):
        class Env(gym.Env):
            observation_space = Box(-np.inf, np.inf, (observations,), np.float32)
            action_space = Box(np.array(low, np.float32), np.array(high, np.float32))

            def reset(self, *, seed=None, options=None):
                super().reset(seed=seed)
                return 3 + 5 * self.np_random.normal(size=observations).astype(np.float32), {}

            def step(self, action):
                return self.reset()[0], float(action.sum()), False, False, {}

        return Env()


def same_functions(networks, model, seen: np.ndarray, given: np.ndarray | None = None) -> None:
    """Compares actions, the standard deviation and Q values with those of a model of Stable-Baselines3."""
    given = seen if given is None else given
    ours, theirs = torch.from_numpy(seen), torch.from_numpy(given)
    actions, _ = model.predict(given, deterministic=True)
    np.testing.assert_allclose(networks.actor.mode(ours).detach(), actions, atol=1e-6)
    mean, log_std, _ = model.actor.get_action_dist_params(theirs)
    for got, wanted in zip(networks.actor(ours), (mean, log_std), strict=True):
        torch.testing.assert_close(got, wanted, atol=1e-5, rtol=1e-5)
    space = model.action_space
    tried = np.random.default_rng(1).uniform(space.low, space.high, (len(seen), len(space.low))).astype(np.float32)
    scaled = torch.from_numpy(model.policy.scale_action(tried))
    for critic, wanted in zip(networks.critics, model.critic(theirs, scaled), strict=True):
        torch.testing.assert_close(critic(ours, torch.from_numpy(tried)), wanted[:, 0], atol=1e-5, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("sizes", [[16, 16], [12, 20, 8], [24]], ids=str)
def test_a_model_of_stable_baselines3_computes_the_same(sizes, tmp_path):
    needs("stable_baselines3")
    from stable_baselines3 import SAC

    env = Spaces(5, LOW, HIGH)
    model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": sizes}, buffer_size=500, learning_starts=50, seed=7)
    model.learn(150)
    with torch.no_grad():
        # Some beyond the bounds, where it is clamped.
        model.actor.log_std.bias += torch.tensor([0.0, 5.0, -40.0, 1.0])
    model.save(tmp_path / "model.zip")
    found = read_sb3(tmp_path / "model.zip")
    assert (found.hidden_sizes, found.seed, found.global_step) == (tuple(sizes), 7, 150)
    assert found.program.startswith("stable-baselines3 2.")
    assert found.log_alpha == pytest.approx(model.log_ent_coef.item())
    networks, about = make_teacher(found, EnvConfig("made_up"), described(5, LOW, HIGH))
    same_functions(networks, model, 3 * rows(64, 5))
    assert (about.log_std, about.log_alpha, about.action_high) == ("clamp", found.log_alpha, pytest.approx(HIGH))


@pytest.mark.slow
def test_normalized_observations_become_plain_ones(tmp_path):
    needs("stable_baselines3")
    from stable_baselines3 import SAC
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    venv = VecNormalize(DummyVecEnv([lambda: Spaces(5, LOW, HIGH)]))
    model = SAC("MlpPolicy", venv, policy_kwargs={"net_arch": [16, 16]}, buffer_size=500, learning_starts=50)
    model.learn(150)
    model.save(tmp_path / "model.zip")
    statistics = model.get_vec_normalize_env().obs_rms
    np.savez(tmp_path / "stats.npz", mean=statistics.mean, var=statistics.var)
    assert abs(statistics.mean - 3).max() < 1.5
    networks, _ = make_teacher(
        read_sb3(tmp_path / "model.zip"), EnvConfig("made_up"), described(5, LOW, HIGH),
        read_normalization(tmp_path / "stats.npz"),
    )  # fmt: skip
    seen = 3 + 5 * rows(64, 5)
    same_functions(networks, model, seen, venv.normalize_obs(seen).astype(np.float32))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"use_sde": True}, "trained with use_sde=True"),
        ({"policy_kwargs": {"activation_fn": torch.nn.Tanh}}, "its activation is <class 'torch.nn.modules.act"),
        ({"policy_kwargs": {"n_critics": 3}}, "3 critics (qf0, qf1, qf2); networks here have two"),
        (
            {"policy_kwargs": {"net_arch": {"pi": [8], "qf": [8, 8]}}},
            "hidden layers of other widths (actor [8]; critic_",
        ),
        ({"policy_kwargs": {"net_arch": []}}, "actor.latent_pi has no hidden layer"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_what_stable_baselines3_has_and_we_have_not(options, says, tmp_path, capsys):
    needs("stable_baselines3")
    from stable_baselines3 import SAC

    SAC("MlpPolicy", PENDULUM, buffer_size=1, **options).save(tmp_path / "model.zip")
    refused(["sb3", tmp_path / "model.zip"], says, tmp_path, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["TD3", "PPO"])
def test_other_algorithms_are_refused(algorithm, tmp_path, capsys):
    needs("stable_baselines3")
    import stable_baselines3

    getattr(stable_baselines3, algorithm)("MlpPolicy", PENDULUM).save(tmp_path / "model.zip")
    refused(["sb3", tmp_path / "model.zip"], "only that of SAC (stable_baselines3.sac.policies)", tmp_path, capsys)


@pytest.mark.slow
def test_what_was_exported_comes_back(tmp_path):
    needs("stable_baselines3")
    teacher = load_teacher(make_run(tmp_path / "run"))
    env, about = EnvConfig("made_up"), described(23, *(list(b) for b in bounds_of(teacher)))
    write_sb3(teacher, tmp_path / "model.zip")
    networks, description = make_teacher(read_sb3(tmp_path / "model.zip"), env, about)
    first = teacher.build_networks()
    seen, actions = torch.from_numpy(rows(32, 23)), torch.rand(32, 6) * 2 - 1
    torch.testing.assert_close(networks.actor.mode(seen), first.actor.mode(seen), atol=1e-6, rtol=0)
    for ours, theirs in zip(networks.critics, first.critics, strict=True):
        torch.testing.assert_close(ours(seen, actions), theirs(seen, actions), atol=1e-5, rtol=1e-5)
    # A second time nothing is lost at all: what was clamped stays clamped.
    write_sb3(Teacher(tmp_path, description, networks.state_dict()), tmp_path / "again.zip")
    again, _ = make_teacher(read_sb3(tmp_path / "again.zip"), env, about)
    for name, tensor in networks.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], tensor, atol=1e-6, rtol=1e-6)


def bounds_of(teacher: Teacher) -> tuple[list[float], list[float]]:
    return teacher.description.action_low, teacher.description.action_high


@pytest.mark.slow
def test_the_page_on_imports_runs_as_it_is_written(tmp_path, monkeypatch):
    needs("stable_baselines3")
    from stable_baselines3 import SAC
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    monkeypatch.chdir(tmp_path)
    page = [block for block in blocks(ROOT / "docs" / "exchange.md") if "acmr import" in block.text.split("\n")[0]]
    (commands, of_cleanrl, of_sb3) = page
    # Its clipping, which no layer can do, begins where so few steps make a narrow spread.
    venv = VecNormalize(DummyVecEnv([lambda: gym.make(PENDULUM)]), clip_obs=np.inf)
    model = SAC("MlpPolicy", venv, buffer_size=300, learning_starts=20, seed=1).learn(50)
    model.save("model.zip")
    parts = dict(zip(("actor", "qf1", "qf2"), map(Stored, cleanrl_networks()), strict=True))
    exec(of_cleanrl.text, parts | {"log_alpha": torch.tensor([-1.0]), "torch": torch})
    exec(of_sb3.text, {"model": model, "np": np})
    for line in commands.text.splitlines():
        words = shlex.split(line)
        assert words[:2] == ["acmr", "import"]
        assert main(words[2:]) == 0
    assert main(["sb3", "model.zip", "--env", PENDULUM, "--out", "normal", "--normalization", "stats.npz"]) == 0
    assert acmr.load("teachers/theirs").description.log_alpha == -1.0
    seen = np.array([0.6, -0.8, 3.0], np.float32)
    for path, given in (("teachers/mine", seen), ("normal", venv.normalize_obs(seen[None])[0])):
        np.testing.assert_allclose(acmr.load(path)(seen), model.predict(given, deterministic=True)[0], atol=1e-6)


class Stored:
    """A module that has nothing but its tensors."""

    def __init__(self, tensors):
        self._tensors = tensors

    def state_dict(self):
        return self._tensors
