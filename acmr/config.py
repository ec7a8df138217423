"""The settings of one run: their types, and which of them matter to what.

Values live in ``conf/``; this module gives them types. Nothing here knows where a value came from
(:mod:`acmr.settings.compose`) or which ones can be run (:mod:`acmr.settings.validate`).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from acmr.text import flatten

#: Settings that cannot change what a run computes: they are no part of a run's name.
NEUTRAL_KEYS = (
    "device", "threads", "output_dir", "force", "progress", "log_every", "tracking", "profile", "pair",
    "checkpoint_every", "resume", "metric",
)  # fmt: skip

#: Settings that a teacher must share with its student: its length and the shape of its networks.
TEACHER_KEYS = ("total_timesteps", "agent.hidden_sizes")
#: Choose the teacher, of which ``transfer.json`` has the hash.
TEACHER_CHOICE = ("transfer.teacher", "transfer.teacher_seeds")

#: When a run ends: after all its steps, or as soon as it has met its threshold.
HORIZON, THRESHOLD = "horizon", "threshold"
#: Settings that can only cut a run short: what it does until then stays the same, and so does the paper's cell.
STOP_KEYS = ("stop", "stop_after")

#: How runs of one seed are related: they share its random numbers, or each cell draws from numbers of its own.
PAIRED, INDEPENDENT = "paired", "independent"
SEEDINGS = (PAIRED, INDEPENDENT)

#: What a run is worth to a search: nothing is told, steps to its threshold, or a return that needs the whole run.
NONE, STEPS, END_METRICS = "none", "steps_to_threshold", ("final_return", "area", "evaluation")
METRICS = (NONE, STEPS, *END_METRICS)

PROGRESS_MODES = ("auto", "bar", "lines", "off")
#: How matrix products are computed.
PRECISIONS = ("float32", "bfloat16")
#: Who acts before learning starts.
RANDOM, POLICY = "random", "policy"
EXACT, INEXACT = "exact", "inexact"
RELU, NO_ACTIVATION = ACTIVATIONS = ("relu", "none")
#: How adapters begin: ``random``, or as the selection of sensors and actuators by their names.
NAMES = "names"
#: What a sensor or an actuator that is gone counts as in the networks that knew it (``transfer=named``).
MEAN, ZERO, INITIAL, AUTO = "mean", "zero", "initial", "auto"
IMPUTATIONS = (AUTO, MEAN, ZERO, INITIAL)

#: What a control takes from a teacher: nothing, the order of its names, or what its weights have learned.
NO_CONTROL, SHUFFLED, UNTRAINED = CONTROLS = ("none", "shuffled", "untrained")


def share_of_mean(rule: str) -> float | None:
    """The share of the mean that a rule of ``transfer.impute`` asks for; None for ``initial``, ``auto`` and others."""
    try:
        share = {MEAN: 1.0, ZERO: 0.0}[rule] if rule in (MEAN, ZERO) else float(rule)
    except ValueError:
        return None
    return share if math.isfinite(share) else None


class ConfigError(ValueError):
    """A setting, or a combination of settings, that cannot be run. Its message is one line for the user."""

    #: What the process that is told this ends with.
    exit_code = 2


@dataclass
class EnvConfig:
    """An environment: a Gymnasium id and how the robot's body differs from it."""

    #: Its file in ``conf/env``; part of the name of every run in it.
    name: str = "???"
    #: The Gymnasium id with its version; ``module:Name-v0`` imports the module that registers it.
    id: str = "???"
    #: Name of the environment whose agent teaches in this one (its own name: same body).
    source: str = "???"
    #: Arguments of the environment, as in ``gymnasium.make(id, **kwargs)``.
    kwargs: dict[str, Any] = field(default_factory=dict)
    #: Names of MuJoCo bodies that the robot lacks, with all that hangs on them.
    remove_bodies: list[str] = field(default_factory=list)
    #: Observations that the agent does not see: names, globs such as ``cinert/*``, or indices.
    drop_sensors: list[int | str] = field(default_factory=list)
    #: Actions that the agent does not command, given in the same way; the robot stays whole.
    drop_actuators: list[int | str] = field(default_factory=list)
    #: Steps an episode may take; None: as registered with Gymnasium.
    max_episode_steps: int | None = None
    #: What is put around it, the first innermost: Gymnasium's wrappers, or ``module:Name``, and their arguments.
    wrappers: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class SACConfig:
    """Soft Actor-Critic, with the paper's values (docs/paper.md)."""

    #: The learner, a file in ``conf/agent`` and a module in ``acmr/agent``.
    name: str = "sac"
    #: Width of each hidden layer, in the actor as in the critics.
    hidden_sizes: list[int] = field(default_factory=lambda: [256, 256])
    #: Discount of future rewards, per step.
    gamma: float = 0.99
    #: Share of the critics that their targets take over in one update (Polyak).
    tau: float = 0.005
    #: Transitions in one update.
    batch_size: int = 256
    #: Transitions that the replay buffer holds; the oldest go first.
    buffer_size: int = 1_000_000
    #: Steps before the first update.
    learning_starts: int = 5_000
    #: Who acts in them: ``random``, uniformly within the bounds, or the ``policy``, as it was transferred.
    start: str = RANDOM
    #: Learning rate of the actor (Adam).
    policy_lr: float = 3e-4
    #: Learning rate of the critics and of the temperature (Adam).
    q_lr: float = 1e-3
    #: Steps between two updates of the actor, which then makes up for the delay with so many at once.
    policy_frequency: int = 2
    #: Steps between two updates of the target critics.
    target_network_frequency: int = 1
    #: Whether the temperature is learned, so that the entropy stays at minus the number of actions.
    autotune: bool = True
    #: The temperature where it is not learned.
    alpha: float = 0.2
    #: Of matrix products: float32 or bfloat16. Weights and optimizers are in float32 either way.
    precision: str = PRECISIONS[0]
    #: Updates over which learning rates rise from zero. This and the next three: acmr/agent/fine_tuning.py.
    warmup: int = 0
    #: Updates that the critics make before the actor's first.
    critics_first: int = 0
    #: Weight of the penalty on the distance between the policy and the one that was transferred, at first.
    kickstart: float = 0.0
    #: Updates of the actor over which that weight fades to zero.
    kickstart_updates: int = 60_000
    #: Free room for the settings of learners that are added.
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class TransferRules:
    """What a transfer method needs and allows, as its file in ``conf/transfer`` states it.

    Facts of the method, not settings of a run: they are in no ``config.yaml`` and no name, and the command line cannot
    change them. The defaults are those of a method that copies some layers of any teacher with the same widths.
    """

    #: Whether there is a teacher to take something from.
    needs_teacher: bool = True
    #: Whether teacher and student must have the same numbers of sensors and actuators.
    same_body: bool = False
    #: Whether teacher and student must have hidden layers of the same widths.
    same_widths: bool = True
    #: Whether something is left that learns when all that is copied is frozen.
    freezable: bool = True
    #: Hidden layers that the student needs at least.
    min_hidden_layers: int = 1
    #: Whether it asks what the teacher saw and did on average.
    statistics: bool = False
    #: Other methods, named to a user whom this one is refused.
    instead: list[str] = field(default_factory=list)

    @property
    def or_instead(self) -> str:
        """End of a refusal: ``, or type transfer=hidden or transfer=expand``; empty where no other method is named."""
        others = " or ".join(f"transfer={name}" for name in self.instead)
        return f", or type {others}" if others else ""


