"""Forward and backward passes of networks that run side by side, written out, in memory that is allocated once.

A product of a batch of 256 with a layer of 256 takes 0.3 ms of a core, and every other call, however small, some
microseconds, because the product has emptied the caches. So nothing here copies, allocates, makes a view or computes
a gradient that could have been made before or that nobody asks for. ``tests/test_learner.py`` holds the passes against
autograd.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from acmr.agent.kernels.arrays import Array, array_of, math_of
from acmr.agent.kernels.parameters import LayerParameters

# The operation that autograd itself calls for ReLU; torch offers no public form that writes to memory of one's own.
_relu_backward = torch.ops.aten.threshold_backward.grad_input


class Activations:
    """One layer's part of the memory of a pass.

    Attributes:
        output: (networks, batch, out).
        gradient: Gradient of ``output``; on the way back it becomes that of the sums before the activation.
        outputs: ``output`` by network.
        gradients: ``gradient`` by network.
        inputs: Output of the layer below as this one reads it, (networks, batch, in); empty for the first layer.
        inputs_transposed: (networks, in, batch).
        input_gradient: Gradient of the layer below as this one writes it.
    """

    def __init__(self, layer: Dense, batch_size: int, below: Activations | None) -> None:
        self.output = layer.weight.new_zeros(layer.networks, batch_size, layer.fan_out)
        self.gradient = torch.zeros_like(self.output)
        # Views by network, made once: made in each pass, they and the transposes would cost 3% of an update.
        self.outputs, self.gradients = list(self.output), list(self.gradient)
        read = written = self.output.new_empty(0, 0, 0)
        self._below = None
        if below:
            read, written = below.output, below.gradient
            # Where bfloat16 ends: the heads are in float32, since a Q value rounded to 8 bits would say little.
            if below.output.dtype != self.output.dtype:
                read, written = (torch.zeros_like(tensor, dtype=self.output.dtype) for tensor in (read, written))
                self._below = (below.output, below.gradient, read, written)
            # Mean and log_std come from one product side by side, and their adapters read one half each.
            read, written = columns(read, layer.networks), columns(written, layer.networks)
        self.inputs, self.input_gradient = read, written
        self.inputs_transposed = self.inputs.transpose(1, 2)
        # Of a layer with one output, by network: inputs (batch, in), output and its gradient (batch,).
        self.vectors: list[tuple[Array, Array, Array]] = []
        if below and layer.fan_out == 1:
            self.vectors = [
                (array_of(inputs), array_of(output[:, 0]), array_of(gradient[:, 0]))
                for inputs, output, gradient in zip(self.inputs, self.output, self.gradient, strict=True)
            ]

    def fetch(self) -> None:
        """Brings the output of a layer below that has another precision to ``inputs``."""
        if self._below:
            output, _, read, _ = self._below
            read.copy_(output)

    def hand_down(self) -> None:
        """Brings ``input_gradient`` to a layer below that has another precision."""
        if self._below:
            _, gradient, _, written = self._below
            gradient.copy_(written)


def columns(tensor: Tensor, parts: int) -> Tensor:
    """Views (1, batch, parts * width) as (parts, batch, width); what has that shape already stays as it is."""
    if len(tensor) == parts:
        return tensor
    return tensor[0].view(tensor.shape[1], parts, -1).transpose(0, 1)


class Dense:
    """One linear layer of each network, maybe followed by ReLU.

    The first layer of a stack reads one input, (batch, in), for all networks. It may be columns of a wider tensor:
    torch's single products take it as it is, while batched ones would copy it first.
    """

    def __init__(self, block: LayerParameters, relu: bool) -> None:
        self.weight, self.bias, self.relu = block.weight, block.bias, relu
        self.networks, self.fan_in, self.fan_out = block.weight.shape
        # Weights lie as (in, out), so that a batch times a weight reads both operands row by row.
        self._transposed, self._weights = block.weight.transpose(1, 2), list(block.weight)
        self.learns = block.weight_gradient is not None
        if block.weight_gradient is not None and block.bias_gradient is not None:
            self._weight_gradient, self._bias_gradient = block.weight_gradient, block.bias_gradient
            self._weight_gradients = list(block.weight_gradient)

    def forward(self, activations: Activations) -> None:
        """Writes the output."""
        activations.fetch()
        # Both critics in one call: one after the other takes 6% longer (docs/performance.md).
        torch.bmm(activations.inputs, self.weight, out=activations.output)
        self.finish(activations.output)

    def forward_shared(self, inputs: Tensor, activations: Activations) -> None:
        """Writes the output for inputs (batch, in) that all networks read."""
        # A batched product would first copy the inputs, the largest operand there is, since it shares none.
        for weight, output in zip(self._weights, activations.outputs, strict=True):
            torch.mm(inputs, weight, out=output)
        self.finish(activations.output)

    def finish(self, output: Tensor) -> None:
        """Turns products with the weights into the output."""
        output.add_(self.bias)
        if self.relu:
            output.relu_()

    def through_activation(self, activations: Activations) -> None:
        """Takes the gradient of the output to that of the sum before the activation."""
        if self.relu:
            # ReLU passes a gradient on where its output is above 0: the sum before it need not be kept.
            _relu_backward(activations.gradient, activations.output, 0.0, grad_input=activations.gradient)

    def parameter_gradients(self, activations: Activations) -> None:
        """Writes the gradients of weight and bias."""
        # With y = x W + b: dW = x^T dy and db = the sum of dy over the batch.
        torch.bmm(activations.inputs_transposed, activations.gradient, out=self._weight_gradient)
        torch.sum(activations.gradient, dim=1, keepdim=True, out=self._bias_gradient)

    def parameter_gradients_shared(self, inputs: Tensor, activations: Activations) -> None:
        """The same where all networks read these inputs, (batch, in)."""
        transposed = inputs.t()
        for gradient, of_weight in zip(activations.gradients, self._weight_gradients, strict=True):
            torch.mm(transposed, gradient, out=of_weight)
        torch.sum(activations.gradient, dim=1, keepdim=True, out=self._bias_gradient)

    def input_gradient(self, activations: Activations) -> None:
        """Writes the gradient of the inputs."""
        # dx = dy W^T, with the transposed view of the weights, which a product takes without a copy.
        torch.bmm(activations.gradient, self._transposed, out=activations.input_gradient)
        activations.hand_down()


class Scalar(Dense):
    """A layer with one output above others: its products are of a matrix and a vector."""

    def __init__(self, block: LayerParameters, relu: bool) -> None:
        super().__init__(block, relu)
        # A product with one column has no use of the kernels for matrices; NumPy's call is cheaper than torch's.
        self._math = math_of(block.weight)
        self._vectors = [array_of(weight[:, 0]) for weight in block.weight]
        if self.learns:
            self._vector_gradients = [array_of(gradient[:, 0]) for gradient in self._weight_gradient]

    def forward(self, activations: Activations) -> None:
        """Writes the output."""
        activations.fetch()
        for vector, (inputs, output, _) in zip(self._vectors, activations.vectors, strict=True):
            self._math.matmul(inputs, vector, out=output)
        self.finish(activations.output)

    def parameter_gradients(self, activations: Activations) -> None:
        """Writes the gradients of weight and bias."""
        for of_vector, (inputs, _, gradient) in zip(self._vector_gradients, activations.vectors, strict=True):
            self._math.matmul(inputs.T, gradient, out=of_vector)
        torch.sum(activations.gradient, dim=1, keepdim=True, out=self._bias_gradient)

    def input_gradient(self, activations: Activations) -> None:
        """Writes the gradient of the inputs."""
        # (batch, 1) times (1, in) is an outer product: no sums, so a plain multiplication with broadcasting.
        torch.mul(activations.gradient, self._transposed, out=activations.input_gradient)
        activations.hand_down()


class Stack:
    """Layers applied one after the other.

    Args:
        blocks: Parameters of each layer.
        relus: Whether ReLU follows it.
    """

    def __init__(self, blocks: Sequence[LayerParameters], relus: Sequence[bool]) -> None:
        # The first layer reads what no activations hold, so it is never the special case of one output.
        kinds = [Dense, *(Scalar if block.weight.shape[2] == 1 else Dense for block in blocks[1:])]
        self.layers = [kind(block, relu) for kind, block, relu in zip(kinds, blocks, relus, strict=True)]
        self.let_learn([layer.learns for layer in self.layers])

    def let_learn(self, learning: Sequence[bool]) -> None:
        """Says which layers learn; none can that has no gradient."""
        for layer, learns in zip(self.layers, learning, strict=True):
            layer.learns = learns
        # Below the lowest layer that learns nobody asks for a gradient: frozen cells end their way back there.
        self._lowest_learning = learning.index(True) if any(learning) else len(self.layers)

    def allocate(self, batch_size: int) -> list[Activations]:
        """Memory for passes of batches of one size, by layer."""
        activations: list[Activations] = []
        for layer in self.layers:
            activations.append(Activations(layer, batch_size, activations[-1] if activations else None))
        return activations

    def forward(self, inputs: Tensor, activations: Sequence[Activations]) -> Tensor:
        """Output of the last layer for inputs (batch, in) that all networks read."""
        self.layers[0].forward_shared(inputs, activations[0])
        return self.upper_layers(activations)

    def upper_layers(self, activations: Sequence[Activations]) -> Tensor:
        """Output of the last layer, given that of the first."""
        for layer, own in zip(self.layers[1:], activations[1:], strict=True):
            layer.forward(own)
        return activations[-1].output

    def backward(self, inputs: Tensor, activations: Sequence[Activations]) -> None:
        """Writes the gradients of all parameters that learn, given that of the output in the last activations."""
        for index in range(len(self.layers) - 1, self._lowest_learning - 1, -1):
            layer, own = self.layers[index], activations[index]
            layer.through_activation(own)
            # A frozen layer hands the gradient down to those below it and computes none of its own.
            if layer.learns and index:
                layer.parameter_gradients(own)
            elif layer.learns:
                layer.parameter_gradients_shared(inputs, own)
            if index > self._lowest_learning:
                layer.input_gradient(own)

    def backward_to_first(self, activations: Sequence[Activations]) -> None:
        """Leaves the gradient of the first layer's sums in its activations, and those of the parameters as they are."""
        for index in range(len(self.layers) - 1, -1, -1):
            # The actor's update asks how values change with actions and changes no critic: without the gradients of
            # their weights an update takes 1 / 1.15 of the time.
            layer, own = self.layers[index], activations[index]
            layer.through_activation(own)
            if index:
                layer.input_gradient(own)


