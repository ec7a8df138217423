"""Each transfer copies exactly what the paper says, bit for bit, and refuses what does not fit."""

import ast
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from guides import ROOT, copy_checkout, follow

from acmr.agent.architecture import CLAMP, TANH, Architecture, Dimensions
from acmr.agent.networks import Networks
from acmr.config import ConfigError, TransferConfig, TransferRules
from acmr.settings.compose import CONFIG_FOLDER, compose_config, parse
from acmr.settings.run_spec import specify
from acmr.storage.run_dir import differing_keys
from acmr.transfer import methods
from acmr.transfer.methods import METHODS, Student, Taken, method, transfer
from acmr.transfer.teacher import load_teacher, save_teacher

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
    return Networks(Architecture.plain(dims, sizes, low, high), torch.Generator().manual_seed(seed))


def settings(name: str) -> TransferConfig:
    """The method as its file describes it, rules included; without a file what the schema says."""
    has_file = (CONFIG_FOLDER / "transfer" / f"{name}.yaml").exists()
    return parse(compose_config([f"transfer={name}"])).transfer if has_file else TransferConfig(name=name)


def run(dims, teacher, name, freeze=False, sizes=SIZES, **options):
    config = replace(settings(name), **options)
    taker = Student(
        student(dims, sizes),
        [f"obs/{row}" for row in range(dims.observation)],
        [f"action/{row}" for row in range(dims.action)],
    )
    made = transfer(taker, teacher, config, freeze, torch.Generator().manual_seed(2))
    return made.networks, made.report


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


def test_a_method_may_take_other_widths_and_another_body_if_its_rules_do_not_forbid_it(teacher_factory, monkeypatch):
    monkeypatch.setattr(
        methods.METHODS, "_entries", {"biases": lambda student, *_: Taken(student.networks, ["actor.mean"])}
    )
    teacher, free = teacher_factory(SOURCE, (10, 8)), TransferRules(same_widths=False)
    assert run(TARGET, teacher, "biases", rules=free)[1].copied == ["actor.mean"]
    for broken in (TransferRules(), TransferRules(same_widths=False, same_body=True)):
        with pytest.raises(ConfigError, match=r"transfer=biases: the teacher .* has "):
            run(TARGET, teacher, "biases", rules=broken)


def test_methods_that_are_named_instead_exist():
    for name in METHODS.names:
        assert set(settings(name).rules.instead) <= set(METHODS.names) - {name}


def names_it(path: Path, name: str) -> bool:
    """Whether a source has the method's name, or what to type for it, in a string that is no docstring."""
    tree = ast.parse(path.read_text())
    docstrings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and node not in docstrings]
    return any(text == name or f"transfer={name}" in text for text in texts if isinstance(text, str))


@pytest.mark.parametrize("name", ["direct", "hidden", "expand"])
def test_nobody_but_the_methods_knows_a_methods_name(name):
    root = CONFIG_FOLDER.parent
    sources = [path for folder in ("acmr", "sweeps") for path in (root / folder).rglob("*.py")]
    assert len(sources) > 50
    knows = {str(path.relative_to(root)) for path in sources if names_it(path, name)}
    # The rows of the cells say which method each has.
    assert knows <= {"acmr/transfer/methods.py", "acmr/cells.py"}


def test_rules_are_no_settings():
    """They stand in no config.yaml and no name, so that a new rule orphans no run; and a method has its own ones."""
    made = specify(parse(compose_config(["experiment=H1"])))
    assert made.config.transfer.rules.same_body
    assert "rules" not in made.settings["transfer"]
    assert made.name == "humanoid-direct"
    changed = replace(made.config, transfer=replace(made.config.transfer, rules=TransferRules(min_hidden_layers=0)))
    assert differing_keys(made.settings, changed) == []
    for overrides in (["transfer.name=direct"], ["transfer=direct", "transfer.rules.freezable=true"]):
        with pytest.raises(ConfigError, match=r"no setting, .* conf/transfer/direct.yaml says .* transfer=direct"):
            specify(parse(compose_config(overrides)))


