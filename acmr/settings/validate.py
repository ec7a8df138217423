"""Refuses settings that cannot be run, before anything is created: one line each, with what to type instead."""

from __future__ import annotations

import math
import re
from dataclasses import asdict

from acmr.command import typed
from acmr.config import (
    ACTIVATIONS,
    CONTROLS,
    END_METRICS,
    EXACT,
    HORIZON,
    IMPUTATIONS,
    INEXACT,
    METRICS,
    NAMES,
    NO_CONTROL,
    POLICY,
    PRECISIONS,
    PROGRESS_MODES,
    RANDOM,
    RELU,
    SEEDINGS,
    SHUFFLED,
    STEPS,
    THRESHOLD,
    ConfigError,
    EnvConfig,
    ExperimentConfig,
    share_of_mean,
)
from acmr.records import MOST_CONSECUTIVE, MOST_RETURN, MOST_SEED
from acmr.text import flatten, holds_userinfo

#: Settings are stored with the run.
NO_USERINFO = (
    "an address with a user or a password, which would be stored with the run; leave them out "
    "(a W&B server's key is read from WANDB_API_KEY)"
)
#: A setting that is hard to guess, and how it is typed.
WRAPPERS, A_WRAPPER = "env.wrappers", "'env.wrappers=[{name: FrameStackObservation, stack_size: 3}]'"
#: No machine has more.
MOST_THREADS = 4096
#: Hidden layers; nobody learns with more.
MOST_LAYERS = 100


def validate(config: ExperimentConfig) -> None:
    """Refuses what cannot be run.

    Args:
        config: The typed settings.

    Raises:
        ConfigError: With one line that says what was given, what is allowed and what to type.
    """
    agent = config.agent
    _at_least("seed", config.seed, 0)
    _one_of("seeding", config.seeding, SEEDINGS)
    for key in ("total_timesteps", "log_every"):
        _at_least(key, getattr(config, key), 1)
    _at_least("consecutive", config.consecutive, 1, MOST_CONSECUTIVE)
    _at_least("threads", config.threads, 1, MOST_THREADS)
    for key in ("batch_size", "buffer_size", "policy_frequency", "target_network_frequency"):
        _at_least(f"agent.{key}", getattr(agent, key), 1)
    for key in ("learning_starts", "warmup", "critics_first"):
        _at_least(f"agent.{key}", getattr(agent, key), 0)
    _at_least("agent.kickstart_updates", agent.kickstart_updates, 1)
    _within("agent.kickstart", agent.kickstart, low=0.0, high=math.inf)
    if config.transfer.teacher_seeds is not None:
        _at_least("transfer.teacher_seeds", config.transfer.teacher_seeds, 1)
    if config.checkpoint_every is not None:
        _at_least("checkpoint_every", config.checkpoint_every, 0)
    check_environment(config.env)
    for key in ("policy_lr", "q_lr", "alpha"):
        _within(f"agent.{key}", getattr(agent, key), low=0.0, high=math.inf, low_open=True)
    _within("agent.tau", agent.tau, low=0.0, high=1.0, low_open=True)
    _within("agent.gamma", agent.gamma, low=0.0, high=1.0)
    if not abs(config.threshold) <= MOST_RETURN:
        raise ConfigError(
            f"threshold={config.threshold}: a finite return is needed, of at most {MOST_RETURN:g} in size, "
            "as in threshold=4900"
        )
    if not agent.hidden_sizes or min(agent.hidden_sizes) < 1:
        raise ConfigError(
            f"agent.hidden_sizes={agent.hidden_sizes}: one or more widths of at least 1 are needed, "
            "as in agent.hidden_sizes=[256,256]"
        )
    if len(agent.hidden_sizes) > MOST_LAYERS:
        raise ConfigError(f"agent.hidden_sizes: {len(agent.hidden_sizes):,} widths, at most {MOST_LAYERS} are taken")
    if max(agent.hidden_sizes) > MOST_SEED:
        raise ConfigError(f"agent.hidden_sizes={agent.hidden_sizes}: integers of at most {MOST_SEED} are needed")
    _one_of("agent.precision", agent.precision, PRECISIONS)
    _one_of("agent.start", agent.start, (RANDOM, POLICY))
    _one_of("progress", config.progress, PROGRESS_MODES)
    _one_of("resume", config.resume, (EXACT, INEXACT))
    _one_of("metric", config.metric, METRICS)
    _one_of("transfer.adapter_activation", config.transfer.adapter_activation, ACTIVATIONS)
    _one_of("transfer.adapter_init", config.transfer.adapter_init, (RANDOM, NAMES))
    _one_of("transfer.control", config.transfer.control, CONTROLS)
    _check_impute(config.transfer.impute)
    check_address("tracking.base_url", config.tracking.base_url)
    for key, value in flatten(asdict(config)).items():
        if holds_userinfo(value):
            raise ConfigError(f"{key}: {NO_USERINFO}")
    _check_transfer(config)
    _check_stop(config)


def check_address(key: str, value: str | None) -> None:
    """Refuses what is no address of a server, or says more than where it is.

    Args:
        key: What it is called to the user.
        value: The address; None: there is none.

    Raises:
        ConfigError: In a line without the address, which may hold a password.
    """
    if value is None:
        return
    if value == "":
        raise ConfigError(f"tracking=self_hosted needs the server's address: type {key}=http://HOST:PORT")
    if "@" in value:
        raise ConfigError(f"{key}: {NO_USERINFO}")
    if not re.fullmatch(r"https?://[^\s/?#]+(/[^\s?#]*)?", value):
        raise ConfigError(f"{key}: the address of a server is needed, and nothing else, as in http://HOST:PORT")


