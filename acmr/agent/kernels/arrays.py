"""The same arithmetic by NumPy on the CPU and by torch elsewhere, for the small arrays around matrix products.

On the CPU they are NumPy's, in the memory of torch's tensors: a call of NumPy on a few thousand numbers takes a third
of the time of torch's. Elsewhere they are tensors. Formulas that use what both have are the same text for both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

#: ``numpy.ndarray`` on the CPU, ``torch.Tensor`` elsewhere.
Array = Any

#: Devices whose memory NumPy reads. Without "cpu", the CPU runs what a GPU runs (tests do so).
NUMPY_DEVICES = {"cpu"}


def array_of(tensor: Tensor) -> Array:
    """The tensor's memory as a small array."""
    # No copy: both libraries read and write one memory, so what either of them changes the other one sees.
    return tensor.numpy() if tensor.device.type in NUMPY_DEVICES else tensor


def tensor_of(array: Array) -> Tensor:
    """The array's memory as a tensor."""
    return torch.from_numpy(array) if isinstance(array, np.ndarray) else array


def math_of(tensor: Tensor) -> Any:
    """The module with the functions of the tensor's small arrays."""
    return np if tensor.device.type in NUMPY_DEVICES else torch
