"""A whole picture lost on the link: what a decoder shows after it, and who tells."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

import av
import numpy as np
import pytest

from companion.sources.references import DamageTracker, ReferenceTracker
from localizer.types import Image

_SIZE = (160, 120)
_KEY_EVERY = 8
_STEP_PX = 4
_SECOND_NS = 1_000_000_000


def _picture(number: int) -> Image:
    """A ramp that moves on by `_STEP_PX` a picture."""
    v, u = np.mgrid[: _SIZE[1], : _SIZE[0]]
    texture = 96 + 60 * np.sin((u + _STEP_PX * number) / 9.0) + 40 * np.sin(v / 7.0)
    return np.repeat(texture[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)


def _encoded(count: int, **options: str) -> Iterator[bytes]:
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = *_SIZE, "yuv420p"
    encoder.time_base = Fraction(1, 10)
    encoder.options = {
        "preset": "ultrafast", "tune": "zerolatency", "g": str(_KEY_EVERY),
        "x264-params": "repeat-headers=1:scenecut=0:threads=1",
    } | options  # fmt: skip
    for number in range(count):
        picture = av.VideoFrame.from_ndarray(_picture(number), format="rgb24")
        picture = picture.reformat(format="yuv420p")
        picture.pts = number
        for packet in encoder.encode(picture):
            yield bytes(packet)


def _without(packets: list[bytes], *lost: int) -> list[tuple[int, bytes]]:
    return [(i, p) for i, p in enumerate(packets) if i not in lost]


def _broken(packets: list[tuple[int, bytes]], step_ns: int = _SECOND_NS // 10) -> list[int]:
    follows = ReferenceTracker()
    return [i for i, packet in packets if follows.is_broken(packet, i * step_ns)]


def _shown(packets: list[tuple[int, bytes]]) -> dict[int, tuple[Image, bool]]:
    decoder = av.CodecContext.create("h264", "r")
    shown = {}
    for i, packet in packets:
        for picture in decoder.decode(av.Packet(packet)):
            shown[i] = picture.to_ndarray(format="rgb24"), picture.is_corrupt
    return shown


def test_the_attack_a_decoder_shows_what_was_and_marks_nothing() -> None:
    shown = _shown(_without(list(_encoded(2 * _KEY_EVERY)), 3))
    image, corrupt = shown[5]
    error = [np.abs(image.astype(int) - _picture(n)).mean() for n in (4, 5)]
    print(f"\nmean difference to the picture before {error[0]:.1f}, to its own {error[1]:.1f}")
    assert not corrupt
    assert error[0] < 0.5 * error[1]  # one picture late


def test_what_follows_a_lost_picture_is_broken_until_the_next_key_frame() -> None:
    packets = list(_encoded(3 * _KEY_EVERY))
    assert _broken(_without(packets, 3)) == [4, 5, 6, 7]
    assert _broken(_without(packets, 9, 10, 13)) == [11, 12, 14, 15]


def test_a_lost_key_frame_is_a_gap_too() -> None:
    packets = list(_encoded(3 * _KEY_EVERY))
    broken = _broken(_without(packets, _KEY_EVERY))
    assert broken == list(range(_KEY_EVERY + 1, 2 * _KEY_EVERY))


_KINDS = [
    {},
    {"profile": "baseline"},
    {"profile": "high", "preset": "medium"},
    {"bf": "2", "tune": "psnr", "preset": "medium"},  # pictures that nothing is predicted from
    {"x264-params": "repeat-headers=1:threads=1:intra-refresh=1:scenecut=0"},
    {"x264-params": "repeat-headers=1:threads=1:slices=4:scenecut=0"},
]


def _damaged(packets: list[tuple[int, bytes]]) -> list[int]:
    """The pictures that `DamageTracker` withholds, by their packets."""
    decoder, damage = av.CodecContext.create("h264", "r"), DamageTracker()
    decoder.thread_count = 1
    found = []
    for i, packet in packets:
        now_ns = i * _SECOND_NS // 10
        try:
            pictures = decoder.decode(av.Packet(packet))
        except av.error.InvalidDataError:
            damage.add_undecodable(now_ns)
            continue
        for p in pictures:
            clean = bool(p.key_frame)
            if damage.is_damaged(now_ns, marked=bool(p.is_corrupt), clean=clean):
                found.append(i)
    return found


@pytest.mark.parametrize("options", _KINDS)
def test_no_false_alarm_on_a_whole_stream(options: dict[str, str]) -> None:
    packets = list(enumerate(_encoded(70, **options)))
    assert len(packets) > 60
    assert _broken(packets) == []
    for joined in (0, 5):
        assert _damaged(packets[joined:]) == []


def test_what_leans_on_a_damaged_picture_is_damaged_until_the_next_key_frame() -> None:
    packets = [(i, p[: len(p) // 2] if i == 3 else p) for i, p in enumerate(_encoded(24))]
    shown = _shown(packets)
    assert shown[3][1]  # the decoder marks the picture itself,
    assert not any(shown[i][1] for i in range(4, 24))  # and nothing that leans on it
    wrong = [np.abs(shown[i][0].astype(int) - _picture(i)).mean() for i in (2, 5)]
    print(f"\nmean error before {wrong[0]:.1f}, two pictures after {wrong[1]:.1f}")
    assert wrong[1] > 2.0 * wrong[0]
    assert _damaged(packets) == [3, 4, 5, 6, 7]


def test_a_damaged_stream_without_key_frames_is_taken_again() -> None:
    packets = [(i, p[: len(p) // 2] if i == 3 else p) for i, p in enumerate(_encoded(70, g="250"))]
    assert _damaged(packets) == list(range(3, 3 + 51))


def test_frame_numbers_that_begin_again_are_no_gap() -> None:
    packets = list(_encoded(70, g="250"))  # 16 numbers at least, then 0 again
    assert _broken(list(enumerate(packets))) == []
    assert _broken(_without(packets, 3), 1) == list(range(4, 70))


def test_a_stream_without_key_frames_is_taken_again() -> None:
    refreshed = {"x264-params": "repeat-headers=1:threads=1:intra-refresh=1:scenecut=0"}
    packets = _without(list(_encoded(40, **refreshed)), 3)
    again = max(_broken(packets)) + 1
    assert 2 * _KEY_EVERY <= again <= 3 * _KEY_EVERY + 2  # a whole refresh after the loss
    never = _without(list(_encoded(70, g="250")), 3)
    assert max(_broken(never)) == 4 + 50  # ten a second


def test_without_headers_or_of_another_kind_nothing_is_said() -> None:
    rng = np.random.default_rng(3)
    noise = [(i, b"\x00\x00\x01" + rng.bytes(200)) for i in range(500)]
    assert isinstance(_broken(noise), list)
    whole = list(_encoded(_KEY_EVERY))
    assert _broken([(i, p[:7]) for i, p in enumerate(whole)]) == []
    assert _broken([(i, p) for i, p in enumerate(whole) if i > 1]) == []  # joined late


def test_an_encoder_that_counts_otherwise_is_let_pass() -> None:
    packets = list(_encoded(70, g="250"))
    every_second = [(i, p) for i, p in enumerate(packets) if i % 2 == 0]
    assert len(_broken(every_second)) == 9


def test_a_link_that_was_bad_for_a_while_is_watched_again() -> None:
    """Ten gaps in a row are an encoder that counts otherwise, or a link that loses every second
    picture for a while: after it nothing was watched any more, until the next connection.
    """
    packets = list(_encoded(100, g="1000"))
    kept = [p for p in enumerate(packets) if p[0] > 40 or p[0] % 2 == 0]
    lost = 90
    broken = _broken([p for p in kept if p[0] != lost])
    assert broken[-1] == 99
    assert min(i for i in broken if i > 41) == lost + 1
