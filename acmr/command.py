"""What every command of the project begins with: nothing that it prints can end it, and Ctrl-C ends it in one line.

So does what the system refuses: a name that is too long, a folder that is gone or locked, a disk that is full. And
how the commands are called in the lines that they print.

The standard library only, so that it is there before anything that takes long to load.
"""

from __future__ import annotations

import io
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec

from acmr.names import terminal
from acmr.text import without_userinfo

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_Arguments = ParamSpec("_Arguments")
#: The exit code after Ctrl-C.
INTERRUPTED = 130
#: The exit code of what cannot be done.
REFUSED = 2
#: Seconds that threads of an environment's have when the program is over.
_LAST_WAIT = 5.0
#: The command of an installed program; its words for what is a module or a file of a checkout.
PROGRAM = "acmr"
SUBCOMMANDS = {
    "train": "run.py",
    "status": "sweeps.status",
    "analyze": "analysis",
    "publish": "analysis.publish",
    "evaluate": "acmr.evaluation",
    "envs": "acmr.envs",
    "mirror": "acmr.tracking.mirror",
    "export": "acmr.exchange.exports",
    "import": "acmr.exchange.imports",
    "tune": "acmr.app.tune",
}
#: Whether this is a checkout; looked up once, for later the place may be one that this process may not look into.
_IN_CHECKOUT = os.path.isfile(Path(__file__).resolve().parents[1] / SUBCOMMANDS["train"])
#: Who was started as ``acmr`` is told ``acmr`` words; so are its workers, and whoever has no ``run.py``.
_STARTED_AS = "ACMR_STARTED_AS"
if Path(sys.argv[0] if getattr(sys, "argv", None) else "").stem == PROGRAM:
    os.environ[_STARTED_AS] = PROGRAM


def typed(subcommand: str = "train") -> str:
    """What to type for a subcommand: ``python run.py`` or ``acmr``, ``python -m acmr.envs`` or ``acmr envs``.

    Args:
        subcommand: A key of :data:`SUBCOMMANDS`.
    """
    module = SUBCOMMANDS[subcommand]
    if _IN_CHECKOUT and os.environ.get(_STARTED_AS) != PROGRAM:
        return f"python {module}" if subcommand == "train" else f"python -m {module}"
    return PROGRAM if subcommand == "train" else f"{PROGRAM} {subcommand}"


def add_own_modules() -> None:
    """Lets settings name modules of the user's own that lie in the current folder (``env.id=my_robots:Cart-v0``).

    Behind all others: a folder of the user's that is called ``analysis`` is not to be taken for ours.
    """
    if "" not in sys.path and (here := os.getcwd()) not in sys.path:
        sys.path.append(here)


def command(main: Callable[_Arguments, int]) -> Callable[_Arguments, int]:
    """Makes a function the whole of a program: with streams that never fail, and an end in one line after Ctrl-C.

    An error of the system's that nobody has seen to is one line as well: it is about a file, not about the program.

    Args:
        main: Returns the exit code.
    """

    @wraps(main)
    def run(*arguments: _Arguments.args, **more: _Arguments.kwargs) -> int:
        protect_streams()
        before = set(threading.enumerate())
        code = 1
        try:
            # Libraries ask for it as they are loaded, and some end the process where there is none.
            os.getcwd()
        except OSError as error:
            return _refused(f"the current folder is gone ({error.strerror}); cd to one that is there")
        try:
            code = main(*arguments, **more)
        except KeyboardInterrupt:
            code = _interrupted()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
            raise
        except OSError as error:
            if error.errno is None:
                raise
            place = f"{os.fsdecode(error.filename)}: " if isinstance(error.filename, str | bytes) else ""
            code = _refused(f"{place}{error.strerror}")
        finally:
            end_without(before, code)
        return code

    return run


