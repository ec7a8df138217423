"""Networks and log-probabilities against closed forms and PyTorch's own distributions."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import AffineTransform, Independent, Normal, TanhTransform, TransformedDistribution

from acmr.agent.architecture import Architecture, Dimensions, is_hidden
from acmr.agent.networks import Networks, linear

DIMS = Dimensions(7, 3)
LOW, HIGH = np.array([-0.4, -1.0, 0.0], np.float32), np.array([0.4, 1.0, 3.0], np.float32)


def networks(seed: int = 0, **options) -> Networks:
    architecture = replace(Architecture.plain(DIMS, [16, 12, 8], LOW, HIGH), **options)
    return Networks(architecture, torch.Generator().manual_seed(seed))


def test_log_prob_is_that_of_a_squashed_scaled_gaussian():
    actor = networks().actor.double()
    observations = torch.randn(64, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    noise = torch.randn(64, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    actions, log_prob = actor.sample(observations, noise)
    mean, log_std = actor(observations)
    expected = Independent(
        TransformedDistribution(
            Normal(mean, log_std.exp()),
            [TanhTransform(cache_size=1), AffineTransform(actor.action_bias, actor.action_scale, cache_size=1)],
        ),
        1,
    )
    # The 1e-6 of the reference implementation keeps the logarithm finite and shifts it a little.
    torch.testing.assert_close(log_prob, expected.log_prob(actions), atol=2e-3, rtol=0)
    exact = expected.log_prob(actions)
    scale = actor.action_scale * (1 - torch.tanh(mean + log_std.exp() * noise) ** 2)
    torch.testing.assert_close(log_prob, exact - torch.log1p(1e-6 / scale).sum(1), atol=1e-9, rtol=1e-9)


def test_actions_stay_within_their_bounds_and_reach_for_them():
    actor = networks().actor
    noise = torch.full((2, 3), 1e4) * torch.tensor([[1.0], [-1.0]])
    actions, log_prob = actor.sample(torch.zeros(2, 7), noise)
    torch.testing.assert_close(actions, torch.from_numpy(np.stack([HIGH, LOW])))
    assert torch.isfinite(log_prob).all()


def test_log_std_is_squashed_between_its_bounds():
    actor = networks().actor
    with torch.no_grad():
        actor.log_std.weight.zero_()
        for raw, expected in ((0.0, -1.5), (50.0, 2.0), (-50.0, -5.0)):
            actor.log_std.bias.fill_(raw)
            torch.testing.assert_close(actor(torch.randn(4, 7))[1], torch.full((4, 3), expected))


def test_forward_by_hand():
    made = networks()
    observations, actions = torch.randn(5, 7), torch.randn(5, 3)
    weights = {name: (layer.weight, layer.bias) for name, layer in made.layers().items()}

    def apply(name: str, inputs: torch.Tensor) -> torch.Tensor:
        weight, bias = weights[name]
        return inputs @ weight.T + bias

    hidden = observations
    for name in ("input", "hidden_1", "hidden_2"):
        hidden = apply(f"actor.{name}", hidden).clamp(min=0)
    torch.testing.assert_close(made.actor(observations)[0], apply("actor.mean", hidden))
    hidden = torch.cat((observations, actions), 1)
    for name in ("input", "hidden_1", "hidden_2"):
        hidden = apply(f"critic_2.{name}", hidden).clamp(min=0)
    torch.testing.assert_close(made.critic_2(observations, actions), apply("critic_2.output", hidden)[:, 0])


def test_adapter_relu_hides_negative_values_from_the_core():
    core = Dimensions(9, 5)
    for activation, blind in (("relu", True), ("none", False)):
        made = networks(core=core, adapter_activation=activation)
        adapter = made.actor.input_adapter
        with torch.no_grad():
            adapter.weight.zero_()
            adapter.bias.fill_(-1.0)
            first = made.actor(torch.zeros(1, 7))[0]
            adapter.bias.fill_(-2.0)
            second = made.actor(torch.zeros(1, 7))[0]
        assert torch.equal(first, second) == blind
    names = list(made.layers())
    assert [name for name in names if name.startswith("critic_1")] == [
        "critic_1.input_adapter", "critic_1.input", "critic_1.hidden_1", "critic_1.hidden_2", "critic_1.output",
    ]  # fmt: skip
    assert made.actor.input.in_features == 9
    assert made.actor.mean_adapter.weight.shape == (3, 5)
    assert made.critic_1.input_adapter.weight.shape == (14, 10)


def test_initialization_is_pytorchs_default():
    layer = linear(400, 300, torch.Generator().manual_seed(3))
    bound = 1 / math.sqrt(400)
    for tensor in (layer.weight, layer.bias):
        assert tensor.abs().max() <= bound
    # Uniform: variance bound^2 / 3, compared with torch's own layer.
    torch.testing.assert_close(layer.weight.var(), torch.tensor(bound**2 / 3), rtol=0.02, atol=0)
    torch.testing.assert_close(torch.nn.Linear(400, 300).weight.var(), layer.weight.var(), rtol=0.02, atol=0)


def test_same_seed_same_weights_and_critics_independent():
    first, second, other = networks(0), networks(0), networks(1)
    for name, tensor in first.state_dict().items():
        assert torch.equal(tensor, second.state_dict()[name])
    assert not torch.equal(first.critic_1.input.weight, first.critic_2.input.weight)
    assert not torch.equal(first.actor.input.weight, other.actor.input.weight)


def test_only_layers_between_hidden_activations_are_hidden():
    assert [name for name in networks().layers() if is_hidden(name)] == [
        f"{part}.hidden_{index}" for part in ("actor", "critic_1", "critic_2") for index in (1, 2)
    ]


@pytest.mark.parametrize("core", [None, Dimensions(9, 5)], ids=["plain", "adapted"])
@pytest.mark.parametrize("sizes", [(6,), (16, 12, 8)], ids=str)
def test_an_architecture_says_what_networks_have(core, sizes):
    architecture = replace(Architecture.plain(DIMS, sizes, LOW, HIGH), core=core)
    made = Networks(architecture, torch.Generator().manual_seed(0))
    assert architecture.tensors == {name: tuple(tensor.shape) for name, tensor in made.state_dict().items()}
    assert list(architecture.layers) == list(made.layers())
    assert architecture.sizes == {name: layer.weight.numel() + len(layer.bias) for name, layer in made.layers().items()}
    assert architecture.parameter_count == sum(parameter.numel() for parameter in made.parameters())
    np.testing.assert_array_equal(made.actor.action_scale, (HIGH - LOW) / 2)
    np.testing.assert_array_equal(made.actor.action_bias, (HIGH + LOW) / 2)


def test_the_papers_networks_by_hand():
    bounds = np.full(17, 0.4, np.float32)
    plain = Architecture.plain(Dimensions(376, 17), (256, 256), -bounds, bounds)
    actor = 377 * 256 + 257 * 256 + 2 * 257 * 17
    critic = 394 * 256 + 257 * 256 + 257
    assert plain.parameter_count == actor + 2 * critic
    expanded = replace(plain, dims=Dimensions(270, 11), core=Dimensions(376, 17))
    adapters = 271 * 376 + 2 * 18 * 11 + 2 * 282 * 393
    assert expanded.parameter_count == plain.parameter_count + adapters
