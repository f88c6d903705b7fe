"""The world camera in its own process: receives true poses by a pipe and sends H.264 by UDP.

The companion receives the stream as from a real camera, and rendering does not take the interpreter
lock of the companion.
"""

from __future__ import annotations

import multiprocessing
import queue
import threading
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Literal

import cv2

from companion.geometry import Mount
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import Appearance
from localizer.types import Image
from sitl.camera.detector import Detector, DetectorErrors, DetectorView, Observed
from sitl.camera.faults import PictureFault, VideoFaultInjector
from sitl.camera.movers import Mover
from sitl.camera.realism import CameraClock, CameraRealism
from sitl.camera.stream import LossyLink, VideoSender
from sitl.camera.true_motion import PoseTrack, TruthSample, camera_pose
from sitl.camera.world_camera import SHUTTER_S, CameraOptions, FrameLog, WorldCamera
from sitl.camera.zoom import Zooming, ZoomLens
from sitl.errors import WorldCameraError

Message = TruthSample | Literal["stop"] | PictureFault | Zooming | None  # None ends the fault

_START_S = 300.0  # numba compiles on the first run, a minute where there is room
_STOP_S = 60.0
_MAX_BEHIND = 2  # frame periods after which exposures are skipped instead of made late


@dataclass(frozen=True)
class WorldCameraConfig:
    """Configuration of the world camera's process, pickled to it.

    cache: tiles of the live world. origin: of the map's ENU frame, used for true poses and moving
    objects. log: file for the true pose of every frame. targets: objects that the `Detector`
    reports to the address `detections`.
    """

    cache: Path
    origin: Geodetic
    camera: Camera
    url: str
    log: Path
    rate_hz: float = 10.0
    appearance: Appearance = field(default_factory=Appearance)
    movers: tuple[Mover, ...] = ()
    mount: Mount = field(default_factory=Mount.from_degrees)
    seed: int = 0
    bit_rate: int = 4_000_000
    targets: tuple[Observed, ...] = ()
    detections: str | None = None
    realism: CameraRealism = field(default_factory=CameraRealism)
    detector_errors: DetectorErrors = field(default_factory=DetectorErrors)


@dataclass(frozen=True)
class CameraStatistics:
    """Counters of the world camera. skipped: exposures left out because the process was late or the
    video silent; lost: datagrams of the stream dropped on purpose.
    """

    frames: int
    skipped: int
    sent_bytes: int
    lost: int = 0


class WorldCameraProcess:
    """Controls the world camera's process. `send` needs true poses in order, at 20 Hz or more."""

    def __init__(self, config: WorldCameraConfig) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, child = multiprocessing.Pipe()
        self._process = context.Process(
            target=_run, args=(config, child), name="world-camera", daemon=True
        )
        self._child = child
        # One thread at a time on the pipe: flights stop the camera while their truth is still sent.
        self._lock = threading.Lock()
        self.statistics: CameraStatistics | None = None

    def start(self) -> None:
        """Starts the process and waits until it can take samples. `WorldCameraError` if it is not
        ready in time.
        """
        self._process.start()
        self._child.close()  # so that a dead child is seen as the end of the pipe
        if not self._connection.poll(_START_S):
            raise WorldCameraError(f"the world camera was not ready after {_START_S:.0f} s")
        self._receive()

    def stop(self) -> None:
        """End the process; `statistics` then holds its counters. Harmless if it is not running."""
        if self._process.pid is None:
            return
        try:
            with self._lock:
                self._connection.send("stop")
                if self._connection.poll(_STOP_S):
                    self._receive()
        except (OSError, EOFError, WorldCameraError):
            pass  # it is gone already, which is what is wanted
        self._process.join(_STOP_S)
        if self._process.is_alive():
            self._process.terminate()

    def __enter__(self) -> WorldCameraProcess:
        try:
            self.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def send(self, message: Message) -> None:
        """Send a true pose of the vehicle, a video fault (None ends it) or a change of the focal
        length. Raises `WorldCameraError` if the process has died.
        """
        with self._lock:
            if self._connection.poll():
                self._receive()
            try:
                self._connection.send(message)
            except OSError as error:
                raise WorldCameraError("the world camera's process has died") from error

    def _receive(self) -> None:
        try:
            message = self._connection.recv()
        except (EOFError, OSError) as error:
            raise WorldCameraError("the world camera's process has died") from error
        if isinstance(message, CameraStatistics):
            self.statistics = message
        elif isinstance(message, str) and message:
            raise WorldCameraError(f"the world camera failed: {message}")


def _run(config: WorldCameraConfig, connection: Connection) -> None:
    """Main function of the camera's process. Sends "" when it is ready, or the text of an error."""
    cv2.setNumThreads(1)
    try:
        with _CameraServer(config) as studio:
            connection.send("")
            inbox: queue.SimpleQueue[Message] = queue.SimpleQueue()
            threading.Thread(target=_listen, args=(connection, inbox), daemon=True).start()
            connection.send(studio.run(inbox))
    except KeyboardInterrupt:
        pass  # the parent got it too and decides
    except Exception as error:
        connection.send(f"{type(error).__name__}: {error}")