class CriticStack(Stack):
    """Critics, whose first layer sees observation and action side by side.

    In the actor's updates on one batch only the actions change, so the observations' part of the first layer is
    computed once.

    Args:
        blocks: Parameters of each layer.
        relus: Whether ReLU follows it.
        observation_dim: How many of the first layer's inputs are the observation.
    """

    def __init__(self, blocks: Sequence[LayerParameters], relus: Sequence[bool], observation_dim: int) -> None:
        super().__init__(blocks, relus)
        weight = blocks[0].weight
        # [s, a] W = s W_s + a W_a: the upper rows of the weight belong to the observation, the others to the action.
        self._of_observations = list(weight[:, :observation_dim])
        self._of_actions = list(weight[:, observation_dim:])
        self._of_actions_transposed = [part.t() for part in self._of_actions]
        self._shared: list[Tensor] = []

    def share(self, observations: Tensor) -> None:
        """Remembers the first layer's sums for these observations, (batch, observation), without the actions."""
        if not self._shared or len(self._shared[0]) != len(observations):
            first = self.layers[0]
            self._shared = list(first.weight.new_zeros(first.networks, len(observations), first.fan_out))
        for weight, bias, sums in zip(self._of_observations, self.layers[0].bias, self._shared, strict=True):
            torch.addmm(bias, observations, weight, out=sums)

    def forward_actions(self, actions: Tensor, activations: Sequence[Activations]) -> Tensor:
        """Values, (networks, batch, 1), of actions (batch, action) at the observations that were shared."""
        # The sums for the observations are kept: addmm writes shared + a W_a elsewhere.
        actions = actions.to(self.layers[0].weight.dtype)
        for shared, weight, sums in zip(self._shared, self._of_actions, activations[0].outputs, strict=True):
            torch.addmm(shared, actions, weight, out=sums)
        if self.layers[0].relu:
            activations[0].output.relu_()
        return self.upper_layers(activations)

    def action_gradient(self, activations: Sequence[Activations]) -> Tensor:
        """Gradient of the actions, (batch, action), given that of the values in the last activations."""
        self.backward_to_first(activations)
        # Both critics read the same actions, so their gradients add up (one of them is zero in each row).
        (first, *others), (weight, *weights) = activations[0].gradients, self._of_actions_transposed
        gradient = torch.mm(first, weight)
        for of_network, weight in zip(others, weights, strict=True):
            torch.addmm(gradient, of_network, weight, out=gradient)
        return gradient.to(activations[-1].gradient.dtype)
