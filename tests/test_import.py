"""Networks of other programs: what comes out computes what went in, and what does not fit is refused in one line."""

import numpy as np
import pytest
import torch
from foreign_models import PENDULUM, cleanrl_networks, described, refused, rows, saved, sb3_networks, write_sb3_model
from torch.nn import functional

import acmr
from acmr.config import ConfigError, EnvConfig
from acmr.evaluation.cli import main as evaluate
from acmr.exchange.exports import main as export
from acmr.exchange.imported import Normalization, make_teacher
from acmr.exchange.imports import main
from acmr.exchange.sb3_reader import read_sb3
from acmr.transfer.teacher import load_teacher


def test_the_paths_of_data_are_exact(tmp_path):
    """A model made by hand, against its functions written down; test_import_sb3.py has real ones."""
    tensors = sb3_networks()
    found = read_sb3(write_sb3_model(tmp_path / "model.zip"))
    normalization = Normalization(np.array([1.0, -2.0, 0.5]), np.array([4.0, 0.25, 9.0]))
    networks, about = make_teacher(found, EnvConfig("made_up"), described(3, [-2.0], [2.0]), normalization)
    seen, actions = torch.from_numpy(rows(9, 3)), torch.linspace(-2, 2, 9)[:, None]
    normal = ((seen - torch.tensor([1.0, -2.0, 0.5])) / torch.tensor([2.0, 0.5, 3.0])).float()

    def chained(name, inputs, numbers):
        for number in numbers:
            inputs = functional.relu(inputs) if number else inputs
            inputs = functional.linear(inputs, tensors[f"{name}.{number}.weight"], tensors[f"{name}.{number}.bias"])
        return inputs

    hidden = functional.relu(chained("actor.latent_pi", normal, [0, 2]))
    mean = functional.linear(hidden, tensors["actor.mu.weight"], tensors["actor.mu.bias"])
    torch.testing.assert_close(networks.actor.mode(seen), 2 * torch.tanh(mean), atol=1e-6, rtol=1e-6)
    for index, critic in enumerate(networks.critics):
        wanted = chained(f"critic.qf{index}", torch.cat([normal, actions / 2], 1), [0, 2, 4])
        torch.testing.assert_close(critic(seen, actions), wanted[:, 0], atol=1e-5, rtol=1e-5)
    assert about.seed == 3
    assert about.imported == "stable-baselines3 2.9.2"
    assert about.log_alpha == -0.5


