"""All that knows how W&B works: its folders, its variables, its service process.

What was found out about it is in ``docs/tracking.md``.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import re
import signal
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acmr.settings.run_spec import RunSpec
from acmr.storage.durable import remove_tree
from acmr.text import one_line

if TYPE_CHECKING:
    from wandb import Run

#: Seconds that a server may take to answer at the start, and to take what is left at the end.
SERVER_WAIT = 10.0
#: Longest id, group and tag that W&B takes.
LONGEST = {"id": 120, "group": 120, "tag": 64}
#: Folder, in the flat one, of links with names to be read.
LINKS = "by_name"
#: Variables of the user that W&B may see; all others would change what a run is, or where it goes.
_KEPT_VARIABLES = frozenset(
    ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE", "WANDB_CREDENTIALS_FILE", "WANDB_INSECURE_DISABLE_SSL")
)
#: How W&B begins the name of a run's folder.
_TIMED = re.compile(r"(offline-)?run-(\d{8}_\d{6})-")
#: Seconds that a process which was killed may take to vanish.
_END_WAIT = 2.0
#: W&B's connection to the service process of this one.
_connections: list[Any] = []
_NOT_IN_ID = re.compile(r"[^A-Za-z0-9_.,=+-]+")


def mirror_folder(spec: RunSpec) -> Path:
    """The one flat folder of all mirrors, absolute; W&B insists on the name ``wandb``."""
    chosen = spec.config.tracking.dir
    if chosen is None:
        return Path(spec.config.output_dir).absolute() / "wandb"
    folder = Path(chosen).expanduser().absolute()
    return folder if folder.name == "wandb" else folder / "wandb"


def run_id(spec: RunSpec) -> str:
    """A readable id, the same whenever the same run is started: ``paper-armless_humanoid-hidden-frozen-s3``.

    A folder that was chosen may serve several output directories: there the id tells them apart.
    """
    name = f"{spec.config.profile}-{spec.name}"
    ending = f"-s{spec.config.seed}"
    if spec.config.tracking.dir is not None:
        ending += "-" + _digest(str(Path(spec.config.output_dir).absolute()))
    clean = _NOT_IN_ID.sub("_", name)
    if clean != name or len(clean) + len(ending) > LONGEST["id"]:
        ending = f"-{_digest(name)}{ending}"
    return clean[: LONGEST["id"] - len(ending)] + ending


def mirrors_of(folder: Path, name: str) -> list[Path]:
    """The W&B folders in a flat folder that hold the run with this id."""
    pattern = re.compile(_TIMED.pattern + re.escape(name) + r"(-\d+)?")
    return sorted(path for path in folder.glob("*run-*") if pattern.fullmatch(path.name) and _holds(path, name))


def remove_mirrors(folder: Path, name: str) -> None:
    """Removes earlier mirrors of a run, so that no viewer shows it twice."""
    for path in mirrors_of(folder, name):
        remove_tree(path)
    _drop_dead_links(folder)


def link_by_name(folder: Path, mirror: Path, label: str) -> None:
    """Makes a mirror appear in the dashboard under a short name.

    ``wandb leet`` lists folders, the first 34 characters of their names, and opens only those that are named as W&B
    names them; ``offline-run-20261122_093621-`` alone would fill the line.

    Args:
        folder: The flat folder of mirrors.
        mirror: The W&B folder of the run.
        label: What tells the run apart, in a few characters.
    """
    started = _TIMED.match(mirror.name)
    if started is None:
        return
    label = _NOT_IN_ID.sub("_", label)
    link = folder / LINKS / f"run-{started[2]}-{label}" / f"run-{label}.wandb"
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(Path("..", "..", mirror.name, f"run-{_id_of(mirror)}.wandb"))


def linked_mirrors(folder: Path) -> Path:
    """The folder of links to all mirrors, brought up to date."""
    linked = _drop_dead_links(folder)
    for mirror in folder.glob("*run-*"):
        if mirror.name not in linked:
            link_by_name(folder, mirror, _id_of(mirror))
    return folder / LINKS


def server_problem(base_url: str | None) -> str | None:
    """What keeps a server from being used, in words; None if it answers in time and there is a key for it."""
    if not os.environ.get("WANDB_API_KEY"):
        return "WANDB_API_KEY is not set, which the server needs"
    answer: list[str] = []
    # Looking up a name has no time limit of its own: a thread has.
    thread = threading.Thread(target=lambda: answer.append(_ask(str(base_url))), daemon=True)
    thread.start()
    thread.join(SERVER_WAIT / 2)
    reason = answer[0] if answer else "no answer in time"
    return f"the server {base_url} cannot be reached ({reason})" if reason else None


def wandb_environment(folder: Path) -> dict[str, str]:
    """The W&B variables of a run or of a ``wandb`` command: the user's key, nothing in the home folder, no reports."""
    kept = {key: value for key, value in os.environ.items() if key in _KEPT_VARIABLES}
    home = folder / ".home"
    places = {f"WANDB_{kind.upper()}_DIR": str(home / kind) for kind in ("data", "cache")}
    # No settings of W&B's own: a folder of mirrors may be somebody else's, and they can lead the key to another server.
    places["WANDB_CONFIG_DIR"] = os.path.join(os.devnull, "none")
    return {**kept, **places, "WANDB_ERROR_REPORTING": "false", "WANDB_SILENT": "true"}


