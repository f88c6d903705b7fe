"""The page's server: Starlette behind `security.RequestGuard`, with the data of a
`ConsoleSource`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from companion.console import deployment
from companion.console.deployment import Examination
from companion.console.pictures import WIDTHS_PX, TileName, TopTiles, page_message
from companion.console.records import Records, archive
from companion.console.security import REPORT_POLICY, RequestGuard
from companion.console.source import ConsoleSource, sample_of
from companion.errors import CompanionError
from companion.live.config import ConsoleConfig
from localizer.errors import LocalizerError

_STALE = timedelta(seconds=30)


def geojson(targets: list[dict[str, Any]]) -> dict[str, Any]:
    """The targets of a state document as GeoJSON points; heights above the ellipsoid."""
    return {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "geometry": {
                    "type": "Point",
                    "coordinates": [t["longitude_deg"], t["latitude_deg"], t["height_m"]],
                },
                "properties": {
                    k: t[k] for k in ("name", "amsl_m", "sigma_m", "sigma_up_m", "elsewhere")
                },
            }
            for t in targets
        ],
    }


def cursor_on_target(targets: list[dict[str, Any]], now: datetime | None = None) -> str:
    """The targets of a state document as Cursor on Target: one event for each."""
    now = now or datetime.now(timezone.utc)
    root = ElementTree.Element("events")
    for t in targets:
        event = ElementTree.SubElement(
            root, "event", version="2.0", uid=f"pilot-{t['name']}", type="a-u-G", how="m-r",
            time=_time(now), start=_time(now), stale=_time(now + _STALE),
        )  # fmt: skip
        ElementTree.SubElement(
            event, "point", lat=f"{t['latitude_deg']:.8f}", lon=f"{t['longitude_deg']:.8f}",
            hae=f"{t['height_m']:.2f}", ce=f"{t['sigma_m']:.2f}", le=f"{t['sigma_up_m']:.2f}",
        )  # fmt: skip
        detail = ElementTree.SubElement(event, "detail")
        ElementTree.SubElement(detail, "contact", callsign=t["name"])
    return ElementTree.tostring(root, encoding="unicode")


def _time(when: datetime) -> str:
    return when.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"


_log = logging.getLogger(__name__)
_STATIC = Path(__file__).parent / "static"
_MOST_PAGES = 8
_SLOWEST_S = 10.0  # a page that does not take a message for so long is left
# Images that a page has not yet said it showed: sockets would hold seconds of them.
_UNDER_WAY = 2
Answer = Callable[[Request], Awaitable[Response]]


@dataclass(frozen=True)
class ConsoleSite:
    """What the server serves. deployment: the file, None in a replay; token: required from every
    client, None: loopback without one.
    """

    config: ConsoleConfig
    source: ConsoleSource
    map_path: Path
    records: Records
    deployment: Path | None = None
    token: str | None = None
    replay: bool = False


class RefusedError(CompanionError):
    """A valid request that is refused."""


class Pages:
    """The connected browser pages and the images that they share."""

    def __init__(self, source: ConsoleSource) -> None:
        self._source = source
        self._open: dict[int, dict[str, Any]] = {}
        self._made: dict[tuple[bool, int], tuple[int, bytes]] = {}
        self._making = asyncio.Lock()

    async def serve(self, socket: WebSocket) -> None:
        """Send the newest data to one page until it disconnects or takes none for 10 s; older data
        are skipped. A ninth page is refused.
        """
        await socket.accept()
        if len(self._open) >= _MOST_PAGES:
            await socket.close(1013, "too many pages are open")
            return
        wishes = {"frames": False, "map": False, "shown": 0, "width": WIDTHS_PX[-1]}
        self._open[id(socket)] = wishes
        listener = asyncio.create_task(self._listen(socket, wishes))
        try:
            await self._tell(socket, wishes, listener)
        except (WebSocketDisconnect, RuntimeError, asyncio.TimeoutError, OSError):
            pass
        finally:
            listener.cancel()
            del self._open[id(socket)]
            self._watch()
            with contextlib.suppress(WebSocketDisconnect, RuntimeError, OSError):
                await socket.close()  # it may have gone first

    async def _tell(
        self, socket: WebSocket, wishes: dict[str, Any], listener: asyncio.Task[None]
    ) -> None:
        newest, states, frames, connected = self._source.newest, -1, -1, None
        sent = 0
        while not listener.done():
            waiting = asyncio.create_task(self._source.changed())
            if newest.states != states or connected != self._source.is_connected:
                states, connected = newest.states, self._source.is_connected
                await _sent(socket.send_text(json.dumps(self._state_message(connected))))
            fresh = newest.frame is not None and newest.frames != frames
            if wishes["frames"] and fresh and sent - wishes["shown"] < _UNDER_WAY:
                frames, sent = newest.frames, sent + 1
                picture = await self._picture(bool(wishes["map"]), wishes["width"])
                await _sent(socket.send_bytes(picture))
            await asyncio.wait({waiting, listener}, return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()

    def _state_message(self, connected: bool) -> dict[str, Any]:
        newest = self._source.newest
        state = newest.state
        return {
            "kind": "state",
            "connected": connected,
            "about": newest.hello,
            "state": state,
            "sample": None if state is None else sample_of(state),
        }

    async def _picture(self, with_map: bool, width_px: int) -> bytes:
        """Message of the newest frame; made once for all pages with the same wishes."""
        newest, key = self._source.newest, (with_map, width_px)
        async with self._making:
            made = self._made.get(key)
            if made is None or made[0] != newest.frames:
                assert newest.frame is not None
                number = newest.frames
                data = await run_in_threadpool(page_message, newest.frame, with_map, width_px)
                made = self._made[key] = (number, data)
            return made[1]

    async def _listen(self, socket: WebSocket, wishes: dict[str, Any]) -> None:
        """Receive what the page wants, and how many frames it showed; anything else ends it."""
        while True:
            message = await socket.receive()
            if message["type"] != "websocket.receive":
                return
            try:
                value = json.loads(message.get("text") or "")
                for name in ("frames", "map"):
                    wishes[name] = value.get(name) is True
                shown = value.get("shown", 0)
                wishes["shown"] = max(wishes["shown"], int(shown))
                wishes["width"] = _width_px(value.get("width"))
            except (ValueError, TypeError, OverflowError, AttributeError, RecursionError):
                return
            self._watch()

    def _watch(self) -> None:
        self._source.watch(any(w["frames"] for w in self._open.values()))


def _width_px(wished: Any) -> int:
    """The smallest offered width that fills enough of a screen; the largest without a wish."""
    if not isinstance(wished, int | float):
        return WIDTHS_PX[-1]
    return next((width for width in WIDTHS_PX if width >= wished), WIDTHS_PX[-1])


class Views:
    """HTTP handlers, one method for each address. Named errors become one line."""

    def __init__(self, site: ConsoleSite) -> None:
        self._site = site
        self._tiles: TopTiles | None = None
        self._examination = None if site.deployment is None else Examination(site.deployment)

    async def page(self, _: Request) -> Response:
        """The page itself."""
        return HTMLResponse((_STATIC / "index.html").read_text(encoding="utf-8"))

    async def about(self, _: Request) -> Response:
        """The reader's rights, and the map's position."""
        tiles = await run_in_threadpool(self._opened_tiles)
        return JSONResponse(
            {
                "control": self._site.config.control and not self._site.replay,
                "replay": self._site.replay,
                "deployment": self._site.deployment is not None,
                "map": tiles.map_position(),
            }
        )

    async def history(self, _: Request) -> Response:
        """The samples of the last ten minutes, and the events."""
        newest = self._site.source.newest
        return JSONResponse({"samples": list(newest.samples), "events": list(newest.events)})

    async def tile(self, request: Request) -> Response:
        """One map tile, seen from above."""
        name = TileName(*(request.path_params[k] for k in ("z", "x", "y")))
        tiles = await run_in_threadpool(self._opened_tiles)
        data = await run_in_threadpool(tiles.tile, name)
        if data is None:
            return Response(status_code=404)
        headers = {"cache-control": "private, max-age=3600"}
        return Response(data, media_type="image/jpeg", headers=headers)

    async def targets(self, request: Request) -> Response:
        """Targets as GeoJSON or Cursor on Target."""
        found = ((self._site.source.newest.state or {}).get("targets")) or []
        if request.path_params["kind"] == "geojson":
            text, kind = json.dumps(geojson(found)), "application/geo+json"
        else:
            text, kind = cursor_on_target(found), "application/xml"
        name = f"targets.{'geojson' if kind.endswith('json') else 'cot'}"
        return Response(text, media_type=kind, headers=_attachment(name))

    async def order(self, request: Request) -> Response:
        """Orders that are allowed in flight, with `console.control`: targets and position hints."""
        self._require_control()
        order = await _object(request)
        if order.get("do") not in ("target", "box", "stop", "hint"):
            raise RefusedError("no such order")
        ok, text = await self._site.source.order(order)
        _log.info("order %s: %s", order.get("do"), text)
        return JSONResponse({"ok": ok, "text": text}, status_code=200 if ok else 409)

    async def examine(self, request: Request) -> Response:
        """The doctor: POST starts it, with `console.control` and disarmed; both return its output
        so far.
        """
        if self._examination is None:
            raise RefusedError("there is no deployment to examine")
        if request.method == "POST":
            self._require_control()
            self._require_disarmed()
            if not self._examination.begin(self._site.source.is_connected):
                raise RefusedError("the doctor is at work already")
            _log.info("the doctor was called")
        return JSONResponse(self._examination.report())

    async def settings(self, request: Request) -> Response:
        """The deployment file: GET returns it; POST, with `console.control` and disarmed, checks
        its "text", and writes it if "write" is true.
        """
        path = self._site.deployment
        if path is None:
            raise RefusedError("there is no deployment to show")
        if request.method == "GET":
            shown = await run_in_threadpool(
                deployment.read_for_page, path, self._site.config.control
            )
            return JSONResponse(shown)
        self._require_control()
        self._require_disarmed()
        body = await _object(request)
        text = body.get("text")
        if not isinstance(text, str):
            raise RefusedError("text is the file's text")
        if body.get("write") is not True:
            await run_in_threadpool(deployment.check, path, text)
            return JSONResponse({"ok": True, "text": "it holds"})
        kept = await run_in_threadpool(deployment.replace, path, text)
        _log.info("%s was written, the old one is %s", path, kept)
        told = f"written, in force with the next start; the old one is {kept.name}"
        return JSONResponse({"ok": True, "text": told})

    async def records(self, _: Request) -> Response:
        """List of the records for download."""
        list_records = await run_in_threadpool(self._site.records.list_records)
        keys = ("name", "started_utc_ns", "ended")
        return JSONResponse([{k: asdict(r)[k] for k in keys} for r in list_records])

    async def record(self, request: Request) -> Response:
        """One record as .tar, or its report, which is made only while disarmed."""
        record = await run_in_threadpool(self._site.records.find, request.path_params["name"])
        if record is None:
            raise RefusedError("there is no record of that name")
        if request.path_params["kind"] == "tar":
            headers = _attachment(f"{record.name}.tar")
            return StreamingResponse(archive(record), media_type="application/x-tar",
                                     headers=headers)  # fmt: skip
        if self._site.source.newest.is_armed():
            raise RefusedError("reports are made on the ground: they need the processor")
        from companion.reporting.layout import render
        from companion.reporting.report import report_of

        text = await run_in_threadpool(lambda: render(report_of(record.path)))
        return HTMLResponse(text, headers={"content-security-policy": REPORT_POLICY})

    async def seek(self, request: Request) -> Response:
        """Move a replay to another time."""
        if not self._site.replay:
            raise RefusedError("a flight that runs has no time bar")
        ok, text = await self._site.source.order(await _object(request))
        return JSONResponse({"ok": ok, "text": text}, status_code=200 if ok else 409)

    def close(self) -> None:
        """End the map's loader."""
        if self._tiles is not None:
            self._tiles.close()

    def _opened_tiles(self) -> TopTiles:
        if self._tiles is None:
            self._tiles = TopTiles(self._site.map_path)
        return self._tiles

    def _require_control(self) -> None:
        if not self._site.config.control or self._site.replay:
            raise RefusedError("this page only reads: console.control is false")

    def _require_disarmed(self) -> None:
        armed = self._site.source.newest.is_armed() if self._site.source.is_connected else False
        if armed is None:
            raise RefusedError("nobody knows whether the vehicle is armed: it is not heard")
        if armed:
            raise RefusedError("not while the vehicle is armed")


