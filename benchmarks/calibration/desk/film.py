"""The pictures of a desk flight, localized as in flight, into a record as `companion run`'s."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.calibration.desk.flight import DeskFlightRecord
from companion.config import CompanionConfig
from companion.conversions import CameraExtrinsics
from companion.flight.priors import AutopilotPose
from companion.flight.recorder import MANIFEST_NAME, Recorder, write_manifest
from companion.offline.replay import RecordedAutopilot
from companion.recorded.flight import LogBeside
from localizer.errors import OutsideMapError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose
from localizer.map.cache.cache import TileCache
from localizer.map.cache.stream import TileStreamer
from localizer.render.numba_raster import NumbaRenderer
from localizer.synth.appearance.model import Appearance
from localizer.tracking.opening import MapStack, build_localizer
from localizer.types import Frame, PoseEstimate
from sitl.camera.movers import Mover
from sitl.camera.realism import CameraClock, CameraRealism
from sitl.camera.world_camera import CameraOptions, WorldCamera

_LATENCY_NS = 120_000_000  # from the exposure to the estimate, as flights have it


@dataclass(frozen=True)
class Eye:
    """The camera as it is. cache: the live world. stamp_late_s: of its stamps."""

    cache: Path
    camera: Camera
    appearance: Appearance
    realism: CameraRealism
    movers: tuple[Mover, ...]
    rate_hz: float


@dataclass(frozen=True)
class Exposed:
    """A picture as the companion gets it, and the camera's true pose."""

    frame: Frame
    pose: Pose


def exposures(eye: Eye, flown: DeskFlightRecord, cache: TileCache, seed: int) -> Iterator[Exposed]:
    """The pictures of a flight in their order. cache: the companion's map, in whose ENU poses are.

    Frames carry the deployment's stamps; their camera is the true one's size with no model yet.
    """
    live = TileCache.open(eye.cache)
    streamer = TileStreamer(live)
    stamps = CameraClock(eye.realism, seed)
    try:
        scene = live.frame.ecef_from_enu.inverse @ cache.frame.ecef_from_enu
        options = CameraOptions(eye.movers, scene, seed=seed, realism=eye.realism)
        camera = WorldCamera(NumbaRenderer(streamer), eye.camera, eye.appearance, options)
        period_ns = round(1e9 / eye.rate_hz)
        for number, time_ns in enumerate(range(flown.begin_ns, flown.end_ns, period_ns)):
            exposure = camera.expose(time_ns, flown.track(time_ns))
            if exposure is not None:
                frame = Frame(exposure.image, stamps.of(time_ns), eye.camera, number)
                yield Exposed(frame, exposure.world_from_camera)
    finally:
        streamer.close()


@dataclass(frozen=True)
class EstimateWithTruth:
    """One picture's outcome. estimate: None where nothing could be said."""

    estimate: PoseEstimate | None
    truth: Pose


def write_record(
    pictures: Iterator[Exposed], config: CompanionConfig, tlog: Path, clocks: tuple[int, int],
    keep: bool = True,
) -> list[EstimateWithTruth]:  # fmt: skip
    """Localize the pictures under a deployment, and keep them as its record.

    clocks: begin of the record on CLOCK_MONOTONIC, and UTC less it, ns. keep: pictures and all.
    """
    if config.record is None:
        raise ValueError("a desk flight's deployment names its record")
    start_ns, offset_ns = clocks
    autopilot = RecordedAutopilot(config.bridge, LogBeside(tlog, offset_ns, None), start_ns)
    stack = MapStack(config.map, config.localizer)
    recorder = Recorder(config.record, stack.cache.frame) if keep else None
    told = config.camera.model.camera()
    late_ns = round(1e6 * config.camera.settings.time_offset_ms)
    localized = []
    try:
        arm = np.array(config.camera.lever_arm_m)
        geoid_m = stack.cache.manifest.geoid_separation_m
        pose = AutopilotPose(autopilot, CameraExtrinsics(stack.cache.frame, geoid_m, arm))
        localizer = build_localizer(stack, told, config.localizer, pose.sensors)
        for exposed in pictures:
            time_ns = exposed.frame.exposure_time_ns - late_ns
            frame = replace(exposed.frame, camera=told, exposure_time_ns=time_ns)
            autopilot.advance(frame.exposure_time_ns + _LATENCY_NS)
            if localizer.tracker.track_status.wants_prior:
                prior = pose.prior(frame.exposure_time_ns)
                if prior is not None:
                    localizer.offer(prior)
            try:
                estimate = localizer.track(frame)
            except OutsideMapError:
                localized.append(EstimateWithTruth(None, exposed.pose))
                continue
            if estimate.accepted:
                pose.belief.note_fix(estimate.exposure_time_ns)
            localized.append(EstimateWithTruth(estimate, exposed.pose))
            if recorder is not None:
                recorder.estimate(
                    replace(estimate, stage_ms=estimate.stage_ms | {"latency": 1e-6 * _LATENCY_NS})
                )
                recorder.snapshot(frame)
    finally:
        if recorder is not None:
            recorder.close()
        stack.close()
    if recorder is not None:
        _date(config, start_ns, offset_ns)
    return localized


def _date(config: CompanionConfig, start_ns: int, offset_ns: int) -> None:
    """``record.json`` on the simulated clock."""
    if config.record is None:
        return
    write_manifest(config.record.folder, config)
    path = config.record.folder / MANIFEST_NAME
    document = json.loads(path.read_text())
    document |= {"monotonic_ns": start_ns, "utc_ns": start_ns + offset_ns}
    path.write_text(json.dumps(document, indent=1))