def _ask(base_url: str) -> str:
    """Why the address gave no HTTP answer; empty if it did, whatever the answer."""
    try:
        with urllib.request.urlopen(base_url, timeout=SERVER_WAIT / 2):
            return ""
    except urllib.error.HTTPError:
        return ""
    except Exception as error:
        return one_line(error)


def start(arguments: Mapping[str, Any], folder: Path, server: str | None) -> Run:
    """Starts W&B; raises whatever W&B raises, and leaves no service process then."""
    try:
        return _start(arguments, folder, server)
    except SystemExit as error:
        # W&B would end the whole process.
        end_service(1)
        raise RuntimeError(f"W&B ended with exit code {error.code}") from error
    except Exception:
        end_service(1)
        raise


def _start(arguments: Mapping[str, Any], folder: Path, server: str | None) -> Run:
    with wandb_variables(wandb_environment(folder)):
        import wandb

        # W&B has its own log files; a run's log and its terminal are no place for it.
        _keep_to_itself(logging.getLogger("wandb"))
        settings = wandb.Settings(
            mode="online" if server else "offline",
            # W&B leaves all but the last second of a killed run.
            x_transaction_log_flush_interval=1.0,
            x_file_stream_transmit_interval=5.0,
            init_timeout=SERVER_WAIT,
            finish_timeout=SERVER_WAIT,
            finish_timeout_raises=True,
            # A run that was not finished in this process must not be handed out again.
            reinit="create_new",
            # What costs time or writes elsewhere, and what a mirror does not need.
            console="off",
            silent=True,
            symlink=False,
            use_dot_wandb=False,
            save_code=False,
            disable_code=True,
            disable_git=True,
            sagemaker_disable=True,
            x_disable_stats=True,
            x_disable_meta=True,
            x_disable_machine_info=True,
            x_disable_viewer=True,
            x_save_requirements=False,
        )
        if server:
            settings.base_url = server
        run = wandb.init(dir=str(folder.parent), settings=settings, **arguments)
        # Kept here, for W&B itself forgets it as it begins to wait for its end.
        with contextlib.suppress(AttributeError):
            _connections[:] = [wandb.sdk.wandb_setup.singleton()._connection]
    run.define_metric("global_step", hidden=True)
    run.define_metric("*", step_metric="global_step")
    return run


def _keep_to_itself(logger: logging.Logger) -> None:
    logger.propagate = False
    add = logging.Logger.addHandler

    def add_quiet(hdlr: logging.Handler) -> None:
        # A line that its file does not take, as of a path that is no text, is lost there and no matter for the user.
        hdlr.handleError = lambda record: None  # type: ignore[method-assign]
        add(logger, hdlr)

    # On this one logger only: W&B adds its files to it while it starts, and writes to them at once.
    logger.addHandler = add_quiet  # type: ignore[method-assign]


def end_service(exit_code: int) -> None:
    """Ends W&B's service process, so that nothing is left to wait for when the program ends."""
    wandb = sys.modules.get("wandb")
    if wandb is not None:
        # A service that died raises here, one that failed exits; each forgets the user's WANDB_SERVICE.
        with wandb_variables({}), contextlib.suppress(Exception, SystemExit):
            wandb.teardown(exit_code)


def kill_service() -> None:
    """Ends a service process that does not answer, by its number; at the program's end W&B waits for nothing then."""
    wandb = sys.modules.get("wandb")
    if wandb is None:
        return
    # Of all this W&B tells nobody; tests/test_tracking_hang.py finds out if it changes.
    with contextlib.suppress(Exception):
        connection = _connections.pop() if _connections else wandb.sdk.wandb_setup.singleton()._connection
        process = connection._proc._process
        os.kill(process.pid, signal.SIGKILL)
        connection._cleanup()
        process.wait(_END_WAIT)


@contextlib.contextmanager
def wandb_variables(variables: Mapping[str, str]) -> Iterator[None]:
    """Only these W&B variables inside; the user's own ones again outside."""
    before = {key: value for key, value in os.environ.items() if key.startswith("WANDB_")}
    try:
        _set_wandb_variables(variables)
        yield
    finally:
        _set_wandb_variables(before)


def _set_wandb_variables(variables: Mapping[str, str]) -> None:
    for key in [key for key in os.environ if key.startswith("WANDB_")]:
        del os.environ[key]
    os.environ.update(variables)


def make_writable(folder: Path) -> None:
    """Raises OSError if nothing can be written there; W&B itself would quietly go to the system's temporary folder."""
    folder.mkdir(parents=True, exist_ok=True)
    probe = folder / f".probe-{os.getpid()}"
    try:
        probe.write_bytes(bytes(1 << 16))
    finally:
        probe.unlink(missing_ok=True)


def _drop_dead_links(folder: Path) -> set[str]:
    """Removes links to mirrors that are gone; returns the names of the mirrors that are linked."""
    linked = set()
    for link in (folder / LINKS).glob("run-*/run-*.wandb"):
        if link.exists():
            linked.add(link.resolve().parent.name)
        else:
            # Another run may be doing the same.
            with contextlib.suppress(OSError):
                link.unlink()
                link.parent.rmdir()
    return linked


def _id_of(mirror: Path) -> str:
    return next((file.stem.removeprefix("run-") for file in mirror.glob("run-*.wandb")), _TIMED.sub("", mirror.name))


def _holds(path: Path, name: str) -> bool:
    return (path / f"run-{name}.wandb").exists() or not any(path.glob("run-*.wandb"))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:6]
