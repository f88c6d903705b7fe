"""``companion calibrate flight``: estimates calibration values from a record with images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from companion.calibrate import unknowns as u
from companion.calibrate.evidence import (
    REACH_S,
    AutopilotWindow,
    CalibrationFrame,
    CalibrationProblem,
    Guess,
    autopilot_window_at,
    changed_camera,
)
from companion.calibrate.pictures import PictureReader
from companion.calibrate.solve import Solution, solve
from companion.config import CompanionConfig
from companion.errors import RecordError, StreamDecodeError
from companion.geometry import Mount
from companion.offline.record import FlightRecord
from companion.offline.replay import RecordedAutopilot
from companion.recorded.flight import RecordedFrame
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import load_extractor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, Pose
from localizer.geometry.shutter import Sweep
from localizer.tracking.opening import MapStack
from localizer.tracking.pipeline import working_camera
from localizer.types import Frame
from mavlink_bridge.injection.shadow import gnss_healthy

_LEAST_FRAMES = 20
_READ_TWICE = 2  # with the deployment's camera, and with the one that was found
_LATER_NS = round(1e9 * (REACH_S + 0.3))
_GNSS_BIAS_M = 0.5  # of a receiver, for minutes, however good it says it is
# TIMESYNC halves the round trip: what the link's two ways differ by, no flight shows.
_CLOCKS_S = 0.002
_SAME_LENS = 1e-3  # share of the focal length
_OURS = ("inject", "rc")


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration flight. solution: see `solve`; before, after: mean distance of the
    image patches from their map positions before and after the calibration, px of the stream, each
    with free poses; frames, parts: numbers of images and patches used.
    notes: sentences for the reader.
    """

    camera: Camera
    mount: Array
    arm_m: Array
    solution: Solution
    covariance: Array
    before_px: float
    after_px: float
    frames: int
    parts: int
    notes: tuple[str, ...]

    @property
    def shared(self) -> Array:
        """The most probable values, (COUNT,), as differences from the deployment's."""
        return self.solution.guess.shared

    @property
    def sigmas(self) -> Array:
        """(COUNT,), one standard deviation of each value."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class _ChosenFrame:
    """A chosen frame on disk, since two hundred frames of a 4K camera fill 5 GB of memory. window:
    the autopilot's data; pose: the registered one.
    """

    recorded: RecordedFrame
    time_ns: int
    window: AutopilotWindow
    pose: Pose


def calibrate(
    record: FlightRecord,
    frames: int = 200,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> CalibrationResult:
    """Estimate calibration values from a record's images over its map, starting from its
    deployment.

    frames: largest number of images, spread over the flight. progress: called with the numbers read
    and total (twice the frames). `RecordError` says what the record lacks.
    """
    config = record.config
    stack = MapStack(config.map, config.localizer)
    try:
        record.tables.flown_map.require_frame(stack.cache)
        mount = mount_matrix(config)
        pictures, bias_m = _chosen(record, stack, mount, frames)
        camera = _stream_camera(record, pictures)
        arm_m = np.array(config.camera.lever_arm_m)
        size = working_camera(camera, config.localizer.width)
        extractor = DetailExtractor(
            load_extractor(config.localizer.model, threads=1, size=(size.width, size.height))
        )
        guess: Guess | None = None
        solution, before_px = None, np.nan
        total = _READ_TWICE * len(pictures)
        for turn in range(_READ_TWICE):
            begun = total * turn // _READ_TWICE
            shared = np.zeros(u.COUNT) if guess is None else guess.shared
            believed = changed_camera(camera, shared)
            reader = PictureReader(stack.renderer, extractor, believed, config.localizer.width)
            late_s = float(shared[u.LATE])
            pictures, sighted = _sighted(
                pictures, reader, believed, late_s, partial(_tell, progress, begun, total)
            )
            evidence = CalibrationProblem(sighted, camera, mount, arm_m)
            if guess is None:
                still = np.arange(u.COUNT) < u.OPTICS.stop
                before_px = solve(evidence, fixed=still).pixel_sigma
            solution = solve(evidence)
            guess = solution.guess
            pictures = [
                replace(p, pose=Pose(R, t))
                for p, R, t in zip(pictures, guess.rotations, guess.places, strict=True)
            ]
    finally:
        stack.close()
    if solution is None:
        raise RecordError(f"{record.folder}: nothing was solved")
    covariance = solution.covariance.copy()
    covariance[u.SHIFT, u.SHIFT] += np.eye(3) * bias_m**2
    covariance[u.LATE, u.LATE] += _CLOCKS_S**2
    return CalibrationResult(
        camera, mount, arm_m, solution, covariance, before_px, solution.pixel_sigma, len(sighted),
        len(evidence.owner), _notes(evidence, config),
    )  # fmt: skip


def _tell(progress: Callable[[int, int], None], begun: int, total: int, done: int) -> None:
    progress(begun + done, total)


def mount_matrix(config: CompanionConfig) -> Array:
    """(3, 3): the mounting correction from the camera's housing to the gimbal."""
    c = config.bridge.camera
    return Mount.from_degrees(c.mount_roll_deg, c.mount_pitch_deg, c.mount_yaw_deg).rotation