@pytest.mark.parametrize("as_mapping", [False, True])
def test_cleanrl(as_mapping, tmp_path, capsys):
    actor, *critics = parts = cleanrl_networks()
    content = dict(zip(("actor", "qf1", "qf2"), parts, strict=True)) | {"log_alpha": torch.tensor([-0.7])}
    torch.save(content if as_mapping else parts, tmp_path / "agent.pt")
    out = tmp_path / "teacher"
    assert main(["cleanrl", str(tmp_path / "agent.pt"), "--env", PENDULUM, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"written: {out} (3 sensors and 1 actuators of {PENDULUM}; hidden layers of 8 and 8; cleanrl)\n" in said
    teacher = load_teacher(out)
    assert (teacher.description.log_alpha, teacher.description.log_std) == (
        pytest.approx(-0.7) if as_mapping else None, "tanh",
    )  # fmt: skip
    networks = teacher.build_networks()

    def layer(tensors, name, inputs):
        return functional.linear(inputs, tensors[f"{name}.weight"], tensors[f"{name}.bias"])

    seen, actions = torch.from_numpy(rows(9, 3)), torch.linspace(-2, 2, 9)[:, None]
    hidden = functional.relu(layer(actor, "fc2", functional.relu(layer(actor, "fc1", seen))))
    mean, log_std = networks.actor(seen)
    torch.testing.assert_close(networks.actor.mode(seen), 2 * torch.tanh(layer(actor, "fc_mean", hidden)))
    torch.testing.assert_close(mean, layer(actor, "fc_mean", hidden))
    torch.testing.assert_close(log_std, -5 + 3.5 * (torch.tanh(layer(actor, "fc_logstd", hidden)) + 1))
    for ours, theirs in zip(networks.critics, critics, strict=True):
        value = torch.cat([seen, actions], 1)
        for name in ("fc1", "fc2"):
            value = functional.relu(layer(theirs, name, value))
        torch.testing.assert_close(ours(seen, actions), layer(theirs, "fc3", value)[:, 0])


@pytest.mark.slow
def test_an_imported_teacher_teaches_is_evaluated_and_exported(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_sb3_model(tmp_path / "model.zip")
    assert main(["sb3", "model.zip", "--env", PENDULUM, "--out", "teachers/mine"]) == 0
    assert load_teacher("teachers/mine").description.statistics.episodes == 10
    assert acmr.load("teachers/mine").summary["global_step"] == 60
    tiny = {
        "env.id": PENDULUM, "transfer.teacher": "teachers/mine", "total_timesteps": 120, "tracking": "off",
        "agent.hidden_sizes": [8, 6], "agent.learning_starts": 20, "agent.batch_size": 8, "profile": "quick",
    }  # fmt: skip
    run = acmr.train("env=gym", "transfer=direct", **tiny)
    taken = load_teacher(run.directory)
    assert taken.description.log_std == "clamp"
    assert '"log_std": "clamp"' in (run.directory / "transfer.json").read_text()
    acmr.train("env=gym", "transfer=named", "agent=sac_plain", **tiny)
    torch.save(cleanrl_networks(), "agent.pt")
    for words in ([], ["--alpha", "0.25"]):
        assert main(["cleanrl", "agent.pt", "--env", PENDULUM, "--out", f"teachers/{len(words)}", *words]) == 0
    tiny |= {"transfer.copy_log_alpha": True, "agent.hidden_sizes": [8, 8]}
    with pytest.raises(ConfigError, match=r"teachers/0/teacher\.safetensors was imported without its temperature"):
        acmr.train("env=gym", "transfer=direct", **tiny | {"transfer.teacher": "teachers/0"})
    acmr.train("env=gym", "transfer=direct", **tiny | {"transfer.teacher": "teachers/2"})
    assert load_teacher("teachers/2").log_alpha() == pytest.approx(np.log(0.25))
    assert evaluate(["teachers/mine", "--episodes", "1"]) == 0
    assert "200  time limit" in capsys.readouterr().out
    assert export(["teachers/mine", "--torchscript", "policy.pt"]) == 0
    seen = rows(5, 3)
    policy = torch.jit.load("policy.pt")
    np.testing.assert_allclose(policy(torch.from_numpy(seen)).detach(), acmr.load("teachers/mine")(seen), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"settings": {"use_sde": True}}, "use_sde=True"),
        ({"settings": {"policy_class": {"__module__": "theirs"}}}, "a policy of theirs; only that of SAC"),
        ({"settings": {"policy_kwargs": {"activation_fn": "<class 'Tanh'>"}}}, "its activation is <class 'Tanh'>"),
        ({"settings": {"policy_kwargs": {"activation_fn": "<class 'torch.nn.LeakyReLU'>"}}}, "LeakyReLU"),
        ({"settings": {"action_space": {"low": "[-1.]", "high": "[1.]"}}}, "its actions are [-2.0], of the networks' "),
        ({"policy": saved(sb3_networks(critics=1))}, "1 critics (qf0)"),
        ({"policy": saved(sb3_networks(critics=5))}, "5 critics"),
        ({"policy": saved(sb3_networks(actor=[3, 8, 7]))}, "other widths"),
        ({"policy": saved(sb3_networks(actor=[5, 8, 6], critic=[6, 8, 6, 1]))}, "Pendulum-v1: has 3 sensors and 1"),
        (
            {"policy": saved(sb3_networks(critic=[9, 8, 6, 1]))},
            "critic_1.input.weight: the file has it in the shape (8",
        ),
        (
            {"policy": saved(sb3_networks() | {"actor.latent_pi.1.weight": torch.ones(8)})},
            "something else stands between",
        ),
        (
            {"policy": saved(sb3_networks() | {"actor.norm.weight": torch.ones(8)})},
            "no layer here like actor.norm.weight",
        ),
        ({"policy": saved({"actor.mu.weight": torch.ones(1, 1)})}, "no actor and critics of SAC"),
        ({"policy": saved(sb3_networks() | {"actor.mu.bias": torch.tensor([float("nan")])})}, "not finite"),
        ({"policy": None}, "no model of Stable-Baselines3 (there is no policy.pth in it)"),
        ({"data": b"{"}, "data: cannot be read"),
        ({"data": b"[" * 100_000}, "data: cannot be read"),
        ({"data": b"[1]"}, "data: holds no settings"),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)
def test_what_does_not_fit_is_refused_with_a_reason(changes, says, tmp_path, capsys):
    path = write_sb3_model(tmp_path / "model.zip", **changes)
    refused(["sb3", path], says, tmp_path, capsys)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (cleanrl_networks()[:2], "not an actor and two critics; save them with torch.save((actor.state_dict(),"),
        ([1, 2, 3], "actor: no state_dict"),
        ({"actor": {}, "qf1": {}, "qf2": {}}, "has no action_scale and action_bias"),
        ({**dict(zip(("actor", "qf1", "qf2"), cleanrl_networks(), strict=True)), "log_alpha": "0"}, "log_alpha is no"),
    ],
    ids=["two", "numbers", "empty", "log_alpha"],
)
def test_what_is_no_agent_of_cleanrl(content, says, tmp_path, capsys):
    torch.save(content, tmp_path / "agent.pt")
    refused(["cleanrl", tmp_path / "agent.pt"], says, tmp_path, capsys)


