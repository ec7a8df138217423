"""Adam on vectors of parameters, begun anew for each part of them that begins to learn later."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from acmr.agent.kernels.parameters import FlatParameters


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
        # The kernel takes lists of tensors; the empty one is that of AMSGrad.
        self._lists: tuple[list[Tensor], ...] = (
            [values], [gradient], [self._mean], [self._square], [], [self._steps],
        )  # fmt: skip

    @property
    def updates(self) -> int:
        """How many steps it has taken."""
        return int(self._steps)

    def step(self, share: float = 1.0) -> None:
        """Takes one step down the gradient, of this share of its size."""
        self._steps.add_(1)
        torch._fused_adam_(
            *self._lists,
            lr=self._lr * share,
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


class StagedAdam:
    """One :class:`Adam` for all that begins to learn at one environment step.

    What thaws begins without moments and without steps: its first steps are corrected, and its rate warmed up, like
    those of any parameters that begin to learn. All optimizers exist from the start, so that a state can be loaded
    before something has thawed.

    Args:
        stages: The optimizers, by the step at which they begin, ascending.
    """

    def __init__(self, stages: Mapping[float, Adam]) -> None:
        self._stages = stages
        self.thaw(0)

    @classmethod
    def of(cls, parameters: FlatParameters, lr: float) -> StagedAdam:
        """Of all parameters that learn, now or later."""
        parts = (
            (begin, (parameters.values[part], parameters.gradient[part])) for begin, part in parameters.stages.items()
        )
        return cls({begin: Adam(*tensors, lr) for begin, tensors in parts})

    def thaw(self, step: int) -> None:
        """Steps all that begins to learn by this environment step."""
        self._active = [optimizer for begin, optimizer in self._stages.items() if begin <= step]

    @property
    def updates(self) -> int:
        """How many steps the first of them has taken."""
        return next(iter(self._stages.values())).updates

    def step(self, share: Callable[[int], float] | None = None) -> None:
        """Takes one step down the gradient.

        Args:
            share: Of its size, given how many steps were taken; None: all of it.
        """
        for optimizer in self._active:
            optimizer.step(share(optimizer.updates) if share else 1.0)

    def tensors(self) -> dict[str, Tensor]:
        """All that they remember, to be copied from or into."""
        first = min(self._stages)
        return {
            name if begin == first else f"thaw_{begin}.{name}": tensor
            for begin, optimizer in self._stages.items()
            for name, tensor in optimizer.tensors().items()
        }
