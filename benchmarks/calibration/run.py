"""Each draw flown, calibrated and flown again; one line of JSON a draw."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.calibration.desk.film import EstimateWithTruth
from benchmarks.calibration.draws import Draw, Sortie, drawn, fly, true_camera, true_mount
from companion.calibrate import unknowns as u
from companion.calibrate.flight import CalibrationResult, calibrate
from companion.calibrate.proposal import apply_changes, blind_spots, setting_changes
from companion.config import CompanionConfig, load_config
from companion.offline.record import load_record
from localizer.geometry.pose import Array, euler_from_matrix, so3_log
from sitl.camera.pose_sender import GimbalError
from sitl.demo.assets import FlightAssets
from sitl.demo.scenario import CameraSpec

TRUTH = "truth.json"
_FRAMES = 200  # as the command's default
_AGAIN_S = 50.0
_AGAIN = 7_000  # added to the seed of the flight after the calibration


def record_draw(assets: FlightAssets, seed: int, folder: Path) -> None:
    """One draw's shadow flight, localized under the wrong deployment; `TRUTH` is written last."""
    draw = drawn(seed)
    sortie = fly(assets, draw, seed, folder, gimbal=GimbalError(seed))
    seen = sortie.localized(sortie.deployment, seed, keep=True)
    known = {
        "seed": seed, "draw": asdict(draw), "truth": true_numbers(draw, seed, sortie).tolist(),
        "ekf_off_m": sortie.flown.ekf_off_m.tolist(), "in_flight_m": _errors(seen),
    }  # fmt: skip
    (folder / TRUTH).write_text(json.dumps(known))


def solve_draw(
    assets: FlightAssets, known: dict[str, Any], folder: Path, after: bool = True
) -> dict[str, Any]:
    """A recorded draw calibrated: errors of what was found, its sigmas, the flight after it.

    known: of its `TRUTH`. after: fly and localize once more, under three deployments.
    """
    seed = int(known["seed"])
    found = calibrate(load_record(folder / "record", 0.0, folder / "flight.tlog"), _FRAMES)
    row = known | _found_numbers(found)
    if after:
        deployment = load_config(folder / "deployment.yaml")
        corrected = apply_changes(deployment, setting_changes(deployment, found))
        row["again"] = _again(assets, drawn(seed), seed, folder, corrected)
    return row


def _found_numbers(found: CalibrationResult) -> dict[str, Any]:
    return {
        "names": [n.name for n in u.UNKNOWNS],
        "found": found.shared.tolist(), "sigma": found.sigmas.tolist(),
        "lsq_sigma": np.sqrt(np.diag(found.solution.covariance)).tolist(),
        "frames": found.frames, "before_px": found.before_px, "after_px": found.after_px,
        "blind": list(blind_spots(found)), "noise": _noise(found),
    }  # fmt: skip


def true_numbers(draw: Draw, seed: int, sortie: Sortie) -> Array:
    """What `calibrate` should find, (COUNT,). The map's place is against the ground's true one."""
    gimbal = GimbalError(seed)
    truth = np.zeros(u.COUNT)
    truth[u.FOCAL] = np.log1p(draw.focal)
    truth[u.CENTRE], truth[u.BEND], truth[u.LATE] = draw.principal_px, draw.bend, draw.late_s
    truth[u.MOUNT] = so3_log(true_mount(draw, gimbal))
    truth[u.HEADING] = np.radians(gimbal.alignment_deg[2]) - sortie.flown.ekf_yaw_off_rad
    truth[u.ARM], truth[u.SHIFT] = draw.arm_m, draw.shift_m
    return truth


def _noise(found: CalibrationResult) -> dict[str, Any]:
    s = found.solution
    return {
        "attitude_deg": np.degrees(s.attitude.sigma).tolist(),
        "attitude_memory_s": s.attitude.memory_s,
        "place_m": s.place.sigma.tolist(), "place_memory_s": s.place.memory_s.tolist(),
    }  # fmt: skip


def _errors(seen: list[EstimateWithTruth]) -> dict[str, float]:
    """Of accepted poses against the truth, m; completeness as a share."""
    off = [
        x.estimate.world_from_camera.distance_to(x.truth)[0]
        for x in seen
        if x.estimate is not None and x.estimate.accepted
    ]
    values = np.array(off) if off else np.array([np.nan])
    return {
        "median": float(np.median(values)), "p95": float(np.percentile(values, 95)),
        "accepted": len(off) / max(len(seen), 1),
    }  # fmt: skip


def _again(
    assets: FlightAssets, draw: Draw, seed: int, folder: Path, found: CompanionConfig
) -> dict[str, dict[str, float]]:
    """Another way with the same aircraft, under the old, the found and the true deployment."""
    camera, gimbal = true_camera(CameraSpec(), draw), GimbalError(seed)  # the same aircraft
    sortie = fly(assets, draw, seed + _AGAIN, folder / "again", gimbal=gimbal, seconds=_AGAIN_S)
    model = sortie.deployment.camera.model.model_copy(
        update={
            **{k: getattr(camera, k) for k in ("fx", "fy", "cx", "cy", "distortion")},
            "readout_ms": camera.readout_ms,
        }
    )
    settings = sortie.deployment.camera.settings
    true = sortie.deployment.camera.model_copy(
        update={
            "model": model, "lever_arm_m": draw.arm_m,
            "settings": settings.model_copy(update={"time_offset_ms": 1e3 * draw.late_s}),
        }
    )  # fmt: skip
    roll, pitch, yaw = (float(x) for x in np.degrees(euler_from_matrix(true_mount(draw, gimbal))))
    bridge = sortie.deployment.bridge
    mounted = bridge.camera.model_copy(
        update={"mount_roll_deg": roll, "mount_pitch_deg": pitch, "mount_yaw_deg": yaw}
    )
    deployments = {
        "old": sortie.deployment,
        "found": found.model_copy(update={"map": sortie.deployment.map}),
        "true": sortie.deployment.model_copy(
            update={
                "camera": true,
                "bridge": bridge.model_copy(update={"camera": mounted}),
            }
        ),
    }
    return {
        name: _errors(sortie.localized(config, seed + _AGAIN, keep=False))
        for name, config in deployments.items()
    }
