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


def write_record(folder, map_path):
    """20 s of looking down on the origin, lost from 15 s on; a picture, a target, an event."""
    (folder / "snapshots").mkdir(parents=True)
    cache = TileCache.open(map_path)
    origin = cache.frame.origin
    up = float(cache.index.box_min[0, 2]) + HEIGHT_M
    at = {"latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg}
    write_rows(
        folder / "estimates.csv", ESTIMATE_COLUMNS,
        [
            {"exposure_time_ns": (10 + i) * S, "qx": 1.0, "up_m": up, "status": "OK",
             "state": "tracking" if i < 15 else "lost", "accepted": int(i < 15)} | at
            for i in range(21)
        ],
    )  # fmt: skip
    target = {"exposure_time_ns": 12 * S, "target_id": "car"} | at
    write_rows(folder / "targets.csv", TARGET_COLUMNS, [target])
    event = {"time_ns": 25 * S, "level": "warning", "text": text(alert(AlertId.LOST, seconds=9.0))}
    write_rows(folder / "events.csv", EVENT_COLUMNS, [event])
    image = np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
    cv2.imwrite(str(folder / "snapshots" / f"{10 * S}.jpg"), image)
    config = {"camera": {"model": CAMERA.to_dict()}, "map": str(map_path)}
    manifest = {"monotonic_ns": 10 * S, "utc_ns": 1000 * S, "config": config}
    (folder / "record.json").write_text(json.dumps(manifest))
