"""A page that is slow gets fewer pictures, and never old ones."""

import asyncio
import json
import struct

import numpy as np
import pytest

pytest.importorskip("starlette")

from companion.console.server import Pages
from companion.console.source import Newest
from companion.live.protocol import Message
from localizer.geometry.camera import Camera

CAMERA = Camera.from_fov(16, 16, 60.0)


class Fed:
    """A flight whose pictures come when the test says so."""

    def __init__(self):
        self.newest, self.is_connected = Newest(), True
        self._event = asyncio.Event()

    def watch(self, wanted):
        pass

    async def changed(self):
        await self._event.wait()

    def feed(self, number):
        head = {"kind": "frame", "exposure_ns": number, "recorded": True, "image": [16, 16],
                "camera": CAMERA.to_dict()}  # fmt: skip
        self.newest.add(Message(head, np.zeros((16, 16, 3), np.uint8).tobytes()))
        event, self._event = self._event, asyncio.Event()
        event.set()


class Page:
    """The other end of a socket; pictures: the exposures of what it was sent."""

    def __init__(self):
        self.said: asyncio.Queue[dict[str, str]] = asyncio.Queue()
        self.pictures: list[int] = []

    async def accept(self):
        pass

    async def close(self, *_):
        pass

    async def send_text(self, _):
        pass

    async def send_bytes(self, data):
        (size,) = struct.unpack_from("<I", data)
        self.pictures.append(json.loads(data[4 : 4 + size])["exposure_ns"])

    async def receive(self):
        return await self.said.get()

    def say(self, **wishes):
        text = json.dumps({"frames": True, "map": False} | wishes)
        self.said.put_nowait({"type": "websocket.receive", "text": text})


async def _until(holds):
    while not holds():
        await asyncio.sleep(0)


def test_what_a_slow_page_did_not_show_is_not_followed_by_more_and_then_comes_the_newest():
    async def run():
        source, page = Fed(), Page()
        task = asyncio.create_task(Pages(source).serve(page))
        page.say()
        await _until(page.said.empty)
        for number in (1, 2):
            source.feed(number)
            await _until(lambda n=number: n in page.pictures)
        for number in range(3, 40):  # it shows none of them
            source.feed(number)
            await asyncio.sleep(0)
        assert page.pictures == [1, 2]
        page.say(shown=2)
        await _until(page.said.empty)
        source.feed(40)
        await _until(lambda: len(page.pictures) > 2)
        assert page.pictures == [1, 2, 40]
        page.said.put_nowait({"type": "websocket.disconnect"})
        await task

    asyncio.run(asyncio.wait_for(run(), 60))
