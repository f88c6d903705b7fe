"""A record on disk, over a map, without a flight."""

import csv
import json

import cv2
import numpy as np

from companion.flight.recorder import ESTIMATE_COLUMNS, EVENT_COLUMNS, TARGET_COLUMNS
from localizer.map.cache.cache import TileCache
from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.ids import AlertId
from tests.companion.console.companion_flying import CAMERA, HEIGHT_M

S = 1_000_000_000


def write_rows(path, columns, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="0")
        writer.writeheader()
        writer.writerows(rows)


def write_record(folder, map_path=None, *, tracks_s=15, event_s=25, picture_s=10, **settings):
    """20 s of looking down on the map's origin, without a map on 47 N 0 E; tracking for the first
    `tracks_s`. A target at 12 s; times of event and picture from 0.
    """
    (folder / "snapshots").mkdir(parents=True)
    up, at = 0.0, {"latitude_deg": 47.0, "longitude_deg": 0.0}
    if map_path is not None:
        cache = TileCache.open(map_path)
        origin, up = cache.frame.origin, float(cache.index.box_min[0, 2]) + HEIGHT_M
        at = {"latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg}
        settings["map"] = str(map_path)
    write_rows(
        folder / "estimates.csv", ESTIMATE_COLUMNS,
        [
            {"exposure_time_ns": (10 + i) * S, "qx": 1.0, "up_m": up, "status": "OK",
             "state": "tracking" if i < tracks_s else "lost", "accepted": int(i < tracks_s)} | at
            for i in range(21)
        ],
    )  # fmt: skip
    target = {"exposure_time_ns": 12 * S, "target_id": "car"} | at
    write_rows(folder / "targets.csv", TARGET_COLUMNS, [target])
    lost = text(alert(AlertId.LOST, seconds=9.0))
    event = {"time_ns": event_s * S, "level": "warning", "text": lost}
    write_rows(folder / "events.csv", EVENT_COLUMNS, [event])
    image = np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
    cv2.imwrite(str(folder / "snapshots" / f"{picture_s * S}.jpg"), image)
    config = {"camera": {"model": CAMERA.to_dict()}, **settings}
    manifest = {"monotonic_ns": 10 * S, "utc_ns": 1000 * S, "config": config}
    (folder / "record.json").write_text(json.dumps(manifest))
    return folder
