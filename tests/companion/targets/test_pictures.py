import numpy as np
import pytest

from companion.targets.pictures import RecentPictures


@pytest.mark.parametrize(("shape", "kept"), [((54, 96), 16), ((540, 960), 16), ((2160, 3840), 4)])
def test_pictures_are_kept_by_number_and_by_bytes(shape, kept):
    """Attack: sixteen of 4K took 400 MB."""
    pictures = RecentPictures[np.ndarray](16, lambda image: image.nbytes)
    blank = np.zeros((*shape, 3), np.uint8)
    for _ in range(40):
        pictures.append(blank)
    assert len(pictures) == kept
    assert pictures.nbytes == kept * blank.nbytes <= 100 << 20


def test_what_is_dropped_makes_room():
    pictures = RecentPictures[bytes](8, len, most_bytes=40)
    for k in range(5):
        pictures.append(bytes([k]) * 10)
    assert [item[0] for item in pictures] == [1, 2, 3, 4]
    pictures.retain(lambda item: item[0] >= 3)
    assert (len(pictures), pictures.nbytes) == (2, 20)
    pictures.append(b"\x09" * 100)  # alone above what is allowed: the newest three stay
    assert [item[0] for item in pictures] == [3, 4, 9]
