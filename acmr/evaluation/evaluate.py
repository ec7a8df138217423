"""Evaluates the policy of a finished run, films it, and draws an environment."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v2 as imageio
import numpy as np

from acmr.agent.networks import Actor
from acmr.config import ConfigError, EnvConfig
from acmr.evaluation.camera import is_robot, make_camera
from acmr.evaluation.rollout import MOST_STEPS, Episode, VideoOptions, play, render_mode
from acmr.evaluation.zero_shot import policy_in
from acmr.foreign import is_there
from acmr.names import terminal
from acmr.records import CONFIG_FILE, DESCRIPTION_FILE, EVALUATION_FILE, portable
from acmr.settings.compose import environment_config
from acmr.settings.stored import stored_environment
from acmr.storage.durable import WriteError
from acmr.storage.json_files import write_json
from acmr.storage.run_dir import RunDir
from acmr.transfer.teacher import Teacher, load_teacher, locate_teacher

#: Where a still is seen from, in degrees, and how close, relative to the camera that follows a robot.
_STILL_AZIMUTH, _STILL_CLOSENESS = 150.0, 0.85


def load_policy(path: Path) -> tuple[Teacher, object, Path]:
    """The final networks of a finished run, or those of a teacher alone, in whatever folder its two files lie.

    Returns:
        The networks, the settings they learned with, and the file which says so.

    Raises:
        ConfigError: If there is no such run, if it is unfinished, or if one of its files is damaged.
    """
    run_dir = RunDir(path)
    if path.is_file():
        teacher = load_teacher(path)
        return teacher, teacher.description.config, path.with_suffix(".json")
    if not path.is_dir():
        raise ConfigError(f"{path}: no such run directory; give one as in runs/quick/ant-none/seed_1")
    run_dir.check_unchanged()
    settings = run_dir.stored_settings()
    # A run that has lost its settings is damaged, and no teacher.
    if settings is None and run_dir.summary() is None and is_there(locate_teacher(path)):
        teacher = load_teacher(path)
        return teacher, teacher.description.config, path / DESCRIPTION_FILE
    if settings is None:
        raise ConfigError(f"{path}: not a run directory (no {CONFIG_FILE}); give one as in runs/quick/ant-none/seed_1")
    if not run_dir.is_complete():
        raise ConfigError(f"{path}: this run is not finished; start it again with the command that began it")
    return load_teacher(path), settings, run_dir.config_file


def load_run(path: Path, trust: bool = False) -> tuple[Teacher, EnvConfig]:
    """The final networks of a finished run or a teacher, and the environment they learned in.

    Args:
        path: Its directory, or the file of the teacher.
        trust: Whether its files may choose code to run.

    Raises:
        ConfigError: As :func:`load_policy`; or if one of the files chooses code.
    """
    teacher, settings, file = load_policy(path)
    return teacher, stored_environment(settings, file, "type --trust", trust)


def check_fit(teacher: Teacher, config: EnvConfig) -> str | None:
    """Compares the environment that was learned in with the one that is made here.

    Returns:
        A remark if the robot has changed since, else None.

    Raises:
        ConfigError: If the policy cannot act in it.
    """
    from acmr.envs import describe

    about, here = teacher.description, describe(config)
    if (list(here.observation_names), list(here.action_names)) != (about.observation_names, about.action_names):
        raise ConfigError(
            f"{teacher.path}: learned with {about.dims}, but {config.name} has {len(here.observation_names)} sensors "
            f"and {len(here.action_names)} actuators here, or other ones; are {CONFIG_FILE} and the teacher of one run?"
        )
    if here.model_hash != about.model_hash:
        return f"{config.name} is not the robot it was trained on (another version of mujoco or gymnasium?)"
    return None


def limit(config: EnvConfig) -> int | None:
    """Steps that an episode may take; None: no time limit is known."""
    from acmr.envs import describe

    return describe(config).max_episode_steps


def report(episodes: Sequence[Episode], **about: Any) -> dict[str, Any]:
    """What ``evaluation.json`` says.

    The standard deviation is that of these episodes (divided by their number); the fall rate is the share of those that
    the environment ended, not its time limit: of a robot, because it fell.
    """
    returns = [episode.episodic_return for episode in episodes]
    lengths = [episode.episode_length for episode in episodes]
    velocities = [value for episode in episodes if (value := episode.mean_forward_velocity) is not None]
    return {
        **about,
        "episodes": len(episodes),
        "mean_return": float(np.mean(returns)),
        "std_return": float(np.std(returns)),
        "min_return": float(np.min(returns)),
        "max_return": float(np.max(returns)),
        "mean_length": float(np.mean(lengths)),
        "mean_forward_velocity": float(np.mean(velocities)) if velocities else None,
        "fall_rate": float(np.mean([episode.terminated for episode in episodes])),
        "each": [asdict(episode) for episode in episodes],
    }


def evaluate(given: argparse.Namespace) -> None:
    """Evaluates a run, prints each episode and writes the result as JSON; in each body that is asked for."""
    teacher, own = load_run(given.run_dir, given.trust)
    contents = []
    for name in given.env or [None]:
        config = own if name is None else _in_its_wrappers(environment_config(name), own)
        placed = _place(teacher, config, given, is_own=name is None)
        contents.append(_evaluate_in(config, placed, teacher, given))
        file = locate_teacher(given.run_dir).with_name(_file_name(config, is_own=name is None))
        _store(contents[-1], given.out or file)
    if len(contents) > 1:
        width = max(len(content["environment"]) for content in contents)
        print(f"{'body':<{width}}  {'mean':>10}  {'least':>10}  {'most':>10}  {'length':>7}")
        for content in contents:
            numbers = [f"{content[f'{key}_return']:>10,.1f}" for key in ("mean", "min", "max")]
            print(terminal(f"{content['environment']:<{width}}  {'  '.join(numbers)}  {content['mean_length']:>7,.0f}"))


def _in_its_wrappers(config: EnvConfig, own: EnvConfig) -> EnvConfig:
    """Another body within the wrappers that the policy is used to, unless it has its own."""
    return config if config.wrappers else replace(config, wrappers=own.wrappers)


class _Placed(NamedTuple):
    """A policy in a body: what wrappers around the body remember, and a remark if it is not quite the policy's own."""

    actor: Actor
    wrappers: dict[str, Any]
    remark: str | None = None


