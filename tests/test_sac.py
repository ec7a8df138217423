"""SAC against an independent calculation, and what freezing and determinism promise."""

import copy

import numpy as np
import pytest
import torch

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.learner import METRIC_NAMES
from acmr.agent.networks import Networks
from acmr.agent.replay_buffer import Batch
from acmr.agent.sac import SAC
from acmr.config import SACConfig, TransferConfig
from acmr.transfer.methods import Student, transfer

DIMS, TEACHER_DIMS = Dimensions(6, 2), Dimensions(9, 4)
LOW, HIGH = np.full(2, -0.5, np.float32), np.full(2, 1.5, np.float32)
CONFIG = SACConfig(hidden_sizes=[16, 12], batch_size=32, q_lr=1e-3, policy_lr=3e-4)
CONFIGURATIONS = [
    ("none", False), ("direct", False), ("hidden", False), ("hidden", True), ("expand", False), ("expand", True),
]  # fmt: skip


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_batch(seed: int, size: int = 32) -> Batch:
    g = generator(seed)
    return Batch(
        observations=torch.randn(size, DIMS.observation, generator=g),
        actions=torch.rand(size, DIMS.action, generator=g) * 2 - 0.5,
        rewards=torch.randn(size, generator=g),
        next_observations=torch.randn(size, DIMS.observation, generator=g),
        terminated=(torch.rand(size, generator=g) < 0.2).float(),
    )


def make_agent(networks: Networks, config: SACConfig = CONFIG) -> SAC:
    return SAC(networks, config, generator(10), generator(11))


def fresh(seed: int = 0, sizes: tuple[int, ...] = (16, 12)) -> Networks:
    return Networks(Architecture.plain(DIMS, sizes, LOW, HIGH), generator(seed))


def linear(params: dict, name: str, inputs: torch.Tensor) -> torch.Tensor:
    return inputs @ params[f"{name}.weight"].T + params[f"{name}.bias"]


