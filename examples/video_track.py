"""Localize a video file frame by frame, then plot the track, its height and its sigma.

python examples/video_track.py VIDEO CACHE CAMERA.json LAT LON HEIGHT ROLL PITCH YAW PLOT.png

The pose is about where the first frame was taken (docs/reference/angles.md). Beside the plot stands
PLOT.tum, a trajectory for evo. A frame that is not localized is left out; the motion model goes on
to the next one.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from localizer import (
    Camera,
    Frame,
    Geodetic,
    Localizer,
    OutsideMapError,
    PoseEstimate,
    PosePrior,
    PoseRow,
    StampedPose,
    open_localizer,
    pose_of_row,
    write_tum,
)


def frames(video: str, camera: Camera) -> Iterator[Frame]:
    """The video's frames with the times that it gives them."""
    capture = cv2.VideoCapture(video)
    sequence = 0
    while True:
        is_there, bgr = capture.read()
        if not is_there:
            break
        time_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)  # of the frame that was read
        yield Frame(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), time_ns, camera, sequence)
        sequence += 1
    capture.release()


def track(localizer: Localizer, video: str, camera: Camera, first: PoseRow) -> list[PoseEstimate]:
    """The accepted estimates."""
    prior = pose_of_row(first, localizer.frame)
    estimates = []
    for frame in frames(video, camera):
        if frame.sequence == 0:
            localizer.set_prior(PosePrior.around(prior, time_ns=frame.exposure_time_ns))
        try:
            estimate = localizer.track(frame, passes=3 if frame.sequence == 0 else 1)
        except OutsideMapError as error:
            print(f"frame {frame.sequence}: {error}")
            continue
        if estimate.accepted:
            estimates.append(estimate)
        else:
            print(f"frame {frame.sequence}: rejected, quality {estimate.quality:.2f}")
    return estimates


def plot(estimates: list[PoseEstimate], path: Path) -> None:
    """The track from above, and height and sigma over time."""
    places = np.array([e.world_from_camera.translation for e in estimates])
    time_s = np.array([e.exposure_time_ns for e in estimates]) * 1e-9
    sigma = np.sqrt([np.trace(e.covariance[:3, :3]) for e in estimates])
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    above, height, spread = figure.subplot_mosaic([["a", "h"], ["a", "s"]]).values()
    above.plot(places[:, 0], places[:, 1], ".-")
    above.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    height.plot(time_s, places[:, 2], ".-")
    height.set(ylabel="up, m")
    spread.plot(time_s, sigma, ".-")
    spread.set(xlabel="time, s", ylabel="3-D sigma, m")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Read the arguments, localize, plot."""
    video, cache, camera_file, *numbers, out = sys.argv[1:]
    latitude, longitude, height, roll, pitch, yaw = map(float, numbers)
    camera = Camera.from_json(Path(camera_file))
    first = PoseRow("first", Geodetic(latitude, longitude, height), roll, pitch, yaw)
    with open_localizer(cache, camera) as localizer:
        estimates = track(localizer, video, camera, first)
    if not estimates:
        sys.exit("not one frame was localized: check the first pose, the camera and the map")
    poses = [StampedPose("", e.world_from_camera, e.exposure_time_ns) for e in estimates]
    write_tum(Path(out).with_suffix(".tum"), poses)
    plot(estimates, Path(out))
    print(f"{len(estimates)} frames localized: {out}")


if __name__ == "__main__":
    if len(sys.argv) != 11:
        sys.exit(__doc__)
    main()
