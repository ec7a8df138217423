"""What decides, besides the settings, which bits a run computes: versions, processor, program, and samples of each.

A run goes on exactly only where all of it is as it was.
"""

from __future__ import annotations

import ast
import hashlib
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from types import CodeType

import numpy as np
import torch

#: Libraries whose versions a run reports.
_REPORTED_LIBRARIES = ("acmr", "torch", "numpy", "gymnasium", "mujoco", "hydra-core", "omegaconf", "wandb")
#: Those of them whose change changes results.
_LIBRARIES = ("python", "torch", "numpy", "gymnasium", "mujoco")
#: Where a run begins, and the package that it is of.
_ROOT, _OURS = "acmr.run.experiment", "acmr"
#: Packages of it that only name, start, show or send a run; every other one may decide what it computes.
_ASIDE = frozenset(("settings", "tracking", "evaluation", "app"))


def fingerprint(threads: int, device: str, environment_trace: bytes, chosen: tuple[str, ...] = ()) -> dict[str, str]:
    """Everything that must be the same for a run to go on exactly, by name.

    Args:
        chosen: Modules that only the settings name: the learner's, the transfer method's.
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
        "program": _digest(_program(chosen)),
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


def _program(chosen: tuple[str, ...]) -> bytes:
    """What the sources that decide results compile to, without comments, docstrings and positions.

    Only those in use: what the run imports, and what its settings choose. So a method that is added voids no checkpoint
    of runs that know nothing of it.
    """
    waiting, found = [_ROOT, *chosen], dict[str, str]()
    while waiting:
        name = waiting.pop()
        if name in found or _ASIDE.intersection(name.split(".")[1:2]):
            continue
        file = _file_of(name)
        if file is not None:
            imported, found[name] = _source(file)
            waiting += [module for module in imported if module.split(".")[0] == _OURS]
    return "\n".join(f"{name} {meaning}" for name, meaning in sorted(found.items())).encode()


def _file_of(module: str) -> Path | None:
    """The source of a module; None where there is none, as for a name that a module merely holds."""
    if module.split(".")[0] != _OURS:
        # In a folder of the user's, or installed.
        spec = find_spec(module)
        return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None
    place = Path(__file__).resolve().parents[1].joinpath(*module.split(".")[1:])
    files = (place / "__init__.py", place.with_suffix(".py"))
    return next((file for file in files if file.is_file()), None)


@cache
def _source(file: Path) -> tuple[list[str], str]:
    """The modules that a file may import, with the packages they lie in, and what it compiles to."""
    tree = ast.parse(file.read_bytes())
    names = set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    within = {name.rsplit(".", depth)[0] for name in names for depth in range(name.count(".") + 1)}
    return sorted(within), _meaning(compile(tree, file.name, "exec", optimize=2, dont_inherit=True))


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
