"""Whether a process that a lock or a status file names is still there, and how much memory this one can have."""

from __future__ import annotations

import math
import os
import platform
import re
from contextlib import suppress
from pathlib import Path


def is_alive(process: int, host: str) -> bool:
    """Whether a process is still there; of another machine nothing is known, so that its processes count as alive."""
    if host != platform.node():
        return True
    # Others mean groups of processes, or nothing; a status file may hold any number.
    if not 0 < process < 1 << 31:
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        # It is somebody else's.
        return True
    return True


def free_memory() -> float:
    """Bytes that this process can have: what Linux calls available, within the limits of its control groups.

    Elsewhere it is the memory that is built in; infinite where nothing is known.
    """
    free = math.inf
    with suppress(OSError, ValueError):
        free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError):
        said = re.search(r"^MemAvailable:\s+(\d+) kB$", Path("/proc/meminfo").read_text(), re.MULTILINE)
        free = 1024 * int(said[1]) if said else free
    return min([free, *_limits()])


def _limits() -> list[int]:
    """Limits that a container or a cluster's job has, in bytes."""
    found = []
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            # Version 2 has one tree of all controllers, version 1 one of each.
            top, name = Path("/sys/fs/cgroup"), "memory.max"
            if "memory" in controllers.split(","):
                top, name = top / "memory", "memory.limit_in_bytes"
            place = top / path.lstrip("/")
            for folder in (place, *place.parents):
                # Within a container the path is the host's, and only the top is there; "max" is no limit.
                with suppress(OSError, ValueError):
                    found.append(int((folder / name).read_text()))
    return found
