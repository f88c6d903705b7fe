"""A simulated vehicle as a child process with TCP ports: base of ArduPilot and embedded vehicle."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, TypeVar

from sitl.errors import SimulationError
from sitl.geodesy import Location

VehicleKind = Literal["ardupilot", "embedded"]

BASE_PORT, PORTS_PER_INSTANCE = 5760, 10  # ArduPilot SITL's -I n shifts every port by 10 n
_GCS_OFFSET, _COMPANION_OFFSET, _SPARE_OFFSET = 0, 2, 3
_INSTANCES = range(200)
_POLL_S = 0.05
_STOP_TIMEOUT_S = 5.0
_WHOLE_LOG = 1 << 20
_LOG_TAIL = 1500  # characters of the process's log quoted in an error
PARAMETERS = "extra.parm"  # file of what is set over the vehicle's defaults

_Self = TypeVar("_Self", bound="VehicleProcess")


class VehicleProcessError(SimulationError):
    """A simulated vehicle did not start or died; names its log."""


class VehicleProcess(ABC):
    """A vehicle process. Use as a context manager, or `start` and `stop`.

    gcs_endpoint and companion_endpoint ("tcp:127.0.0.1:PORT") are its first two serial ports;
    spare_endpoint is a third, free for an independent observer.

    It runs in a temporary folder that is removed at its end, also after a crash. Its output goes to
    a file there, or to `log`, which stays; errors quote the end of it.

    home: altitude AMSL. parameters: over the vehicle's defaults. seed, px4: the embedded vehicle's
    noise, and whether it has PX4's interface (`sitl.embedded.parameters`).
    """

    kind: VehicleKind
    start_timeout_s: float

    def __init__(
        self, home: Location, heading_deg: float = 0.0, parameters: dict[str, float] | None = None,
        speedup: float = 1.0, seed: int = 0, log: Path | None = None, px4: bool = False,
    ) -> None:  # fmt: skip
        self.home = f"{home.latitude_deg},{home.longitude_deg},{home.altitude_m},{heading_deg}"
        self.speedup, self.seed, self.px4 = speedup, seed, px4
        self._parameters = parameters or {}
        self._log = log
        self._folder: Path | None = None
        self._instance = -1
        self._process: subprocess.Popen[bytes] | None = None
        self._lifeline: subprocess.Popen[bytes] | None = None

    @abstractmethod
    def command(self, instance: int) -> list[str]:
        """Command line that starts an instance in its folder, which holds `PARAMETERS`."""

    # --- where it listens --------------------------------------------------------------------

    @property
    def gcs_endpoint(self) -> str:
        """For the ground station (serial0)."""
        return self._endpoint(_GCS_OFFSET)

    @property
    def companion_endpoint(self) -> str:
        """For the companion computer (serial1)."""
        return self._endpoint(_COMPANION_OFFSET)

    @property
    def spare_endpoint(self) -> str:
        """For an observer (serial2)."""
        return self._endpoint(_SPARE_OFFSET)

    def _endpoint(self, offset: int) -> str:
        if self._instance < 0:
            raise VehicleProcessError(f"the {self.kind} vehicle has no ports before it is started")
        return f"tcp:127.0.0.1:{_port(self._instance, offset)}"

    # --- life --------------------------------------------------------------------------------

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    @property
    def processes(self) -> tuple[subprocess.Popen[bytes], ...]:
        """The vehicle's process, and the shell that ends the vehicle if this process dies."""
        return tuple(p for p in (self._process, self._lifeline) if p is not None)

    @property
    def boots(self) -> int:
        """Number of boots since the last `start` or `restart`, by the log."""
        # The log is watched, as a probing connection would take the port's only client slot.
        marker = f"SERIAL2 on TCP port {_port(self._instance, _SPARE_OFFSET)}"
        return self.log_tail(_WHOLE_LOG).count(marker)

    def start(self) -> None:
        """Start on free ports and wait until it listens; `VehicleProcessError` if it does not."""
        try:
            with _signals_wait():
                self._folder = Path(tempfile.mkdtemp(prefix=f"{self.kind}-"))
            _write_parameters(self._folder / PARAMETERS, self._parameters)
            if fault := self._start_on_free_ports():
                raise VehicleProcessError(
                    f"the {self.kind} vehicle did not start: {fault}; {self._log_end()}"
                )
        except BaseException:  # interrupted too: there is no `__exit__` yet
            self.stop()
            raise

    def _start_on_free_ports(self) -> str:
        """Start it; returns why it does not listen, "" if it listens."""
        # Instances are tried from a place of this process's own, so that vehicles that start at
        # the same time do not reach for the same ports.
        first, fault = os.getpid() * 7 % len(_INSTANCES), "no ports are free"
        for step in _INSTANCES:
            instance = (first + step) % len(_INSTANCES)
            if not _free(instance):
                continue
            self._instance = instance
            self._launch()
            fault = self._wait_listening()
            if not fault or "in use" not in self.log_tail().lower():
                break
        return fault

    def restart(self) -> None:
        """Restart the vehicle on the same ports, as after a power loss. `VehicleProcessError` if it
        does not start.
        """
        self._end()
        self._launch()
        if fault := self._wait_listening():
            raise VehicleProcessError(
                f"the {self.kind} vehicle did not come back: {fault}; {self._log_end()}"
            )

    def _launch(self) -> None:
        command = self.command(self._instance)
        with self._log_path.open("wb") as log, _signals_wait():
            try:
                self._process = subprocess.Popen(
                    command,
                    cwd=self._folder,
                    env={**os.environ, "PYTHONPATH": _search_path()},
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # an interrupt of ours must not end it unasked
                )
            except OSError as error:
                raise VehicleProcessError(f"cannot run {command[0]}: {error}") from error
            self._lifeline = _end_with_us(self._process.pid)

    def _wait_listening(self) -> str:
        """Wait until it listens; returns why it does not, "" if it listens."""
        deadline = time.monotonic() + self.start_timeout_s
        while time.monotonic() < deadline and self.alive:
            if self.boots > 0:
                return ""
            time.sleep(_POLL_S)
        status = None if self._process is None else self._process.poll()
        self._end()
        if status is None:
            return f"nothing listened within {self.start_timeout_s:g} s"
        return f"it ended with status {status}"

    @property
    def _log_path(self) -> Path:
        return self._log or (self._folder or Path()) / "vehicle.log"

    def log_tail(self, characters: int = _LOG_TAIL) -> str:
        """The end of the process's output."""
        try:
            return self._log_path.read_text("utf-8", "replace")[-characters:]
        except FileNotFoundError:
            return ""

    def _log_end(self) -> str:
        where = f"its log {self._log}" if self._log else "its log"
        return f"{where} ends:\n{self.log_tail()}"

    def check(self) -> None:
        """VehicleProcessError if the process has died."""
        if self._process is not None and not self.alive:
            raise VehicleProcessError(
                f"the {self.kind} vehicle died (status {self._process.returncode}); "
                f"{self._log_end()}"
            )

    def stop(self) -> None:
        """End the process and remove its folder; harmless when it does not run."""
        try:
            self._end()
        finally:
            if self._folder is not None:
                shutil.rmtree(self._folder, ignore_errors=True)

    def _end(self) -> None:
        if self._lifeline is not None:  # first: later its number may be another process's
            self._lifeline.kill()
            self._lifeline.communicate()
            self._lifeline = None
        if self._process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self: _Self) -> _Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


