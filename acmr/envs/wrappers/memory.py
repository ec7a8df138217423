"""What wrappers remember: Gymnasium's own, which have no ``state_dict``, and what of it belongs to a policy.

A checkpoint needs all of it. A policy needs what outlives an episode: it acts on observations that were normalized by
what had been seen until then, and with other statistics it is another policy. So that goes into the teacher's file.
"""

from __future__ import annotations

import copy
from collections import Counter, deque
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import NormalizeObservation, TimeLimit
from gymnasium.wrappers.utils import RunningMeanStd

from acmr.config import ConfigError
from acmr.records import DESCRIPTION_FILE
from acmr.stateful import State, Stateful
from acmr.text import one_line

#: What an entry that is no number, text or array is made from; the others stand for themselves.
_KIND, _NUMBER, _QUEUE, _STATISTICS = "kind", "number", "queue", "statistics"


def has_memory(layer: gym.Env[Any, Any]) -> bool:
    """Whether a layer is one of Gymnasium's wrappers, whose memory lies in plain attributes.

    The time limit is not among them: checkpoints have stored it in a way of its own from the beginning.
    """
    ours = isinstance(layer, gym.Wrapper) and type(layer).__module__.startswith("gymnasium.wrappers.")
    return ours and not isinstance(layer, TimeLimit)


def remembered(layer: gym.Env[Any, Any]) -> State:
    """All that such a wrapper remembers, and the settings that lie beside it; whether that is all is tried out.

    (:func:`acmr.envs.state.try_resume` does that before a run: what is missed shows in what two instances do.)
    """
    return {name: stored for name, value in vars(layer).items() if (stored := _stored(value)) is not None}


def remember(layer: gym.Env[Any, Any], state: State) -> None:
    """Gives a wrapper what another one like it has remembered.

    Raises:
        KeyError, ValueError, TypeError: If it is not the memory of such a wrapper.
    """
    for name, stored in state.items():
        if name not in vars(layer):
            raise KeyError(name)
        # Beside its checks of types: some attributes may only be set within its class.
        vars(layer)[name] = _loaded(vars(layer)[name], stored)


def lasting_layers(env: gym.Env[Any, Any]) -> dict[str, gym.Env[Any, Any]]:
    """The wrappers around an environment that remember something from one episode to the next, chosen ones or its own.

    Each is called by its class and, from the second of a class on, a number: the innermost first, so that what is put
    around them does not change their names.
    """
    layers = []
    while isinstance(env, gym.Wrapper):
        layers.append(env)
        env = env.env
    found: dict[str, gym.Env[Any, Any]] = {}
    counts = Counter[str]()
    for layer in reversed(layers):
        if isinstance(layer, Stateful | NormalizeObservation):
            name = type(layer).__name__
            counts[name] += 1
            found[f"{name}_{counts[name]}" if counts[name] > 1 else name] = layer
    return found


def lasting_state(env: gym.Env[Any, Any]) -> State:
    """What these layers remember, by their names."""
    return {
        name: layer.state_dict() if isinstance(layer, Stateful) else _statistics(layer)
        for name, layer in lasting_layers(env).items()
    }


def give_lasting(env: gym.Env[Any, Any], state: State, *, settled: bool) -> None:
    """Gives the layers what others like them have remembered.

    Args:
        env: Where they are.
        state: As :func:`lasting_state` has it; of layers that it does not name nothing changes.
        settled: Whether running statistics stay as they are from now on, as those of a policy that learns no more do.

    Raises:
        ConfigError: If it is not the state of such layers.
    """
    for name, layer in lasting_layers(env).items():
        if isinstance(layer, NormalizeObservation) and settled:
            layer.update_running_mean = False
        if name not in state:
            continue
        try:
            if isinstance(layer, Stateful):
                layer.load_state_dict(copy.deepcopy(state[name]))
            elif isinstance(layer, NormalizeObservation):
                _give(layer.obs_rms, state[name])
        except (KeyError, ValueError, TypeError, IndexError, AttributeError, OverflowError) as error:
            raise ConfigError(
                f"{DESCRIPTION_FILE}: what it says of {name} does not fit the environment ({one_line(error)}); "
                "are the teacher and the environment of one run?"
            ) from error


def _statistics(layer: gym.Env[Any, Any]) -> State:
    assert isinstance(layer, NormalizeObservation)
    known = layer.obs_rms
    return {"mean": known.mean.copy(), "var": known.var.copy(), "count": float(known.count)}


def _give(known: RunningMeanStd, given: State) -> None:
    # Of their own precision: Gymnasium begins in the observation's, and goes on in a greater one.
    mean, var, count = (np.asarray(given[name]) for name in ("mean", "var", "count"))
    if mean.shape != known.mean.shape or var.shape != known.var.shape:
        raise ValueError(f"statistics of {mean.shape} and {var.shape} numbers, not {known.mean.shape}")
    are_numbers = all(value.dtype.kind == "f" and np.isfinite(value).all() for value in (mean, var, count))
    if not are_numbers or (var < 0).any() or count < 0:
        raise ValueError("statistics that are none")
    known.mean, known.var, known.count = mean.copy(), var.copy(), float(count)


def _stored(value: Any) -> Any:
    """A value as a state holds it, None for what is no memory; what is None itself says so in a dictionary."""
    if value is None:
        return {_KIND: "none"}
    if type(value) in (bool, int, float, str):
        return value
    if isinstance(value, np.generic) and value.dtype.kind in "biuf":
        return {_KIND: _NUMBER, "value": np.array(value)}
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return value.copy()
    if isinstance(value, RunningMeanStd):
        return {_KIND: _STATISTICS, **{name: _stored(entry) for name, entry in vars(value).items()}}
    if isinstance(value, deque):
        entries = [_stored(entry) for entry in value]
        if all(entry is not None for entry in entries):
            return {_KIND: _QUEUE, **{str(place): entry for place, entry in enumerate(entries)}}
    return None


def _loaded(now: Any, stored: Any) -> Any:
    if not isinstance(stored, dict):
        return stored
    kind = stored[_KIND]
    if kind == "none":
        return None
    if kind == _NUMBER:
        return stored["value"][()]
    if kind == _STATISTICS:
        if not isinstance(now, RunningMeanStd):
            raise TypeError("running statistics, where there are none")
        for name, entry in vars(now).items():
            loaded = _loaded(entry, stored[name])
            if np.shape(loaded) != np.shape(entry):
                raise ValueError(f"running statistics of {np.shape(loaded)}, not {np.shape(entry)}")
            setattr(now, name, loaded)
        return now
    if kind != _QUEUE or not isinstance(now, deque):
        raise TypeError(f"a {kind}, where there is none")
    return deque((_loaded(None, stored[str(place)]) for place in range(len(stored) - 1)), now.maxlen)