def _chosen(
    record: FlightRecord, stack: MapStack, mount: Array, most: int
) -> tuple[list[_ChosenFrame], float]:
    """At most `most` accepted estimates that have an image, spread over the flight, and the GNSS
    receiver's constant error, m.
    """
    config, bridge = record.config, record.config.bridge
    autopilot = RecordedAutopilot(bridge, record.log, record.tables.start_ns)
    good = [
        (frame, e) for frame, e in zip(record.flight.frames, record.estimates, strict=True)
        if e.accepted and e.is_tracking and frame.path.is_file()
    ]  # fmt: skip
    if len(good) < _LEAST_FRAMES:
        raise RecordError(
            f"{record.folder}: {len(good)} localized frames with their images; calibration needs "
            f"{_LEAST_FRAMES}, better 150: fly in shadow mode for three minutes with "
            "record.snapshot_interval_s: 1"
        )
    picked = np.unique(np.linspace(0, len(good) - 1, min(most, len(good))).round().astype(int))
    geoid_m, frame = stack.cache.manifest.geoid_separation_m, stack.cache.frame
    trusted = bridge.mode not in _OURS
    pictures: list[_ChosenFrame] = []
    accuracies_m: list[float | None] = []
    for index in picked:
        picture, estimate = good[index]
        time_ns = estimate.exposure_time_ns
        autopilot.advance(time_ns + _LATER_NS)
        window = autopilot_window_at(autopilot, time_ns, frame, geoid_m, mount)
        factor = autopilot.zoom_factor(config.camera.zoom, time_ns)
        if window is None or factor is None or abs(factor - 1.0) > _SAME_LENS:
            continue
        state = autopilot.state()
        if not trusted or not gnss_healthy(state, time_ns + _LATER_NS):
            window = replace(window, place=np.full_like(window.place, np.nan))
        elif window.has_place:
            accuracies_m.append(state.gps_h_accuracy_m)
        pictures.append(_ChosenFrame(picture, time_ns, window, estimate.world_from_camera))
    if len(pictures) < _LEAST_FRAMES:
        raise RecordError(
            f"{record.log.path}: attitude and gimbal are known at {len(pictures)} of {len(picked)} "
            f"images; calibration needs {_LEAST_FRAMES}: is it this flight's log?"
        )
    return pictures, receiver_bias_m(accuracies_m)


def _stream_camera(record: FlightRecord, pictures: list[_ChosenFrame]) -> Camera:
    """The deployment's camera at the size of the first readable image."""
    for picture in pictures:
        if (frame := _read(picture, record.flight.camera.camera)) is not None:
            return frame.camera
    raise RecordError(f"{record.folder}: none of its images can be read")


def _read(picture: _ChosenFrame, camera: Camera) -> Frame | None:
    """Read an image; None if it was cut off, for example by a power loss."""
    try:
        return picture.recorded.load(camera, picture.time_ns)
    except StreamDecodeError:
        return None


def receiver_bias_m(accuracies_m: Sequence[float | None]) -> float:
    """Error of a flight's mean position caused by the GNSS receiver, m, 1 sigma.

    accuracies_m: accuracy that the receiver stated for each image used, None if it stated none.
    Errors that last all flight do not average out: the sigma of their mean is the mean of their
    sigmas.
    """
    window = [max(_GNSS_BIAS_M, a) for a in accuracies_m if a is not None]
    return float(np.mean(window)) if window else _GNSS_BIAS_M


def _sighted(
    pictures: list[_ChosenFrame], reader: PictureReader, camera: Camera, late_s: float,
    progress: Callable[[int], None],
) -> tuple[list[_ChosenFrame], list[CalibrationFrame]]:  # fmt: skip
    kept, sighted = [], []
    for number, picture in enumerate(pictures):
        progress(number + 1)
        if (frame := _read(picture, camera)) is None:
            continue
        rate, velocity = picture.window.motion(-late_s)
        sweep = Sweep.of(rate, velocity, camera.readout_ms) if camera.readout_ms > 0 else None
        parts = reader.read(frame, picture.pose, sweep)
        if parts is not None:
            kept.append(picture)
            sighted.append(CalibrationFrame(picture.time_ns, picture.pose, parts, picture.window))
    if len(sighted) < _LEAST_FRAMES:
        raise RecordError(
            f"only {len(sighted)} of {len(pictures)} images match the map again: is it "
            "the flight's own map?"
        )
    return kept, sighted


def _notes(evidence: CalibrationProblem, config: CompanionConfig) -> tuple[str, ...]:
    notes = []
    share = float(evidence.placed.mean())
    if config.bridge.mode in _OURS:
        notes.append(
            "the flight injected its fixes: its EKF's positions repeat them and were not used; fly "
            "in shadow mode to find time offset, lever arm and map offset"
        )
    elif share < 0.5:
        notes.append(f"GNSS positions are known at {100 * share:.0f} % of the images only")
    return tuple(notes)
