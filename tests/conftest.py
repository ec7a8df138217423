"""Fixtures for many tests."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings

from acmr.agent.architecture import Architecture, Dimensions
from acmr.agent.networks import Networks
from acmr.transfer.description import FORMAT_VERSION, TeacherDescription
from acmr.transfer.teacher import Teacher, load_teacher, save_teacher

torch.set_num_threads(1)
# Tests that are started in the background inherit that Ctrl-C and hanging up are ignored; the programs under test would
# respect that, and could not be stopped as the tests stop them.
for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) == signal.SIG_IGN:
        with suppress(ValueError):
            signal.signal(number, usual)
# How long an example takes depends on who shares the machine.
settings.register_profile("acmr", deadline=None)
settings.load_profile("acmr")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks further examples of costly tests as slow, so that the fast suite sees each kind once."""
    seen = set()
    for item in items:
        if item.get_closest_marker("first_is_fast"):
            test = item.nodeid.split("[")[0]
            if test in seen:
                item.add_marker(pytest.mark.slow)
            seen.add(test)


@pytest.fixture(autouse=True)
def _settings_of_the_project() -> Iterator[None]:
    """What a command line says of places of settings files holds for one test."""
    yield
    if "acmr.settings.compose" in sys.modules:
        sys.modules["acmr.settings.compose"]._given = None


@pytest.fixture
def teacher_factory(tmp_path: Path) -> Callable[..., Teacher]:
    """Makes teachers with random weights, saved and loaded as a user's would be."""

    def make(
        dims: Dimensions,
        hidden_sizes: tuple[int, ...],
        seed: int = 99,
        core: Dimensions | None = None,
        log_std: str = "tanh",
    ) -> Teacher:
        low, high = np.full(dims.action, -1, np.float32), np.full(dims.action, 1, np.float32)
        architecture = replace(Architecture.plain(dims, hidden_sizes, low, high), core=core)
        networks = Networks(architecture, torch.Generator().manual_seed(seed))
        kind = f"{len(hidden_sizes)}-{seed}-{bool(core)}-{log_std}"
        folder = tmp_path / f"teacher-{dims.observation}-{dims.action}-{kind}"
        folder.mkdir(exist_ok=True)
        description = TeacherDescription(
            format_version=FORMAT_VERSION, environment="made_up", environment_id="MadeUp-v0", model_hash="0" * 64,
            observation_names=[f"obs/{i}" for i in range(dims.observation)],
            action_names=[f"action/{i}" for i in range(dims.action)],
            action_low=low.tolist(), action_high=high.tolist(), hidden_sizes=list(hidden_sizes),
            core=[core.observation, core.action] if core else None, adapter_activation="relu",
            log_alpha=-1.5, seed=seed, profile="quick", global_step=1234, final_return=5.0, config={}, log_std=log_std,
        )  # fmt: skip
        save_teacher(folder, networks, description)
        return load_teacher(folder)

    return make


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory) -> Callable[[tuple[str, ...]], dict[str, bytes]]:
    """What undisturbed runs leave."""
    from torture import Run  # here, so that tests of other things need not load the whole program

    made: dict[tuple[str, ...], dict[str, bytes]] = {}

    def of(overrides: tuple[str, ...]) -> dict[str, bytes]:
        if overrides not in made:
            made[overrides] = Run(tmp_path_factory.mktemp("untouched"), overrides).finish()
        return dict(made[overrides])

    return of
