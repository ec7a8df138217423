"""Parameters of a group of networks in one vector, so that an optimizer's step is one pass over memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from acmr.agent.fine_tuning import NEVER, begin_of

#: Layers of equal shape that work side by side: by network, and within a network those that read the same input.
Group = Sequence[Sequence[nn.Linear]]

#: Blocks begin on multiples of this many numbers: 64 bytes, a cache line and a vector register of AVX-512. A product
#: on a block that begins elsewhere would load two lines for each vector. What fills the gaps is zero, and so is its
#: gradient, so that Adam leaves it zero.
_ALIGNMENT = 16


@dataclass(frozen=True)
class LayerParameters:
    """A group's parameters: (networks, in, out) and (networks, 1, out); gradients are None where frozen for good.

    The bias has a dimension of one for the batch, so that it is added to (networks, batch, out) as it is.
    """

    weight: Tensor
    bias: Tensor
    weight_gradient: Tensor | None
    bias_gradient: Tensor | None


class FlatParameters:
    """Moves the parameters of linear layers into one vector, in the order in which they begin to learn.

    The layers stay what they are: their weights become views into the vector (transposed ones, since a product reads
    (in, out)), so whoever reads or writes them reads or writes what is learned.

    Args:
        groups: The layers, in the order in which they are applied.
        like: Parameters of the same groups, whose frozen layers count as frozen here; None: those that do not
            require gradients.
        reduced: For each group whether its products are computed in bfloat16, from a copy of its parameters.
        thaws: Environment step at which layers begin to learn that do not require gradients now.

    Attributes:
        begins: Environment step at which each group begins to learn: 0, that of its layers in ``thaws``, or infinite.
        values: All parameters.
        trainable: The beginning of ``values`` that is learned, now or later.
        gradient: Gradient of ``trainable``, to be written to.
        stages: By the step at which they begin to learn, ascending: their part of ``trainable``.
        masters: The groups' parameters and gradients, as views.
        blocks: The same as products read and write them: for reduced groups views of copies in bfloat16.

    Raises:
        ValueError: If a group is frozen in part.
    """

    def __init__(
        self,
        groups: Sequence[Group],
        like: FlatParameters | None = None,
        reduced: Sequence[bool] = (),
        thaws: Mapping[nn.Module, int] | None = None,
    ) -> None:
        self.begins: list[float] = [_begin(group, thaws or {}) for group in groups] if like is None else like.begins
        reduced = reduced or [False] * len(groups)
        device, dtype = groups[0][0][0].weight.device, groups[0][0][0].weight.dtype
        sizes = [sum(_padded_sizes(group)) for group in groups]
        # Frozen parameters lie behind the end of what the optimizer steps: not even their moments exist. What begins to
        # learn at one step is one part, and begins with what is reduced, so that one copy collects its gradients.
        order = sorted(range(len(groups)), key=lambda index: (self.begins[index], not reduced[index]))
        ends = torch.tensor([0, *(sizes[index] for index in order)]).cumsum(0).tolist()
        starts = dict(zip(order, ends, strict=False))
        count = ends[sum(begin < NEVER for begin in self.begins)]
        self.stages = self._parts(sizes, [True] * len(groups)) or {0: slice(0, 0)}
        self.values = torch.zeros(ends[-1], device=device, dtype=dtype)
        self.trainable, self.gradient = self.values[:count], torch.zeros(count, device=device, dtype=dtype)
        self.masters = [self._block(group, starts[index], index) for index, group in enumerate(groups)]
        for group, block in zip(groups, self.masters, strict=True):
            _move_into(block, group)
        self.blocks, self._copies = self.masters, None
        if any(reduced):
            # Adam's steps are far smaller than bfloat16 can tell from nothing beside a weight, so it steps float32
            # masters, and products read a copy that is made anew after each step.
            low_values, low_gradient = self._copies = self.values.bfloat16(), self.gradient.bfloat16()
            self._collected = list(self._parts(sizes, reduced).values())
            self.blocks = [
                self._block(group, starts[index], index, low_values, low_gradient) if low else self.masters[index]
                for index, (group, low) in enumerate(zip(groups, reduced, strict=True))
            ]

    def refresh(self) -> None:
        """Lets products see values that have changed."""
        if self._copies:
            self._copies[0].copy_(self.values)

    def collect(self) -> None:
        """Brings gradients that reduced products have written to ``gradient``."""
        if self._copies:
            for part in self._collected:
                self.gradient[part].copy_(self._copies[1][part])

    def learning(self, step: int) -> list[bool]:
        """Whether each group learns at an environment step."""
        return [begin <= step for begin in self.begins]

    def _parts(self, sizes: Sequence[int], counted: Sequence[bool]) -> dict[float, slice]:
        """Where the groups lie that begin to learn at one step, as far as they are counted; those come first there."""
        parts, start = {}, 0
        for begin in sorted(set(self.begins) - {NEVER}):
            own = [index for index, other in enumerate(self.begins) if other == begin]
            if length := sum(sizes[index] for index in own if counted[index]):
                parts[begin] = slice(start, start + length)
            start += sum(sizes[index] for index in own)
        return parts

    def _block(self, group: Group, start: int, index: int, *vectors: Tensor) -> LayerParameters:
        networks, fan_in, fan_out = _shape(group)
        weights, _ = _padded_sizes(group)

        # Values and gradients have the same layout, so that one slice of each is what the optimizer sees.
        def views(vector: Tensor) -> tuple[Tensor, Tensor]:
            weight = vector[start : start + networks * fan_in * fan_out].view(networks, fan_in, fan_out)
            bias = vector[start + weights : start + weights + networks * fan_out].view(networks, 1, fan_out)
            return weight, bias

        values, gradient = vectors or (self.values, self.gradient)
        return LayerParameters(*views(values), *(views(gradient) if self.begins[index] < NEVER else (None, None)))


def _begin(group: Group, thaws: Mapping[nn.Module, int]) -> float:
    begins = {begin_of(layer, thaws) for layers in group for layer in layers}
    if len(begins) > 1:
        raise ValueError("layers that work side by side (both critics', mean and log_std) must be frozen together")
    return begins.pop()


def _shape(group: Group) -> tuple[int, int, int]:
    return len(group), group[0][0].in_features, sum(layer.out_features for layer in group[0])


def _padded_sizes(group: Group) -> tuple[int, int]:
    networks, fan_in, fan_out = _shape(group)
    weights, biases = networks * fan_in * fan_out, networks * fan_out
    return weights + -weights % _ALIGNMENT, biases + -biases % _ALIGNMENT


def _move_into(block: LayerParameters, group: Group) -> None:
    for network, layers in enumerate(group):
        column = 0
        for layer in layers:
            columns = slice(column, column := column + layer.out_features)
            _move(layer.weight, block.weight[network, :, columns].t())
            _move(layer.bias, block.bias[network, 0, columns])


def _move(parameter: Tensor, place: Tensor) -> None:
    # The module keeps its parameter, which from now on is this memory: whoever reads the module reads it there.
    place.copy_(parameter.data)
    parameter.data = place
