"""The settings of one run: their types, and what makes them valid.

Values live in ``conf/``; this module gives them types and checks them once, before anything is created.
Nothing here knows where a value came from (see :mod:`acmr.settings.compose` for that).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

#: Settings that cannot change what a run computes: they are no part of a run's name.
NEUTRAL_KEYS = (
    "device", "threads", "output_dir", "force", "progress", "log_every", "tracking", "profile", "pair",
    "checkpoint_every", "resume",
)  # fmt: skip

#: Settings that a teacher must share with its student: its length and the shape of its networks.
TEACHER_KEYS = ("total_timesteps", "agent.hidden_sizes")

#: When a run ends: after all its steps, or as soon as it has met its threshold.
HORIZON, THRESHOLD = "horizon", "threshold"
#: Settings that can only cut a run short: what it does until then stays the same, and so does the paper's cell.
STOP_KEYS = ("stop", "stop_after")

TRACKING_MODES = ("off", "offline", "self_hosted")
PROGRESS_MODES = ("auto", "bar", "lines", "off")
#: How matrix products are computed.
PRECISIONS = ("float32", "bfloat16")
EXACT, INEXACT = "exact", "inexact"
ACTIVATIONS = ("relu", "none")


class ConfigError(ValueError):
    """A setting, or a combination of settings, that cannot be run. Its message is one line for the user."""

    #: What the process that is told this ends with.
    exit_code = 2


@dataclass
class EnvConfig:
    """An environment: a Gymnasium id and how the robot's body differs from it."""

    name: str = "???"
    id: str = "???"
    #: Name of the environment whose agent teaches in this one (its own name: same body).
    source: str = "???"
    kwargs: dict[str, Any] = field(default_factory=dict)
    remove_bodies: list[str] = field(default_factory=list)
    drop_sensors: list[int | str] = field(default_factory=list)
    drop_actuators: list[int | str] = field(default_factory=list)
    #: Steps an episode may take; None: as registered with Gymnasium.
    max_episode_steps: int | None = None


@dataclass
class SACConfig:
    """Soft Actor-Critic, with the paper's values (docs/paper.md)."""

    hidden_sizes: list[int] = field(default_factory=lambda: [256, 256])
    gamma: float = 0.99
    tau: float = 0.005
    batch_size: int = 256
    buffer_size: int = 1_000_000
    learning_starts: int = 5_000
    policy_lr: float = 3e-4
    q_lr: float = 1e-3
    policy_frequency: int = 2
    target_network_frequency: int = 1
    autotune: bool = True
    alpha: float = 0.2
    #: Of matrix products: float32 or bfloat16. Weights and optimizers are in float32 either way.
    precision: str = PRECISIONS[0]


@dataclass
class TransferConfig:
    """What a student takes from its teacher."""

    name: str = "none"
    #: Path of a teacher file or of a finished run; None: the run of the source environment with the same seed.
    teacher: str | None = None
    #: Activation between the new input adapter and the teacher's first layer (``expand`` only).
    adapter_activation: str = "relu"
    #: Start from the teacher's temperature instead of log_alpha = 0.
    copy_log_alpha: bool = False
    #: Free room for the settings of methods that are added.
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class TrackingConfig:
    """Where Weights & Biases mirrors a run."""

    mode: str = "offline"
    project: str = "acmr"
    entity: str | None = None
    base_url: str | None = None
    #: Folder of the offline runs; None: ``<output_dir>/wandb``.
    dir: str | None = None


@dataclass
class PairConfig:
    """The two environments that a profile's cells are made of."""

    source: str = "humanoid"
    target: str = "armless_humanoid"


