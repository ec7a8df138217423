"""How float32 products are computed: by oneDNN where that is still float32, as the settings promise.

On AMD processors torch's default, MKL, runs at half of oneDNN's rate or less. ``torch.set_float32_matmul_precision``
sends products to oneDNN, but also allows it to compute in bfloat16, which it does on processors with AMX. Whether it
does here is measured, not guessed.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from acmr.config import SACConfig

#: Relative error (Frobenius norm) that float32 products stay far below: they have about 3e-7, bfloat16 has 3e-3.
TOLERANCE = 5e-6
#: Multiplications in one hidden layer's product from which oneDNN is worth its 20 microseconds a call (measured).
_WORTHWHILE = 4_000_000
#: Batch, inputs, outputs: the products of the paper's networks, their gradients, and narrow ones.
_SHAPES = ((256, 393, 256), (256, 256, 256), (393, 256, 256), (256, 17, 256), (256, 256, 34), (128, 64, 64))


@dataclass(frozen=True)
class MatmulPrecision:
    """What was found and chosen, as a run records it.

    Attributes:
        precision: torch's name of the setting: ``medium`` (oneDNN) or ``highest`` (torch's default library).
        relative_error: Greatest relative error against float64 of the products as they are computed now.
        rejected_error: That of ``medium`` where it was not float32, else None.
    """

    precision: str
    relative_error: float
    rejected_error: float | None = None


def choose_products(agent: SACConfig, device: str = "cpu") -> MatmulPrecision:
    """Chooses how the whole process computes float32 products: oneDNN where it pays and is accurate.

    The choice rests on the networks' size and on accuracy, never on timing, so that a machine always makes the same
    one for the same settings.

    Args:
        agent: Network sizes and batch size.
        device: Where the learner computes; on anything but the CPU the setting would allow lower precision.

    Raises:
        RuntimeError: If even the default products are not accurate to float32.
    """
    widest = sorted(agent.hidden_sizes)[-2:]
    worthwhile = agent.batch_size * widest[0] * widest[-1] >= _WORTHWHILE
    return use_fast_float32() if worthwhile and device == "cpu" else _use_default(device)


def use_fast_float32(tolerance: float = TOLERANCE) -> MatmulPrecision:
    """Sends the products of the whole process to oneDNN, unless it would leave float32 here.

    Args:
        tolerance: Relative error above which the default library is used.

    Raises:
        RuntimeError: If even the default products are less accurate than that.
    """
    # The setting alone does not say what a processor makes of it; its results do.
    torch.set_float32_matmul_precision("medium")
    error = relative_error()
    return MatmulPrecision("medium", error) if error <= tolerance else _use_default("cpu", tolerance, error)


def _use_default(device: str, tolerance: float = TOLERANCE, rejected: float | None = None) -> MatmulPrecision:
    torch.set_float32_matmul_precision("highest")
    error = relative_error(device)
    if error > tolerance:
        raise RuntimeError(f"float32 matrix products have a relative error of {error:.1e} on {device}")
    return MatmulPrecision("highest", error, rejected)


def relative_error(device: str = "cpu") -> float:
    """Greatest relative error of float32 products against float64, over the shapes and layouts of the learner."""
    generator = torch.Generator().manual_seed(0)
    worst = 0.0
    for rows, inner, columns in _SHAPES:
        left = torch.randn(2, rows, inner, generator=generator).to(device)
        right = torch.randn(2, inner, columns, generator=generator).to(device)
        exact = left.double() @ right.double()
        # Libraries choose another kernel for transposed operands, as gradients have them, and for batched ones.
        for first, second in (
            (left, right),
            (left.mT.contiguous().mT, right),
            (left, right.mT.contiguous().mT),
        ):
            for product in (
                torch.bmm(first, second),
                torch.stack([torch.mm(a, b) for a, b in zip(first, second, strict=True)]),
            ):
                worst = max(worst, float((product.double() - exact).norm() / exact.norm()))
    return worst
