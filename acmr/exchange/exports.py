"""Policies for other programs: ``acmr export RUN --onnx policy.onnx``, ``--torchscript FILE``, ``--sb3 FILE``."""

from __future__ import annotations

import argparse
import logging
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from gymnasium.wrappers import NormalizeObservation
from torch import Tensor, nn

from acmr.agent.networks import Actor
from acmr.command import command, typed
from acmr.config import ConfigError
from acmr.envs.wrappers.carried import AGO
from acmr.envs.wrappers.chosen import NAME
from acmr.evaluation.evaluate import load_policy
from acmr.exchange.imported import Normalization, for_plain_observations
from acmr.exchange.sb3_writer import write_sb3
from acmr.names import terminal
from acmr.transfer.teacher import Teacher

#: What the numbers that go in and out are called in a file of ONNX.
OBSERVATION, ACTION = "observation", "action"


class DeterministicPolicy(nn.Module):
    """The mean action, as a module: observations (batch, observation) to actions (batch, action) within their bounds.

    Args:
        actor: The policy.
    """

    def __init__(self, actor: Actor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, observation: Tensor) -> Tensor:
        """The action for each observation."""
        return self.actor.mode(observation)


def write_torchscript(teacher: Teacher, path: Path) -> None:
    """Writes the policy for ``torch.jit.load``, in Python or in C++."""
    with warnings.catch_warnings():
        # It is a format that others read; that torch itself prefers another one by now is no news to the user.
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.trace(_module(teacher), _example(teacher)), str(path))


def write_onnx(teacher: Teacher, path: Path) -> None:
    """Writes the policy for ONNX runtimes: one input, ``observation``, one output, ``action``, any number of rows.

    Raises:
        ConfigError: If the extra is not installed.
    """
    needed("onnx", "onnx", "onnxscript")
    # It tells of each operator of torchvision that it does without.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = torch.onnx.export(
            _module(teacher),
            (_example(teacher),),
            input_names=[OBSERVATION],
            output_names=[ACTION],
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            dynamo=True,
            verbose=False,
        )
    assert made is not None
    made.save(str(path))


def needed(extra: str, *modules: str) -> list[Any]:
    """The modules of an optional extra.

    Raises:
        ConfigError: If it is not installed.
    """
    try:
        return [import_module(module) for module in modules]
    except ImportError as error:
        raise ConfigError(f"--{extra}: {error.name} is not installed; type pip install 'acmr[{extra}]'") from error


def _module(teacher: Teacher) -> nn.Module:
    return DeterministicPolicy(teacher.build_networks().actor).eval()


def _example(teacher: Teacher) -> Tensor:
    # Two rows, so that no number of rows is taken for a constant.
    return torch.zeros(2, teacher.description.dims.observation)


def _for_others(teacher: Teacher) -> tuple[Teacher, str]:
    """The policy without the running normalization around it, which other programs do not have; and a note on that."""
    about = teacher.description
    told = about.config.get("env")
    wrappers = [entry.get(NAME) for entry in told.get("wrappers") or []] if isinstance(told, dict) else []
    if not wrappers:
        return teacher, ""
    states = [state for state in teacher.wrapper_states().values() if "names" in state]
    # Two of them, or what else scales, is more than one linear layer can be told in general.
    if len(states) != 1 or not set(wrappers) <= {"NormalizeObservation", "FrameStackObservation", "NormalizeReward"}:
        return teacher, f"it expects observations from within the wrappers {', '.join(map(str, wrappers))}"
    state = states[0]
    rows = {name: row for row, name in enumerate(state["names"])}
    # Frames that are stacked outside of it were normalized alike, whenever they were seen.
    found = [rows.get(name, rows.get(name.partition(AGO)[0])) for name in about.observation_names]
    if None in found:
        return teacher, "it expects observations that are normalized as in its training"
    normalization = Normalization(state["mean"][found], state["var"][found], _epsilon(told))
    tensors = for_plain_observations(teacher.tensors, normalization, about.dims)
    plain = replace(teacher, tensors={name: tensor.float() for name, tensor in tensors.items()})
    return plain, "the running normalization is part of the first layers now: it expects observations as they are"


def _epsilon(env: Any) -> float:
    """What the normalization adds to the variance; Gymnasium's own value where none was typed."""
    given = next(entry for entry in env["wrappers"] if entry.get(NAME) == "NormalizeObservation")
    return float(given.get("epsilon", signature(NormalizeObservation).parameters["epsilon"].default))


def _sb3(teacher: Teacher, path: Path) -> None:
    needed("sb3", "stable_baselines3")
    write_sb3(teacher, path)


_WRITERS = {
    "torchscript": (write_torchscript, "policy.pt"),
    "onnx": (write_onnx, "policy.onnx"),
    "sb3": (_sb3, "model.zip"),
}


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog=typed("export"), description=__doc__, epilog="docs/exchange.md")
    parser.add_argument("run", type=Path, metavar="RUN", help="a finished run's directory, or a teacher")
    for name, (_, example) in _WRITERS.items():
        parser.add_argument(f"--{name}", type=Path, metavar="FILE", help=f"as in {example}")
    given = parser.parse_args(arguments)
    chosen = {name: path for name in _WRITERS if (path := getattr(given, name)) is not None}
    if not chosen:
        options = ", ".join(f"--{name} {example}" for name, (_, example) in _WRITERS.items())
        parser.error(f"nothing to write; type one or more of {options}")
    try:
        teacher, note = _for_others(load_policy(given.run)[0])
        if note:
            print(terminal(f"note: {note}"))
        for name, path in chosen.items():
            if not path.parent.is_dir():
                raise ConfigError(f"--{name} {path}: there is no folder {path.parent}")
            _WRITERS[name][0](teacher, path)
            print(terminal(f"written: {path} ({teacher.description.dims})"))
    except ConfigError as error:
        print(terminal(f"error: {error}"), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
