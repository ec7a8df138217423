"""Uses what a run has learned: evaluates its policy, films it, draws its robot.

``python -m acmr.evaluation RUN_DIR [--episodes N] [--video FILE.mp4]`` and
``python -m acmr.evaluation still ENVIRONMENT --out FILE.png``.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import torch

from acmr.checkpoint import Teacher, load_teacher
from acmr.config import ConfigError, EnvConfig
from acmr.durable import write_bytes
from acmr.networks import Actor
from acmr.run_dir import RunDir
from acmr.video import Film, is_robot, make_camera, without_gl

RESULT_FILE = "evaluation.json"
#: Where a still is seen from, in degrees, and how close, relative to the camera that follows a robot.
_STILL_AZIMUTH, _STILL_CLOSENESS = 150.0, 0.85


@dataclass(frozen=True)
class Episode:
    """One episode of an evaluation.

    Attributes:
        seed: What the environment was reset with.
        episodic_return: Sum of the raw rewards.
        episode_length: Steps in the episode.
        terminated: Whether the environment ended it, not its time limit.
    """

    seed: int
    episodic_return: float
    episode_length: int
    terminated: bool


def play(
    actor: Actor, config: EnvConfig, *, episodes: int, seed: int, stochastic: bool, video: Path | None = None
) -> Iterator[Episode]:
    """Plays episodes, each the same whatever came before it.

    Args:
        actor: The policy.
        config: Where it acts.
        episodes: How many to play.
        seed: The k-th episode (k = 0, 1, ...) is reset with ``seed + k``.
        stochastic: Sample actions, as in training; else take the mean action.
        video: An mp4 file to film the first episode in.

    Raises:
        ConfigError: If the environment cannot be made.
    """
    from acmr.envs import make_env

    env = make_env(config, render_mode=None if video is None else _render_mode(config))
    film = Film(video, env) if video is not None else None
    try:
        for number in range(episodes):
            noise = torch.Generator().manual_seed(seed + number)
            observation, _ = env.reset(seed=seed + number)
            total, length, terminated, truncated = 0.0, 0, False, False
            while not (terminated or truncated):
                if film is not None:
                    film.step()
                action = _act(actor, observation, noise if stochastic else None)
                observation, reward, terminated, truncated, _ = env.step(action)
                total, length = total + float(reward), length + 1
            if film is not None:
                film.close()
                film = None
            yield Episode(seed + number, total, length, bool(terminated))
    finally:
        if film is not None:
            film.close()
        env.close()


def load_run(path: Path) -> tuple[Teacher, EnvConfig]:
    """The final networks of a finished run, and the environment they learned in.

    Raises:
        ConfigError: If there is no such run, if it is unfinished, or if one of its files is damaged.
    """
    run_dir = RunDir(path)
    if not path.is_dir():
        raise ConfigError(f"{path}: no such run directory; give one as in runs/quick/ant-none/seed_1")
    settings = run_dir.stored_settings()
    if settings is None:
        raise ConfigError(f"{path}: not a run directory (no config.yaml); give one as in runs/quick/ant-none/seed_1")
    if not run_dir.is_complete():
        raise ConfigError(f"{path}: this run is not finished; start it again with the command that began it")
    try:
        config = EnvConfig(**settings["env"])
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{run_dir.config_file}: damaged, its part env cannot be used ({error})") from error
    return load_teacher(path), config


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
            f"and {len(here.action_names)} actuators here, or other ones; are config.yaml and the teacher of one run?"
        )
    if here.model_hash != about.model_hash:
        return f"{config.name} is not the robot it was trained on (another version of mujoco or gymnasium?)"
    return None


def report(episodes: Sequence[Episode], **about: Any) -> dict[str, Any]:
    """What ``evaluation.json`` says; the standard deviation is that of these episodes (divided by their number)."""
    returns = [episode.episodic_return for episode in episodes]
    lengths = [episode.episode_length for episode in episodes]
    return {
        **about,
        "episodes": len(episodes),
        "mean_return": float(np.mean(returns)),
        "std_return": float(np.std(returns)),
        "min_return": float(np.min(returns)),
        "max_return": float(np.max(returns)),
        "mean_length": float(np.mean(lengths)),
        "each": [asdict(episode) for episode in episodes],
    }


def evaluate(given: argparse.Namespace) -> None:
    """Evaluates a run, prints each episode and writes the result as JSON."""
    teacher, config = load_run(given.run_dir)
    remark = check_fit(teacher, config)
    if remark:
        print(f"warning: {remark}", file=sys.stderr)
    actor = teacher.build_networks().actor.eval()
    episodes = []
    for episode in play(
        actor, config, episodes=given.episodes, seed=given.seed, stochastic=given.stochastic, video=given.video
    ):
        episodes.append(episode)
        end = "terminated" if episode.terminated else "time limit"
        print(
            f"episode {len(episodes):>3}  seed {episode.seed:>3}  return {episode.episodic_return:>10,.1f}  "
            f"length {episode.episode_length:>5}  {end}",
            flush=True,
        )
    content = report(
        episodes,
        run=str(given.run_dir),
        environment=config.name,
        policy="stochastic" if given.stochastic else "deterministic",
        seed=given.seed,
        sha256=teacher.description.sha256,
        same_robot=remark is None,
    )
    print(
        f"mean {content['mean_return']:,.1f}  standard deviation {content['std_return']:,.1f}  "
        f"over {len(episodes)} episodes, {content['policy']} policy"
    )
    path = given.out or given.run_dir / RESULT_FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, (json.dumps(content, indent=2) + "\n").encode())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror}); type --out FILE.json") from error
    print(f"written: {path}")


def still(given: argparse.Namespace) -> None:
    """Draws the pose that an environment begins with, as a PNG file."""
    from acmr.envs import make_env
    from acmr.envs.__main__ import leaves, read_leaf

    name = given.environment
    config = read_leaf(name) if name in leaves() else EnvConfig(name=name, id=name, source=name)
    env = make_env(config, render_mode=_render_mode(config))
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


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code: 2 for what cannot be done, with one line that says why."""
    given = _parse(list(sys.argv[1:] if arguments is None else arguments))
    torch.set_num_threads(1)
    try:
        with without_gl():
            importlib.import_module("acmr.envs")
        given.action(given)
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _parse(arguments: list[str]) -> argparse.Namespace:
    if arguments[:1] == ["still"]:
        parser = argparse.ArgumentParser(prog="python -m acmr.evaluation still", description=still.__doc__)
        parser.add_argument("environment", help="an environment of conf/env, or any Gymnasium id")
        parser.add_argument("--out", type=Path, required=True, metavar="FILE.png")
        parser.add_argument("--width", type=_positive, default=480)
        parser.add_argument("--height", type=_positive, default=480)
        parser.set_defaults(action=still)
        return parser.parse_args(arguments[1:])
    parser = argparse.ArgumentParser(
        prog="python -m acmr.evaluation",
        description="Evaluates the policy of a finished run.",
        epilog="python -m acmr.evaluation still ENVIRONMENT --out FILE.png draws a robot.",
    )
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR", help="as in runs/quick/ant-none/seed_1")
    parser.add_argument("--episodes", type=_positive, default=10, help="default: 10")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the next ones count up")
    parser.add_argument("--stochastic", action="store_true", help="sample actions, as in training")
    parser.add_argument(
        "--video", type=_mp4, metavar="FILE.mp4", help="film the first episode (0.2 s a frame without a GPU)"
    )
    parser.add_argument("--out", type=Path, metavar="FILE.json", help=f"default: {RESULT_FILE} in the run directory")
    parser.set_defaults(action=evaluate)
    given = parser.parse_args(arguments)
    if given.seed < 0:
        parser.error(f"--seed {given.seed}: an integer of at least 0 is needed")
    return given


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: an integer of at least 1 is needed")
    return int(text)


def _mp4(text: str) -> Path:
    if not text.endswith(".mp4"):
        raise argparse.ArgumentTypeError(f"{text}: the name must end in .mp4")
    return Path(text)


def _render_mode(config: EnvConfig) -> str | None:
    """How an environment must be made to be drawn: robots are drawn from outside."""
    from acmr.envs import make_env

    env = make_env(config)
    env.close()
    return None if is_robot(env) else "rgb_array"


def _act(actor: Actor, observation: np.ndarray, noise: torch.Generator | None) -> np.ndarray:
    with torch.no_grad():
        batch = torch.as_tensor(observation, dtype=torch.float32).unsqueeze(0)
        if noise is None:
            action: torch.Tensor = actor.mode(batch)
        else:
            action, _ = actor.sample(batch, torch.randn(1, actor.action_scale.numel(), generator=noise))
    return action[0].numpy()


if __name__ == "__main__":
    sys.exit(main())
