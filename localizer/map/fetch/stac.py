"""STAC: the files of a catalogue, static or with a search, that meet an area."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any
from urllib.parse import urlencode, urljoin

from localizer.errors import MapFetchError
from localizer.map.fetch.area import Area
from localizer.map.fetch.catalogue import CatalogueSource, require_allowed
from localizer.map.fetch.cloud import CloudFile
from localizer.map.fetch.http_client import HttpClient, safe_url

_MOST_ITEMS, _MOST_PAGES = 2000, 50
_PAGE = 100  # items that are asked for at once; a service may give fewer
_TIFFS = ("image/tiff", "image/vnd.stac.geotiff")


def stac_files(source: CatalogueSource, area: Area, client: HttpClient) -> list[CloudFile]:
    """The asset of each item that meets the area; of items of one place the newest comes first.
    `MapFetchError` if pystac is missing, the answer cannot be read, or it has no GeoTIFF or too
    many items.
    """
    try:
        import pystac
    except ImportError as error:
        raise MapFetchError("STAC needs pystac: pip install -e '.[fetch]' in a checkout") from error

    items = []
    try:
        walk = _searched if _is_api(source) else _walked
        for item in walk(source, area, client):
            items.append(item)
            if len(items) > _MOST_ITEMS:
                raise MapFetchError(f"{source.name}: over {_MOST_ITEMS} items: a smaller area")
    except (pystac.STACError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise MapFetchError(f"{safe_url(source.url)}: no STAC that can be read: {error}") from error
    items.sort(key=lambda item: str(item.datetime or item.properties.get("datetime") or ""),
               reverse=True)  # fmt: skip
    files = []
    for item in items:
        asset = _asset(source, item)
        if asset is not None:
            href = str(asset.get_absolute_href() or asset.href)
            require_allowed(href)
            files.append(CloudFile(href, _flat(item.bbox)))
    if items and not files:
        known = ", ".join(sorted(items[0].assets))
        raise MapFetchError(f"{source.name}: no GeoTIFF among its assets ({known}); set `asset`")
    return files


def _is_api(source: CatalogueSource) -> bool:
    return not source.url.lower().split("?")[0].endswith(".json")


def _asset(source: CatalogueSource, item: Any) -> Any:
    if source.asset:
        return next((a for k, a in item.assets.items() if fnmatchcase(k, source.asset)), None)
    for asset in item.assets.values():
        if str(asset.media_type or "").split(";")[0].strip() in _TIFFS:
            return asset
    return None


def _searched(source: CatalogueSource, area: Area, client: HttpClient) -> Iterator[Any]:
    """Item Search of the STAC API, page by page: by GET, or by POST where only that is offered."""
    import pystac

    page = _first_page(source, area, client)
    for _ in range(_MOST_PAGES):
        for feature in page.document["features"]:
            item = pystac.Item.from_dict(feature)
            if item.get_self_href() is None:
                item.set_self_href(page.url)  # what relative addresses are relative to
            if item.bbox is not None and area.meets(_flat(item.bbox)):
                yield item
        following = page.next(client)
        if following is None:
            return
        page = following
    raise MapFetchError(f"{source.name}: over {_MOST_PAGES} pages of items: a smaller area")


@dataclass(frozen=True)
class _Page:
    """An answer to a search. asked: the document that was posted; None: the request was a GET."""

    url: str
    document: dict[str, Any]
    asked: dict[str, Any] | None

    @classmethod
    def request(cls, url: str, asked: dict[str, Any] | None, client: HttpClient) -> _Page:
        """Request a page."""
        answer = client.get(url) if asked is None else client.post(url, asked)
        return cls(url, json.loads(answer.data), asked)

    def next(self, client: HttpClient) -> _Page | None:
        """The following page; None after the last. A link may demand a POST, with a body that
        replaces the posted one or is merged into it (STAC API 1.0, Item Search, paging).
        """
        for link in self.document.get("links", ()):
            if link.get("rel") == "next":
                asked = None
                if str(link.get("method", "GET")).upper() == "POST":
                    earlier = (self.asked or {}) if link.get("merge") else {}
                    asked = {**earlier, **(link.get("body") or {})}
                return _Page.request(urljoin(self.url, link["href"]), asked, client)
        return None


def _first_page(source: CatalogueSource, area: Area, client: HttpClient) -> _Page:
    box = [round(v, 7) for v in (area.west, area.south, area.east, area.north)]
    home = source.url.rstrip("/")
    landing = json.loads(client.get(home).data)
    offered = [li for li in landing.get("links", ()) if li.get("rel") == "search"]
    methods = {str(li.get("method", "GET")).upper(): li["href"] for li in offered}
    if set(methods) == {"POST"}:
        asked: dict[str, Any] = {"bbox": box, "limit": _PAGE}
        if source.layer:
            asked["collections"] = [source.layer]
        return _Page.request(urljoin(f"{home}/", methods["POST"]), asked, client)
    parameters = {"bbox": ",".join(f"{v:.7f}" for v in box), "limit": str(_PAGE)}
    if source.layer:
        parameters["collections"] = source.layer
    there = urljoin(f"{home}/", methods.get("GET", f"{home}/search"))
    return _Page.request(f"{there}?{urlencode(parameters)}", None, client)


def _walked(source: CatalogueSource, area: Area, client: HttpClient) -> Iterator[Any]:
    """Items of a static catalogue, without those on other hosts or in other collections."""
    import pystac
    from pystac.stac_io import DefaultStacIO

    class Io(DefaultStacIO):
        """Reads through the client, from the network only."""

        def read_text(self, source: Any, *_: Any, **__: Any) -> str:
            href = source if isinstance(source, str) else source.get_absolute_href()
            return client.get(str(href)).data.decode("utf-8")

    waiting = [pystac.read_file(source.url, stac_io=Io())]
    for _ in range(_MOST_ITEMS):
        if not waiting:
            return
        found = waiting.pop()
        if isinstance(found, pystac.Collection):
            if source.layer not in ("", found.id):
                continue
            boxes = found.extent.spatial.bboxes
            if boxes and not any(area.meets(_flat(box)) for box in boxes):
                continue
        if isinstance(found, pystac.Item):
            if found.bbox is not None and area.meets(_flat(found.bbox)):
                yield found
            continue
        if isinstance(found, pystac.Catalog):
            waiting += list(found.get_children())
            for item in found.get_items():
                if item.bbox is not None and area.meets(_flat(item.bbox)):
                    yield item


def _flat(box: Any) -> tuple[float, float, float, float]:
    """A bounding box without heights."""
    numbers = [float(v) for v in box]
    west, south, east, north = numbers if len(numbers) == 4 else (*numbers[:2], *numbers[3:5])
    return west, south, east, north
