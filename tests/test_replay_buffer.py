"""The ring against a plain list of whole transitions."""

import copy
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from acmr.agent.replay_buffer import Batch, JoinedBatch, ReplayBuffer

OBSERVATION, ACTION = 3, 2


def play(buffer: ReplayBuffer, lengths: list[tuple[int, bool]]) -> list[tuple]:
    """Adds episodes of unique numbers; returns every transition ever added, oldest first."""
    counter, history = 0, []
    for length, terminates in lengths:
        observation = np.full(OBSERVATION, counter := counter + 1, np.float64)
        for step in range(length):
            following = np.full(OBSERVATION, counter := counter + 1, np.float64)
            ended = step == length - 1
            action, reward = np.full(ACTION, -counter, np.float32), counter / 7
            buffer.add(observation, action, reward, following, ended and terminates, ended)
            history.append((observation, action, reward, following, ended and terminates))
            observation = following
    return history


def expected(history: list[tuple], capacity: int, drawn: np.ndarray) -> list[np.ndarray]:
    kept = history[-capacity:]
    return [np.array([kept[index][column] for index in drawn], np.float32) for column in range(5)]


def columns(batch: Batch) -> list[np.ndarray]:
    tensors = (batch.observations, batch.actions, batch.rewards, batch.next_observations, batch.terminated)
    return [tensor.numpy() for tensor in tensors]


episodes = st.lists(st.tuples(st.integers(1, 12), st.booleans()), min_size=1, max_size=30)


@settings(max_examples=150, deadline=None)
@given(lengths=episodes, capacity=st.integers(1, 40), seed=st.integers(0, 2**32 - 1), size=st.integers(1, 33))
def test_samples_are_those_of_a_list_of_transitions(lengths, capacity, seed, size):
    buffer = ReplayBuffer(capacity, OBSERVATION, ACTION)
    history = play(buffer, lengths)
    assert len(buffer) == min(len(history), capacity)
    drawn = np.random.default_rng(seed).integers(len(buffer), size=size)
    batch = buffer.sample(size, np.random.default_rng(seed))
    for got, wanted in zip(columns(batch), expected(history, capacity, drawn), strict=True):
        np.testing.assert_array_equal(got, wanted)


@settings(max_examples=50, deadline=None)
@given(before=episodes, after=episodes, capacity=st.integers(1, 40))
def test_only_the_rows_that_the_layout_names_change(before, after, capacity):
    buffer = ReplayBuffer(capacity, OBSERVATION, ACTION)
    play(buffer, before)
    names = ("rows", "rewards", "terminated", "endings", "last_observations")
    old = {name: getattr(buffer, name).copy() for name in names}
    added, ended = buffer.added, buffer._ended
    play(buffer, after)
    allowed = set(np.arange(added, buffer.added + 1) % (capacity + 1))
    allowed_last = set(np.arange(ended, buffer._ended) % capacity)
    for name in names:
        changed = np.flatnonzero((getattr(buffer, name) != old[name]).reshape(len(old[name]), -1).any(1))
        assert set(changed) <= (allowed_last if name == "last_observations" else allowed), name


@settings(max_examples=150, deadline=None)
@given(
    before=episodes,
    after=episodes,
    capacity=st.integers(1, 40),
    pieces=st.integers(1, 5),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_buffer_that_takes_the_transitions_of_another_goes_on_as_that_one(before, after, capacity, pieces, seed):
    buffer, other = ReplayBuffer(capacity, OBSERVATION, ACTION), ReplayBuffer(capacity, OBSERVATION, ACTION)
    play(other, after)
    # Its newest transition may be in the middle of an episode.
    play(buffer, before)
    buffer.add(np.zeros(OBSERVATION), np.ones(ACTION), 0.5, np.full(OBSERVATION, 0.25), False, False)
    borders = np.linspace(buffer.oldest, buffer.added, pieces + 1).astype(int)
    chunks = [buffer.transitions(first, end) for first, end in pairwise(borders) if first < end]
    other.replace(buffer.oldest, copy.deepcopy(chunks))
    for _ in range(2):
        assert (len(other), other.added) == (len(buffer), buffer.added)
        batches = [one.sample(9, np.random.default_rng(seed)) for one in (buffer, other)]
        for got, wanted in zip(*map(columns, batches), strict=True):
            np.testing.assert_array_equal(got, wanted)
        play(buffer, after)
        play(other, after)


def test_transitions_that_do_not_fit_are_refused():
    buffer = ReplayBuffer(10, OBSERVATION, ACTION)
    play(buffer, [(4, True), (9, False), (3, True)])
    first, whole = buffer.oldest, buffer.transitions(buffer.oldest, buffer.added)
    assert first == 6
    for name, array in whole.items():
        if name != "ended":
            with pytest.raises(ValueError, match="of shape"):
                ReplayBuffer(10, OBSERVATION, ACTION).replace(first, [whole | {name: array[:1, ..., None]}])
    with pytest.raises(ValueError, match="a part of the replay buffer is missing"):
        buffer.replace(8, [buffer.transitions(8, 16)])
    with pytest.raises(ValueError, match="more transitions than the replay buffer keeps"):
        ReplayBuffer(9, OBSERVATION, ACTION).replace(first, [whole])


def test_every_kept_transition_is_drawn_equally_often():
    buffer = ReplayBuffer(10, OBSERVATION, ACTION)
    history = play(buffer, [(4, True), (7, False), (3, True)])
    rng = np.random.default_rng(0)
    counts = dict.fromkeys([transition[2] for transition in history[-10:]], 0)
    for _ in range(100):
        for reward in buffer.sample(100, rng).rewards.double():
            counts[min(counts, key=lambda known: abs(known - reward.item()))] += 1
    # 10,000 draws over 10 transitions: mean 1,000, standard deviation 30.
    assert all(850 < count < 1150 for count in counts.values())


def test_joined_batches_are_views_and_joining_copies_nothing_twice():
    buffer = ReplayBuffer(20, OBSERVATION, ACTION)
    play(buffer, [(9, True)])
    batch = buffer.sample(4, np.random.default_rng(0))
    assert batch.inputs.data_ptr() == batch.observations.data_ptr()
    assert torch.equal(batch.inputs, torch.cat((batch.observations, batch.actions), 1))
    assert JoinedBatch.join(batch) is batch
    again = JoinedBatch.join(Batch(*columns_as_tensors(batch)))
    assert torch.equal(again.inputs, batch.inputs)
    assert torch.equal(again.next_observations, batch.next_observations)


def columns_as_tensors(batch: Batch) -> list[torch.Tensor]:
    return [torch.from_numpy(column.copy()) for column in columns(batch)]


def test_a_million_transitions_of_the_humanoid_take_1_6_gb_and_are_touched_lazily():
    before = resident_bytes()
    buffer = ReplayBuffer(1_000_000, 376, 17)
    buffer.add(np.ones(376), np.ones(17), 1.0, np.ones(376), False, False)
    assert resident_bytes() - before < 100e6
    # The last observations of 20,000 episodes; more rows of theirs exist, but nothing ever touches them.
    arrays = (buffer.rows, buffer.rewards, buffer.terminated, buffer.endings, buffer.last_observations[:20_000])
    assert sum(array.nbytes for array in arrays) < 1.62e9


def resident_bytes() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096
