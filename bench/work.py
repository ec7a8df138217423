"""The matrix products that one training step cannot do without, counted from the networks, and how fast they run."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from dataclasses import dataclass

import torch

from acmr.agent.networks import Networks, Trunk

#: Optimizer, target update: bytes read and written for each parameter that learns (values, gradient, two moments).
ADAM_BYTES, POLYAK_BYTES = 4 * 7, 4 * 3


@dataclass(frozen=True)
class Product:
    """(rows, inner) times (inner, columns)."""

    rows: int
    inner: int
    columns: int

    @property
    def flops(self) -> int:
        return 2 * self.rows * self.inner * self.columns


#: How often each product occurs in a training step, on average.
Work = dict[Product, float]


@dataclass(frozen=True)
class Layer:
    """Inputs, outputs, whether it learns, and how many such layers work side by side on inputs of their own."""

    fan_in: int
    fan_out: int
    learns: bool
    twins: int = 1


def _layers(network: Trunk) -> list[Layer]:
    """Layers in their order; mean and log_std, which read the same, are one."""
    named = dict(network.layers())

    def layer(name: str, width: int = 1, twins: int = 1) -> Layer:
        found = named[name]
        return Layer(found.in_features, found.out_features * width, found.weight.requires_grad, twins)

    trunk = [layer(name) for name in named if not name.startswith(("mean", "log_std"))]
    heads = [layer("mean", width=2)] if "mean" in named else []
    adapters = [layer("mean_adapter", twins=2)] if "mean_adapter" in named else []
    return trunk + heads + adapters


def _forward(network: Trunk, batch: int) -> list[Product]:
    return [Product(batch, each.fan_in, each.fan_out) for each in _layers(network) for _ in range(each.twins)]


def _backward(network: Trunk, batch: int, parameters: bool, down_to_input: bool) -> list[Product]:
    """Products of the way back: weights that learn, and inputs as far down as somebody needs them."""
    layers, found = _layers(network), []
    learning = [index for index, each in enumerate(layers) if each.learns and parameters]
    lowest = 0 if down_to_input else min(learning, default=len(layers))
    for index, each in enumerate(layers):
        if index in learning:
            found += each.twins * [Product(each.fan_in, batch, each.fan_out)]
        if index > lowest:
            found += each.twins * [Product(batch, each.fan_out, each.fan_in)]
    return found


def step_work(networks: Networks, batch: int, policy_frequency: int = 2, autotune: bool = True) -> Work:
    """Everything that a step must multiply when nothing is computed twice (docs/performance.md)."""
    actor, critic = networks.actor, networks.critic_1
    sensors, actions = networks.dims.observation, networks.dims.action
    first = _layers(critic)[0].fan_out
    # The critics' update: the policy, both targets, both critics and their way back.
    every = _forward(actor, batch) + 4 * _forward(critic, batch)
    every += 2 * _backward(critic, batch, parameters=True, down_to_input=False)
    # The actor's updates on one batch: the policy before each of them and after the last, the critics' first layer
    # for the observations once, then for each update the rest of the critics, their way back, and the actor's.
    due = (policy_frequency + autotune) * _forward(actor, batch) + 2 * [Product(batch, sensors, first)]
    critics = [Product(batch, actions, first), *_forward(critic, batch)[1:]]
    critics += [*_backward(critic, batch, parameters=False, down_to_input=True), Product(batch, first, actions)]
    due += policy_frequency * (2 * critics + _backward(actor, batch, parameters=True, down_to_input=False))
    often, seldom = Counter(every), Counter(due)
    return {product: often[product] + seldom[product] / policy_frequency for product in often | seldom}


def flops(work: Work) -> float:
    """Floating-point operations of a step's products."""
    return sum(product.flops * count for product, count in work.items())


def bytes_of_step(networks: Networks, batch: int) -> int:
    """Bytes that optimizer, target update and the gathering of a batch must move in a step."""
    learning = dict.fromkeys(("actor", "critic"), 0)
    for name, parameter in networks.named_parameters():
        if parameter.requires_grad:
            learning[name.split("_")[0].split(".")[0]] += parameter.numel()
    gathered = 2 * 4 * batch * (2 * networks.dims.observation + networks.dims.action)
    return sum(learning.values()) * ADAM_BYTES + learning["critic"] * POLYAK_BYTES + gathered


class ProductTimer:
    """Runs a step's products alone, each on memory of its own, as fast as torch runs them here."""

    def __init__(self, work: Work, dtype: torch.dtype = torch.float32) -> None:
        # Products with one column are sums, no matrix products: counted as work, but not timed as such.
        self._counts = {product: count for product, count in work.items() if min(product.columns, product.inner) > 1}
        self._operands = {
            product: (
                torch.randn(product.rows, product.inner).to(dtype),
                torch.randn(product.inner, product.columns).to(dtype),
                torch.empty(product.rows, product.columns, dtype=dtype),
            )
            for product in self._counts
        }

    def seconds(self, steps: int = 6) -> float:
        """CPU time of one step's products.

        Shapes take turns, so that operands come from where they are in a real step: the second and third level cache.
        """
        left = {product: round(count * steps) for product, count in self._counts.items()}
        turns = []
        while any(left.values()):
            for product in [product for product, count in left.items() if count]:
                left[product] -= 1
                turns.append(self._operands[product])
        began = time.process_time()
        for first, second, out in turns:
            torch.mm(first, second, out=out)
        return (time.process_time() - began) / steps

    def rates(self, repeats: int = 40, rounds: int = 5) -> dict[str, float]:
        """GFLOP/s of each shape, as the median of some rounds."""
        found = {}
        for product in self._counts:
            left, right, out = self._operands[product]
            times = []
            for _ in range(rounds):
                began = time.process_time()
                for _ in range(repeats):
                    torch.mm(left, right, out=out)
                times.append((time.process_time() - began) / repeats)
            name = f"{product.rows}x{product.inner} {product.inner}x{product.columns}"
            found[name] = product.flops / statistics.median(times) / 1e9
        return found