def make_application(site: ConsoleSite) -> RequestGuard:
    """The complete web application of the console. While it is served, it runs the source."""
    views, pages = Views(site), Pages(site.source)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        task = asyncio.create_task(site.source.run())
        try:
            yield
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
            views.close()

    routes = [
        Route("/", views.page),
        Route("/api/about", _with_named_errors(views.about)),
        Route("/api/history", _with_named_errors(views.history)),
        Route("/api/targets.{kind:str}", _with_named_errors(views.targets)),
        Route("/api/order", _with_named_errors(views.order), methods=["POST"]),
        Route("/api/seek", _with_named_errors(views.seek), methods=["POST"]),
        Route("/api/doctor", _with_named_errors(views.examine), methods=["GET", "POST"]),
        Route("/api/deployment", _with_named_errors(views.settings), methods=["GET", "POST"]),
        Route("/api/records", _with_named_errors(views.records)),
        Route("/api/records/{name:str}/{kind:str}", _with_named_errors(views.record)),
        Route("/tiles/{z:int}/{x:int}/{y:int}.jpg", _with_named_errors(views.tile)),
        WebSocketRoute("/ws", pages.serve),
        Mount("/static", StaticFiles(directory=_STATIC)),
    ]
    return RequestGuard(Starlette(routes=routes, lifespan=lifespan), site.config, site.token)


