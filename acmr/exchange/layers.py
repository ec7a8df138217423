"""Layers of other programs by our names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice

from torch import Tensor

from acmr.agent.architecture import ACTOR
from acmr.config import ConfigError
from acmr.exchange.archive import NAMED

#: Layers of a chain.
_MOST_LAYERS = 100


def renamed_layers(
    given: Mapping[str, Tensor], trunks: Mapping[str, str], heads: Mapping[str, str], places: Iterable[int], title: str
) -> tuple[dict[str, Tensor], tuple[int, ...]]:
    """Layers of three chains that are numbered in the order of their application, and of the policy's heads.

    Args:
        given: Tensors, as ``<chain>.<number>.weight``, or ``<head>.weight``, and the same with ``bias``.
        trunks: Our part (``actor``, ``critic_1``, ``critic_2``) by the name of its chain.
            A critic's ends with its output.
        heads: Our layer by the name of the head.
        places: The numbers in a chain, endless.
        title: The file, for messages.

    Returns:
        The tensors by our names, and the widths of the hidden layers.

    Raises:
        ConfigError: If there are layers of other kinds, or of shapes that do not follow on one another.
    """
    order = list(islice(places, _MOST_LAYERS))
    found, widths = dict[str, Tensor](), dict[str, tuple[int, ...]]()
    for chain, part in trunks.items():
        numbers = sorted({int(middle) for middle in _middles(given, chain) if middle.isdecimal() and len(middle) < 4})
        if numbers != order[: len(numbers)]:
            raise ConfigError(f"{title}: {chain} has layers {numbers}: something else stands between them")
        count = len(numbers) - (part != ACTOR)
        if count < 1:
            raise ConfigError(f"{title}: {chain} has no hidden layer; networks here have one at least")
        names = ["input", *(f"hidden_{index}" for index in range(1, count))]
        names += [] if part == ACTOR else ["output"]
        for number, name in zip(numbers, names, strict=True):
            _take(given, f"{chain}.{number}", f"{part}.{name}", found, title)
        widths[part] = tuple(found[f"{part}.{name}.bias"].shape[0] for name in names[:count])
    for head, layer in heads.items():
        _take(given, head, layer, found, title)
    # All there are: what has been left out might change what the networks compute.
    taken = {f"{name}.{kind}" for name in _sources(given, trunks, heads) for kind in ("weight", "bias")}
    if strange := sorted(given.keys() - taken):
        raise ConfigError(f"{title}: there is no layer here like {strange[0][:NAMED]}")
    if len(set(widths.values())) > 1:
        said = "; ".join(f"{part} {list(sizes)}" for part, sizes in widths.items())
        raise ConfigError(
            f"{title}: actor and critics have hidden layers of other widths ({said}); here they are alike"
        )
    return found, widths[ACTOR]


def _middles(given: Mapping[str, Tensor], chain: str) -> list[str]:
    return [name[len(chain) + 1 :].rpartition(".")[0] for name in given if name.startswith(f"{chain}.")]


def _sources(given: Mapping[str, Tensor], trunks: Mapping[str, str], heads: Mapping[str, str]) -> list[str]:
    numbered = [f"{chain}.{middle}" for chain in trunks for middle in _middles(given, chain) if middle.isdecimal()]
    return [*numbered, *heads]


def _take(given: Mapping[str, Tensor], theirs: str, ours: str, found: dict[str, Tensor], title: str) -> None:
    weight, bias = (given.get(f"{theirs}.{kind}") for kind in ("weight", "bias"))
    if weight is None or bias is None or weight.dim() != 2 or bias.shape != weight.shape[:1]:
        raise ConfigError(f"{title}: {theirs} is no linear layer with a bias")
    found |= {f"{ours}.weight": weight, f"{ours}.bias": bias}