def _place(teacher: Teacher, config: EnvConfig, given: argparse.Namespace, *, is_own: bool) -> _Placed:
    if is_own:
        remark = check_fit(teacher, config)
        if remark:
            print(terminal(f"warning: {remark}"), file=sys.stderr)
        return _Placed(teacher.build_networks().actor.eval(), teacher.wrapper_states(), remark)
    actor, wrappers, lines = policy_in(teacher, config, given.impute, given.trust)
    print(terminal(f"{config.name}: {'; '.join(lines)}"))
    return _Placed(actor, wrappers)


def _file_name(config: EnvConfig, *, is_own: bool) -> str:
    path = Path(EVALUATION_FILE)
    return EVALUATION_FILE if is_own else f"{path.stem}-{re.sub(r'[^A-Za-z0-9_.-]', '_', config.name)}{path.suffix}"


def _evaluate_in(config: EnvConfig, placed: _Placed, teacher: Teacher, given: argparse.Namespace) -> dict[str, Any]:
    """Plays, prints each episode, and returns the content of the file."""
    if limit(config) is None:
        print(
            terminal(f"warning: {config.name} has no time limit: an episode is cut off at {MOST_STEPS:,} steps"),
            file=sys.stderr,
        )
    episodes = []
    video = VideoOptions(given.video, given.seconds, given.width, given.height) if given.video else None
    actor, wrappers, remark = placed
    options = {"episodes": given.episodes, "seed": given.seed, "stochastic": given.stochastic, "video": video}
    for episode in play(actor, config, wrappers, **options):
        episodes.append(episode)
        end = "terminated" if episode.terminated else "time limit"
        print(
            f"episode {len(episodes):>3}  seed {episode.seed:>3}  return {episode.episodic_return:>10,.1f}  "
            f"length {episode.episode_length:>5}{_velocity(episode.mean_forward_velocity)}  {end}",
            flush=True,
        )
    content = report(
        episodes,
        run=portable(str(given.run_dir)),
        environment=config.name,
        policy="stochastic" if given.stochastic else "deterministic",
        seed=given.seed,
        sha256=teacher.description.sha256,
        precision=teacher.description.precision,
        same_robot=remark is None,
        **({} if given.env is None else {"impute": given.impute}),
    )
    print(
        f"mean {content['mean_return']:,.1f}  standard deviation {content['std_return']:,.1f}"
        f"{_velocity(content['mean_forward_velocity'])}  over {len(episodes)} episodes, {content['policy']} policy"
        f"  ({content['fall_rate']:.0%} ended before their time limit)"
    )
    return content


def _store(content: dict[str, Any], path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, content)
    except WriteError as error:
        raise ConfigError(f"{error}; type --out FILE.json") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror}); type --out FILE.json") from error
    print(terminal(f"written: {path}"))


def _velocity(value: float | None) -> str:
    return "" if value is None else f"  velocity {value:>5.2f} m/s"


def still(given: argparse.Namespace) -> None:
    """Draws the pose that an environment begins with, as a PNG file."""
    from acmr.envs import make_env

    config = environment_config(given.environment)
    env = make_env(config, render_mode=render_mode(config))
    env.reset(seed=0)
    robot: Any = env.unwrapped
    if is_robot(env):
        # Without the noise that a reset adds.
        robot.set_state(robot.init_qpos, robot.init_qvel)
    camera = make_camera(env, given.width, given.height, azimuth=_STILL_AZIMUTH, closeness=_STILL_CLOSENESS)
    picture = camera.frame()
    camera.close()
    env.close()
    try:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        imageio.imwrite(str(given.out), picture, format="PNG")
    except OSError as error:
        raise ConfigError(f"{given.out}: cannot be written ({error.strerror or error})") from error
    print(f"written: {given.out}")
