"""The learner's parts against autograd, torch's own Adam, and the public networks; and going on from a saved state."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from acmr.agent import precision as matmul_precision
from acmr.agent.architecture import LOG_STD_BOUNDS, Architecture, Dimensions
from acmr.agent.kernels import arrays
from acmr.agent.kernels.adam import Adam
from acmr.agent.kernels.layers import CriticStack, Stack, columns
from acmr.agent.kernels.parameters import FlatParameters
from acmr.agent.kernels.policy import SquashedGaussian
from acmr.agent.networks import Networks
from acmr.agent.replay_buffer import ReplayBuffer
from acmr.agent.sac import SAC
from acmr.config import PRECISIONS, SACConfig

DIMS, CORE = Dimensions(11, 3), Dimensions(14, 5)
LOW, HIGH = np.array([-0.4, -1.0, 0.0], np.float32), np.array([0.4, 1.0, 2.0], np.float32)
CONFIG = SACConfig(hidden_sizes=[24, 20], batch_size=16)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_networks(core: Dimensions | None = None, sizes: tuple[int, ...] = (24, 20)) -> Networks:
    return Networks(replace(Architecture.plain(DIMS, sizes, LOW, HIGH), core=core), generator(0))


def make_agent(core: Dimensions | None = None, precision: str = "float32") -> SAC:
    return SAC(make_networks(core), replace(CONFIG, precision=precision), generator(1), generator(2))


def filled_buffer() -> ReplayBuffer:
    buffer, rng = ReplayBuffer(200, DIMS.observation, DIMS.action), np.random.default_rng(0)
    for index in range(150):
        observation, after = rng.standard_normal((2, DIMS.observation))
        buffer.add(
            observation, rng.uniform(LOW, HIGH), rng.standard_normal(), after, index % 30 == 29, index % 30 == 29
        )
    return buffer


def layers(*sizes: tuple[int, int], frozen: tuple[int, ...] = ()) -> list[nn.Linear]:
    torch.manual_seed(0)
    made = [nn.Linear(*size) for size in sizes]
    for index in frozen:
        made[index].requires_grad_(False)
    return made


@pytest.mark.parametrize("frozen", [(), (0,), (1,), (0, 1), (1, 2)])
def test_passes_of_twin_networks_agree_with_autograd(frozen):
    sizes = ((9, 7), (7, 5), (5, 1))
    twins = [layers(*sizes, frozen=frozen) for _ in range(2)]
    torch.nn.init.normal_(twins[1][0].weight)
    inputs, weights = torch.randn(6, 9), torch.randn(2, 6, 1)
    plain = [nn.Sequential(one[0], nn.ReLU(), one[1], nn.ReLU(), one[2]) for one in copy.deepcopy(twins)]
    wanted = torch.stack([network(inputs) for network in plain])
    (wanted * weights).sum().backward()

    parameters = FlatParameters([[[a], [b]] for a, b in zip(*twins, strict=True)])
    stack = Stack(parameters.blocks, [True, True, False])
    memory = stack.allocate(6)
    torch.testing.assert_close(stack.forward(inputs, memory), wanted.detach())
    memory[-1].gradient.copy_(weights)
    stack.backward(inputs, memory)
    for index, block in enumerate(parameters.blocks):
        for twin in range(2):
            reference = plain[twin][2 * index]
            if index in frozen:
                assert block.weight_gradient is None
            else:
                torch.testing.assert_close(block.weight_gradient[twin].t(), reference.weight.grad)
                torch.testing.assert_close(block.bias_gradient[twin, 0], reference.bias.grad)
    assert len(parameters.trainable) == len(parameters.gradient)
    assert len(parameters.trainable) >= sum(
        p.numel() for twin in twins for layer in twin for p in layer.parameters() if p.requires_grad
    )


@pytest.mark.parametrize("core", [None, CORE], ids=["plain", "adapted"])
def test_shared_observations_and_action_gradient_agree_with_autograd(core):
    networks = make_networks(core)
    observations, weights = torch.randn(8, DIMS.observation), torch.randn(2, 8)
    actions = torch.randn(8, DIMS.action, requires_grad=True)
    wanted = torch.stack([critic(observations, actions) for critic in networks.critics])
    (wanted * weights).sum().backward()
    groups = [[[a], [b]] for (_, a), (_, b) in zip(*(critic.layers() for critic in networks.critics), strict=True)]
    critics = CriticStack(FlatParameters(groups).blocks, [True] * (len(groups) - 1) + [False], DIMS.observation)
    memory = critics.allocate(8)
    critics.share(observations)
    torch.testing.assert_close(critics.forward_actions(actions.detach(), memory)[:, :, 0], wanted.detach())
    memory[-1].gradient[:, :, 0] = weights
    torch.testing.assert_close(critics.action_gradient(memory), actions.grad)


@pytest.mark.parametrize("width", [1, 2], ids=["one network", "two networks"])
def test_gaussian_and_its_gradient_agree_with_autograd(width):
    networks = make_networks()
    output = torch.randn(width, 8, 2 * DIMS.action // width, requires_grad=True)
    noise, of_actions, of_log_prob = torch.randn(8, DIMS.action), torch.randn(8, DIMS.action), torch.tensor([0.3])
    policy = SquashedGaussian(networks.actor.action_scale, networks.actor.action_bias)
    mean, raw = output[0].chunk(2, 1) if width == 1 else output
    x = mean + noise * torch.exp(-5 + 3.5 * (torch.tanh(raw) + 1))
    scale, bias = networks.actor.action_scale, networks.actor.action_bias
    normal = torch.distributions.Normal(mean, torch.exp(-5 + 3.5 * (torch.tanh(raw) + 1)))
    log_prob = (normal.log_prob(x) - torch.log(scale * (1 - torch.tanh(x) ** 2) + 1e-6)).sum(1)
    actions = torch.tanh(x) * scale + bias
    ((actions * of_actions).sum() + of_log_prob * log_prob.sum()).backward()
    sample = policy.sample(*columns(output.detach(), 2).numpy(), noise.numpy())
    np.testing.assert_allclose(sample.actions, actions.detach(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sample.log_prob, log_prob.detach(), rtol=1e-4, atol=1e-4)
    gradient = torch.zeros_like(output)
    policy.backward(sample, of_actions.numpy(), of_log_prob.numpy(), *columns(gradient, 2).numpy())
    torch.testing.assert_close(gradient, output.grad, rtol=1e-4, atol=1e-5)


def test_adam_is_torchs():
    start = torch.randn(100, generator=generator(0))
    ours, gradient = start.clone(), torch.zeros(100)
    adam = Adam(ours, gradient, 1e-3)
    theirs = start.clone().requires_grad_()
    reference = torch.optim.Adam([theirs], lr=1e-3)
    for step in range(50):
        gradient.copy_(torch.randn(100, generator=generator(step)))
        theirs.grad = gradient.clone()
        adam.step()
        reference.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-6, atol=1e-7)


def test_layers_stay_the_truth_of_what_is_learned():
    networks = make_networks()
    before = copy.deepcopy(networks.state_dict())
    agent = SAC(networks, CONFIG, generator(1), generator(2))
    assert all(torch.equal(value, before[name]) for name, value in networks.state_dict().items())
    observation = np.linspace(-1, 1, DIMS.observation)
    with torch.no_grad():
        networks.actor.mean.weight.zero_()
        networks.actor.mean.bias.fill_(30.0)
    np.testing.assert_allclose(agent.act(observation), HIGH, atol=1e-5)


@pytest.mark.parametrize("core", [None, CORE], ids=["plain", "adapted"])
@pytest.mark.parametrize("devices", [{"cpu"}, set()], ids=["numpy", "torch"])
@pytest.mark.parametrize("log_std", LOG_STD_BOUNDS)
def test_acting_is_the_networks_sample(core, devices, log_std, monkeypatch):
    monkeypatch.setattr(arrays, "NUMPY_DEVICES", devices)
    agent = SAC(make_networks(core).with_log_std(log_std), CONFIG, generator(1), generator(2))
    draws = generator(1)
    for seed in range(20):
        observation = np.random.default_rng(seed).standard_normal(DIMS.observation)
        noise = torch.randn((1, DIMS.action), generator=draws)
        with torch.no_grad():
            wanted, _ = agent.networks.actor.sample(torch.from_numpy(observation).float().unsqueeze(0), noise)
        action = agent.act(observation)
        assert action.dtype == np.float32
        np.testing.assert_allclose(action, wanted[0], rtol=1e-5, atol=1e-6)


def test_twins_frozen_apart_are_refused():
    networks = make_networks()
    networks.critic_1.hidden_1.requires_grad_(False)
    with pytest.raises(ValueError, match="frozen together"):
        SAC(networks, CONFIG, generator(1), generator(2))


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("core", [None, CORE], ids=["plain", "adapted"])
def test_a_restored_learner_goes_on_bit_for_bit(core, precision):
    buffer, rng = filled_buffer(), np.random.default_rng(3)
    agent, restored = make_agent(core, precision), make_agent(core, precision)

    def go_on(learner: SAC, rng: np.random.Generator) -> list[np.ndarray]:
        actions = []
        for step in range(8, 20):
            actions.append(learner.act(np.ones(DIMS.observation)))
            learner.update(buffer.sample(16, rng), step)
        return actions

    for step in range(1, 8):
        agent.act(np.zeros(DIMS.observation))
        agent.update(buffer.sample(16, rng), step)
    state, draws = copy.deepcopy(agent.state_dict()), copy.deepcopy(rng)
    straight = go_on(agent, rng)
    restored.load_state_dict(state)
    np.testing.assert_array_equal(straight, go_on(restored, draws))
    ours, theirs = agent.state_dict(), restored.state_dict()
    assert all(torch.equal(value, theirs["tensors"][name]) for name, value in ours["tensors"].items())
    assert all(torch.equal(value, theirs["generators"][name]) for name, value in ours["generators"].items())
    assert agent.metrics() == restored.metrics()


@pytest.mark.parametrize("core", [None, CORE], ids=["plain", "adapted"])
@pytest.mark.parametrize("freeze", [False, True], ids=["free", "frozen"])
@pytest.mark.parametrize("devices", [{"cpu"}, set()], ids=["numpy", "torch"])
def test_bfloat16_takes_the_steps_of_float32_but_for_its_rounding(core, freeze, devices, monkeypatch):
    monkeypatch.setattr(arrays, "NUMPY_DEVICES", devices)
    buffer, agents, frozen = filled_buffer(), [], 0
    for precision in PRECISIONS:
        networks = make_networks(core)
        for name, layer in networks.layers().items():
            layer.requires_grad_(not freeze or not name.endswith("hidden_1"))
        agents.append(SAC(networks, replace(CONFIG, precision=precision), generator(1), generator(2)))
    before = copy.deepcopy(agents[0].networks.state_dict())
    for agent in agents:
        rng = np.random.default_rng(3)
        for step in range(1, 41):
            agent.update(buffer.sample(16, rng), step)
    exact, reduced = (agent.networks.state_dict() for agent in agents)
    for name, start in before.items():
        assert reduced[name].dtype == torch.float32
        if torch.equal(start, exact[name]):
            assert torch.equal(start, reduced[name]), name
            frozen += 1
            continue
        taken, wanted = (reduced[name] - start).flatten(), (exact[name] - start).flatten()
        # 8 bits of precision: the way of 40 steps has the same direction and length, and is not the same.
        assert torch.cosine_similarity(taken, wanted, dim=0) > 0.98, name
        assert float(taken.norm() / wanted.norm()) == pytest.approx(1.0, rel=0.1), name
        assert not torch.equal(taken, wanted), name
    assert (frozen > 0) == freeze
    for name, target in agents[1].targets.state_dict().items():
        assert torch.allclose(target, agents[0].targets.state_dict()[name], atol=1e-2), name


def test_the_state_of_another_agent_is_refused():
    with pytest.raises(ValueError, match=r"another agent: actor.* differ"):
        make_agent().load_state_dict(make_agent(CORE).state_dict())


@pytest.fixture
def _restore_precision():
    yield
    torch.set_float32_matmul_precision("highest")


@pytest.mark.usefixtures("_restore_precision")
def test_products_are_float32_and_by_onednn_where_that_pays():
    assert matmul_precision.choose_products(SACConfig(hidden_sizes=[64, 64], batch_size=128)).precision == "highest"
    chosen = matmul_precision.choose_products(SACConfig())
    assert chosen.precision == torch.get_float32_matmul_precision()
    assert chosen.relative_error < matmul_precision.TOLERANCE
    assert (chosen.rejected_error is None) == (chosen.precision == "medium")


@pytest.mark.usefixtures("_restore_precision")
def test_products_that_are_not_accurate_enough_are_refused():
    with pytest.raises(RuntimeError, match="relative error"):
        matmul_precision.use_fast_float32(tolerance=1e-9)
    assert torch.get_float32_matmul_precision() == "highest"


def test_the_guard_sees_bfloat16():
    left, right = torch.randn(256, 393), torch.randn(393, 256)
    exact = left.double() @ right.double()
    rounded = (left.bfloat16() @ right.bfloat16()).double()
    assert (rounded - exact).norm() / exact.norm() > 100 * matmul_precision.TOLERANCE
    assert matmul_precision.relative_error() < matmul_precision.TOLERANCE
