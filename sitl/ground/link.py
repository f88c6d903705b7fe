"""Ground station link: socket, heartbeat, commands, parameters, and waiting for conditions.

One thread reads the vehicle's first serial port and time-stamps what it receives. Calls other than
`send` block until the vehicle has answered.
"""

from __future__ import annotations

import contextlib
import queue
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.errors import PilotError
from sitl.ground.vehicle_record import AUTOPILOT, VEHICLE, VehicleRecord, from_autopilot

SYSTEM, COMPONENT = 255, 190  # of the ground station


def disable_reconnect(link: Any) -> None:
    """Keep pymavlink from printing and reconnecting when the vehicle closes a TCP link."""
    link.handle_eof = link.handle_disconnect = lambda: None


class Connection:
    """A MAVLink connection over TCP; any thread sends, one receives."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self._link: Any = None
        self._send_lock = threading.Lock()

    def open(self, deadline: float, alive: Callable[[], None]) -> None:
        """Connect, retrying until `deadline` (time.monotonic()); `PilotError` after it. alive:
        raises if the vehicle has died.
        """
        while self._link is None:
            alive()
            try:
                self._link = mavutil.mavlink_connection(
                    self.endpoint,
                    source_system=SYSTEM,
                    source_component=COMPONENT,
                    dialect="ardupilotmega",
                    retries=0,
                    robust_parsing=True,
                )
            except OSError as error:
                if time.monotonic() > deadline:
                    raise PilotError(
                        f"no vehicle listens at {self.endpoint}: {error}; is it started?"
                    ) from error
                time.sleep(0.1)
        disable_reconnect(self._link)

    def shut_down(self) -> None:
        """Shut the socket down, so that a waiting `receive` returns; `close` comes later."""
        if self._link is not None:
            with contextlib.suppress(OSError):  # the vehicle may have closed it
                self._link.port.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Disconnect after the receiving thread has ended."""
        if self._link is not None:
            self._link.close()

    def send(self, message: Any) -> None:
        """Send one message, after `open`; OSError if the vehicle closed the link."""
        with self._send_lock:
            self._link.mav.send(message)

    def send_heartbeat(self) -> None:
        """Send the ground station's heartbeat if the link is open."""
        with contextlib.suppress(OSError):
            self.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3
                )
            )

    def receive(self) -> list[Any]:
        """Messages received, after waiting up to 0.1 s; none from a closed link, or OSError."""
        port = self._link.port
        if port.fileno() < 0 or not select.select([port], [], [], 0.1)[0]:
            return []
        if not port.recv(1, socket.MSG_PEEK):
            time.sleep(0.05)  # closed by the vehicle; pymavlink would report that in a tight loop
            return []
        messages = []
        while (message := self._link.recv_msg()) is not None:
            messages.append(message)
        return messages


class AutopilotQueues:
    """Queues of the autopilot's messages: one thread adds messages, any thread waits for types."""

    def __init__(self) -> None:
        self._boxes: list[tuple[frozenset[str], queue.SimpleQueue[Any]]] = []

    def add(self, message: Any) -> None:
        """Put a message into every queue that expects its type; other components' messages are
        ignored.
        """
        if from_autopilot(message):
            for kinds, box in self._boxes:
                if message.get_type() in kinds:
                    box.put(message)

    @contextlib.contextmanager
    def expect(self, *kinds: str) -> Iterator[queue.SimpleQueue[Any]]:
        """Context manager: a queue of the autopilot's messages of these types, from now on."""
        box: queue.SimpleQueue[Any] = queue.SimpleQueue()
        entry = (frozenset(kinds), box)
        self._boxes = [*self._boxes, entry]
        try:
            yield box
        finally:
            self._boxes = [e for e in self._boxes if e is not entry]


