"""The deployment of a restart in flight: kept in memory, without settings whose disks failed.

At a first start, a folder that cannot be written to is an error. At a restart in flight it was
right before, so the flight continues without it.
"""

from __future__ import annotations

import json
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from fcntl import F_DUPFD_CLOEXEC, fcntl
from pathlib import Path

from companion.config import CompanionConfig, load_config, parse_config, resolved
from companion.errors import ConfigError
from mavlink_bridge.link.tlog import is_disk_fault


def keep_settings(config: CompanionConfig) -> int:
    """Keep the deployment in memory; returns its file descriptor, to be passed to child processes
    (`pass_fds`) for their `settings_of`.
    """
    with open(os.memfd_create("deployment"), "wb") as file:
        # Escaped: a folder's name may be no UTF-8.
        file.write(json.dumps(config.model_dump(mode="json")).encode())
        # Beyond the standard streams, whose places are free where a program was begun without.
        return fcntl(file, F_DUPFD_CLOEXEC, 3)


def settings_of(path: Path, kept: int | None) -> tuple[CompanionConfig, str]:
    """The deployment of a file; if the file cannot be read, the kept deployment and the reason.

    kept: the descriptor returned by `keep_settings`; None at a first start, where an unreadable
    file is a `ConfigError`.
    """
    try:
        return load_config(path), ""
    except ConfigError as error:
        if kept is None:
            raise
        # Several processes have this descriptor, and one position in it.
        data = os.pread(kept, os.fstat(kept).st_size, 0)
        config = parse_config(json.loads(data), "the supervisor's deployment")
        return resolved(config, Path()), str(error)


_PATIENCE_S = 3.0  # for all disks together: no position comes meanwhile
_STILL = "does not answer"


def without_lost_disks(
    config: CompanionConfig, probe: Callable[[Path], str] | None = None
) -> tuple[CompanionConfig, str]:
    """The deployment without the files whose disk is gone, and a text on what was left out (empty:
    nothing). Takes up to 3 s. A full or failing disk is reported by the component that writes
    (`DiskFaultError`).

    probe: returns why a folder cannot be written to, empty if it can; called for each folder on a
    thread of its own. The default creates the folder if necessary, and writes and removes a file in
    it. A folder that does not answer in time counts as gone.
    """
    bridge, record, state = config.bridge, config.record, config.state_folder
    beside = None if record is None else record.folder.parent
    tlog = bridge.tlog
    folders = {None if tlog is None else tlog.parent, state, beside} - {None}
    lost = _lost(filter(None, folders), probe or write_problem)
    if not lost:
        return config, ""
    # Of what is read, too: without a disk that answers there is nothing to read.
    if tlog is not None and tlog.parent in lost:
        # One that is there is appended to, though its folder takes no other.
        can_append = lost[tlog.parent] != _STILL and os.access(tlog, os.W_OK)
        tlog = tlog if can_append else None
    changed = config.model_copy(
        update={
            "record": None if beside in lost else record,
            "bridge": bridge.model_copy(update={"tlog": tlog}),
            "state_dir": None if state is None or lost.get(state) == _STILL else state,
        }
    )
    return changed, ", ".join(f"{folder}: {why}" for folder, why in sorted(lost.items()))


def _lost(folders: Iterable[Path], probe: Callable[[Path], str]) -> dict[Path, str]:
    found: dict[Path, str] = {}

    def look(folder: Path) -> None:
        found[folder] = probe(folder)

    threads = {
        folder: threading.Thread(target=look, args=(folder,), name="probe", daemon=True)
        for folder in folders
    }
    for thread in threads.values():
        thread.start()
    end_s = time.monotonic() + _PATIENCE_S
    for thread in threads.values():
        thread.join(max(end_s - time.monotonic(), 0.0))
    told = {folder: found.get(folder, _STILL) for folder in threads}
    return {folder: why for folder, why in told.items() if why}


def write_problem(folder: Path) -> str:
    """Why a folder cannot be written to; "" if it can, or if the disk is full or failing. Creates
    the folder if missing; may block as long as the disk does.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(prefix=".again-", dir=folder)
        os.close(descriptor)
        os.unlink(name)
    except OSError as error:
        return "" if is_disk_fault(error) else (error.strerror or str(error))
    return ""
