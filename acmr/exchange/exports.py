"""Policies for other programs: ``acmr export RUN --onnx policy.onnx``, ``--torchscript FILE``, ``--sb3 FILE``."""

from __future__ import annotations

import argparse
import logging
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from acmr.agent.networks import Actor
from acmr.command import command, typed
from acmr.config import ConfigError
from acmr.evaluation.evaluate import load_policy
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
        teacher = load_policy(given.run)[0]
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