@contextlib.contextmanager
def _signals_wait() -> Iterator[None]:
    """Delay signals until the end of the block, because an exception within it would leave
    processes that nobody ends.

    Signals raise on the main thread only. Blocking them instead would be inherited by the vehicle.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    late: list[signal.Signals] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, lambda taken, _frame: late.append(signal.Signals(taken)))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in late:
            signal.raise_signal(number)


def _write_parameters(path: Path, parameters: dict[str, float]) -> None:
    """An ArduPilot .parm file."""
    lines = [f"{name} {value:.9g}\n" for name, value in parameters.items()]
    path.write_text("".join(lines), encoding="utf-8")


def _end_with_us(pid: int) -> subprocess.Popen[bytes]:
    """A shell that ends the vehicle's process when this process has ended in any way, because the
    shell's input ends then.

    A parent-death signal would already be sent at the end of the thread that started the process.
    """
    return subprocess.Popen(
        ["/bin/sh", "-c", f"read -r _; kill {pid}"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _search_path() -> str:
    """PYTHONPATH with this checkout first: the process runs in a folder of its own."""
    here = str(Path(__file__).resolve().parents[2])
    return os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))


def _port(instance: int, offset: int) -> int:
    return BASE_PORT + PORTS_PER_INSTANCE * instance + offset


def _free(instance: int) -> bool:
    for offset in (_GCS_OFFSET, _COMPANION_OFFSET, _SPARE_OFFSET):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", _port(instance, offset)))
            except OSError:
                return False
    return True