def test_the_environment_may_be_of_a_folder_of_ones_own(tmp_path, capsys):
    (tmp_path / "conf" / "env").mkdir(parents=True)
    (tmp_path / "conf" / "env" / "pole.yaml").write_text(f"name: pole\nid: {PENDULUM}\nsource: pole\n")
    path, out = write_sb3_model(tmp_path / "model.zip"), tmp_path / "out"
    words = ["sb3", str(path), "--env", "pole", "--out", str(out)]
    assert main([*words, "--config-dir", str(tmp_path / "gone")]) == 2
    assert "there is no such folder" in capsys.readouterr().err
    assert main([*words, "--config-dir", str(tmp_path / "conf")]) == 0
    assert load_teacher(out).description.environment == "pole"


def test_a_folder_that_holds_something_is_left_alone(tmp_path, capsys):
    path, out = write_sb3_model(tmp_path / "model.zip"), tmp_path / "out"
    out.mkdir()
    (out / "precious").touch()
    assert main(["sb3", str(path), "--env", PENDULUM, "--out", str(out)]) == 2
    assert "holds something already; give a folder that is new or empty" in capsys.readouterr().err
    assert [entry.name for entry in out.iterdir()] == ["precious"]


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"mean": np.zeros(3)}, "there is no var in it"),
        ({"mean": np.zeros(3), "var": np.ones(3), "other": np.ones(3)}, "holds other; it needs mean and var"),
        ({"mean": np.zeros(2), "var": np.ones(2)}, "mean (2,) and var (2,); a number each for 3 sensors"),
        ({"mean": np.zeros(3), "var": -np.ones(3)}, "above zero"),
        ({"mean": np.full(3, np.inf), "var": np.ones(3)}, "finite"),
        ({"mean": np.zeros((1, 3)), "var": np.ones(3)}, "mean: no vector of real numbers"),
        ({"mean": np.array(["a"] * 3), "var": np.ones(3)}, "mean: no vector of real numbers"),
    ],
    ids=lambda value: value[:20] if isinstance(value, str) else "",
)
def test_statistics_that_do_not_fit(arrays, says, tmp_path, capsys):
    np.savez(tmp_path / "stats.npz", **arrays)
    path = write_sb3_model(tmp_path / "model.zip")
    refused(["sb3", path, "--normalization", tmp_path / "stats.npz"], says, tmp_path, capsys)
