"""Each transfer copies exactly what the paper says, bit for bit, and refuses what does not fit."""

import numpy as np
import pytest
import torch

from acmr.agent.networks import Dimensions, Networks
from acmr.config import ConfigError, TransferConfig
from acmr.settings.compose import CONFIG_FOLDER
from acmr.transfer import methods
from acmr.transfer.methods import method, method_names, transfer

SOURCE, TARGET = Dimensions(12, 5), Dimensions(8, 3)
SIZES = (10, 9)
INNER = {
    "actor": ["input", "hidden_1", "mean", "log_std"],
    "critic_1": ["input", "hidden_1", "output"],
    "critic_2": ["input", "hidden_1", "output"],
}
ADAPTERS = [
    "actor.input_adapter", "actor.mean_adapter", "actor.log_std_adapter", "critic_1.input_adapter",
    "critic_2.input_adapter",
]  # fmt: skip
ALL = [f"{part}.{name}" for part, names in INNER.items() for name in names]
HIDDEN = ["actor.hidden_1", "critic_1.hidden_1", "critic_2.hidden_1"]


def student(dims: Dimensions, sizes: tuple[int, ...] = SIZES, seed: int = 1) -> Networks:
    low, high = np.full(dims.action, -1, np.float32), np.full(dims.action, 1, np.float32)
    return Networks(dims, sizes, low, high, torch.Generator().manual_seed(seed))


def run(dims, teacher, name, freeze=False, sizes=SIZES, **options):
    config = TransferConfig(name=name, **options)
    return transfer(student(dims, sizes), teacher, config, freeze, torch.Generator().manual_seed(2))


@pytest.mark.parametrize(
    ("name", "dims", "copied", "fresh"),
    [
        ("none", TARGET, [], ALL),
        ("direct", SOURCE, ALL, []),
        ("hidden", TARGET, HIDDEN, [layer for layer in ALL if layer not in HIDDEN]),
        ("expand", TARGET, ALL, ADAPTERS),
    ],
)
@pytest.mark.parametrize("freeze", [False, True])
def test_copied_layers_are_the_teachers_bit_for_bit(name, dims, copied, fresh, freeze, teacher_factory):
    teacher = None if name == "none" else teacher_factory(SOURCE, SIZES)
    networks, report = run(dims, teacher, name, freeze)
    assert sorted(report.copied) == sorted(copied)
    assert sorted(report.fresh) == sorted(fresh)
    assert sorted(report.frozen) == sorted(copied if freeze else [])
    layers = networks.layers()
    for layer in copied:
        assert torch.equal(layers[layer].weight, teacher.tensors[f"{layer}.weight"])
        assert torch.equal(layers[layer].bias, teacher.tensors[f"{layer}.bias"])
    for layer, module in layers.items():
        learns = layer not in report.frozen
        assert all(parameter.requires_grad == learns for parameter in module.parameters())
    total = sum(parameter.numel() for parameter in networks.parameters())
    assert report.parameters["total"] == total == report.parameters["copied"] + report.parameters["fresh"]
    assert report.parameters["trainable"] == sum(p.numel() for p in networks.parameters() if p.requires_grad)


def test_expanded_student_has_the_students_interface(teacher_factory):
    networks, _ = run(TARGET, teacher_factory(SOURCE, SIZES), "expand")
    actions, log_prob = networks.actor.sample(torch.randn(4, 8), torch.randn(4, 3))
    assert actions.shape == (4, 3)
    assert log_prob.shape == (4,)
    assert networks.critic_1(torch.randn(4, 8), actions).shape == (4,)


def test_adapter_activation_is_a_setting(teacher_factory):
    teacher = teacher_factory(SOURCE, SIZES)
    assert run(TARGET, teacher, "expand")[0].actor.adapter_relu
    assert not run(TARGET, teacher, "expand", adapter_activation="none")[0].actor.adapter_relu


def test_direct_from_an_expanded_teacher_keeps_its_adapters(teacher_factory):
    teacher = teacher_factory(TARGET, SIZES, core=SOURCE)
    networks, report = run(TARGET, teacher, "direct")
    assert set(report.copied) == {*ALL, *ADAPTERS}
    assert torch.equal(networks.actor.mean_adapter.weight, teacher.tensors["actor.mean_adapter.weight"])


@pytest.mark.parametrize(
    ("name", "teacher_dims", "sizes", "core", "says"),
    [
        ("direct", SOURCE, SIZES, None, "12 sensors and 5 actuators, the student 8 sensors and 3 actuators"),
        ("hidden", SOURCE, (10, 8), None, r"agent.hidden_sizes=\[10,8\]"),
        ("expand", SOURCE, (10, 9, 8), None, r"agent.hidden_sizes=\[10,9,8\]"),
        ("expand", SOURCE, SIZES, Dimensions(20, 7), "itself expanded"),
    ],
)
def test_a_teacher_that_does_not_fit_is_refused(name, teacher_dims, sizes, core, says, teacher_factory):
    teacher = teacher_factory(teacher_dims, sizes, core=core)
    with pytest.raises(ConfigError, match=says) as caught:
        run(TARGET, teacher, name)
    assert "\n" not in str(caught.value)


def test_unknown_method_is_refused(teacher_factory):
    with pytest.raises(ConfigError, match="must be one of none, direct, hidden, expand"):
        run(TARGET, teacher_factory(SOURCE, SIZES), "distill")


def test_every_method_has_a_yaml_file_and_the_other_way_round():
    assert sorted(path.stem for path in (CONFIG_FOLDER / "transfer").glob("*.yaml")) == sorted(method_names())


def test_a_new_method_is_one_function(teacher_factory, monkeypatch):
    monkeypatch.setattr(methods, "_METHODS", dict(methods._METHODS))

    @method("heads")
    def heads(networks, teacher, config, generator):
        with torch.no_grad():
            networks.critic_1.output.weight.copy_(teacher.tensors["critic_1.output.weight"])
            networks.critic_1.output.bias.copy_(teacher.tensors["critic_1.output.bias"])
        return networks, ["critic_1.output"]

    networks, report = run(TARGET, teacher_factory(SOURCE, SIZES), "heads", freeze=True)
    assert report.copied == report.frozen == ["critic_1.output"]
    assert not networks.critic_1.output.weight.requires_grad
