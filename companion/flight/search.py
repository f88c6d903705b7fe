"""Searches the map with one frame while no position is known, on its own thread.

The result is not a fix: it is a hypothesis that the tracker must confirm (`PosePrior.independent`).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from companion.flight.priors import AutopilotPose
from localizer.config import LocalizerConfig
from localizer.errors import LocalizerError
from localizer.geometry.geo import EARTH_RADIUS_M
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.pictures import shrink
from localizer.relocalization.patch import with_heading
from localizer.relocalization.relocalizer import SEARCH_WIDTH, OpenRelocalizer, open_relocalizer
from localizer.relocalization.types import EarlierFrame, PlaceQuery, Relocalization, SearchRegion
from localizer.relocalization.verify import attitude_difference
from localizer.sensors.error_model import SENSORS
from localizer.types import Frame, PosePrior
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.messages import PlaceHint

_log = logging.getLogger(__name__)
_HINT_SIGMAS = 2.0
_HORIZON_M = 10_000.0  # below the origin: over 350 km away
_HINT_S = 120.0  # after which an operator's word is of another place
_STOP_S = 10.0
_WHOLE_MAP_EVERY = 5  # searches
_KEPT, _KEPT_EVERY_S = 10, 1.0  # frames to be laid together
_NEWS_S = 2.0  # for which the last search tells what is missing

# What the autopilot knows of the camera while it does not know where it is.
_TILT_SIGMA_RAD = math.radians(SENSORS.unaided_tilt_deg)
_HEADING_SIGMA_RAD = math.radians(SENSORS.town_heading_deg)
_HEIGHT_SIGMA_M = SENSORS.height_since_takeoff_m
_SIGMAS = 3.0
_PLACE_SIGMA_M, _PLACE_SIGMA_RAD = 2.0, math.radians(1.0)  # of a found place, at the least

# A search takes seconds where the processors fly, too. Farther from where the camera is by now than
# this, a place found is no place to begin at: a second search, of the newest frame, looks for it
# about there, which takes a tenth.
_STALE_M = 5.0
_SPEED_SIGMA_M_S, _UNKNOWN_SPEED_M_S = 2.0, 15.0  # with the EKF's velocity, and without
_FOLLOWED_M, _LONGEST_S = 10.0, 120.0
_LATE_S = 10.0  # after which attitude, height and mean velocity of then say less
_MOST_MISSES = 3  # of one place: 100 km² take most of a minute, a look about a place a second
_FOLLOWED_TILT_RAD, _FOLLOWED_HEADING_RAD = math.radians(1.0), math.radians(2.0)
_FOLLOWED_HEIGHT_M = SENSORS.height_of_late_m
_LEAST_BASE_S = 0.3  # between two places, for a velocity

Event = Callable[[str, str], None]


@dataclass(frozen=True)
class RelocalizationHypothesis:
    """Result of a search that took too long, for a second search near it.

    found: the pose at the query's frame; reachable: region of the camera at that time by its IMU,
    None if unknown; misses: searches near it without a result.
    """

    query: PlaceQuery
    found: Relocalization
    reachable: SearchRegion | None = None
    misses: int = 0

    def predicted_query(
        self, query: PlaceQuery, velocity: Array | None, reachable: SearchRegion | None
    ) -> PlaceQuery | None:
        """`query`, of a later frame, limited to where the camera can be by then, with its attitude
        and height corrected by what was found; None unless it is up to 120 s later.
        velocity: (3,) m/s in the map's axes, of the EKF, None if unknown; reachable: the reachable
        region at the time of the later frame.
        """
        elapsed_s = self.elapsed_s(query.frame.exposure_time_ns)
        if not 0.0 < elapsed_s <= _LONGEST_S:
            return None
        way, sigma_m = np.zeros(2), _speed_sigma(velocity) * elapsed_s
        if velocity is not None:
            way = velocity[:2] * elapsed_s
            if elapsed_s > _LATE_S:  # that of now: it may have circled where it was found
                way, sigma_m = way / 2.0, sigma_m + float(np.linalg.norm(way)) / 2.0
        elif self.reachable is not None and reachable is not None:
            by_imu, grown_m = (
                reachable.centre - self.reachable.centre,
                _radius_m(reachable) - _radius_m(self.reachable),
            )
            # A record of the IMU that broke meanwhile has another centre, and says nothing.
            if 0.0 < grown_m <= sigma_m and np.linalg.norm(by_imu) <= sigma_m:
                way, sigma_m = by_imu, grown_m
        pose = self.found.world_from_camera
        # The turn since is about the autopilot's axes, which an unknown heading turns against ours.
        _, heading = attitude_difference(pose.rotation, self.query.rotation)
        turn = query.rotation @ self.query.rotation.T @ with_heading(pose.rotation, -heading)
        late = max(1.0, elapsed_s / _LATE_S)
        return replace(
            query,
            rotation=with_heading(turn, heading),
            tilt_sigma_rad=min(late * _FOLLOWED_TILT_RAD, _TILT_SIGMA_RAD),
            heading_sigma_rad=min(late * _FOLLOWED_HEADING_RAD, _HEADING_SIGMA_RAD),
            height_m=float(pose.translation[2]) + query.height_m - self.query.height_m,
            height_sigma_m=min(late * _FOLLOWED_HEIGHT_M, _HEIGHT_SIGMA_M),
            region=SearchRegion.circle(pose.translation[:2] + way, _FOLLOWED_M + sigma_m),
            earlier=(),
        )

    def velocity_to(self, later: Relocalization) -> Array | None:
        """Mean velocity (3,), m/s, map axes, to a position at least 0.3 s later; otherwise None."""
        elapsed_s = self.elapsed_s(later.exposure_time_ns)
        if elapsed_s < _LEAST_BASE_S:
            return None
        way = later.world_from_camera.translation - self.found.world_from_camera.translation
        return np.asarray(way / elapsed_s)

    def elapsed_s(self, time_ns: int) -> float:
        """From the found pose to a CLOCK_MONOTONIC time."""
        return (time_ns - self.found.exposure_time_ns) * 1e-9


def _on_plane(query: PlaceQuery) -> PlaceQuery:
    """The query with its height above the tangent plane at the map's origin instead of the Earth's
    surface, which lies 8 m below the plane at 10 km; unchanged if the region is unknown.
    """
    if query.region is None:
        return query
    away = query.region.centre
    return replace(query, height_m=query.height_m - 0.5 * float(away @ away) / EARTH_RADIUS_M)


def _seconds(before: Frame, after: Frame) -> float:
    return (after.exposure_time_ns - before.exposure_time_ns) * 1e-9


def _radius_m(circle: SearchRegion) -> float:
    return float(np.sqrt(circle.shape[0, 0]))


def _speed_sigma(velocity: Array | None) -> float:
    return _UNKNOWN_SPEED_M_S if velocity is None else _SPEED_SIGMA_M_S


def enu_on_map(
    cache: TileCache, latitude_deg: float, longitude_deg: float, radius_m: float
) -> tuple[float, float] | None:
    """East and north of a WGS84 position in the map's frame, metres; None if it is more than
    radius_m from the map's box in either.
    """
    place = cache.frame.enu_from_geodetic(
        latitude_deg, longitude_deg, cache.manifest.origin.height_m
    )
    low, high = cache.index.box_min[0] - radius_m, cache.index.box_max[0] + radius_m
    inside = bool(((low <= place) & (place <= high))[:2].all())
    # East and north come back to zero on the far side of the Earth.
    return (float(place[0]), float(place[1])) if inside and place[2] > -_HORIZON_M else None


class PlaceSearch:
    """Searches the map for the position of a frame, with the autopilot's attitude and height.

    A thread of its own opens the map's overview, or computes it at the first start, so that neither
    the start nor a search waits for it. event: receives (level, text) for log and record.
    reachable: region that the camera can have reached at a time since the last position on the map;
    used if the autopilot knows no position.
    """

    def __init__(
        self,
        cache: TileCache,
        config: LocalizerConfig,
        autopilot: AutopilotPose,
        event: Event,
        reachable: Callable[[int], SearchRegion | None] = lambda _time_ns: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._hypothesis: RelocalizationHypothesis | None = None  # too old to be given out
        self._cache, self._config = cache, config
        self._autopilot, self._event, self._reach = autopilot, event, reachable
        self._in_reach = 0  # searches since the whole map was searched
        self._hint: tuple[SearchRegion, float] | None = None  # the operator's, and when it came
        self._kept: tuple[tuple[Frame, Array, float], ...] = ()  # rotation, height; newest first
        self._lays_together = False  # at the last search, if not near a place
        self._open: OpenRelocalizer | None = None
        self._obstacle: AlertId | None = AlertId.SEARCH_NOT_READY
        self._without_pose_s = -math.inf  # when attitude or height was missing last
        self._stop = threading.Event()
        # A daemon: one that hangs must not keep the process from ending.
        self._thread = threading.Thread(target=self.prepare, name="overview", daemon=True)

    @property
    def lacks(self) -> AlertId | None:
        """Why no position can be searched now; None if one can."""
        if self._obstacle is None and self._clock() - self._without_pose_s < _NEWS_S:
            return AlertId.WAITING_FOR_PRIOR
        return self._obstacle

    def start(self) -> None:
        """Start the thread that runs `prepare`."""
        self._thread.start()

    def stop(self) -> None:
        """Cancel the preparation, if it still runs; wait for that up to 10 s."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(_STOP_S)

    def close(self) -> None:
        """Stop, and release renderer and loader; no search may run, later ones return None."""
        self.stop()
        if self._open is not None:
            self._open.close()
            self._open = None

    def hint(self, east_m: float, north_m: float, radius_m: float) -> None:
        """Set the operator's position (map frame): for 120 s searches look within radius_m of it.
        It is never a fix.
        """
        region = SearchRegion.circle(np.array([east_m, north_m]), radius_m)
        self._hint = region, time.monotonic()

    def hint_at(self, hint: PlaceHint) -> bool:
        """As `hint`, for a position in WGS84 and twice its radius, and log it. False and nothing
        set if it is off the map.
        """
        radius_m = _HINT_SIGMAS * hint.radius_m
        at = enu_on_map(self._cache, hint.latitude_deg, hint.longitude_deg, radius_m)
        if at is None:
            return False
        self.hint(*at, radius_m)
        self._event("info", f"search about {at[0]:.0f} m east, {at[1]:.0f} m north: operator")
        return True

    def keep(self, frame: Frame) -> None:
        """Keep one frame a second, small, for the next searches. Called for each frame, on the
        thread of the video.
        """
        if self._kept and 0.0 <= _seconds(self._kept[0][0], frame) < _KEPT_EVERY_S:
            return
        rotation = self._autopilot.rotation(frame.exposure_time_ns)
        height_m = self._autopilot.height_m
        if rotation is None or height_m is None:
            return
        width = min(SEARCH_WIDTH, frame.camera.width)
        camera = frame.camera.resized(
            width, round(width * frame.camera.height / frame.camera.width)
        )
        image = shrink(frame.image, (camera.width, camera.height))
        small = replace(frame, image=image, camera=camera)
        self._kept = ((small, rotation, height_m), *self._kept[: _KEPT - 1])

    def search(self, frame: Frame, should_stop: Callable[[], bool]) -> PosePrior | None:
        """The camera's pose at the frame's exposure, as a hypothesis; takes seconds. None until the
        map's overview is open, without the autopilot's attitude or height, without a clear result,
        and if the search took so long that the next call must search again near it.
        should_stop: asked during the search, which ends without a result once it is true.
        """
        if self._open is None:
            return None
        query = self._query(frame)
        if query is None:
            return None
        seen, self._hypothesis = self._hypothesis, None
        if seen and self._hint and self._hint[1] > 1e-9 * seen.found.exposure_time_ns:
            seen = None  # the operator knows it since
        velocity, about = self._autopilot.velocity, self._reach(frame.exposure_time_ns)
        predicted = seen.predicted_query(query, velocity, about) if seen is not None else None
        if predicted is None:
            # Every second time of one frame: relief or dirt may lay them together wrongly.
            self._lays_together = not self._lays_together
            query = query if self._lays_together else replace(query, earlier=())
        began = self._clock()
        found = self._open.relocalizer.find(predicted or _on_plane(query), should_stop)
        near = seen if predicted is not None else None
        if found is None:
            if near is not None and near.misses + 1 < _MOST_MISSES:
                self._hypothesis = replace(near, misses=near.misses + 1)
            return None
        seconds = self._clock() - began
        recent = near is not None and near.elapsed_s(frame.exposure_time_ns) <= _LATE_S
        if not recent and seconds * _speed_sigma(velocity) > _STALE_M:
            self._hypothesis = RelocalizationHypothesis(query, found, about)
            self._event("info", f"place found by search in {seconds:.1f} s, where we were then")
            return None
        self._event("info", f"place found by search in {seconds:.1f} s, to be confirmed")
        if velocity is None and near is not None and recent:
            velocity = near.velocity_to(found)
        least = np.repeat([_PLACE_SIGMA_M, _PLACE_SIGMA_RAD], 3) ** 2
        return PosePrior(
            found.world_from_camera,
            found.covariance + np.diag(least),
            found.exposure_time_ns,
            velocity,
            independent=False,
        )

    def _query(self, frame: Frame) -> PlaceQuery | None:
        """Query from frame and autopilot's data; None while attitude or height is unknown."""
        rotation = self._autopilot.rotation(frame.exposure_time_ns)
        height_m = self._autopilot.height_m
        if rotation is None or height_m is None:
            self._without_pose_s = self._clock()
            return None
        self._without_pose_s = -math.inf
        earlier = (
            EarlierFrame(kept, then, was_m - height_m)
            for kept, then, was_m in self._kept
            if 0.0 < _seconds(kept, frame) < _KEPT * 1.5 * _KEPT_EVERY_S
        )
        return PlaceQuery(
            frame,
            rotation,
            _TILT_SIGMA_RAD,
            _HEADING_SIGMA_RAD if self._autopilot.knows_heading else None,
            height_m,
            _HEIGHT_SIGMA_M,
            self.region(frame.exposure_time_ns),
            tuple(earlier),
        )

    def region(self, time_ns: int) -> SearchRegion | None:
        """Search region: the operator's position, else that of the autopilot, else the reachable
        region. None: the whole map, in every fifth call that has to use the reachable region.
        """
        if self._hint is not None:
            region, time_s = self._hint
            if time.monotonic() - time_s < _HINT_S:
                return region
        prior = self._autopilot.prior(time_ns)
        if prior is None:
            self._in_reach = (self._in_reach + 1) % _WHOLE_MAP_EVERY
            return self._reach(time_ns) if self._in_reach else None
        sigma_m = float(np.sqrt(prior.covariance[0, 0]))
        return SearchRegion.circle(prior.world_from_camera.translation, _SIGMAS * sigma_m)

    def prepare(self) -> None:
        """Open or compute the map's overview in the caller's thread, for `search`. `lacks` is then
        None, or says why no search is possible, which is reported too. Raises nothing.
        """
        # Of the process's own priority, see `DualThreadEngine`.
        try:
            self._open = open_relocalizer(self._cache, self._config, should_stop=self._stop.is_set)
            self._obstacle = None
        except (LocalizerError, OSError) as error:
            self._disable(str(error))
        except Exception as error:  # the flight goes on without it, and says so
            _log.exception("the search could not be made ready")
            self._disable(f"{type(error).__name__}: {error}")

    def _disable(self, why: str) -> None:
        self._obstacle = AlertId.NO_SEARCH
        self._event("warning", f"no search for a lost place: {why}")