def _with_named_errors(answer: Answer) -> Answer:
    """Answer a named error by its text; others are logged, and the page learns nothing."""

    async def answered(request: Request) -> Response:
        try:
            return await answer(request)
        except RefusedError as error:
            return JSONResponse({"ok": False, "text": str(error)}, status_code=409)
        except (CompanionError, LocalizerError) as error:
            return JSONResponse({"ok": False, "text": str(error)}, status_code=400)
        except Exception:
            _log.exception("%s failed", request.url.path)
            return JSONResponse({"ok": False, "text": "it failed, see the log"}, status_code=500)

    return answered


async def _object(request: Request) -> dict[str, Any]:
    if request.headers.get("content-type", "").split(";")[0] != "application/json":
        raise RefusedError("the body is JSON")
    try:
        value = json.loads(await request.body())
    except ClientDisconnect as error:  # `RequestGuard` ended it, too
        raise RefusedError("the body is too long") from error
    except (ValueError, RecursionError) as error:
        raise RefusedError(f"not JSON: {error}") from error
    if not isinstance(value, dict):
        raise RefusedError("the body is a JSON object")
    return value


async def _sent(sending: Awaitable[None]) -> None:
    await asyncio.wait_for(sending, _SLOWEST_S)


def _attachment(name: str) -> dict[str, str]:
    safe = "".join(c for c in name if c.isascii() and (c.isalnum() or c in "-_."))
    return {"content-disposition": f'attachment; filename="{safe}"'}
