"""Where was this photo taken? Localize one image against a map, from a rough idea of its pose.

python examples/localize_photo.py PHOTO CACHE CAMERA.json LAT LON HEIGHT ROLL PITCH YAW

Degrees, metres above the ellipsoid; pitch 0 looks straight down, 90 at the horizon; yaw counts
counter-clockwise from north (docs/reference/angles.md).
"""

import sys
from pathlib import Path

from localizer import Camera, Frame, Geodetic, PosePrior, PoseRow, open_localizer, pose_of_row
from localizer.pictures import read_rgb

photo, cache, camera_file, *numbers = sys.argv[1:] if len(sys.argv) == 10 else sys.exit(__doc__)
latitude, longitude, height, roll, pitch, yaw = map(float, numbers)
camera = Camera.from_json(Path(camera_file))
image = read_rgb(Path(photo))
with open_localizer(cache, camera) as localizer:
    about = PoseRow(photo, Geodetic(latitude, longitude, height), roll, pitch, yaw)
    localizer.set_prior(PosePrior.around(pose_of_row(about, localizer.frame)))
    found = localizer.track(Frame(image, 0, camera, 0), passes=3)
    print(localizer.frame.position(found.world_from_camera.translation))
    print("accepted" if found.accepted else f"not localized: {found.status.value}")
