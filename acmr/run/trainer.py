"""The training loop: act, store, learn, record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
import torch

from acmr.agent.architecture import Dimensions
from acmr.agent.learner import Learner
from acmr.agent.replay_buffer import ReplayBuffer
from acmr.config import RANDOM, THRESHOLD, ConfigError, ExperimentConfig
from acmr.envs.conversion import FaultyEnvironmentError
from acmr.records import EpisodeInProgress
from acmr.run.preparation import Prepared
from acmr.run.random_streams import RandomStreams
from acmr.run.run_logs import RunLogs
from acmr.stateful import State
from acmr.text import message
from acmr.tracking.observer import Observer
from acmr.transfer.audition import Audition


class DivergedError(Exception):
    """Numbers are no longer finite, so that nothing can be learned from here on.

    Attributes:
        step: The step at which this was seen.
        cause: What is not finite.
    """

    def __init__(self, step: int, cause: str) -> None:
        super().__init__(f"diverged at step {step:,}: {cause}")
        self.step, self.cause = step, cause


class FailedError(ConfigError):
    """The environment raised an exception, or gave what cannot be used, in the middle of a run."""

    #: Not that of what is refused: a simulator that could not be reached may be there at the next attempt.
    exit_code = 1


def _never() -> bool:
    return False


@dataclass
class Trainer:
    """Trains one agent in one environment.

    Attributes:
        env: The environment, with its time limit.
        agent: The learner.
        buffer: Replay memory.
        streams: Random numbers of the run.
        total_timesteps: Environment steps to take at most.
        log_every: Environment steps between two rows of metrics.
        episode: Sums over the current episode.
        audition: Tries ways to begin in the first episodes; nothing is learned meanwhile.
        is_satisfied: Asked between two episodes whether the training may end before its last step.
        observers: Told of every step, episode and row of metrics, in their order; what one raises ends the training.
        global_step: Environment steps taken.
        observation: What the next action answers; None between two episodes.
    """

    env: gym.Env[np.ndarray, np.ndarray]
    agent: Learner
    buffer: ReplayBuffer
    streams: RandomStreams
    total_timesteps: int
    log_every: int
    episode: EpisodeInProgress
    audition: Audition = field(default_factory=lambda: Audition({}))
    is_satisfied: Callable[[], bool] = _never
    observers: Sequence[Observer] = ()
    global_step: int = 0
    observation: np.ndarray | None = None

    @property
    def is_over(self) -> bool:
        """Whether no further step is to be taken."""
        # Asked anew rather than kept: a run that was killed right here must not go on when it is taken up again.
        return self.global_step >= self.total_timesteps or (self.observation is None and self.is_satisfied())

    def state_dict(self) -> State:
        """How far it is; its agent, environment, buffer, streams and episode have states of their own."""
        state: State = {"global_step": self.global_step, "observation": self.observation}
        return state | {"audition": self.audition.state_dict()} if self.audition.returns else state

    def load_state_dict(self, state: State) -> None:
        """Goes on from there.

        Raises:
            ValueError: If the observation is not one of this environment.
        """
        observation = state["observation"]
        if observation is not None and observation.shape != self.env.observation_space.shape:
            raise ValueError(f"an observation of shape {observation.shape}")
        if self.audition.returns:
            self.audition.load_state_dict(state["audition"])
        self.global_step, self.observation = int(state["global_step"]), observation

    def train(self) -> None:
        """Runs from the step that was reached to the last.

        Raises:
            DivergedError: If a number that must be finite is not.
            FailedError: If the environment fails.
        """
        try:
            self._run()
        except FaultyEnvironmentError as error:
            raise FailedError(f"failed at step {self.global_step:,}: {error}") from error
        self._check_learner()

    def _run(self) -> None:
        since = (time.perf_counter(), self.global_step)
        while not self.is_over:
            self._step()
            if self.global_step % self.log_every == 0:
                now, (before, first) = time.perf_counter(), since
                since = (now, self.global_step)
                self._log((self.global_step - first) / (now - before))
            for observer in self.observers:
                observer.on_step(self.global_step)

    def _step(self) -> None:
        config, observation = self.agent.config, self.observation
        if observation is None:
            # Later resets go on with the generator that the first one seeds.
            observation, _ = self.env.reset(seed=None if self.global_step else self.streams.environment)
            self._check("an observation", observation)
        self.global_step += 1
        trying = not self.audition.is_over
        learning = self.global_step > config.learning_starts and not trying
        explores = config.start == RANDOM and not learning and not trying
        action = self._random_action() if explores else self.agent.act(observation)
        self._check("the policy's action", action)
        next_observation, reward, terminated, truncated, info = self.env.step(action)
        reward, ended = float(reward), terminated or truncated
        self._check("an observation", next_observation)
        self._check("a reward", reward)
        self.episode.step(reward, info)
        self.buffer.add(observation, action, reward, next_observation, terminated, ended)
        self.observation = next_observation
        if ended:
            record = self.episode.record(self.global_step)
            for observer in self.observers:
                observer.on_episode(record)
            if trying:
                self.audition.add(record.episodic_return)
                # Of the one that plays next; where the audition is over now, of the one that was chosen.
                self.agent.set_biases(self.audition.biases())
            self.episode.restart()
            self.observation = None
        if learning:
            self.agent.update(self.buffer.sample(config.batch_size, self.streams.replay), self.global_step)

    def _log(self, speed: float) -> None:
        metrics = self.agent.metrics()
        values = {"steps_per_second": speed, **metrics}
        for observer in self.observers:
            observer.on_metrics(self.global_step, values)
        # It is NaN, too, where there was no update; one that was would have left its mark on the weights.
        if not math.isnan(metrics["critic_loss"]) or not is_finite(self.agent):
            self._check("the critics' loss", metrics["critic_loss"])
        self._check_learner()

    def _check(self, what: str, values: np.ndarray | float) -> None:
        # A sum is quicker than a look at each number, and finite only if they all are, or nearly so.
        total = values if isinstance(values, float) else float(values.sum())
        if not math.isfinite(total) and not np.isfinite(values).all():
            raise DivergedError(self.global_step, f"{what} is not finite")

    def _check_learner(self) -> None:
        if not is_finite(self.agent):
            raise DivergedError(self.global_step, "the learner's weights are not finite")

    def _random_action(self) -> np.ndarray:
        space = self.env.action_space
        assert isinstance(space, gym.spaces.Box)
        return self.streams.exploration.uniform(space.low, space.high).astype(np.float32)


def is_finite(agent: Learner) -> bool:
    """Whether all weights, targets, moments and sums of a learner are finite."""
    state = agent.state_dict()
    sums = all(map(math.isfinite, state["metric_sums"].values()))
    return sums and all(map(_all_finite, state["tensors"].values()))


def _all_finite(tensor: torch.Tensor) -> bool:
    # As with the trainer's checks: a finite sum has finite terms, and is quicker to come by.
    return math.isfinite(float(tensor.sum())) or bool(torch.isfinite(tensor).all())


def make_trainer(prepared: Prepared, env: gym.Env[np.ndarray, np.ndarray], logs: RunLogs) -> Trainer:
    """Makes the trainer of a run as it is before its first step.

    Args:
        prepared: What the run starts with.
        env: The environment to step.
        logs: Hold the returns by which a run may stop at its threshold.
    """
    config, streams, about = prepared.spec.config, prepared.streams, prepared.about
    dims = prepared.networks.dims
    return Trainer(
        env=env,
        agent=prepared.learner(
            prepared.networks,
            config.agent,
            streams.acting,
            streams.learning,
            prepared.log_alpha,
            config.device,
            # A learner of the user's own need not know of it.
            **({"thaws": prepared.thaws} if prepared.thaws else {}),
        ),
        buffer=_make_buffer(config, dims),
        streams=streams,
        total_timesteps=config.most_steps,
        log_every=config.log_every,
        episode=EpisodeInProgress(about.reward_terms, about.has_forward_velocity),
        audition=prepared.audition.until(config.threshold),
        is_satisfied=lambda: config.stop == THRESHOLD and logs.meet(config.threshold, config.consecutive),
    )


def _make_buffer(config: ExperimentConfig, dims: Dimensions) -> ReplayBuffer:
    # What the run cannot fill it need not ask for; which transitions are drawn is the same.
    capacity = min(config.agent.buffer_size, config.most_steps)
    try:
        return ReplayBuffer(capacity, dims.observation, dims.action, config.device)
    except MemoryError as error:
        # There is enough, but this process may not have it: a limit of the shell or of the system.
        size = f"agent.buffer_size={config.agent.buffer_size}"
        raise ConfigError(f"{size}: {message(error)}; type a smaller agent.buffer_size, or lift the limit") from error
