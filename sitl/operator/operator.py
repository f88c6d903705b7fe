"""The operator at work in a flight: he sees each picture late, points at it, and stops targets."""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sitl.camera.movers import Mover
from sitl.camera.world_camera import FRAME_COLUMNS
from sitl.operator.station import ReceivedMessages, Station
from sitl.operator.wishes import Wish
from sitl.suite.loop.flight import ParticipantContext

_ACCEPTED = 0  # MAV_RESULT
LATE_S, LATE_SIGMA_S = 0.25, 0.03  # exposure to click, of a link whose delay was measured
_EARLIEST_S = 0.2  # a picture so old stands in the world camera's log
_LAST_LOOK_NS = 8_000_000_000  # after the last wish, so that it is looked at, too


@dataclass(frozen=True)
class SentWish:
    """A wish as it was sent. sequence, frame_ns: of the picture that he pointed into, its true
    exposure; late_s: the command left so long after it. number: the target's, as it was told;
    result: MAV_RESULT, None without an answer. ended: the numbers that a stop ended. movers: where
    everything that moves was at the exposure, (M, 3).
    """

    wish: Wish
    sent_ns: int
    answered_ns: int
    sequence: int
    frame_ns: int
    late_s: float
    number: int
    result: int | None
    ended: tuple[int, ...] = ()
    movers: tuple[tuple[float, float, float], ...] = ()


class Frames:
    """The world camera's log as it grows: (sequence, true exposure) of every picture."""

    def __init__(self, path: Path) -> None:
        self._file = path.open(newline="", encoding="utf-8")
        self._rest = ""
        self._rows: list[tuple[int, int]] = []

    def newest_before(self, time_ns: int) -> tuple[int, int] | None:
        """The newest picture that was exposed before a time; None before the first."""
        lines = (self._rest + self._file.read()).split("\n")
        self._rest = lines.pop()
        for row in csv.DictReader(lines, FRAME_COLUMNS):
            if row["sequence"] == "sequence":
                continue  # the names of the columns
            self._rows.append((int(row["sequence"]), int(row["true_time_ns"])))
        return next((r for r in reversed(self._rows) if r[1] <= time_ns), None)

    def close(self) -> None:
        """Close the log."""
        self._file.close()


class Operator:
    """A `FlightParticipant` who acts on a thread of his own. seed: of how late he clicks."""

    def __init__(self, wishes: Sequence[Wish], seed: int) -> None:
        self._wishes = tuple(wishes)
        self._rng = np.random.default_rng([seed, 89])
        self._stop = threading.Event()
        self._movers: tuple[Mover, ...] = ()
        self.asked: list[SentWish] = []
        self.heard = ReceivedMessages()
        self.failure = ""

    def movers(self, _epoch_ns: int) -> tuple[Mover, ...]:
        """He brings none along."""
        return ()

    @property
    def seconds(self) -> float:
        """How long a flight he needs."""
        return self._wishes[-1].at_s + _LAST_LOOK_NS * 1e-9

    @contextmanager
    def ride(self, cabin: ParticipantContext) -> Iterator[None]:
        """Click while the flight goes on."""
        self._movers = cabin.movers
        thread = threading.Thread(target=self._run, args=(cabin,), name="operator")
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()

    def _run(self, cabin: ParticipantContext) -> None:
        station = Station(cabin.vehicle.spare_endpoint, cabin.vehicle.check)
        frames = Frames(cabin.frames)
        self.heard = station.heard
        begun_ns = time.monotonic_ns()
        try:
            for wish in self._wishes:
                due_ns = begun_ns + round(wish.at_s * 1e9)
                if station.run_until(self._stop.is_set, due_ns):
                    return
                self._carry_out(wish, station, frames)
            station.run_until(self._stop.is_set, time.monotonic_ns() + _LAST_LOOK_NS)
        except Exception as error:  # told by the judge: a dead operator is no passed flight
            self.failure = f"{type(error).__name__}: {error}"
        finally:
            station.close()
            frames.close()

    def _carry_out(self, wish: Wish, station: Station, frames: Frames) -> None:
        late_s = max(float(self._rng.normal(LATE_S, LATE_SIGMA_S)), _EARLIEST_S)
        seen = frames.newest_before(time.monotonic_ns() - round(_EARLIEST_S * 1e9))
        if seen is None:
            raise RuntimeError("no picture has been taken yet")
        alive = self.alive()
        ended: tuple[int, ...] = ()
        parameters = wish.coordinates
        if wish.kind == "stop":
            if wish.which is not None and alive:
                ended = (alive[int(wish.which * len(alive))],)
            else:
                ended = alive
            parameters = (float(ended[0]) if wish.which is not None and ended else 0.0,)
        time.sleep(max((seen[1] - time.monotonic_ns()) * 1e-9 + late_s, 0.0))
        sent_ns = time.monotonic_ns()
        result, number = station.ask(wish.kind, parameters)
        places = [m.position_at(seen[1]) for m in self._movers]
        self.asked.append(
            SentWish(
                wish, sent_ns, time.monotonic_ns(), *seen, (sent_ns - seen[1]) * 1e-9, number,
                result, ended, tuple((float(x), float(y), float(z)) for x, y, z in places),
            )
        )  # fmt: skip

    def alive(self) -> tuple[int, ...]:
        """The numbers that were given and not stopped."""
        given: list[int] = []
        for asked in self.asked:
            if asked.wish.kind != "stop" and asked.result == _ACCEPTED:
                given.append(asked.number)
            given = [n for n in given if n not in asked.ended]
        return tuple(given)