def check_environment(config: EnvConfig) -> None:
    """Refuses an environment that cannot be played, whatever it is.

    Raises:
        ConfigError: As :func:`validate`.
    """
    if config.max_episode_steps is not None:
        _at_least("env.max_episode_steps", config.max_episode_steps, 1)
    for wrapper in config.wrappers:
        name = wrapper.get("name")
        if not isinstance(name, str) or not name:
            raise ConfigError(f"{WRAPPERS}={config.wrappers}: each needs its name, as in {A_WRAPPER}")


def _check_impute(rule: str) -> None:
    if rule not in IMPUTATIONS and share_of_mean(rule) is None:
        allowed = f"one of {', '.join(IMPUTATIONS)}, or a share of the mean such as 0.75"
        raise ConfigError(f"transfer.impute={rule}: must be {allowed}")


def _check_stop(config: ExperimentConfig) -> None:
    _one_of("stop", config.stop, (HORIZON, THRESHOLD))
    if config.stop == THRESHOLD and config.metric in END_METRICS:
        # Of runs of different lengths these are no measure of one thing.
        raise ConfigError(
            f"metric={config.metric} stop={config.stop}: is taken of runs that make all their steps; "
            f"type stop=horizon, or metric={STEPS}"
        )
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
    """Holds the settings against the rules of the method, whichever it is."""
    transfer, rules, sizes = config.transfer, config.transfer.rules, config.agent.hidden_sizes
    name = f"transfer={transfer.name}"
    if not rules.needs_teacher and transfer.teacher is not None:
        raise ConfigError(
            f"{name} transfer.teacher={transfer.teacher}: without a transfer no teacher is read; "
            f"leave it out{rules.or_instead}"
        )
    if not rules.needs_teacher and transfer.copy_log_alpha:
        raise ConfigError(
            f"{name} transfer.copy_log_alpha=true: without a transfer no temperature is copied; "
            f"leave it out{rules.or_instead}"
        )
    if not rules.needs_teacher and config.agent.kickstart:
        raise ConfigError(
            f"{name} agent.kickstart={config.agent.kickstart:g}: without a transfer there is no policy to hold on to; "
            f"leave it out{rules.or_instead}"
        )
    if transfer.adapter_init == NAMES and transfer.adapter_activation == RELU:
        raise ConfigError(
            f"transfer.adapter_init={NAMES} transfer.adapter_activation={RELU}: the ReLU would cut off whatever is "
            "below zero, so that the teacher's layers would not see its sensors; type transfer.adapter_activation=none"
        )
    if transfer.control != NO_CONTROL and not rules.needs_teacher:
        raise ConfigError(
            f"{name} transfer.control={transfer.control}: there is no teacher; leave it out{rules.or_instead}"
        )
    if transfer.control == SHUFFLED and not (rules.statistics or transfer.adapter_init == NAMES):
        raise ConfigError(f"{name} transfer.control={SHUFFLED}: reads no names; leave it out, or type transfer=named")
    if config.freeze and not rules.freezable:
        why = (
            f"every layer would be frozen and nothing could learn ({typed('evaluate')} shows what a teacher does)"
            if rules.needs_teacher
            else "without a transfer there is nothing to freeze"
        )
        raise ConfigError(f"{name} freeze=true: {why}; type freeze=false{rules.or_instead}")
    _check_thaw(config)
    if len(sizes) < rules.min_hidden_layers:
        enough = ",".join(map(str, [*sizes, *sizes[-1:] * rules.min_hidden_layers][: rules.min_hidden_layers]))
        raise ConfigError(
            f"{name} agent.hidden_sizes={sizes}: it needs {rules.min_hidden_layers} hidden layers or more; "
            f"type agent.hidden_sizes=[{enough}]{rules.or_instead}"
        )


def _check_thaw(config: ExperimentConfig) -> None:
    steps = config.thaw
    given = f"thaw=[{','.join(map(str, steps))}]"
    if steps and not config.freeze:
        raise ConfigError(f"{given} freeze=false: nothing is frozen that could thaw; type freeze=true, or thaw=[]")
    if steps != sorted(set(steps)) or min(steps, default=1) < 1:
        raise ConfigError(f"{given}: steps are needed that ascend from 1 or more, as in thaw=[10000,20000]")
    if steps and steps[0] >= config.most_steps:
        raise ConfigError(
            f"{given}: nothing would thaw before the run ends, at step {config.most_steps}; "
            f"type thaw=[{max(1, config.most_steps // 2)}], or freeze=true thaw=[]"
        )


def _at_least(key: str, value: int, least: int, most: int = MOST_SEED) -> None:
    if value < least:
        raise ConfigError(f"{key}={value}: an integer of at least {least} is needed, as in {key}={max(least, 1)}")
    if value > most:
        raise ConfigError(f"{key}={value}: an integer of at most {most} is needed")


def _within(key: str, value: float, *, low: float, high: float, low_open: bool = False) -> None:
    if not math.isfinite(value) or value < low or value > high or (low_open and value == low):
        bracket = "(" if low_open else "["
        upper = "inf)" if math.isinf(high) else f"{high:g}]"
        raise ConfigError(f"{key}={value}: a number in {bracket}{low:g}, {upper} is needed")


def _one_of(key: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ConfigError(f"{key}={value}: must be one of {', '.join(allowed)}")
