"""The fast learner against the plain one: the same weights, batches and noise give the same results."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from acmr.agent.architecture import CLAMP, TANH, Architecture, Dimensions
from acmr.agent.kernels import arrays
from acmr.agent.networks import Networks
from acmr.agent.precision import use_fast_float32
from acmr.agent.replay_buffer import Batch
from acmr.agent.sac import SAC
from acmr.agent.sac_plain import PlainSAC
from acmr.config import SACConfig, TransferConfig
from acmr.transfer.methods import Student, transfer

SOURCE, TARGET = Dimensions(45, 9), Dimensions(31, 7)
UPDATES = 200
#: Method, freeze and the student's dimensions of the paper's seven cells, and of transfer by name.
CELLS = {
    "H0": ("none", False, SOURCE),
    "H1": ("direct", False, SOURCE),
    "A0": ("none", False, TARGET),
    "A1": ("hidden", False, TARGET),
    "A2": ("hidden", True, TARGET),
    "A3": ("expand", False, TARGET),
    "A4": ("expand", True, TARGET),
    "N1": ("named", False, TARGET),
}


#: float32: relative error of each tensor's norm. float64: of each element, to the tensor's greatest.
FLOAT32_TOLERANCE, FLOAT64_TOLERANCE = 1e-4, 1e-9


@pytest.fixture(autouse=True)
def _products():
    """As a run computes: through oneDNN where that is accurate."""
    before = torch.get_float32_matmul_precision()
    use_fast_float32()
    yield
    torch.set_float32_matmul_precision(before)


@pytest.fixture
def _double():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_batch(dims: Dimensions, seed: int, size: int) -> Batch:
    g = generator(seed)
    return Batch(
        observations=torch.randn(size, dims.observation, generator=g),
        actions=torch.rand(size, dims.action, generator=g) * 0.8 - 0.4,
        rewards=torch.randn(size, generator=g),
        next_observations=torch.randn(size, dims.observation, generator=g),
        terminated=(torch.rand(size, generator=g) < 0.1).float(),
    )


def make_networks(
    cell: str, sizes: tuple[int, ...], teacher_factory: Callable, activation: str = "relu", log_std: str = TANH
) -> Networks:
    method, freeze, dims = CELLS[cell]
    high = np.full(dims.action, 0.4, np.float32)
    fresh = Networks(Architecture.plain(dims, sizes, -high, high), generator(5))
    teacher = None if method == "none" else teacher_factory(SOURCE, sizes, log_std=log_std)
    if method in ("none", "hidden"):
        # Of no teacher they take the rule over.
        fresh = fresh.with_log_std(log_std)
    config = TransferConfig(name=method, adapter_activation=activation, impute="zero")
    names = ([f"{kind}/{row}" for row in range(count)] for kind, count in
             (("obs", dims.observation), ("action", dims.action)))  # fmt: skip
    return transfer(Student(fresh, *names), teacher, config, freeze, generator(6)).networks


def assert_same_course(
    make: Callable[[], Networks], config: SACConfig, updates: int = UPDATES, thaws: dict[str, int] | None = None
) -> None:
    """Updates both learners and compares every parameter, both targets, log_alpha and the metrics.

    Rounding grows as they learn: where a gradient is almost zero, Adam's step follows its sign. The plain learner
    with MKL's products and with oneDNN's differ by up to 5e-3 at the paper's shape after 100 updates (norm), so that
    float32 is compared on smaller networks, and the paper's shape in float64, element by element.
    """
    fast, plain = (kind(make(), config, generator(1), generator(2), thaws=thaws) for kind in (SAC, PlainSAC))
    start = {name: value.clone() for name, value in plain.networks.state_dict().items()}
    for step in range(1, updates + 1):
        batch = make_batch(plain.networks.dims, step, config.batch_size)
        plain.update(batch, step)
        fast.update(batch, step)
    double = torch.get_default_dtype() == torch.float64
    for name, (got, wanted) in compared(fast, plain).items():
        order, tolerance = (torch.inf, FLOAT64_TOLERANCE) if double else (2, FLOAT32_TOLERANCE)
        error = torch.linalg.vector_norm(got - wanted, order) / torch.linalg.vector_norm(wanted, order)
        assert error < tolerance, f"{name} is off by {error:.1e}"
    frozen = {name for name, parameter in plain.networks.named_parameters() if not parameter.requires_grad}
    for name, value in fast.networks.state_dict().items():
        assert torch.equal(value, start[name]) == (name in frozen), name
    theirs = plain.metrics()
    for name, mean in fast.metrics().items():
        assert mean == pytest.approx(theirs[name], rel=1e-3, abs=1e-4, nan_ok=True), name


def compared(fast: SAC, plain: PlainSAC) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    pairs = {"log_alpha": (fast.log_alpha, plain.log_alpha.detach())}
    for part in ("networks", "targets"):
        got, wanted = (getattr(learner, part).state_dict() for learner in (fast, plain))
        assert got.keys() == wanted.keys()
        pairs |= {f"{part}.{name}": (got[name], wanted[name]) for name in got}
    return pairs


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.first_is_fast
def test_every_cell_takes_the_same_course(cell, teacher_factory):
    config = SACConfig(hidden_sizes=[64, 48], batch_size=96)
    assert_same_course(lambda: make_networks(cell, (64, 48), teacher_factory), config)


@pytest.mark.parametrize("cell", ["A0", "A3", "A4"])
@pytest.mark.parametrize("sizes", [(40,), (24, 40, 16)])
def test_any_number_of_layers(cell, sizes, teacher_factory):
    config = SACConfig(hidden_sizes=list(sizes), batch_size=33)
    assert_same_course(lambda: make_networks(cell, sizes, teacher_factory), config, updates=50)


@pytest.mark.parametrize(
    "changes",
    [
        {"autotune": False},
        {"policy_frequency": 1},
        {"policy_frequency": 3, "target_network_frequency": 2},
        {"policy_frequency": 3, "autotune": False, "tau": 1.0},
        {"batch_size": 1},
    ],
    ids=str,
)
def test_any_settings(changes, teacher_factory):
    config = SACConfig(**({"hidden_sizes": [64, 48], "batch_size": 96} | changes))
    assert_same_course(lambda: make_networks("A1", (64, 48), teacher_factory), config, updates=50)


def test_adapters_without_activation(teacher_factory):
    config = SACConfig(hidden_sizes=[64, 48], batch_size=96)
    assert_same_course(lambda: make_networks("A4", (64, 48), teacher_factory, "none"), config)


@pytest.mark.parametrize("cell", ["A0", "A2", "A3", "A4"])
@pytest.mark.parametrize("log_std", [TANH, CLAMP])
def test_the_code_path_of_a_gpu_takes_the_same_course(cell, log_std, teacher_factory, monkeypatch):
    monkeypatch.setattr(arrays, "NUMPY_DEVICES", set())
    config = SACConfig(hidden_sizes=[64, 48], batch_size=96)
    assert_same_course(lambda: make_networks(cell, (64, 48), teacher_factory, log_std=log_std), config, updates=40)


@pytest.mark.usefixtures("_double")
@pytest.mark.parametrize("cell", ["A0", "H1", "A3", "N1"])
@pytest.mark.parametrize("bias", [0.0, 4.0])
def test_a_clamped_log_std_takes_the_same_course(cell, bias, teacher_factory):
    def make() -> Networks:
        networks = make_networks(cell, (64, 48), teacher_factory, log_std=CLAMP)
        assert networks.actor.log_std_rule == networks.architecture.log_std == CLAMP
        head = networks.actor.log_std_adapter or networks.actor.log_std
        with torch.no_grad():
            # Some are far beyond a bound, where no gradient passes, some between them.
            head.bias[::3] += 3 * bias
            head.bias[1::3] -= 6 * bias
        return networks

    config = SACConfig(hidden_sizes=[64, 48], batch_size=96, kickstart=0.5, kickstart_updates=20)
    assert_same_course(make, config, updates=60)


@pytest.mark.usefixtures("_double")
@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.first_is_fast
def test_every_cell_to_the_precision_of_float64(cell, teacher_factory):
    config = SACConfig(hidden_sizes=[64, 48], batch_size=96)
    assert_same_course(lambda: make_networks(cell, (64, 48), teacher_factory), config)


@pytest.mark.usefixtures("_double")
def test_the_shape_of_the_paper_to_the_precision_of_float64():
    dims, high = Dimensions(376, 17), np.full(17, 0.4, np.float32)
    architecture = Architecture.plain(dims, (256, 256), -high, high)
    assert_same_course(lambda: Networks(architecture, generator(5)), SACConfig(), updates=20)
