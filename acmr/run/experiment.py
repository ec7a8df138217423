"""One run from its settings to its results: what is done in which order, and what is said to the user."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any

import torch

from acmr.envs.physics import no_log_file
from acmr.records import DIVERGED
from acmr.run.checkpointing import Checkpoints, CheckpointSchedule, discard_checkpoints, make_checkpoints
from acmr.run.preparation import Prepared, prepare
from acmr.run.run_state import RunState, check_space, make_state
from acmr.run.stop_signals import StopSignals
from acmr.run.summary import describe_teacher, reached, summarize
from acmr.run.trainer import DivergedError, FailedError, Trainer
from acmr.settings.run_spec import RunSpec
from acmr.storage.durable import FileDigest, StorageError, WriteError
from acmr.storage.run_dir import RunDir, holds_run
from acmr.text import one_line
from acmr.tracking.observer import close_all
from acmr.tracking.watchers import make_watchers
from acmr.transfer.teacher import save_teacher


def run_experiment(
    spec: RunSpec, say: Callable[[str], None] = print, begun: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Trains what ``spec`` describes, from where it was left, unless that has been done.

    Args:
        spec: The run.
        say: Where lines for the user go.
        begun: Called once the run has been begun from its first step, and nothing is left of what was there.

    Returns:
        The run's summary, as in ``summary.json``; its ``status`` is ``complete`` or ``diverged``.

    Raises:
        ConfigError: If the run cannot be made; its ``exit_code`` says of which kind that is.
        Stopped: If the run was asked to stop (a ``SystemExit``).
    """
    run_dir, config = RunDir(spec.directory), spec.config
    done = _finished(spec, run_dir, say)
    if done is not None:
        return done
    torch.set_num_threads(config.threads)
    prepared = prepare(spec)
    check_space(config, prepared.networks, run_dir.path, run_dir.checkpoint_folder)
    try:
        with run_dir.lock(), run_dir.log(say) as say:
            # While this process prepared itself, another may have finished the run.
            done = _finished(spec, run_dir, say)
            if done is not None:
                return done
            with StopSignals() as stop, no_log_file():
                return Session(prepared, run_dir, stop, say, begun).run()
    except WriteError as error:
        raise StorageError(run_dir.path, error) from error


def exit_code(summary: dict[str, Any]) -> int:
    """What a process that made a run ends with: 0, or 3 if it diverged."""
    return 3 if summary["status"] == DIVERGED else 0


def _finished(spec: RunSpec, run_dir: RunDir, say: Callable[[str], None]) -> dict[str, Any] | None:
    if not holds_run(run_dir, spec.config):
        return None
    summary = run_dir.summary()
    if summary is not None and summary.get("status") == DIVERGED:
        say(f"{run_dir}: diverged at step {summary.get('step')} ({summary.get('cause')}); force=true runs it anew")
        return summary
    if not run_dir.is_complete() or summary is None:
        return None
    discard_checkpoints(run_dir)
    say(f"{run_dir}: complete already{reached(summary)}; force=true runs it anew")
    return summary


