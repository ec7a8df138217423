"""What MuJoCo warns of while it simulates: read from the simulation, counted, and kept out of the user's folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from acmr.stateful import State

_KINDS = [
    mujoco.mjtWarning(number).name.removeprefix("mjWARN_").lower() for number in range(mujoco.mjtWarning.mjNWARNING)
]


class PhysicsWarnings(gym.Wrapper[Any, Any, Any, Any]):
    """Counts the warnings of each step, which a reset would clear.

    Attributes:
        counts: Warnings by kind, such as ``badqacc``; kinds that never appeared are left out.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.counts: Counter[str] = Counter()
        data = getattr(env.unwrapped, "data", None)
        self._numbers: np.ndarray | None = data.warning.number if isinstance(data, mujoco.MjData) else None

    def step(self, action: Any) -> Any:
        """Steps, then reads what MuJoCo warned of."""
        result = self.env.step(action)
        numbers = self._numbers
        if numbers is not None and numbers.any():
            self.counts.update({_KINDS[kind]: int(numbers[kind]) for kind in np.flatnonzero(numbers)})
            numbers[:] = 0
        return result

    def state_dict(self) -> State:
        """What was counted so far."""
        return {"counts": dict(self.counts)}

    def load_state_dict(self, state: State) -> None:
        """Counts on from there."""
        # Others hold the counter itself.
        self.counts.clear()
        self.counts.update(state["counts"])


@contextmanager
def no_log_file() -> Iterator[None]:
    """Keeps MuJoCo from writing ``MUJOCO_LOG.TXT`` in the working directory."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
