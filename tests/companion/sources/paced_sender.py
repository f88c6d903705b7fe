"""A sender of numbered pictures at a fixed rate, and who collects what becomes of them."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable

import numpy as np

from companion.sources import FrameSource, SourceSettings, StreamState, open_source
from localizer.geometry.camera import Camera
from localizer.types import Frame, Image
from sitl.camera.stream import VideoSender

CAMERA = Camera.from_fov(320, 240, 70.0)
CELL = 16
_BITS = 10


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def counter_image(number: int, camera: Camera = CAMERA) -> Image:
    """Smooth background, and `number` as black and white cells along the top."""
    v, u = np.mgrid[: camera.height, : camera.width]
    image = np.stack([u * 255 // camera.width, v * 255 // camera.height, (u + v) // 4], axis=-1)
    for bit in range(_BITS):
        image[:CELL, bit * CELL : (bit + 1) * CELL] = 255 * (number >> bit & 1)
    return image.astype(np.uint8)


def read_counter(image: Image) -> int:
    h = CELL // 2
    bits = [image[h - 2 : h + 2, b * CELL + h - 2 : b * CELL + h + 2].mean() > 128
            for b in range(_BITS)]  # fmt: skip
    return sum(1 << b for b, bit in enumerate(bits) if bit)


class PacedSender:
    """Sends counter images at a fixed rate from a thread; remembers when each was exposed.

    delay_s: what a camera's own processing takes between exposure and sending.
    """

    def __init__(
        self,
        url: str,
        rate_hz: float = 20.0,
        *,
        camera: Camera = CAMERA,
        misp: bool = True,
        delay_s: float = 0.0,
        first: int = 0,
    ) -> None:
        self.exposed: dict[int, int] = {}
        self._url, self._rate, self._camera, self._misp = url, rate_hz, camera, misp
        self._delay, self._next = delay_s, first
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> PacedSender:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)

    def _run(self) -> None:
        c = self._camera
        sender = VideoSender(self._url, c.width, c.height, self._rate, misp=self._misp)
        while not self._stop.is_set():
            exposed = time.monotonic_ns()
            self.exposed[self._next] = exposed
            image = counter_image(self._next, c)
            time.sleep(self._delay)
            sender.send(image, exposed)
            self._next = (self._next + 1) % (1 << _BITS)
            self._stop.wait(max(0.0, 1 / self._rate - (time.monotonic_ns() - exposed) / 1e9))
        sender.close()


class Watch:
    """Collects a source's frames and states from a thread, with the time each frame came out."""

    def __init__(self, url: str, camera: Camera = CAMERA, **settings: object) -> None:
        self.frames: list[tuple[Frame, int]] = []
        self.told: list[tuple[StreamState, str]] = []
        self.error: Exception | None = None
        self.strangers: list[str] = []
        self._news = threading.Condition()
        self.source: FrameSource = open_source(
            url,
            camera,
            SourceSettings.model_validate(settings),
            self._on_state,
            self.strangers.append,
        )
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.source.close()
        self._thread.join(60.0)
        assert not self._thread.is_alive()

    @property
    def states(self) -> list[StreamState]:
        return [state for state, _ in list(self.told)]

    def text(self, state: StreamState) -> str:
        """What was told first with a state."""
        return next(text for s, text in list(self.told) if s is state)

    def wait_for(self, count: int) -> None:
        self.wait_until(lambda: len(self.frames) >= count)

    def wait_until(self, condition: Callable[[], bool]) -> None:
        assert self.comes_true(condition, 60.0), (len(self.frames), self.told)

    def comes_true(self, condition: Callable[[], bool], within_s: float) -> bool:
        """Whether it holds after a frame or a state that comes by then."""
        with self._news:
            return self._news.wait_for(condition, within_s)

    def shows(self, number: int, within_s: float) -> bool:
        """Whether that picture comes out by then."""
        return self.comes_true(
            lambda: bool(self.frames) and read_counter(self.frames[-1][0].image) == number, within_s
        )

    def _run(self) -> None:
        try:
            for frame in self.source.frames():
                with self._news:
                    self.frames.append((frame, time.monotonic_ns()))
                    self._news.notify_all()
        except Exception as error:
            with self._news:
                self.error = error
                self._news.notify_all()

    def _on_state(self, state: StreamState, text: str) -> None:
        with self._news:
            self.told.append((state, text))
            self._news.notify_all()