@dataclass
class Session:
    """One process's work on a run that it holds."""

    prepared: Prepared
    run_dir: RunDir
    stop: StopSignals
    say: Callable[[str], None]
    begun: Callable[[], None]
    _settings: FileDigest = field(init=False)

    def run(self) -> dict[str, Any]:
        """Trains to the end, and stores what came of it."""
        remarks = self.prepared.about.remarks(self.prepared.spec.config.env.name)
        for line in [f"run: {self.run_dir}", *remarks, *self.prepared.report.lines()]:
            self.say(line)
        state = make_state(self.prepared, self.run_dir)
        checkpoints = make_checkpoints(self.prepared, state, self.run_dir)
        try:
            self._start(checkpoints, state)
            return self._train(checkpoints, state)
        except WriteError as error:
            raise StorageError(self.run_dir.path, error, checkpoints.latest) from error
        except FailedError as error:
            then = f"; it resumes at step {checkpoints.latest:,}" if checkpoints.latest else ""
            raise FailedError(f"{self.run_dir}: {error}; mend that, then run the same command again{then}") from error
        finally:
            self._close(state)

    def _start(self, checkpoints: Checkpoints, state: RunState) -> None:
        spec, run_dir, trainer = self.prepared.spec, self.run_dir, state.trainer
        if not spec.config.force and checkpoints.load(self.say) is not None:
            self.say(f"{run_dir}: resumed at step {trainer.global_step:,} of {trainer.total_timesteps:,}")
        else:
            if run_dir.config_file.exists():
                why = "run anew" if spec.config.force else "it had no checkpoint yet"
                self.say(f"{run_dir}: {why}; starting from the first step")
            checkpoints.clear()
            run_dir.start(spec.settings)
            state.logs.begin()
            self.begun()
        if not run_dir.transfer_file.exists():
            run_dir.write_json(run_dir.transfer_file, asdict(self.prepared.report))
        self._settings = run_dir.settings_digest()

    def _train(self, checkpoints: Checkpoints, state: RunState) -> dict[str, Any]:
        spec, trainer, run_dir = self.prepared.spec, state.trainer, self.run_dir
        schedule = CheckpointSchedule(checkpoints, self.prepared, state, self.stop, self.say)
        # The run's own record comes first, whatever becomes of those that show it; a checkpoint of a step holds all of
        # that step, so its schedule comes last.
        watchers = make_watchers(spec, trainer.global_step, self.say)
        trainer.audition.on_chosen = lambda line: self.say(f"{run_dir}: step {trainer.global_step:,}: {line}")
        trainer.observers = [state.logs, *watchers, schedule]
        try:
            state.clock.start()
            summary = self._summary(checkpoints, state, _train(trainer))
            if summary["status"] != DIVERGED:
                about = self.prepared.about
                description = describe_teacher(spec, about, trainer.agent, state.environment, summary, self.say)
                save_teacher(run_dir.path, trainer.agent.networks, description)
            # Every row is on the disk before anything says that the run is finished, and a run with a summary is.
            files = {run_dir.config_file.name: self._settings, **state.logs.digests()}
            summary = run_dir.finish(summary, files)
        except BaseException:
            # What ended the run matters more than what closing may raise; a tracker may take a while for it.
            self.stop.release()
            with suppress(Exception):
                close_all(trainer.observers, None)
            raise
        self.stop.release()
        close_all(trainer.observers, summary)
        if summary["physics_warnings"]:
            counts = ", ".join(f"{count:,} x {kind}" for kind, count in summary["physics_warnings"].items())
            self.say(f"{run_dir}: MuJoCo warned of the simulation: {counts}")
        if summary["status"] == DIVERGED:
            last = f"; the checkpoint of step {checkpoints.latest:,} is kept" if checkpoints.latest else ""
            self.say(f"{run_dir}: diverged at step {summary['step']:,}: {summary['cause']}{last}")
        else:
            self._remove(checkpoints)
            speed = f"{summary['steps_per_second']:.0f} steps per second"
            self.say(f"{run_dir}: complete, {speed}{reached(summary)}")
        return summary

    def _close(self, state: RunState) -> None:
        try:
            state.trainer.env.close()
        except Exception as error:
            # The run is what it is; whether its environment could be closed is no part of it.
            self.say(f"warning: the environment could not be closed ({one_line(error)})")
        finally:
            state.logs.close()

    def _remove(self, checkpoints: Checkpoints) -> None:
        try:
            checkpoints.clear()
        except WriteError as error:
            self.say(f"warning: the checkpoints of this finished run are still there ({error}); remove them")

    def _summary(
        self, checkpoints: Checkpoints, state: RunState, diverged: DivergedError | None = None
    ) -> dict[str, Any]:
        more = {
            "matrix_products": asdict(self.prepared.products),
            "physics_warnings": dict(state.warnings.counts),
            "inexact_resumes": checkpoints.inexact,
        }
        audition = state.trainer.audition
        if audition.returns:
            more |= {"audition": {"chosen": audition.best if audition.is_over else None, "returns": audition.returns}}
        steps, history = state.trainer.global_step, state.logs.history
        return summarize(self.prepared.spec, history, steps, state.clock.seconds, diverged) | more


def _train(trainer: Trainer) -> DivergedError | None:
    """Trains to the end; returns what ended it before."""
    try:
        trainer.train()
    except DivergedError as error:
        return error
    return None
