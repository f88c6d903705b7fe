"""A flight for the console's tests: the map's own pictures along a line, the truth as estimate.

Everything else is the product's: what is shown, the publisher, orders, clicks, targets.
"""

from __future__ import annotations

import itertools
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from companion.config import TargetConfig
from companion.live.orders import OrderContext, Orders
from companion.live.publisher import Publisher
from companion.live.shown import ConsoleData, Instruments
from companion.targets.clicks import ClickPolicy
from companion.targets.reporter import TargetReporter
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import MapSurface
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.render.topview import DOWN
from localizer.types import Frame, PoseEstimate, ReferenceBundle, RegistrationStatus, TrackingState
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.injection.shadow import ShadowScore
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.mission import MissionWaypoint

CAMERA = Camera.from_fov(480, 360, 65.0)
HEIGHT_M = 80.0


@dataclass
class Flight:
    """The flight's side. said: what the operator was told; hints: what the search was given."""

    path: object
    cache: TileCache
    control: bool = True
    armed: bool = False
    hz: float = 5.0
    said: list[Alert] = field(default_factory=list)
    hints: list[tuple[float, float, float]] = field(default_factory=list)
    targets: dict[str, np.ndarray] = field(default_factory=dict)
    sent: int = 0

    def __post_init__(self) -> None:
        origin = self.cache.frame.origin
        self.vehicle = VehicleState(
            connected=True, mode="GUIDED", system_id=1, armed=self.armed,
            latitude_deg=origin.latitude_deg, longitude_deg=origin.longitude_deg,
            gps_latitude_deg=origin.latitude_deg, gps_longitude_deg=origin.longitude_deg,
            gps_fix_type=3,
        )  # fmt: skip
        corners = [(0.0, 0.0), (0.0, 60.0), (60.0, 60.0)]
        places = [self.cache.frame.position([e, n, 0.0]) for e, n in corners]
        self.mission = tuple(
            MissionWaypoint(i, place.latitude_deg, place.longitude_deg)
            for i, place in enumerate(places)
        )
        self.health = {
            "level": "ok", "text": "localization tracking", "rate_hz": self.hz,
            "guardian": {"hpl_m": 2.5, "vpl_m": 2.0, "findings": {}},
            "stages_ms": {"latency": {"p50": 90.0, "p95": 120.0}},
        }  # fmt: skip
        instruments = Instruments(
            lambda: self.health, lambda: self.vehicle,
            lambda: ShadowScore(False, 3, (alert(AlertId.SHADOW_NOT_COMPARED),)),
            lambda: None, lambda: False,
            lambda: self.mission,
        )  # fmt: skip
        about = {"mode": "inject", "delay_ms": 220.0, "alert_limit_m": 10.0, "record": None}
        self.shown = ConsoleData(self.cache.frame, 48.0, instruments, about)
        self.origin = origin
        self.reporter = TargetReporter(
            TargetConfig(), MapSurface(self.cache).cast, self._located, self.shown.forget_target
        )
        config = TargetConfig()
        self.clicks = ClickPolicy(self.reporter, self._report, config)
        numbers = itertools.count(1)

        def track(request):
            late_ns = round(config.operator_delay_ms * 1e6)
            self.clicks.on_request(
                replace(request, time_ns=request.time_ns + late_ns, number=next(numbers))
            )

        helm = OrderContext(self._report, track, lambda *hint: self.hints.append(hint))
        self.publisher = Publisher(self.path, self.shown, Orders(self.control, helm), 10.0)
        self._stop = threading.Event()
        self._streamer = TileStreamer(self.cache)
        self._renderer = NumbaRenderer(self._streamer)
        self._views = self._way()

    def _located(self, target) -> None:
        self.targets[target.fix.target_id] = target.fix.position_world
        self.shown.add_target(target)

    def _report(self, alert: Alert) -> None:
        self.said.append(alert)
        self.shown.add_event("info", text(alert))

    def _way(self):
        base = float(self.cache.index.box_min[0, 2])
        poses = [Pose(DOWN, np.array([x, 0.0, base + HEIGHT_M])) for x in range(-20, 21, 4)]
        return [self._renderer.render(pose, CAMERA, wait=True) for pose in poses]

    def send(self, number: int) -> PoseEstimate:
        """One frame with its estimate."""
        view = self._views[number % len(self._views)]
        now = time.monotonic_ns()
        frame = Frame(view.rgb, now - 50_000_000, CAMERA, number)
        estimate = PoseEstimate(
            view.world_from_camera, np.eye(6) * 0.01, 0.8, TrackingState.TRACKING,
            RegistrationStatus.OK, True, frame.exposure_time_ns, number, CAMERA,
            {"reference": 40.0, "extract": 25.0, "register": 9.0, "latency": 50.0},
            frame.exposure_time_ns,
        )  # fmt: skip
        if self.publisher.is_watched:
            self.shown.add_frame(frame)
        self.clicks.add_estimate(estimate)
        self.reporter.add_estimate(estimate)
        bundle = ReferenceBundle(replace(view), None, now)
        self.shown.add_estimate(estimate, bundle)
        self.publisher.wake()
        return estimate

    def _fly(self) -> None:
        number = 0
        while not self._stop.wait(1.0 / self.hz):
            self.send(number)
            number += 1
            self.sent = number

    @contextmanager
    def flying(self):
        """Serve, and fly up and down."""
        self.reporter.start()
        self.publisher.start()
        thread = threading.Thread(target=self._fly)
        thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            thread.join()
            self.publisher.stop()
            self.publisher.close()
            self.reporter.stop()
            self._streamer.close()
