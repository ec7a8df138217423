"""Which of several ways to begin a student takes: each plays, and the best one stays.

No rule says for every teacher what should count in place of what its student has lost (docs/method.md). So the first
episodes of a run try some: they are steps of the run like any others, counted, recorded and learned from later.
"""

from __future__ import annotations

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

    The first to have played all of :data:`EPISODES` is chosen. A bad one is hardly seen again, and one that stands
    plays without a break, so that it may meet the run's threshold before anything is learned.

    Args:
        choices: The ways to begin by their names; with fewer than two there is nothing to choose.
    """

    def __init__(self, choices: Mapping[str, Biases]) -> None:
        self._choices = choices
        self.returns: dict[str, list[float]] = {name: [] for name in choices}
        # Told once what was chosen; whoever makes a run may set it.
        self.on_chosen: Callable[[str], None] = lambda line: None

    @property
    def is_over(self) -> bool:
        """Whether nothing is left to try."""
        return len(self._choices) < 2 or any(len(played) >= EPISODES for played in self.returns.values())

    @property
    def best(self) -> str:
        """Who plays next, or who was chosen: the first that has not played yet, else the best mean return."""
        # Of equal means the first.
        return next((name for name, played in self.returns.items() if not played), None) or max(
            self.returns, key=lambda name: (len(self.returns[name]) >= EPISODES, fmean(self.returns[name]))
        )

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
