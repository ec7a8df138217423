"""``acmr tune 'agent.q_lr=interval(1e-4,1e-3)' agent.tau=0.005,0.01 seed=1,2,3 trials=40 profile=quick``.

Words are those of a run and of a sweep. What has several values, or an interval, is searched; all of ``seed`` are
trained, and their mean counts. Of the search itself: ``trials=N``, ``study=NAME``, ``prune=false``, ``workers=N``, and
``metric=`` (default: steps_to_threshold). The page docs/howto-tune.md says more.
"""

from __future__ import annotations

import sys

from acmr.command import PROGRAM, command, typed
from acmr.config import ConfigError
from acmr.names import terminal

#: Words of the search, and where Hydra keeps them.
_WORDS = ("trials", "study", "prune")
_EXTRA = "optuna"


@command
def main() -> int:
    """Runs the command line; returns the exit code."""
    words = sys.argv[1:]
    if not words or set(words) & {"-h", "--help"}:
        print(f"usage: {typed('tune')} KEY=interval(LOW,HIGH) KEY=A,B seed=1,2,3 trials=40 KEY=VALUE ...\n\n{__doc__}")
        return 0 if words else 2
    try:
        _check_extra()
    except ConfigError as error:
        print(terminal(f"error: {error}"), file=sys.stderr)
        return 2
    # Here, for whoever asks for help need not wait.
    from acmr.app.training import main as train

    sys.argv[1:] = ["-m", *_options(words), "hydra/sweeper=tune", *map(_in_hydras_words, _settings(words))]
    return train()


def _options(words: list[str]) -> list[str]:
    """Options of Hydra's, such as ``--config-dir my_study``; they go before all settings."""
    first = next((place for place, word in enumerate(words) if "=" in word and not word.startswith("-")), len(words))
    return words[:first]


def _settings(words: list[str]) -> list[str]:
    return words[len(_options(words)) :]


def _in_hydras_words(word: str) -> str:
    key, equal, value = word.partition("=")
    return f"hydra.sweeper.{key}{equal}{value}" if key in _WORDS else word


def _check_extra() -> None:
    from importlib.util import find_spec

    if find_spec(_EXTRA) is None:
        raise ConfigError(f"{typed('tune')}: {_EXTRA} is not installed; type pip install '{PROGRAM}[tune]'")


if __name__ == "__main__":
    sys.exit(main())
