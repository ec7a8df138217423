"""Independent streams of random numbers, all derived from one seed.

Each consumer draws from a stream of its own, so that adding a draw in one place changes nothing elsewhere.
No global generator is touched.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import torch

from acmr.stateful import State

#: Streams that nothing else keeps the state of.
_DRAWN_BY_THE_RUN = ("replay", "exploration")


@dataclass(frozen=True)
class RandomStreams:
    """Generators of one run.

    Attributes:
        networks: Initial weights.
        acting: Noise of the actions taken in the environment.
        learning: Noise of the actions sampled in the updates.
        replay: Indices of the batches.
        exploration: The uniform random actions before learning starts.
        environment: Seed of the environment's first reset.
    """

    networks: torch.Generator
    acting: torch.Generator
    learning: torch.Generator
    replay: np.random.Generator
    exploration: np.random.Generator
    environment: int

    def state_dict(self) -> State:
        """Where the streams are that the run draws from as it goes on.

        Those of the networks and of the first reset are used before the first step only, and the learner, which is
        given the other two, has them in its own state.
        """
        return {name: getattr(self, name).bit_generator.state for name in _DRAWN_BY_THE_RUN}

    def load_state_dict(self, state: State) -> None:
        """Goes on drawing from there."""
        for name in _DRAWN_BY_THE_RUN:
            getattr(self, name).bit_generator.state = state[name]


def random_streams(seed: int, device: str = "cpu", apart: str | None = None) -> RandomStreams:
    """Derives every stream of a run from its seed.

    Args:
        seed: Any integer >= 0.
        device: Device on which the learner draws its noise.
        apart: What sets the run's streams apart from those of other runs with the same seed; None: they share them.

    Returns:
        Streams that are independent of each other, by NumPy's ``SeedSequence.spawn``.
    """
    networks, acting, learning, replay, exploration, environment = _root(seed, apart).spawn(6)
    return RandomStreams(
        networks=_torch_generator(networks, "cpu"),
        acting=_torch_generator(acting, "cpu"),
        learning=_torch_generator(learning, device),
        replay=np.random.default_rng(replay),
        exploration=np.random.default_rng(exploration),
        environment=int(environment.generate_state(1)[0]),
    )


def _root(seed: int, apart: str | None) -> np.random.SeedSequence:
    if apart is None:
        return np.random.SeedSequence(seed)
    # The seed's own length goes first, so that no seed followed by a name reads like another seed.
    words = np.frombuffer(hashlib.sha256(apart.encode()).digest(), dtype="<u4").tolist()
    return np.random.SeedSequence([seed.bit_length(), seed, *words])


def _torch_generator(sequence: np.random.SeedSequence, device: str) -> torch.Generator:
    return torch.Generator(device).manual_seed(int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1)))
