"""The contract of every part of a run that has a state: it gives the state as data and takes it back.

``acmr/run/run_state.py`` lists the parts of a run; docs/howto-state.md adds one.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

#: Nested dictionaries whose keys are text. Their leaves are of exactly these types, so that a file gives back what it
#: was given: None, bool, int, float, str, lists of these, NumPy arrays and torch tensors.
State = dict[str, Any]


@runtime_checkable
class Stateful(Protocol):
    """A part that can go on, bit for bit, from where another one like it has stopped."""

    def state_dict(self) -> State:
        """All that the part's future depends on, apart from how it was made. May share memory with the part."""

    def load_state_dict(self, state: State) -> None:
        """Goes on from the state of a part that was made alike; the arrays in it are this part's own from now on.

        Raises:
            KeyError, ValueError, TypeError: If it is not the state of such a part.
        """