def policy(params: dict, observations: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    hidden = torch.relu(linear(params, "actor.input", observations))
    hidden = torch.relu(linear(params, "actor.hidden_1", hidden))
    mean = linear(params, "actor.mean", hidden)
    std = torch.exp(-5 + 3.5 * (torch.tanh(linear(params, "actor.log_std", hidden)) + 1))
    x = mean + std * noise
    density = torch.distributions.Normal(mean, std).log_prob(x) - torch.log(1.0 * (1 - torch.tanh(x) ** 2) + 1e-6)
    return torch.tanh(x) * 1.0 + 0.5, density.sum(1)


def q_value(params: dict, name: str, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    hidden = torch.relu(linear(params, f"{name}.input", torch.cat((observations, actions), 1)))
    return linear(params, f"{name}.output", torch.relu(linear(params, f"{name}.hidden_1", hidden)))[:, 0]


def first_adam_step(params: dict, loss: torch.Tensor, prefix: str, lr: float) -> dict:
    """Adam's first step in closed form: both bias corrections cancel, p - lr * g / (|g| + 1e-8)."""
    names = [name for name in params if name.startswith(prefix)]
    gradients = torch.autograd.grad(loss, [params[name] for name in names])
    stepped = {
        name: (params[name] - lr * g / (g.abs() + 1e-8)).detach().requires_grad_()
        for name, g in zip(names, gradients, strict=True)
    }
    return params | stepped


def test_first_update_equals_the_formulas():
    networks, batch = fresh(), make_batch(1)
    params = {name: value.detach().double().requires_grad_() for name, value in networks.state_dict().items()}
    targets = {name: value.detach().clone() for name, value in params.items()}
    agent = make_agent(networks, SACConfig(hidden_sizes=[16, 12], batch_size=32, policy_frequency=1))
    draws = generator(11)
    noise = [torch.randn(32, 2, generator=draws).double() for _ in range(3)]
    agent.update(batch, global_step=1)

    b = Batch(*(column.double() for column in vars(batch).values()))
    with torch.no_grad():
        actions, log_prob = policy(params, b.next_observations, noise[0])
        q_next = torch.minimum(*(q_value(targets, f"critic_{i}", b.next_observations, actions) for i in (1, 2)))
        y = b.rewards + 0.99 * (1 - b.terminated) * (q_next - 1.0 * log_prob)
    loss = sum(((q_value(params, f"critic_{i}", b.observations, b.actions) - y) ** 2).mean() for i in (1, 2))
    params = first_adam_step(params, loss, "critic_", 1e-3)
    actions, log_prob = policy(params, b.observations, noise[1])
    q_pi = torch.minimum(*(q_value(params, f"critic_{i}", b.observations, actions) for i in (1, 2)))
    params = first_adam_step(params, (1.0 * log_prob - q_pi).mean(), "actor.", 3e-4)
    _, log_prob = policy(params, b.observations, noise[2])
    gradient = -(log_prob.detach() - 2.0).mean()  # d/d log_alpha of -alpha (log_prob + target entropy), alpha = 1
    log_alpha = -1e-3 * torch.sign(gradient)

    for name, value in agent.networks.state_dict().items():
        torch.testing.assert_close(value.double(), params[name].detach(), rtol=1e-4, atol=2e-6, msg=name)
    assert agent.log_alpha.item() == pytest.approx(log_alpha.item(), rel=1e-4)
    for index, target in enumerate(agent.targets, start=1):
        for name, value in target.state_dict().items():
            key = f"critic_{index}.{name}"
            expected = 0.995 * targets[key] + 0.005 * params[key]
            torch.testing.assert_close(value.double(), expected.detach(), rtol=1e-4, atol=1e-6)


def student(method: str, freeze: bool, teacher_factory) -> tuple[Networks, list[str]]:
    dims = DIMS if method == "direct" else TEACHER_DIMS
    teacher = None if method == "none" else teacher_factory(dims, (16, 12))
    taker = Student(fresh(5), [], [])
    made = transfer(taker, teacher, TransferConfig(name=method), freeze, generator(6))
    return made.networks, made.report.frozen


@pytest.mark.parametrize(("method", "freeze"), CONFIGURATIONS)
def test_frozen_layers_and_their_target_twins_never_move(method, freeze, teacher_factory):
    networks, frozen = student(method, freeze, teacher_factory)
    agent = make_agent(networks)
    before = copy.deepcopy(agent.networks.state_dict())
    targets_before = copy.deepcopy(agent.targets.state_dict())
    for step in range(1, 201):
        agent.update(make_batch(step), step)
    assert bool(frozen) == freeze
    for layer in agent.networks.layers():
        moved = not torch.equal(agent.networks.state_dict()[f"{layer}.weight"], before[f"{layer}.weight"])
        assert moved == (layer not in frozen), layer
        if layer.startswith("critic_"):
            index, name = int(layer[7]) - 1, layer.split(".")[1]
            key = f"{index}.{name}.weight"
            assert (not torch.equal(agent.targets.state_dict()[key], targets_before[key])) == (layer not in frozen)


def test_targets_start_equal_to_the_transferred_critics(teacher_factory):
    networks, _ = student("expand", True, teacher_factory)
    agent = make_agent(networks)
    for critic, target in zip(agent.networks.critics, agent.targets, strict=True):
        for name, value in critic.state_dict().items():
            assert torch.equal(value, target.state_dict()[name])


def test_same_seed_same_bytes():
    agents = [make_agent(fresh()) for _ in range(2)]
    for agent in agents:
        for step in range(1, 31):
            agent.update(make_batch(step), step)
            agent.act(np.ones(6))
    first, second = (agent.networks.state_dict() for agent in agents)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert agents[0].metrics() == agents[1].metrics()


def test_fixed_temperature_stays():
    agent = make_agent(fresh(), SACConfig(hidden_sizes=[16, 12], autotune=False, alpha=0.2))
    for step in range(1, 11):
        agent.update(make_batch(step), step)
    assert agent.log_alpha.exp().item() == pytest.approx(0.2)


def test_temperature_falls_while_entropy_exceeds_its_target():
    agent = make_agent(fresh())
    for step in range(1, 51):
        agent.update(make_batch(step), step)
    assert agent.log_alpha.item() < 0
    assert agent.metrics()["entropy"] > agent.target_entropy


def test_metrics_are_means_since_they_were_last_asked_for():
    agent = make_agent(fresh())
    agent.update(make_batch(1), 1)
    first = agent.metrics()
    assert set(first) == set(METRIC_NAMES)
    assert np.isfinite(first["critic_loss"])
    assert np.isnan(first["actor_loss"])  # the actor waits for the second step
    agent.update(make_batch(2), 2)
    assert np.isfinite(list(agent.metrics().values())).all()
    assert np.isnan(list(agent.metrics().values())).all()


def test_actions_are_sampled_within_bounds_and_do_not_touch_the_learning_noise():
    agents = [make_agent(fresh()) for _ in range(2)]
    actions = np.stack([agents[0].act(np.zeros(6)) for _ in range(200)])
    assert ((actions >= LOW) & (actions <= HIGH)).all()
    assert actions.std() > 0.1
    for agent in agents:
        agent.update(make_batch(1), 1)
    assert torch.equal(agents[0].networks.critic_1.input.weight, agents[1].networks.critic_1.input.weight)
