"""A detector beside the companion: finds a red object in the video and tells where it is.

    python examples/detector_client.py DEPLOYMENT.yaml

It opens the same camera feed as `companion run DEPLOYMENT.yaml` and sends one JSON datagram per
frame to that deployment's `targets.detections`; formats.md describes it. Put your own network
into `find_red`. The feed must be one that two processes can read: multicast, RTSP, a file; and its
frames must carry their time, so that the times of both differ by less than 5 ms.
"""

from __future__ import annotations

import json
import socket
import sys
from pathlib import Path

import cv2
import numpy as np

from companion.config import load_config
from companion.errors import CompanionError, ConfigError
from companion.sources import open_source
from companion.targets.detections import parse_host_port
from localizer.types import Image

SMALLEST_PX = 12  # area; below it, red is noise


def find_red(image: Image) -> tuple[float, float] | None:
    """Middle (u, v) of the largest red area of an RGB image (H, W, 3), None where there is none.

    Pixel centres are at + 0.5: the first pixel's middle is (0.5, 0.5).
    """
    hue, saturation, value = np.moveaxis(cv2.cvtColor(image, cv2.COLOR_RGB2HSV), -1, 0)
    red = ((hue < 8) | (hue > 172)) & (saturation > 150) & (value > 90)
    count, _, stats, centroids = cv2.connectedComponentsWithStats(red.astype(np.uint8))
    if count < 2 or stats[1:, cv2.CC_STAT_AREA].max() < SMALLEST_PX:
        return None
    u, v = centroids[1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())] + 0.5
    return float(u), float(v)


def main(deployment: Path) -> int:
    """Send detections until the feed ends; returns how many."""
    config = load_config(deployment)
    if config.targets.detections is None:
        raise ConfigError(f"{deployment}: set targets.detections to host:port")
    address = parse_host_port(config.targets.detections)
    feed, sent = config.camera, 0
    source = open_source(feed.source, feed.model.camera(), feed.settings)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for frame in source.frames():
            pixel = find_red(frame.image)
            if pixel is None:
                continue
            u, v = pixel
            detection = {"target_id": "red", "time_ns": frame.exposure_time_ns, "u": u, "v": v}
            out.sendto(json.dumps(detection).encode(), address)
            sent += 1
    return sent


if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1] == "--help":
        sys.exit(__doc__)
    try:
        print(f"{main(Path(sys.argv[1]))} detections sent")
    except CompanionError as error:
        sys.exit(str(error))