_HEARTBEAT_S = 0.5  # wall time
_STREAMS = {  # message id -> Hz
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50.0,
    mavlink.MAVLINK_MSG_ID_SIM_STATE: 50.0,
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: 50.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 25.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
}
_OF_PX4 = {mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS}
_WALL_MARGIN_S = 30.0
# Wall time. A busy machine may let one of the two wait for seconds: an answer that comes costs
# nothing, and only a vehicle that is alive and silent takes that long.
_REPEAT_S = 1.5
_TRIES = 80


class GroundLink:
    """A link to a vehicle at a MAVLink endpoint ("tcp:127.0.0.1:5760"), with its record.

    answers: queues of the autopilot's messages, for callers that wait for one. Seconds are
    simulated unless called wall time. speedup: simulated seconds per real second of the started
    vehicle. alive: called while waiting; raises if the vehicle has died (`VehicleProcess.check`).
    """

    def __init__(
        self,
        endpoint: str,
        speedup: float = 1.0,
        alive: Callable[[], None] = lambda: None,
    ) -> None:
        self.record = VehicleRecord(speedup)
        self.speedup = speedup
        self._connection, self._alive = Connection(endpoint), alive
        self.answers = AutopilotQueues()
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    # --- life --------------------------------------------------------------------------------

    def connect(self, timeout_s: float = 90.0) -> None:
        """Connect, ask for streams, await heartbeat and true state; `PilotError` without one."""
        deadline = time.monotonic() + timeout_s
        self._connection.open(deadline, self._alive)
        self._thread = threading.Thread(target=self._read, name="pilot", daemon=True)
        self._thread.start()
        if not self.wait_wall(lambda: self.record.mode is not None, deadline - time.monotonic()):
            raise PilotError(
                f"no autopilot heartbeat at {self._connection.endpoint} in {timeout_s:g} s"
            )
        for message_id, hertz in _STREAMS.items():
            px4s = _OF_PX4.get(message_id, message_id)
            self._request_stream(px4s if self.record.is_px4 else message_id, hertz)
        self.wait(
            lambda: "SIM_STATE" in self.record.latest, 20.0, "the vehicle's true state (SIM_STATE)"
        )

    def close(self) -> None:
        """Stop reading and disconnect."""
        self._stop.set()
        self._connection.shut_down()
        if self._thread is not None:
            self._thread.join()
        self._connection.close()

    # --- waiting -----------------------------------------------------------------------------

    def wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Block until a condition holds; PilotError, naming `what`, after simulated timeout_s."""
        if not self._wait(condition, timeout_s):
            texts = "; ".join(t.text for t in self.record.texts[-4:])
            raise PilotError(
                f"waited {timeout_s:g} s in vain for {what} (mode {self.record.mode}, "
                f"{'armed' if self.record.armed else 'disarmed'}, last texts: {texts})"
            )

    def sleep(self, seconds: float) -> None:
        """Wait for simulated seconds."""
        self._wait(lambda: False, seconds)

    def _wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        start, wall = self.record.time_s, time.monotonic()
        limit = _WALL_MARGIN_S + 4.0 * timeout_s / min(self.speedup, 1.0)
        while not condition():
            self._alive()
            if self.record.time_s - start >= timeout_s and start > 0:
                return condition()
            if time.monotonic() - wall > limit:
                return False
            with self._changed:
                self._changed.wait(0.05)
        return True

    def wait_wall(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Block until a condition holds; False after timeout_s seconds of wall time."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            self._alive()
            if time.monotonic() > deadline:
                return False
            with self._changed:
                self._changed.wait(0.05)
        return True

    # --- parameters --------------------------------------------------------------------------

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter and wait until the vehicle confirms it; `PilotError` if it does not."""
        with self.answers.expect("PARAM_VALUE") as box:
            for _ in range(_TRIES):
                self.send(
                    mavlink.MAVLink_param_set_message(
                        VEHICLE, AUTOPILOT, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32
                    )
                )
                if self._parameter_from(box, name) is not None:
                    return
        raise PilotError(f"the vehicle did not confirm {name} = {value:g}; does it know it?")

    def parameter(self, name: str, tries: int = _TRIES) -> float:
        """Read a parameter; `PilotError` if `tries` requests get no answer (unknown name)."""
        with self.answers.expect("PARAM_VALUE") as box:
            for _ in range(tries):
                self.send(
                    mavlink.MAVLink_param_request_read_message(
                        VEHICLE, AUTOPILOT, name.encode(), -1
                    )
                )
                value = self._parameter_from(box, name)
                if value is not None:
                    return value
        raise PilotError(f"the vehicle has no parameter {name}")

    def _parameter_from(self, box: queue.SimpleQueue[Any], name: str) -> float | None:
        answer = self._answer(box, lambda m: bool(m.param_id == name))
        return None if answer is None else float(answer.param_value)

    def _answer(self, box: queue.SimpleQueue[Any], fits: Callable[[Any], bool]) -> Any | None:
        """The first message for which `fits` is true; None after `_REPEAT_S`."""
        self._alive()
        deadline = time.monotonic() + _REPEAT_S
        while (left := deadline - time.monotonic()) > 0:
            with contextlib.suppress(queue.Empty):
                message = box.get(timeout=left)
                if fits(message):
                    return message
        return None

    def set_speed(self, speedup: float) -> None:
        """Run simulated time at another speed (SIM_SPEEDUP)."""
        self.set_parameter("SIM_SPEEDUP", speedup)
        self.speedup = speedup
        self.record.restart_clock(speedup)

    # --- commands ----------------------------------------------------------------------------

    def command(self, number: int, *parameters: float) -> None:
        """Send COMMAND_LONG and wait for its answer; `PilotError` unless it is accepted."""
        started = time.monotonic_ns()
        result = self.try_command(number, *parameters)
        if result != mavlink.MAV_RESULT_ACCEPTED:
            texts = "; ".join(t.text for t in self.record.texts if t.time_ns > started)
            raise PilotError(f"command {number} was refused (MAV_RESULT {result}): {texts}")

    def try_command(self, number: int, *parameters: float) -> int | None:
        """Send COMMAND_LONG; returns its MAV_RESULT, or None without an answer in two minutes."""
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        with self.answers.expect("COMMAND_ACK") as box:
            for attempt in range(_TRIES):
                self.send(
                    mavlink.MAVLink_command_long_message(
                        VEHICLE, AUTOPILOT, number, attempt, *filled
                    )
                )
                answer = self._answer(box, lambda m: bool(m.command == number))
                if answer is not None:
                    return int(answer.result)
        return None

    def _request_stream(self, message_id: int, hertz: float) -> None:
        self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / hertz)

    def next_of(self, box: queue.SimpleQueue[Any], what: str) -> Any:
        """The next message in a queue of `answers`; `PilotError` naming `what` after a timeout."""
        try:
            return box.get(timeout=_TRIES * _REPEAT_S)
        except queue.Empty:
            self._alive()
            raise PilotError(f"the vehicle was silent during {what}") from None

    def send(self, message: Any) -> None:
        """Send a message from any thread, after `connect`; OSError once the link is closed."""
        self._connection.send(message)

    # --- the reading thread ------------------------------------------------------------------

    def _read(self) -> None:
        next_heartbeat = 0.0
        while not self._stop.is_set():
            now = time.monotonic()
            if now >= next_heartbeat:
                next_heartbeat = now + _HEARTBEAT_S
                self._connection.send_heartbeat()
            try:
                messages = self._connection.receive()
            except OSError:  # the socket is being closed, or the vehicle died
                if not self._stop.is_set():
                    time.sleep(0.05)
                continue
            for message in messages:
                self.record.add(message, time.monotonic_ns())
                self.answers.add(message)
            if messages:
                with self._changed:
                    self._changed.notify_all()