@dataclass
class TransferConfig:
    """What a student takes from its teacher."""

    #: The method, a file in ``conf/transfer``; by default nothing is taken.
    name: str = "none"
    #: The function that does it, ``module:name``; None: the one of the method's name in ``acmr/transfer``.
    method: str | None = None
    rules: TransferRules = field(default_factory=TransferRules)
    #: Path of a teacher file or of a finished run; None: the run of the source environment with the same seed.
    teacher: str | None = None
    #: Teachers that students take in turn, unless a path names one: seed s that of seed (s - 1) mod so many + 1.
    teacher_seeds: int | None = None
    #: Activation between the new input adapter and the teacher's first layer (``expand`` only).
    adapter_activation: str = RELU
    #: How its adapters begin: ``random``, or with each sensor and actuator as what the teacher calls so (``names``).
    adapter_init: str = RANDOM
    #: Start from the teacher's temperature instead of log_alpha = 0.
    copy_log_alpha: bool = False
    #: What the student calls otherwise, as ``old:new``; typed ``transfer.rename={old: new}`` (``named`` only).
    rename: list[str] = field(default_factory=list)
    #: What those count as that the student has not (``named`` only): their ``mean``, a share of it such as ``0.75``,
    #: ``zero``, or their ``initial`` mean; ``auto`` tries some of these in the first episodes, and keeps the best.
    impute: str = MEAN
    #: For a comparison, a teacher whose names are ``shuffled``, or one with its fresh weights, ``untrained``.
    control: str = NO_CONTROL
    #: Free room for the settings of methods that are added.
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class TrackingConfig:
    """What shows a run while it goes on, besides its own files."""

    #: The class that is told how the run goes (docs/howto-tracking.md); None: none.
    tracker: str | None = "acmr.tracking.wandb_tracker.WandbTracker"
    #: Project on W&B that holds the run.
    project: str = "acmr"
    #: Team or user on W&B; None: whose key it is.
    entity: str | None = None
    #: Address of a W&B server; None: offline; empty: it has to be given.
    base_url: str | None = None
    #: Folder of the offline runs; None: ``<output_dir>/wandb``.
    dir: str | None = None
    #: Free room for the settings of trackers that are added.
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class PairConfig:
    """The two environments that a profile's cells are made of."""

    #: Name of the environment that teachers learn in.
    source: str = "humanoid"
    #: Name of the environment that students learn in.
    target: str = "armless_humanoid"


