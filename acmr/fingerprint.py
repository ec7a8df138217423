"""What decides, besides the settings, which bits a run computes: versions, processor, program, and samples of each.

A run goes on exactly only where all of it is as it was.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import CodeType

import numpy as np
import torch

from acmr.provenance import machine, versions

#: Libraries whose change changes results.
_LIBRARIES = ("python", "torch", "numpy", "gymnasium", "mujoco")
#: Parts of this program that only name, show or send a run; any other part may decide what it computes.
_ASIDE = frozenset(
    ("camera", "compose", "disk", "evaluation", "heartbeat", "identity", "messages", "mirror", "progress", "provenance",
     "rollout", "stopping", "summary", "tracking", "video", "wandb_backend", "features", "__main__")
)  # fmt: skip


def fingerprint(threads: int, device: str, environment_trace: bytes) -> dict[str, str]:
    """Everything that must be the same for a run to go on exactly, by name.

    Args:
        threads: Threads that the learner computes with.
        device: Where it computes.
        environment_trace: What the environment returned in a rehearsal.
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
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine().encode()
    flags = next((line.partition(":")[2] for line in lines if line.startswith(("flags", "Features"))), "")
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
    folder = Path(__file__).resolve().parent
    paths = sorted(path for path in folder.rglob("*.py") if path.stem not in _ASIDE)
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
