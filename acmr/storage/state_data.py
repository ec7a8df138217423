"""The state of a part as data: what JSON holds, and arrays that are named by their place in it."""

from __future__ import annotations

import copy
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
import torch

from acmr.stateful import State

#: How the name of an array begins: with the library that it comes from and goes back to.
_NUMPY, _TORCH = "numpy", "torch"


def split(state: State, path: str = "") -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Takes a state apart into what JSON holds and arrays, which are named by their place in it.

    Raises:
        TypeError: If it holds anything that a file would not give back as it is.
    """
    values: dict[str, Any] = {}
    arrays: dict[str, np.ndarray] = {}
    for key, leaf in state.items():
        if type(key) is not str:
            raise TypeError(f"state{path}: the key {key!r} is no text")
        # Quoted, for a name may hold the slash that parts names.
        place = f"{path}/{quote(key, safe='')}"
        if isinstance(leaf, dict):
            values[key], inner = split(leaf, place)
            arrays |= inner
        elif isinstance(leaf, np.ndarray) and leaf.dtype.kind in "biuf":
            arrays[_NUMPY + place] = leaf
        elif isinstance(leaf, torch.Tensor):
            arrays[_TORCH + place] = leaf.detach().cpu().numpy()
        elif _is_plain(leaf):
            values[key] = leaf
        else:
            raise TypeError(
                f"state{place}: a {type(leaf).__name__} cannot be stored; give a number, a text or an array"
            )
    return values, arrays


def join(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> State:
    """Reverses :func:`split`; every array is a copy."""
    state = copy.deepcopy(values)
    for name, array in arrays.items():
        kind, *groups, last = (unquote(part) for part in name.split("/"))
        group = state
        for inner in groups:
            group = group[inner]
        if last in group:
            raise ValueError(f"two values at {name}")
        # What was read from a file cannot be written to, and parts do write to it.
        group[last] = torch.from_numpy(array.copy()) if kind == _TORCH else array.copy()
    return state


def as_json(state: State) -> dict[str, Any]:
    """A small state as JSON holds it, its arrays as lists of numbers; each number comes back as it was.

    Raises:
        TypeError: As :func:`split`.
    """
    values, arrays = split(state)
    told = {
        name: {"dtype": str(array.dtype), "shape": list(array.shape), "data": array.ravel().tolist()}
        for name, array in arrays.items()
    }
    return {"values": values, "arrays": told}


def from_json(content: Any) -> State:
    """Reverses :func:`as_json`.

    Raises:
        ValueError: If it is not what that writes.
    """
    try:
        arrays = {name: _array(**entry) for name, entry in content["arrays"].items()}
        return join(dict(content["values"]), arrays)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError("no state") from error


def _array(dtype: str, shape: list[int], data: list[float]) -> np.ndarray:
    if np.dtype(dtype).kind not in "biuf":
        raise ValueError(dtype)
    return np.array(data, dtype).reshape(shape)


def _is_plain(leaf: object) -> bool:
    # The type itself: a NumPy number is a float, too, but would come back as Python's, which rounds differently.
    return type(leaf) in (type(None), bool, int, float, str) or (type(leaf) is list and all(map(_is_plain, leaf)))