@pytest.mark.parametrize("cell", ["H0", "A0", "A2"])
def test_the_published_runs_are_still_the_runs_that_their_settings_name(cell):
    made = specify(parse(compose_config([f"experiment={cell}"])))
    for stored in (CONFIG_FOLDER.parent / "results" / "paper" / made.name).glob("seed_*/config.yaml"):
        settings = yaml.safe_load(stored.read_text())
        assert differing_keys(settings, replace(made.config, seed=settings["seed"])) == []


def test_published_teachers_are_read_and_described_as_they_were():
    for folder in (CONFIG_FOLDER.parent / "results" / "paper" / "humanoid-none").glob("seed_*"):
        teacher = load_teacher(folder)
        assert teacher.description.architecture.parameter_count == sum(map(torch.numel, teacher.tensors.values()))
        stored = json.loads((folder / "teacher.json").read_text())
        assert asdict(teacher.description) == {**asdict(teacher.description), **stored, "description_sha256": ""}


@pytest.mark.parametrize(
    ("name", "dims"), [("direct", SOURCE), ("expand", TARGET), ("named", TARGET), ("hidden", TARGET)]
)
def test_the_bounds_of_log_std_go_where_its_head_goes(name, dims, teacher_factory):
    clamped, squashed = (teacher_factory(SOURCE, SIZES, log_std=rule) for rule in (CLAMP, TANH))
    # What is the default is not written: files are as they were, and older ones still read.
    assert "log_std" not in json.loads(squashed.path.with_suffix(".json").read_text())
    assert clamped.description.architecture.log_std == CLAMP
    networks, report = run(dims, clamped, name, impute="zero")
    before, _ = run(dims, squashed, name, impute="zero")
    taken = name != "hidden"
    assert (networks.architecture.log_std == CLAMP) == taken == (networks.actor.log_std_rule == CLAMP)
    assert ("log_std is bounded as in the teacher (clamp)" in report.notes) == taken
    seen = torch.randn(4, dims.observation, generator=torch.Generator().manual_seed(3))
    mean, raw = networks.actor.outputs(seen)
    torch.testing.assert_close(networks.actor(seen)[1], raw.clamp(-20, 2) if taken else before.actor(seen)[1])
    assert torch.equal(mean, before.actor.outputs(seen)[0])
    assert before.architecture.log_std == TANH


def test_an_unknown_temperature_is_not_copied(teacher_factory):
    teacher = teacher_factory(SOURCE, SIZES)
    assert teacher.log_alpha() == -1.5
    save_teacher(teacher.path.parent, teacher.build_networks(), replace(teacher.description, log_alpha=None))
    with pytest.raises(ConfigError, match="imported without its temperature; type transfer"):
        load_teacher(teacher.path).log_alpha()


def test_every_method_has_a_yaml_file_and_the_other_way_round():
    files = sorted(path.stem for path in (CONFIG_FOLDER / "transfer").glob("*.yaml"))
    assert all(METHODS.find(name) for name in files)
    assert files == sorted(METHODS.names)


def test_a_new_method_is_one_function(teacher_factory, monkeypatch):
    monkeypatch.setattr(methods.METHODS, "_entries", dict(methods.METHODS._entries))

    @method("heads")
    def heads(student, teacher, config, generator):
        networks = student.networks
        with torch.no_grad():
            networks.critic_1.output.weight.copy_(teacher.tensors["critic_1.output.weight"])
            networks.critic_1.output.bias.copy_(teacher.tensors["critic_1.output.bias"])
        return Taken(networks, ["critic_1.output"])

    networks, report = run(TARGET, teacher_factory(SOURCE, SIZES), "heads", freeze=True)
    assert report.copied == report.frozen == ["critic_1.output"]
    assert not networks.critic_1.output.weight.requires_grad


@pytest.mark.slow
def test_the_guide_to_a_method_of_ones_own(tmp_path):
    said = follow(ROOT / "docs" / "howto-transfer.md", copy_checkout(tmp_path / "checkout"))
    report, _ = json.JSONDecoder().raw_decode(said[said.index("{") :])
    assert report["copied"] == report["frozen"] == ["critic_1.output", "critic_2.output"]
    assert "  copied: 130 parameters: critic_1.output, critic_2.output" in said
