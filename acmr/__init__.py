"""Actor-Critic Model Reuse: transfer in deep reinforcement learning when an agent's body changes.

``acmr.train``, ``acmr.load`` and ``acmr.results`` are the whole of it from Python (docs/python.md). They are loaded
when first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acmr.command import open_closed_streams

if TYPE_CHECKING:
    from acmr.app.policies import Policy, load
    from acmr.app.results import Results, results
    from acmr.app.runs import Run, train

__version__ = "0.1.0"
__all__ = ["Policy", "Results", "Run", "load", "results", "train"]

# Before anything else is imported: some libraries cannot be where a stream is closed.
open_closed_streams()


def __getattr__(name: str) -> Any:
    # torch, MuJoCo and pandas take seconds, and whoever imports a part of the package may need none of them.
    if name not in __all__:
        raise AttributeError(f"module 'acmr' has no attribute {name!r}; it offers {', '.join(__all__)}")
    if name in ("Run", "train"):
        from acmr.app import runs

        return getattr(runs, name)
    if name in ("Policy", "load"):
        from acmr.app import policies

        return getattr(policies, name)
    from acmr.app import results

    return getattr(results, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
