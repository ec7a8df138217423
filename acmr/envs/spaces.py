"""Observation spaces that are made of parts: their numbers side by side, each with a name, and values as arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Sized
from itertools import takewhile
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple
from gymnasium.spaces.utils import flatdim, flatten, flatten_space

from acmr.text import brief

#: Spaces whose values are a fixed number of numbers; a choice among n is n numbers, one of them 1.
USABLE = (Box, Dict, Tuple, Discrete, MultiBinary, MultiDiscrete)


def is_usable(space: Space[Any]) -> bool:
    """Whether the values of a space are a fixed number of numbers."""
    return isinstance(space, USABLE) and all(map(is_usable, _parts(space).values()))


def is_empty(space: Space[Any]) -> bool:
    """Whether the values of a usable space hold no number at all."""
    return flatdim(space) == 0


def names_of(space: Space[Any]) -> tuple[str, ...]:
    """A name for each number of a space, in Gymnasium's order (:func:`gymnasium.spaces.utils.flatten`).

    A number is called after the keys that lead to it and its index: ``position_0``, ``arm/angle_2``.
    """
    names = list(_names(space, ()))
    if len(set(names)) == len(names) and all(map(str.isprintable, names)):
        return tuple(names)
    # Names that mean two things, or cannot be shown, are none.
    return tuple(f"obs/{row}" for row in range(len(names)))


def own_names(env: gym.Env[Any, Any], attributes: Sequence[str], count: int) -> tuple[str, ...] | None:
    """The names that an environment has itself for all its observations, or actions, in their order.

    Args:
        env: The environment, or a wrapper around it; of several that have names the outermost is asked.
        attributes: Where the names may be. Each holds names, or groups as libraries of power grids have them: words,
            then the numbers or names of the parts that have such a value, as in ``("load", "p_mw", [0, 1])``.
        count: How many names are needed.

    Returns:
        None where there are not as many, or where they are no names: not text, or the same twice.
    """
    layer: Any = env
    while layer is not None:
        for attribute in attributes:
            given = vars(layer).get(attribute, getattr(type(layer), attribute, None))
            if isinstance(given, list | tuple) and given:
                names = [name for entry in given for name in _own(entry)]
                usable = all(name.strip() and name.isprintable() and not _is_number(name) for name in names)
                if len(names) == len(set(names)) == count and usable:
                    return tuple(names)
        layer = layer.env if isinstance(layer, gym.Wrapper) else None
    return None


def flat_space(space: Space[Any]) -> Box:
    """The Box of all numbers of a space, side by side."""
    flat = flatten_space(space)
    assert isinstance(flat, Box)
    return flat


def flattened(given: Any, space: Space[Any], dtype: np.dtype[Any]) -> np.ndarray:
    """The numbers of an observation that is made of parts, (all of them,).

    Raises:
        ValueError: If it is not made of the parts that its space declares.
    """
    return np.concatenate(list(_values(given, space, "its observation"))).astype(dtype, copy=False)


def to_array(given: Any, shape: tuple[int, ...], dtype: np.dtype[Any], title: str) -> np.ndarray:
    """A new array of a value, which may be a list or have dimensions of length one more or less.

    Args:
        given: What an environment gave.
        shape: What the array has to have.
        dtype: What it has to hold; floats are rounded to it, integers have to fit.
        title: What messages call the value.

    Raises:
        ValueError: If that is not possible without a loss.
    """
    try:
        array = np.asarray(given)
    except Exception as error:
        raise ValueError(f"{title} is no array of numbers ({' '.join(str(error).split())[:120]})") from error
    if np.ma.is_masked(given):
        raise ValueError(f"{title} is masked in part, but every number is needed")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{title} is {type(given).__name__} of {array.dtype}, but numbers are needed")
    if _lengths(array.shape) != _lengths(shape):
        raise ValueError(f"{title} has the shape {array.shape}, but its space declares {shape}")
    with np.errstate(invalid="ignore", over="ignore"):
        converted = array.reshape(shape).astype(dtype)
    if dtype.kind in "biu" and not np.array_equal(converted, array.reshape(shape)):
        raise ValueError(f"{title} holds numbers that are no {dtype}, which its space declares")
    return converted


def _parts(space: Space[Any]) -> dict[Any, Space[Any]]:
    if isinstance(space, Dict):
        return dict(space.spaces)
    return dict(enumerate(space.spaces)) if isinstance(space, Tuple) else {}


def _names(space: Space[Any], path: tuple[Any, ...]) -> Iterator[str]:
    if isinstance(space, Dict | Tuple):
        for key, part in _parts(space).items():
            yield from _names(part, (*path, key))
        return
    called = "/".join(map(str, path))
    # What begins with a digit YAML would take for a number: 1_0 is ten.
    start = f"{called}_" if called[:1].isalpha() else f"obs/{called}_" if path else "obs/"
    yield from (f"{start}{row}" for row in range(flatdim(space)))


def _own(entry: object) -> list[str]:
    """The names that one entry of an environment's own list stands for; an empty one for what is none."""
    if isinstance(entry, str):
        return [entry]
    if not isinstance(entry, list | tuple):
        return [""]
    words = list(takewhile(lambda part: isinstance(part, str), entry))
    parts = entry[len(words)] if len(words) < len(entry) else []
    try:
        return ["/".join([*words, str(part)]) for part in parts]
    except TypeError:
        return [""]


def _is_number(name: str) -> bool:
    """Whether a command line would take a name for an index."""
    try:
        int(name)
    except ValueError:
        return False
    return True


def _values(given: Any, space: Space[Any], title: str) -> Iterator[np.ndarray]:
    if not isinstance(space, Dict | Tuple):
        yield _leaf(given, space, title)
        return
    parts = _parts(space)
    if not isinstance(given, Mapping) and not _holds(given, len(parts)):
        raise ValueError(f"{title} is {brief(given)}, but its space declares {len(parts)} parts")
    for key, part in parts.items():
        try:
            value = given[key]
        except (LookupError, TypeError) as error:
            raise ValueError(f"{title}[{key!r}] is missing, which its space declares") from error
        yield from _values(value, part, f"{title}[{key!r}]")
    if isinstance(given, Mapping) and (more := [key for key in given if key not in parts]):
        raise ValueError(f"{title} has {more[0]!r}, which its space does not declare")


def _holds(given: Any, count: int) -> bool:
    """Whether it is something of so many parts."""
    return isinstance(given, Sized) and not isinstance(given, str) and len(given) == count


def _leaf(given: Any, space: Space[Any], title: str) -> np.ndarray:
    assert space.shape is not None
    assert space.dtype is not None
    array = to_array(given, space.shape, space.dtype, title)
    if isinstance(space, Box):
        return array.ravel()
    # A choice that does not exist would be another one, or none.
    if not space.contains(array[()]):
        raise ValueError(f"{title} is {array.tolist()}, which is not in {space}")
    return np.asarray(flatten(space, array[()]))


def _lengths(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(length for length in shape if length != 1)
