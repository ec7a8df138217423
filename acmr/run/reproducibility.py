"""What decides, besides the settings, which bits a run computes: versions, processor, program, and samples of each.

A run goes on exactly only where all of it is as it was.
"""

from __future__ import annotations

import hashlib
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from types import CodeType

import numpy as np
import torch

#: Libraries whose versions a run reports.
_REPORTED_LIBRARIES = ("acmr", "torch", "numpy", "gymnasium", "mujoco", "hydra-core", "omegaconf", "wandb")
#: Those of them whose change changes results.
_LIBRARIES = ("python", "torch", "numpy", "gymnasium", "mujoco")
#: Packages of this program that only name, show or send a run; every other one may decide what it computes.
_ASIDE = frozenset(("settings", "tracking", "evaluation"))


def fingerprint(threads: int, device: str, environment_trace: bytes) -> dict[str, str]:
    """Everything that must be the same for a run to go on exactly, by name.

    Args:
        threads: Threads that the learner computes with.
        device: Where it computes.
        environment_trace: What the environment returned while its resuming was checked.
    """
    found = versions()
    where = machine(threads, device)
    return {
        **{name: found[name] for name in _LIBRARIES},
        "system": f"{where['system']}, {platform.libc_ver()[1]}",
        "processor": str(where["processor"]),
        "processor features": _digest(_processor_flags()),
        "threads": str(threads),
        "device": _device_name(device),
        "matrix products": f"{torch.backends.cpu.get_cpu_capability()} {torch.get_float32_matmul_precision()}",
        "sample of computations": _digest(_computations()),
        "sample of the environment": _digest(environment_trace),
        "program": _digest(_program()),
    }


def differences(stored: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """What differs, in words: ``torch 2.13 (now 2.14)``; what is a mere hash only by its name."""
    words = []
    for name in [*here, *(name for name in stored if name not in here)]:
        before, now = stored.get(name, "unknown"), here.get(name, "unknown")
        if before != now:
            is_hash = len(before) == len(now) == 16 and not name.startswith("processor ")
            words.append(name if is_hash or name == "processor features" else f"{name} {before} (now {now})")
    return words


def _processor_flags() -> bytes:
    said = _first_processor()
    flags = said.get("flags") or said.get("Features") or platform.machine()
    return " ".join(sorted(flags.split())).encode()


def _device_name(device: str) -> str:
    return device if torch.device(device).type == "cpu" else f"{device} {torch.cuda.get_device_name(device)}"


def _computations() -> bytes:
    """Products and functions of the kinds that the learner and the policy compute."""
    generator = torch.Generator().manual_seed(0)
    batch, weight = torch.randn(64, 97, generator=generator), torch.randn(97, 65, generator=generator)
    product = batch @ weight
    results = [
        product,
        torch.bmm(batch.expand(2, -1, -1), weight.expand(2, -1, -1)),
        torch.tanh(product),
        torch.exp(product / 50.0),
        torch.log1p(product.abs()),
        product.sum(dim=0),
    ]
    alone = batch[0].numpy() @ weight.numpy()
    return b"".join(result.numpy().tobytes() for result in results) + alone.tobytes() + np.tanh(alone).tobytes()


@cache
def _program() -> bytes:
    """What the sources that decide results compile to, without comments, docstrings and positions."""
    folder = Path(__file__).resolve().parents[1]
    paths = sorted(path for path in folder.rglob("*.py") if path.relative_to(folder).parts[0] not in _ASIDE)
    codes = [compile(path.read_bytes(), path.name, "exec", optimize=2, dont_inherit=True) for path in paths]
    return "\n".join(f"{path.name} {_meaning(code)}" for path, code in zip(paths, codes, strict=True)).encode()


def _meaning(code: CodeType) -> str:
    constants = [_meaning(entry) if isinstance(entry, CodeType) else _stable(entry) for entry in code.co_consts]
    names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    return f"{code.co_name} {code.co_code.hex()} {names} {constants}"


def _stable(constant: object) -> str:
    return repr(sorted(map(repr, constant)) if isinstance(constant, frozenset) else constant)


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that decide what a run computes."""
    found = {"python": platform.python_version()}
    for name in _REPORTED_LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def git_commit() -> str | None:
    """Commit of this checkout, with ``-dirty`` if tracked files differ from it; None outside a checkout."""
    file = Path(__file__).resolve()

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(file.parent), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=20).stdout.strip()

    try:
        # Installed in somebody's virtual environment it may lie in a repository that has nothing to do with it.
        git("ls-files", "--error-unmatch", file.name)
        commit = git("rev-parse", "HEAD")
        return commit + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def machine(threads: int, device: str) -> dict[str, str | int]:
    """The machine, as far as it bears on speed and rounding."""
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "threads": threads,
        "device": device,
    }


def _processor() -> str:
    """The processor's name; with family and model, where it has them, for hypervisors shorten the name."""
    said = _first_processor()
    name = said.get("model name") or platform.processor() or "unknown"
    kind = [f"{key.split()[-1]} {said[key]}" for key in ("cpu family", "model") if key in said]
    return f"{name} ({', '.join(kind)})" if kind else name


def _first_processor() -> dict[str, str]:
    """What Linux says of the first processor, by name; empty elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return {}
    # Reversed, so that the first processor's entries come last and stay.
    return {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in reversed(lines))}
