"""Carries the names of sensors and actuators through the wrappers of ``env.wrappers``.

Transfer by name needs to know what each number is. What a wrapper makes of names is written here for Gymnasium's; one
of the user's says it itself, or its numbers are called by their index.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
from gymnasium.spaces import Box
from gymnasium.spaces.utils import flatdim
from gymnasium.wrappers import (
    DelayObservation,
    DtypeObservation,
    FlattenObservation,
    FrameStackObservation,
    NormalizeObservation,
    RescaleAction,
    RescaleObservation,
    ReshapeObservation,
    TimeAwareObservation,
)

from acmr.envs.spaces import names_of, own_names
from acmr.envs.wrappers.chosen import chosen_layers
from acmr.envs.wrappers.memory import lasting_layers

#: Where a wrapper may say the names itself; a class that changes numbers but not what they mean sets the last to True.
_OBSERVATIONS, _ACTIONS, _KEEPS = ("observation_names",), ("action_names",), "keeps_names"
#: Between a sensor's name and how many steps ago it was read.
AGO = "@"
#: They change the numbers, but neither their order nor what they are of.
_SAME = (
    *(DelayObservation, DtypeObservation, FlattenObservation, NormalizeObservation, RescaleObservation),
    ReshapeObservation,
)

#: Kinds of wrappers that do nothing to observations, and to actions.
_NO_OBSERVATION, _NO_ACTION = (gym.RewardWrapper, gym.ActionWrapper), (gym.RewardWrapper, gym.ObservationWrapper)

Names = tuple[str, ...]
Layer = gym.Wrapper[Any, Any, Any, Any]


def carried_names(env: gym.Env[Any, Any], observations: Names, actions: Names) -> tuple[Names, Names]:
    """The names outside of all chosen wrappers.

    Args:
        env: The outermost of them.
        observations: The names of the observations within them, row by row.
        actions: Those of the actions.

    Returns:
        Names of observations, and of actions.
    """
    for layer in chosen_layers(env):
        observations = _observations(layer, observations)
        actions = _actions(layer, actions)
    return observations, actions


def normalized_names(env: gym.Env[Any, Any], observations: Names) -> dict[str, Names]:
    """The names of what each chosen ``NormalizeObservation`` normalizes, by what :func:`lasting_layers` calls it.

    Args:
        env: As in :func:`carried_names`.
        observations: As there.
    """
    called = {id(layer): name for name, layer in lasting_layers(env).items()}
    found: dict[str, Names] = {}
    for layer in chosen_layers(env):
        observations = _observations(layer, observations)
        if isinstance(layer, NormalizeObservation):
            found[called[id(layer)]] = observations
    return found


def _observations(layer: Layer, within: Names) -> Names:
    space = layer.observation_space
    count = flatdim(space)
    said = _said(layer, _OBSERVATIONS, count)
    if said is not None:
        return said
    if not isinstance(space, Box):
        return names_of(space)
    carry = _CARRIES.get(type(layer))
    keeps = _keeps(layer, layer._observation_space is None, _NO_OBSERVATION)
    names = carry(layer, within) if carry else within if keeps else ()
    return names if len(names) == count else tuple(f"obs/{row}" for row in range(count))


def _actions(layer: Layer, within: Names) -> Names:
    count = flatdim(layer.action_space)
    said = _said(layer, _ACTIONS, count)
    if said is not None:
        return said
    keeps = isinstance(layer, RescaleAction) or _keeps(layer, layer._action_space is None, _NO_ACTION)
    return within if keeps and len(within) == count else tuple(f"action/{row}" for row in range(count))


def _said(layer: Layer, attributes: Sequence[str], count: int) -> Names | None:
    """The names that the wrapper itself has, whatever lies within it has."""
    for attribute in attributes:
        if attribute in vars(layer) or hasattr(type(layer), attribute):
            return own_names(layer, attributes, count)
    return None


def _keeps(layer: Layer, same_space: bool, others: tuple[type[Any], ...]) -> bool:
    """Whether a wrapper leaves numbers what they are: it says so, or is of a kind that does nothing to them."""
    if getattr(type(layer), _KEEPS, False) is True:
        return True
    # Of Gymnasium's, one that does not declare a space does nothing to what it passes on.
    return same_space and (isinstance(layer, others) or type(layer).__module__.startswith("gymnasium."))


def _stacked(layer: Layer, within: Names) -> Names:
    """The latest keeps its name, so that a policy without memory fits to it; those before it say how long ago."""
    assert isinstance(layer, FrameStackObservation)
    steps = range(layer.stack_size - 1, -1, -1)
    return tuple(f"{name}{AGO}{ago}" if ago else name for ago in steps for name in within)


def _timed(layer: Layer, within: Names) -> Names:
    # It lays out what it makes as Gymnasium flattens a dictionary, "obs" before "time".
    return (*within, "time")


_CARRIES: dict[type[Any], Callable[[Layer, Names], Names]] = {
    **dict.fromkeys(_SAME, lambda layer, within: within),
    FrameStackObservation: _stacked,
    TimeAwareObservation: _timed,
}
