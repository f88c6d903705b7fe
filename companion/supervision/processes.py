"""Flight processes, as the supervisor starts and ends them, their signs of life, and systemd.

Pulse: a process whose threads hang is not dead, and its heartbeat may continue. So each thread that
a position needs stores the time of its last cycle; the oldest is sent.

Restart: at a first start, a folder that cannot be written to is an error. At a restart in flight it
was right before, so the flight continues without it.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from fcntl import F_DUPFD_CLOEXEC, fcntl
from pathlib import Path

from companion.config import CompanionConfig, load_config, parse_config, resolved
from companion.ending import wait_for_end
from companion.errors import ConfigError
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.link.tlog import is_disk_fault

_PERIOD_S = 0.25


class Pulse:
    """Writes ``NAME MILLISECONDS`` lines: the component whose last cycle is oldest, and its age.

    beats: times of the components' last cycles, CLOCK_MONOTONIC ns; ages count from the start at
    the earliest. descriptor: of a pipe, closed at the end. Writing does not wait for a supervisor
    that does not read.
    """

    def __init__(self, beats: Callable[[], Mapping[str, int]], descriptor: int) -> None:
        self._beats, self._descriptor = beats, descriptor
        os.set_inheritable(descriptor, False)
        os.set_blocking(descriptor, False)
        self._begun_ns = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._begun_ns = monotonic_ns()
        self._thread.start()

    def stop(self, *, clean_shutdown: bool) -> None:
        """Stop the thread, announce the end and close the pipe. After a clean shutdown the
        supervisor allows time to close a recording; after an error it restarts soon.
        """
        self._stop.set()
        ended = wait_for_end(self._thread)
        self._say(f"{ENDING if clean_shutdown else 'failing'} 0\n".encode())
        if ended:  # else its next line would go into whatever file has the number then
            os.close(self._descriptor)

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            turns = {name: max(at, self._begun_ns) for name, at in self._beats().items()}
            self._say(line(turns, monotonic_ns()))

    def _say(self, text: bytes) -> None:
        try:
            os.write(self._descriptor, text)
        except OSError:  # full, or the supervisor is gone: the flight goes on alone
            return


def line(beats: Mapping[str, int], now_ns: int) -> bytes:
    """The line of `Pulse` for now_ns, with `-` for blanks in the name; ``all 0`` without
    components. beats: times of their last cycles, ns.
    """
    if not beats:
        return b"all 0\n"
    name = min(beats, key=lambda one: beats[one])
    age_ms = max(now_ns - beats[name], 0) // 1_000_000
    return f"{name.replace(' ', '-')} {age_ms}\n".encode()


_DISMISS_S = 5.0
_KILL_S = 10.0  # its ports are free once it is gone, and not before
_READ = 4096
ENDING = "ending"  # the last word of a process whose end is in order


@dataclass(frozen=True)
class Beat:
    """Sign of life of a flight process: the component whose last cycle is oldest, and its age."""

    part: str
    age_s: float


class FlightProcess:
    """Starts (in the constructor; OSError) and controls a flight process. standby: it is started
    with ``--standby``, prepares and waits. hands_on: inherited file descriptors.

    It has its own process group, so that the terminal's interrupt reaches it through the supervisor
    only. It has no session of its own, because Linux schedules each session as one group and would
    ignore the supervisor's priority.
    """

    def __init__(
        self, command: Sequence[str], *, standby: bool, hands_on: Sequence[int] = ()
    ) -> None:
        self._beats, end = os.pipe()
        os.set_blocking(self._beats, False)
        self._unread = b""
        try:
            self._process = subprocess.Popen(
                [*command, f"--pulse={end}", *(["--standby"] if standby else [])],
                stdin=subprocess.PIPE if standby else subprocess.DEVNULL,
                pass_fds=(end, *hands_on),
            )
        except BaseException:
            os.close(self._beats)
            raise
        finally:
            os.close(end)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def release(self) -> None:
        """Let a standby fly; harmless if it has died."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                self._process.stdin.write(b"fly\n")
                self._process.stdin.flush()

    def wait(self, timeout_s: float) -> int | None:
        """Wait; exit code, negative for a signal, or None while it runs after timeout_s."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def close(self) -> None:
        """Close the pipe of the signs of life, also repeatedly; the process goes on."""
        if self._beats >= 0:
            os.close(self._beats)
            self._beats = -1

    def beats(self) -> tuple[Beat, ...]:
        """Signs of life since the last call, oldest first. Never blocks."""
        try:
            while data := os.read(self._beats, _READ):
                self._unread += data
        except OSError:  # nothing more for now
            pass
        *lines, self._unread = self._unread.split(b"\n")
        self._unread = self._unread[:_READ]
        return tuple(beat for line in lines if (beat := _beat(line)) is not None)

    def kill(self) -> None:
        """Kill it (SIGKILL), and wait up to 10 s until it is gone."""
        self._process.kill()
        self.wait(_KILL_S)

    def send_signal(self, number: int) -> None:
        """Send the signal `number`; harmless if the process has ended."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def dismiss(self) -> None:
        """End an unused standby: close its input, kill it if it has not ended after 5 s, and close
        the pipes.
        """
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        if self.wait(_DISMISS_S) is None:
            self.kill()
        self.close()


def _beat(line: bytes) -> Beat | None:
    """Parse a line of `companion.supervision.processes`; None for anything else."""
    part, _, age_ms = line.decode(errors="replace").partition(" ")
    return Beat(part, int(age_ms) * 1e-3) if age_ms.isdecimal() and len(age_ms) < 12 else None


_VARIABLE = "NOTIFY_SOCKET"
_LONGEST = 200  # characters of a status


class ServiceManager:
    """Reports to the service manager; does nothing with an empty address. Never blocks.

    address: of a datagram socket, a path, or ``@`` and a name in the abstract name space.
    """

    def __init__(self, address: str) -> None:
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    @classmethod
    def of(cls, environment: MutableMapping[str, str]) -> ServiceManager:
        """From NOTIFY_SOCKET, "" if not set. It is removed from `environment`, so that child
        processes do not use it.
        """
        return cls(environment.pop(_VARIABLE, ""))

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ready(self) -> None:
        """Report that the service has started."""
        self._say("READY=1")

    def alive(self) -> None:
        """Report a sign of life (WatchdogSec)."""
        self._say("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Set the line for `systemctl status`, cut to 200 characters."""
        self._say(f"STATUS={text[:_LONGEST]}")

    def _say(self, text: str) -> None:
        if self._socket is None:
            return
        with contextlib.suppress(OSError):  # it restarts, or its queue is full: the flight goes on
            self._socket.sendto(text.encode(), self._address)


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