@dataclass
class ExperimentConfig:
    """Everything that defines one run."""

    seed: int = 1
    freeze: bool = False
    total_timesteps: int = 1_000_000
    threshold: float = 4900.0
    consecutive: int = 5
    #: ``horizon``: all steps are taken; ``threshold``: the run ends with the episode that completes the streak of
    #: ``consecutive`` ones at the threshold. Until there it is bit for bit the run that takes all steps.
    stop: str = HORIZON
    #: Steps after which a run with ``stop=threshold`` ends even if it has not met it; None: ``total_timesteps``.
    stop_after: int | None = None
    device: str = "cpu"
    threads: int = 1
    output_dir: str = "runs"
    force: bool = False
    progress: str = "auto"
    #: Environment steps between two rows of metrics.
    log_every: int = 1_000
    #: Environment steps between two checkpoints; None: as the length of the run suggests; 0: none are made.
    checkpoint_every: int | None = None
    #: ``inexact`` goes on from a checkpoint of another machine or of other versions, and records that.
    resume: str = EXACT
    profile: str = "paper"
    pair: PairConfig = field(default_factory=PairConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    agent: SACConfig = field(default_factory=SACConfig)
    transfer: TransferConfig = field(default_factory=TransferConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    @property
    def most_steps(self) -> int:
        """Environment steps after which the run ends at the latest."""
        return self.total_timesteps if self.stop_after is None else self.stop_after


def validate(config: ExperimentConfig) -> None:
    """Refuses what cannot be run.

    Args:
        config: The typed settings.

    Raises:
        ConfigError: With one line that says what was given, what is allowed and what to type.
    """
    agent = config.agent
    _at_least("seed", config.seed, 0)
    for key in ("total_timesteps", "consecutive", "threads", "log_every"):
        _at_least(key, getattr(config, key), 1)
    for key in ("batch_size", "buffer_size", "policy_frequency", "target_network_frequency"):
        _at_least(f"agent.{key}", getattr(agent, key), 1)
    _at_least("agent.learning_starts", agent.learning_starts, 0)
    if config.checkpoint_every is not None:
        _at_least("checkpoint_every", config.checkpoint_every, 0)
    if config.env.max_episode_steps is not None:
        _at_least("env.max_episode_steps", config.env.max_episode_steps, 1)
    for key in ("policy_lr", "q_lr", "alpha"):
        _within(f"agent.{key}", getattr(agent, key), low=0.0, high=math.inf, low_open=True)
    _within("agent.tau", agent.tau, low=0.0, high=1.0, low_open=True)
    _within("agent.gamma", agent.gamma, low=0.0, high=1.0)
    if not math.isfinite(config.threshold):
        raise ConfigError(f"threshold={config.threshold}: a finite return is needed, as in threshold=4900")
    if not agent.hidden_sizes or min(agent.hidden_sizes) < 1:
        raise ConfigError(
            f"agent.hidden_sizes={agent.hidden_sizes}: one or more widths of at least 1 are needed, "
            "as in agent.hidden_sizes=[256,256]"
        )
    _one_of("agent.precision", agent.precision, PRECISIONS)
    _one_of("progress", config.progress, PROGRESS_MODES)
    _one_of("resume", config.resume, (EXACT, INEXACT))
    _one_of("tracking.mode", config.tracking.mode, TRACKING_MODES)
    _one_of("transfer.adapter_activation", config.transfer.adapter_activation, ACTIVATIONS)
    _check_transfer(config)
    _check_stop(config)
    if config.tracking.mode == "self_hosted" and not config.tracking.base_url:
        raise ConfigError("tracking=self_hosted needs the server's address: tracking.base_url=http://HOST:PORT")


def _check_stop(config: ExperimentConfig) -> None:
    _one_of("stop", config.stop, (HORIZON, THRESHOLD))
    after = config.stop_after
    if after is None:
        return
    _at_least("stop_after", after, 1)
    if config.stop != THRESHOLD:
        raise ConfigError(
            f"stop_after={after} stop={config.stop}: only a run that stops at its threshold may end before its last "
            f"step; type stop=threshold stop_after={after}, or total_timesteps={after} for a shorter run"
        )
    # It would change nothing, and give one run two names.
    if after >= config.total_timesteps:
        raise ConfigError(
            f"stop_after={after}: the run has ended by then (total_timesteps={config.total_timesteps}); "
            "type less, or leave stop_after out"
        )


def _check_transfer(config: ExperimentConfig) -> None:
    transfer = config.transfer
    if transfer.name == "none":
        if config.freeze:
            raise ConfigError(
                "transfer=none freeze=true: without a transfer there is nothing to freeze; "
                "type transfer=hidden freeze=true or transfer=none freeze=false"
            )
        if transfer.teacher is not None:
            raise ConfigError(
                f"transfer=none transfer.teacher={transfer.teacher}: without a transfer no teacher is read; "
                "type transfer=hidden or transfer=expand"
            )
        if transfer.copy_log_alpha:
            raise ConfigError(
                "transfer=none transfer.copy_log_alpha=true: without a transfer no temperature is copied; "
                "type transfer=hidden or transfer=expand"
            )
    if transfer.name == "direct" and config.freeze:
        raise ConfigError(
            "transfer=direct freeze=true: every layer would be frozen and nothing could learn; "
            "type transfer=direct freeze=false, or evaluate the teacher with python -m acmr.evaluation"
        )
    if transfer.name == "hidden" and len(config.agent.hidden_sizes) < 2:
        raise ConfigError(
            f"transfer=hidden agent.hidden_sizes={config.agent.hidden_sizes}: there is no layer between two hidden "
            "layers to transfer; give two widths or more, or type transfer=expand"
        )


def _at_least(key: str, value: int, least: int) -> None:
    if value < least:
        raise ConfigError(f"{key}={value}: an integer of at least {least} is needed, as in {key}={max(least, 1)}")


def _within(key: str, value: float, *, low: float, high: float, low_open: bool = False) -> None:
    if not math.isfinite(value) or value < low or value > high or (low_open and value == low):
        bracket = "(" if low_open else "["
        upper = "inf)" if math.isinf(high) else f"{high:g}]"
        raise ConfigError(f"{key}={value}: a number in {bracket}{low:g}, {upper} is needed")


def _one_of(key: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ConfigError(f"{key}={value}: must be one of {', '.join(allowed)}")


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as ``{"agent.q_lr": 0.001, ...}``; lists are values."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        elif not isinstance(value, Mapping):
            flat[f"{prefix}{key}"] = value
    return flat


def schema_defaults() -> dict[str, Any]:
    """The value of every setting, as ``group.key``, where no file and no command line says anything."""
    return flatten(asdict(ExperimentConfig()))


def is_neutral(key: str) -> bool:
    """Whether a setting cannot change what a run computes."""
    return key.split(".")[0] in NEUTRAL_KEYS


def differing_keys(stored: Mapping[str, Any], config: ExperimentConfig) -> list[str]:
    """Settings, of those that change the result, in which a stored run differs from this one.

    A setting that the stored run knew nothing of has the schema's default: one that is added to the schema must default
    to what was done before, and then orphans no run. One that only the stored run knows did something that cannot be
    done any more, so it counts as a difference, unless it was null: not set.
    """
    before, now = schema_defaults() | flatten(stored), flatten(asdict(config))
    keys = sorted(set(before) | set(now))
    return [
        key
        for key in keys
        # One teacher may be named by several paths; the run's name identifies it by its content.
        if not is_neutral(key) and key != "transfer.teacher" and before.get(key) != now.get(key)
    ]
