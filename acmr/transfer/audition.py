"""Which of several ways to begin a student takes: each plays, and the best one stays.

No rule says for every teacher what should count in place of what its student has lost (docs/method.md). So the first
episodes of a run try some: they are steps of the run like any others, counted, recorded and learned from later.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from statistics import fmean

from torch import Tensor

from acmr.stateful import State

#: What a way to begin sets: the biases of layers, by the layer's name.
Biases = Mapping[str, Tensor]
#: Episodes that the one which is chosen has played.
EPISODES = 5


class Audition:
    """Lets ways to begin play in turn: each once, then whichever has the best mean return so far.

    The first to have played all of :data:`EPISODES` is chosen. A bad one is hardly seen again, and one that does well
    enough plays without a break, so that the run may meet its threshold before anything is learned.

    Args:
        choices: The ways to begin by their names; with fewer than two there is nothing to choose.
        enough: Who has never returned less plays on before the others are tried.
    """

    def __init__(self, choices: Mapping[str, Biases], enough: float = math.inf) -> None:
        self._choices, self._enough = choices, enough
        self.returns: dict[str, list[float]] = {name: [] for name in choices}
        # Told once what was chosen; whoever makes a run may set it.
        self.on_chosen: Callable[[str], None] = lambda line: None

    def until(self, enough: float) -> Audition:
        """The same audition for a run whose threshold is this return; nobody has played in it yet."""
        return Audition(self._choices, enough)

    @property
    def is_over(self) -> bool:
        """Whether nothing is left to try."""
        return len(self._choices) < 2 or any(len(played) >= EPISODES for played in self.returns.values())

    @property
    def best(self) -> str:
        """Who plays next, or who was chosen."""
        return max(self.returns, key=self._rank)

    def _rank(self, name: str) -> tuple[bool, bool, bool, float]:
        played = self.returns[name]
        # Of equals the first: max keeps it.
        satisfies = bool(played) and min(played) >= self._enough
        return len(played) >= EPISODES, satisfies, not played, fmean(played) if played else 0.0

    def biases(self) -> Biases:
        """What the one that plays next sets."""
        return self._choices[self.best]

    def add(self, episodic_return: float) -> None:
        """Counts an episode of the one that has played."""
        self.returns[self.best].append(episodic_return)
        if self.is_over:
            played = ", ".join(f"{name} {fmean(each):.0f} ({len(each)})" for name, each in self.returns.items() if each)
            self.on_chosen(f"what is gone counts as: {self.best}; mean returns (episodes): {played}")

    def state_dict(self) -> State:
        """The returns so far."""
        return {"returns": {name: list(played) for name, played in self.returns.items()}}

    def load_state_dict(self, state: State) -> None:
        """Goes on from there.

        Raises:
            ValueError: If it is of other ways to begin.
        """
        if list(state["returns"]) != list(self._choices):
            raise ValueError(f"an audition of {', '.join(state['returns'])}")
        self.returns = {name: [float(each) for each in played] for name, played in state["returns"].items()}
