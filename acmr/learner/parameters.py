"""Parameters of a group of networks in one vector, so that an optimizer's step is one pass over memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

#: Layers of equal shape that work side by side: by network, and within a network those that read the same input.
Group = Sequence[Sequence[nn.Linear]]

#: Blocks begin on multiples of this many numbers: 64 bytes, a cache line and a vector register of AVX-512.
_ALIGNMENT = 16


@dataclass(frozen=True)
class Block:
    """A group's parameters: (networks, in, out) and (networks, 1, out); gradients are None where frozen."""

    weight: Tensor
    bias: Tensor
    weight_gradient: Tensor | None
    bias_gradient: Tensor | None


class FlatParameters:
    """Moves the parameters of linear layers into one vector, the trainable ones first.

    The layers stay what they are: their weights become views into the vector (transposed ones, since a product reads
    (in, out)), so whoever reads or writes them reads or writes what is learned.

    Args:
        groups: The layers, in the order in which they are applied.
        like: Parameters of the same groups, whose frozen layers count as frozen here; None: those that do not
            require gradients.

    Attributes:
        values: All parameters.
        trainable: The beginning of ``values`` that is learned.
        gradient: Gradient of ``trainable``, to be written to.
        blocks: The groups' parameters and gradients, as views.

    Raises:
        ValueError: If a group is frozen in part.
    """

    def __init__(self, groups: Sequence[Group], like: FlatParameters | None = None) -> None:
        self.frozen: list[bool] = [_is_frozen(group) for group in groups] if like is None else like.frozen
        device, dtype = groups[0][0][0].weight.device, groups[0][0][0].weight.dtype
        sizes = [_padded_sizes(group) for group in groups]
        order = sorted(range(len(groups)), key=lambda index: self.frozen[index])
        ends = torch.tensor([0, *(sum(sizes[index]) for index in order)]).cumsum(0).tolist()
        starts = dict(zip(order, ends, strict=False))
        count = ends[sum(not frozen for frozen in self.frozen)]
        self.values = torch.zeros(ends[-1], device=device, dtype=dtype)
        self.trainable, self.gradient = self.values[:count], torch.zeros(count, device=device, dtype=dtype)
        self.blocks = [
            self._block(group, starts[index], sizes[index][0], self.frozen[index]) for index, group in enumerate(groups)
        ]

    def _block(self, group: Group, start: int, weights: int, frozen: bool) -> Block:
        networks, fan_in, fan_out = _shape(group)

        def views(vector: Tensor) -> tuple[Tensor, Tensor]:
            weight = vector[start : start + networks * fan_in * fan_out].view(networks, fan_in, fan_out)
            bias = vector[start + weights : start + weights + networks * fan_out].view(networks, 1, fan_out)
            return weight, bias

        weight, bias = views(self.values)
        for network, layers in enumerate(group):
            column = 0
            for layer in layers:
                columns = slice(column, column := column + layer.out_features)
                _move(layer.weight, weight[network, :, columns].t())
                _move(layer.bias, bias[network, 0, columns])
        return Block(weight, bias, *((None, None) if frozen else views(self.gradient)))


class Adam:
    """Adam (Kingma and Ba 2015) with PyTorch's defaults, on one vector.

    Calls the kernel of ``torch.optim.Adam(fused=True)`` itself: the optimizer's bookkeeping around it takes longer
    than a small network's step.

    Args:
        values: What it steps.
        gradient: Gradient of ``values``, read at each step.
        lr: Step size.
    """

    def __init__(self, values: Tensor, gradient: Tensor, lr: float) -> None:
        self._mean, self._square = torch.zeros_like(values), torch.zeros_like(values)
        self._steps, self._lr = torch.zeros((), device=values.device), lr
        self._lists: tuple[list[Tensor], ...] = (
            [values], [gradient], [self._mean], [self._square], [], [self._steps],
        )  # fmt: skip

    def step(self) -> None:
        """Takes one step down the gradient."""
        self._steps.add_(1)
        torch._fused_adam_(
            *self._lists,
            lr=self._lr,
            beta1=0.9,
            beta2=0.999,
            weight_decay=0.0,
            eps=1e-8,
            amsgrad=False,
            maximize=False,
        )

    def tensors(self) -> dict[str, Tensor]:
        """All that it remembers, to be copied from or into."""
        return {"mean": self._mean, "square": self._square, "steps": self._steps}


def _is_frozen(group: Group) -> bool:
    learns = {parameter.requires_grad for layers in group for layer in layers for parameter in layer.parameters()}
    if len(learns) > 1:
        raise ValueError("layers that work side by side (both critics', mean and log_std) must be frozen together")
    return not learns.pop()


def _shape(group: Group) -> tuple[int, int, int]:
    return len(group), group[0][0].in_features, sum(layer.out_features for layer in group[0])


def _padded_sizes(group: Group) -> tuple[int, int]:
    networks, fan_in, fan_out = _shape(group)
    weights, biases = networks * fan_in * fan_out, networks * fan_out
    return weights + -weights % _ALIGNMENT, biases + -biases % _ALIGNMENT


def _move(parameter: Tensor, place: Tensor) -> None:
    place.copy_(parameter.data)
    parameter.data = place
