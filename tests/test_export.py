"""Exported policies, in the programs that they are for: torch.jit, onnxruntime, Stable-Baselines3."""

import os
import shlex
import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import takewhile

import numpy as np
import pytest
import torch
from finished_run import make_run
from guides import ROOT, blocks

import acmr
from acmr.agent.architecture import Dimensions
from acmr.exchange.exports import main
from acmr.exchange.sb3_writer import write_sb3
from acmr.transfer.teacher import load_teacher

DOCUMENT = ROOT / "docs" / "exchange.md"
CORES = [None, Dimensions(27, 8)]


def needs(*modules: str) -> None:
    """Skips a test without an optional library, with a reason; fails where all of them have to be there."""
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        assert not os.environ.get("ACMR_REQUIRE_EXTRAS"), f"{missing} are to be installed here"
        pytest.skip(f"{', '.join(missing)} not installed; type pip install '.[onnx,sb3,tune,grid]'")


@pytest.fixture(params=CORES, ids=["plain", "adapters"])
def run(request, tmp_path):
    return make_run(tmp_path / "run", core=request.param)


@pytest.fixture
def seen() -> np.ndarray:
    return 3 * np.random.default_rng(0).normal(size=(6, 23)).astype(np.float32)


def test_torchscript_gives_the_same_actions(run, seen, tmp_path, capsys):
    path = tmp_path / "policy.pt"
    assert main([str(run), "--torchscript", str(path)]) == 0
    assert capsys.readouterr().out == f"written: {path} (23 sensors and 6 actuators)\n"
    policy = torch.jit.load(path)
    for rows in (seen, seen[:1]):
        np.testing.assert_allclose(policy(torch.from_numpy(rows)).detach(), acmr.load(run)(rows), atol=1e-6)


@pytest.mark.slow
def test_onnx_gives_the_same_actions_in_one_file(run, seen, tmp_path, capfd):
    needs("onnx", "onnxscript", "onnxruntime")
    import onnxruntime

    path = tmp_path / "out" / "policy.onnx"
    path.parent.mkdir()
    assert main([str(run), "--onnx", str(path)]) == 0
    assert capfd.readouterr() == (f"written: {path} (23 sensors and 6 actuators)\n", "")
    assert list(path.parent.iterdir()) == [path]
    session = onnxruntime.InferenceSession(path)
    for rows in (seen, seen[:1]):
        (action,) = session.run(["action"], {"observation": rows})
        np.testing.assert_allclose(action, acmr.load(run)(rows), atol=1e-6)


@pytest.mark.slow
def test_stable_baselines3_gives_the_same_actions_and_values(run, seen, tmp_path):
    needs("stable_baselines3")
    from stable_baselines3 import SAC

    teacher = load_teacher(run)
    # Bounds that are neither alike nor around zero: Stable-Baselines3 knows none but -1 and 1 within.
    low, high = [-1.0, -0.4, 0.0, -3.0, 1.0, -1.0], [1.0, 0.4, 2.0, 1.0, 5.0, 1.0]
    teacher = replace(teacher, description=replace(teacher.description, action_low=low, action_high=high))
    write_sb3(teacher, tmp_path / "model.zip")
    model = SAC.load(tmp_path / "model.zip")
    networks = teacher.build_networks()
    rows = torch.from_numpy(seen)
    wanted = networks.actor.mode(rows).detach().numpy()
    actions, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(actions, wanted, atol=1e-6)
    scaled = torch.from_numpy(model.policy.scale_action(wanted))
    for critic in (model.critic, model.critic_target):
        for theirs, ours in zip(critic(rows, scaled), networks.critics, strict=True):
            torch.testing.assert_close(theirs.squeeze(1), ours(rows, torch.from_numpy(wanted)), atol=2e-5, rtol=1e-5)
    assert model.log_ent_coef.item() == pytest.approx(teacher.description.log_alpha)
    # As the page says: the same where raw log_std is near the middle.
    _, raw = networks.actor.outputs(rows)
    _, log_std, _ = model.actor.get_action_dist_params(rows)
    torch.testing.assert_close(log_std, (3.5 * raw - 1.5).clamp(-20, 2), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nothing", "--torchscript", "policy.pt"], "error: nothing: no such run directory"),
        (["{run}", "--torchscript", "no/policy.pt"], "error: --torchscript no/policy.pt: there is no folder no"),
        (
            ["{run}"],
            "nothing to write; type one or more of --torchscript policy.pt, --onnx policy.onnx, --sb3 model.zip",
        ),
    ],
)
def test_what_cannot_be_exported_says_why(words, says, tmp_path, monkeypatch, capsys):
    run = make_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    try:
        code = main([word.format(run=run) for word in words])
    except SystemExit as stopped:
        code = stopped.code
    assert code == 2
    assert says in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize(("format_", "module"), [("onnx", "onnxscript"), ("sb3", "stable_baselines3")])
def test_without_its_extra_it_names_it(format_, module, tmp_path, monkeypatch, capsys):
    run = make_run(tmp_path / "run")
    # Python takes a None there for a module that cannot be imported.
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert main([str(run), f"--{format_}", str(tmp_path / "file")]) == 2
    assert f"pip install 'acmr[{format_}]'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_page_runs_as_it_is_written(tmp_path, monkeypatch):
    needs("onnx", "onnxscript", "onnxruntime", "stable_baselines3")
    monkeypatch.chdir(tmp_path)
    acmr.train("env=ant", profile="quick", total_timesteps=1100, tracking="off", progress="off")
    there, whole = "runs/quick/ant-none-total_timesteps=1100", "runs/quick/ant-none"
    (command, *others) = blocks(DOCUMENT)
    snippets = list(takewhile(lambda block: block.language == "python", others))
    assert len(snippets) == 3
    words = shlex.split(command.text.replace(whole, there))
    assert words[:2] == ["acmr", "export"]
    assert main(words[2:]) == 0
    for snippet in snippets:
        names = {}
        exec(snippet.text, names)
        assert names["action"].shape[-1] == 8