@dataclass
class ExperimentConfig:
    """Everything that defines one run."""

    #: Of every random number of the run, 0 to 2**53 - 1. A teacher that no path names is the one with the same seed.
    seed: int = 1
    #: How it is used, a file in ``conf/seeding``: runs of one seed are ``paired`` (they share environment seed, random
    #: first actions and fresh weights) or ``independent`` (streams from the seed and the run's name).
    seeding: str = PAIRED
    #: Whether what is copied from the teacher stays as it is; on the command line a file in ``conf/freeze``.
    freeze: bool = False
    #: Steps at which that begins to learn again: at each the layer next to the output, at the last all that are left.
    thaw: list[int] = field(default_factory=list)
    #: Environment steps that the run takes.
    total_timesteps: int = 1_000_000
    #: Raw episodic return that counts as success.
    threshold: float = 4900.0
    #: Episodes in a row that have to reach the threshold.
    consecutive: int = 5
    #: ``horizon``: all steps are taken; ``threshold``: the run ends with the episode that completes the streak of
    #: ``consecutive`` ones at the threshold. Until there it is bit for bit the run that takes all steps.
    stop: str = HORIZON
    #: Steps after which a run with ``stop=threshold`` ends even if it has not met it; None: ``total_timesteps``.
    stop_after: int | None = None
    #: Where networks and replay buffer are: ``cpu`` or ``cuda``.
    device: str = "cpu"
    #: Threads that PyTorch computes with on the CPU.
    threads: int = 1
    #: Folder of all runs; a run's own directory in it follows from its settings.
    output_dir: str = "runs"
    #: Whether to train anew what is finished or under way there.
    force: bool = False
    #: What is shown while it trains: ``bar``, ``lines``, ``off``; ``auto``: a bar in a terminal, else lines.
    progress: str = "auto"
    #: Environment steps between two rows of metrics.
    log_every: int = 1_000
    #: Environment steps between two checkpoints; None: as the length of the run suggests; 0: none are made.
    checkpoint_every: int | None = None
    #: What a search is told of the run: ``steps_to_threshold``, ``final_return``, ``area``, ``evaluation`` or ``none``.
    metric: str = NONE
    #: ``inexact`` goes on from a checkpoint of another machine or of other versions, and records that.
    resume: str = EXACT
    #: Name of the file in ``conf/profile`` whose values hold where nothing else is said.
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


def plain_settings(config: ExperimentConfig) -> dict[str, Any]:
    """All settings as plain data, as ``config.yaml`` stores them: without the rules of the method, which are none."""
    settings = asdict(config)
    del settings["transfer"]["rules"]
    return settings


def schema_defaults() -> dict[str, Any]:
    """The value of every setting, as ``group.key``, where no file and no command line says anything."""
    return flatten(plain_settings(ExperimentConfig()))


def is_neutral(key: str) -> bool:
    """Whether a setting cannot change what a run computes."""
    return key.split(".")[0] in NEUTRAL_KEYS