def _listen(connection: Connection, inbox: queue.SimpleQueue[Message]) -> None:
    # Emptied by a thread of its own: while a frame is rendered the pipe must not fill up and hold
    # the parent, which flies the vehicle.
    try:
        while True:
            inbox.put(connection.recv())
    except (EOFError, OSError):
        inbox.put("stop")


@dataclass(frozen=True)
class _DelayedFrame:
    """A frame that waits until it is sent at due_ns."""

    due_ns: int
    exposure_ns: int
    stamped_ns: int
    image: Image


class _CameraServer:
    """Owns renderer, encoder and log in the camera's process, and answers its messages."""

    def __init__(self, config: WorldCameraConfig) -> None:
        c = self._config = config
        cache = TileCache.open(c.cache)
        self._frame = LocalFrame(c.origin)
        self._streamer = TileStreamer(cache)
        self._renderer = NumbaRenderer(self._streamer, threads=1)
        self._renderer.warm_up()
        self._camera = WorldCamera(
            self._renderer,
            c.camera,
            c.appearance,
            CameraOptions(
                c.movers,
                cache.frame.ecef_from_enu.inverse @ self._frame.ecef_from_enu,
                seed=c.seed,
                realism=c.realism,
            ),
        )
        self._log = FrameLog(c.log)
        loss = c.realism.packet_loss
        self._link = LossyLink(c.url, loss, c.seed) if loss > 0 else None
        self._sender = VideoSender(
            c.url, c.camera.width, c.camera.height, c.rate_hz, bit_rate=c.bit_rate,
            link=self._link,
        )  # fmt: skip
        self._stamps = CameraClock(c.realism, c.seed)
        self._detector = (
            Detector(c.detections, c.camera, c.targets, c.detector_errors, c.seed)
            if c.detections
            else None
        )
        self._lens, self._zoom = VideoFaultInjector(c.seed), ZoomLens(c.camera)
        self._outbox: deque[_DelayedFrame] = deque()
        self._track = PoseTrack()
        self._stopped = False
        self._frames = self._skipped = 0

    def __enter__(self) -> _CameraServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._sender.close()
        if self._link is not None:
            self._link.close()
        if self._detector is not None:
            self._detector.close()
        self._log.close()
        self._renderer.close()
        self._streamer.close()

    def run(self, inbox: queue.SimpleQueue[Message]) -> CameraStatistics:
        """Expose frames at the configured rate, as far as true poses are known, until "stop"
        arrives.
        """
        period_ns = round(1e9 / self._config.rate_hz)
        real = self._config.realism
        margin_ns = round(max(SHUTTER_S * 0.5e9, real.readout_ms * 0.5e6))
        due: int | None = None
        while True:
            self._handle(inbox.get())
            while not inbox.empty():
                self._handle(inbox.get())
            if self._stopped:
                return self._statistics()
            newest = self._track.newest_ns
            if newest is None:
                continue
            due = newest if due is None else due
            behind = (newest - due) // period_ns
            if behind > _MAX_BEHIND:
                self._skipped += behind
                due += behind * period_ns
            if newest >= due + margin_ns:
                self._expose(due)
                due += period_ns
            while self._outbox and self._outbox[0].due_ns <= newest:
                self._send(self._outbox.popleft())

    def _handle(self, message: Message) -> None:
        if isinstance(message, TruthSample):
            pose = camera_pose(message, self._frame, self._config.mount)
            self._track.add(message.time_ns, pose)
        elif message is None or isinstance(message, PictureFault):
            self._lens.set(message)
        elif isinstance(message, Zooming):
            self._zoom.set(message)
        else:
            self._stopped = True

    def _expose(self, time_ns: int) -> None:
        if self._lens.is_silent:
            self._skipped += 1
            return
        exposure = self._camera.expose(time_ns, self._track)
        if exposure is None:
            self._skipped += 1
            return
        stamp_ns = self._stamps.of(time_ns)
        self._outbox.append(
            _DelayedFrame(
                time_ns + self._lens.delay_ns,
                time_ns,
                self._lens.stamp(stamp_ns),
                self._lens.apply(self._zoom.apply(exposure.image, time_ns), time_ns),
            )
        )
        if self._detector is not None:
            view = DetectorView(time_ns, exposure.depth, exposure.pose_of_row)
            self._detector.observe(view, stamp_ns)
        self._log.add(self._frames, stamp_ns, exposure.world_from_camera, time_ns)
        self._frames += 1

    def _send(self, waiting: _DelayedFrame) -> None:
        self._sender.send(waiting.image, waiting.exposure_ns, waiting.stamped_ns)

    def _statistics(self) -> CameraStatistics:
        lost = self._link.lost if self._link is not None else 0
        return CameraStatistics(self._frames, self._skipped, self._sender.sent_bytes, lost)