def end_without(before: set[threading.Thread], code: int) -> None:
    """Lets a thread that somebody's code has begun and never ends, an environment's for instance, not keep the process.

    Python waits for such a thread when the program is over. It has a few seconds then.

    Args:
        before: Threads that were there before that code was run; they are their owner's business.
        code: The exit code of the program.
    """

    def left() -> list[threading.Thread]:
        return [thread for thread in threading.enumerate() if thread not in before and not thread.daemon]

    def watch() -> None:
        # Over as soon as the program's last line is; then those of thread pools are told to end, and do.
        threading.main_thread().join()
        until = time.monotonic() + _LAST_WAIT
        while left():
            if time.monotonic() > until:
                names = terminal(", ".join(thread.name for thread in left()))
                print(
                    f"warning: a thread that is not this program's does not end ({names}); ended without it",
                    file=sys.stderr,
                )
                for stream in (sys.stdout, sys.stderr):
                    stream.flush()
                os._exit(code)
            time.sleep(0.05)

    if left():
        threading.Thread(target=watch, name="end", daemon=True).start()


def end_at_ctrl_c() -> None:
    """Lets Ctrl-C end this process where it stands, until somebody else takes care of it.

    Libraries that are being loaded may take a KeyboardInterrupt for an error of their own, and go on without a part of
    themselves. For programs that hold nothing then which would be lost.
    """
    # A notebook's kernel is to stay, and who started this in the background may have chosen that Ctrl-C does nothing.
    if "IPython" not in sys.modules and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(_interrupted()))


def _refused(reason: str) -> int:
    print(without_userinfo(terminal(f"error: {reason}")), file=sys.stderr)
    return REFUSED


def _interrupted() -> int:
    # Straight to the stream's number: a signal may come while something else is being printed.
    with suppress(OSError):
        os.write(2, b"stopped by Ctrl-C; the same command starts it again\n")
    return INTERRUPTED


def open_closed_streams() -> None:
    """Puts the null device in the place of each standard stream that was closed before the program started."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # Else the next file that is opened, a checkpoint for instance, has this number, and what a library in C
            # writes to standard error lands in it. This is the lowest number that is free, so it is the one we get.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if getattr(sys, name) is None:
            stream = open(number, "w" if number else "r", encoding="utf-8", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)


def protect_streams() -> None:
    """Lets standard output and standard error lose what nobody can take, in place of ending the program.

    A reader that has gone (``| head``), a full disk, a terminal that was closed, a character that the terminal's
    encoding lacks: what is printed is for people, and no work depends on it. Libraries print through the same streams.
    Streams that something else has put in their places, a notebook for instance, stay as they are.
    """
    _keep_encoding_to_itself()
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is getattr(sys, f"__{name}__") and isinstance(stream, io.TextIOWrapper):
            stream = _protected(number, stream)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)


def _keep_encoding_to_itself() -> None:
    # Libraries ask a Python of their own what there is (GLFW where MuJoCo is loaded), and read its answer as ASCII.
    encoding = os.environ.get("PYTHONIOENCODING", "").partition(":")[0]
    with suppress(LookupError):
        if encoding and "a\n".encode(encoding) != b"a\n":
            del os.environ["PYTHONIOENCODING"]


def _protected(number: int, stream: io.TextIOWrapper) -> io.TextIOWrapper:
    with suppress(OSError):
        stream.flush()
    raw = _Lossy(number, "wb", closefd=False)
    # As Python itself does it: without a buffer where it was started with -u.
    buffer = raw if stream.write_through else io.BufferedWriter(raw)
    return io.TextIOWrapper(
        buffer, stream.encoding, "replace", line_buffering=stream.line_buffering, write_through=stream.write_through
    )


class _Lossy(io.FileIO):
    """A stream that takes whatever is written to it; what cannot be passed on is lost."""

    def write(self, data: ReadableBuffer, /) -> int:
        """Writes all of it, if that is possible."""
        rest = memoryview(data)
        size = len(rest)
        with suppress(OSError):
            while rest:
                written = super().write(rest)
                if written is None:
                    # Somebody who shares the stream has made it one that does not wait.
                    select.select([], [self], [])
                rest = rest[written or 0 :]
        return size
