"""HTTP client with a rate limit, few connections, waits on request, and size limits."""

from __future__ import annotations

import email.utils
import json
import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from urllib.parse import urljoin, urlsplit
from xml.etree import ElementTree

from localizer.errors import MapFetchError
from localizer.map.fetch.catalogue import require_allowed

try:
    import urllib3
except ImportError as missing:
    raise MapFetchError(
        "fetching a map needs urllib3: pip install -e '.[fetch]' in a checkout, with "
        "the pip of the program's environment"
    ) from missing

_AGENT = "pilot-companion (map fetch)"
_TRIES = 5
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 60.0
_MOST_REDIRECTS = 4
_AGAIN = (408, 425, 429, 500, 502, 503, 504)
_REDIRECTED = (301, 302, 303, 307, 308)
_KEEPS_METHOD = (307, 308)  # RFC 9110, 15.4: after the others a POST becomes a GET
_TIMEOUT = urllib3.Timeout(connect=15.0, read=60.0)
_MOST_ANSWER = 256 << 20
_BLOCK = 1 << 16


@dataclass(frozen=True)
class HttpAnswer:
    """An HTTP response. status: 200, 206, or one of the request's `missing`."""

    status: int
    kind: str
    data: bytes
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Request:
    """body: of a POST; None: a GET."""

    url: str
    headers: Mapping[str, str]
    body: bytes | None = None


class HttpClient:
    """Sends GET and POST requests from any thread, within limits. `MapFetchError` for a refused
    request or an exceeded limit. rate_per_s: requests a second to one host; most_bytes: sum of all
    answers; sleep, clock: in seconds; replaced in tests.
    """

    def __init__(
        self,
        rate_per_s: float = 4.0,
        most_bytes: int = 4 << 30,
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._rate_per_s, self._most_bytes = rate_per_s, most_bytes
        self._sleep, self._clock = sleep, clock
        self._pool = urllib3.PoolManager(num_pools=8, maxsize=8, headers={"User-Agent": _AGENT})
        self._lock = threading.Lock()
        self._due: dict[str, float] = {}
        self._bytes = 0
        self._requests = 0

    @property
    def bytes(self) -> int:
        """Number of bytes received so far."""
        return self._bytes

    @property
    def requests(self) -> int:
        """Number of requests sent so far, with repeated ones."""
        return self._requests

    def get(
        self,
        url: str,
        headers: Mapping[str, str] | None = None,
        missing: Collection[int] = (),
    ) -> HttpAnswer:
        """Send a GET; follows redirections and retries while the server is busy. missing: HTTP
        statuses that mean "no data" and are returned.
        """
        return self._followed(_Request(url, headers or {}), missing)

    def post(self, url: str, document: object) -> HttpAnswer:
        """Send a POST of a JSON document; see `get`."""
        body = json.dumps(document).encode()
        return self._followed(_Request(url, {"Content-Type": "application/json"}, body), ())

    def _followed(self, request: _Request, missing: Collection[int]) -> HttpAnswer:
        for _ in range(_MOST_REDIRECTS + 1):
            require_allowed(request.url)
            answer = self._patiently(request, missing)
            if answer.status not in _REDIRECTED:
                return answer
            there = urljoin(request.url, answer.headers.get("location", ""))
            body = request.body if answer.status in _KEEPS_METHOD else None
            request = replace(request, url=there, body=body)
        raise MapFetchError(
            f"{safe_url(request.url)}: redirected more than {_MOST_REDIRECTS} times"
        )

    def _patiently(self, request: _Request, missing: Collection[int]) -> HttpAnswer:
        url = request.url
        wait_s, why = _FIRST_WAIT_S, ""
        for attempt in range(_TRIES):
            if attempt:
                self._sleep(wait_s)
                wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
            self._wait_turn(urlsplit(url).netloc)
            try:
                answer = self._once(request)
            except urllib3.exceptions.HTTPError as error:
                why = str(error)
                continue
            if answer.status in (200, 206, *_REDIRECTED, *missing):
                return answer
            why = f"status {answer.status}"
            if answer.status not in _AGAIN:
                raise MapFetchError(f"{safe_url(url)}: {why}: {message_text(answer.data)}")
            wait_s = max(wait_s, _told_wait_s(answer.headers))
        raise MapFetchError(f"{safe_url(url)}: given up after {_TRIES} tries: {why}")

    def _wait_turn(self, host: str) -> None:
        with self._lock:
            now = self._clock()
            due = max(self._due.get(host, now), now)
            self._due[host] = due + 1.0 / self._rate_per_s
            self._requests += 1
        if due > now:
            self._sleep(due - now)

    def _once(self, request: _Request) -> HttpAnswer:
        url, headers = request.url, {"User-Agent": _AGENT, **request.headers}
        reply = self._pool.request(
            "GET" if request.body is None else "POST", url, headers=headers, body=request.body,
            timeout=_TIMEOUT, retries=False, redirect=False, preload_content=False,
        )  # fmt: skip
        try:
            data = bytearray()
            for block in reply.stream(_BLOCK):
                data += block
                self._count(len(block))
                if len(data) > _MOST_ANSWER:
                    raise MapFetchError(
                        f"{safe_url(url)}: an answer of over {_MOST_ANSWER >> 20} MiB"
                    )
        finally:
            reply.release_conn()
        kind = reply.headers.get("content-type", "").split(";")[0].strip().lower()
        known = {name.lower(): value for name, value in reply.headers.items()}
        return HttpAnswer(int(reply.status), kind, bytes(data), known)

    def _count(self, size: int) -> None:
        with self._lock:
            self._bytes += size
            if self._bytes > self._most_bytes:
                raise MapFetchError(
                    f"more than {self._most_bytes / 1e6:.0f} MB came: a smaller area, a "
                    "coarser --resolution, or a higher --most-mb"
                )


def safe_url(url: str) -> str:
    """A URL without its query, which may contain keys, for messages."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.hostname}{f':{parts.port}' if parts.port else ''}{parts.path}"


def _told_wait_s(headers: Mapping[str, str]) -> float:
    """Seconds of a Retry-After header (a number or a date), bounded."""
    told = headers.get("retry-after", "")
    try:
        seconds = float(told)
    except ValueError:
        try:
            seconds = email.utils.parsedate_to_datetime(told).timestamp() - time.time()
        except (TypeError, ValueError):
            return 0.0
    return min(seconds, _LONGEST_WAIT_S) if seconds > 0 else 0.0  # false for NaN, too


_MOST_BYTES = 32 << 20


def parse_xml(data: bytes) -> ElementTree.Element:
    """Parse XML; returns the root. `MapFetchError` for over 32 MiB and for entities of its own,
    which can expand without limit; ParseError for invalid XML.
    """
    if len(data) > _MOST_BYTES or b"<!ENTITY" in data:
        raise MapFetchError("a server's XML is too long, or brings entities of its own")
    return ElementTree.fromstring(data)


def message_text(data: bytes) -> str:
    """Text of a server's message, for an error; tags of XML are removed."""
    try:
        words = " ".join(t.strip() for t in parse_xml(data[:65536]).itertext() if t.strip())
    except (ElementTree.ParseError, MapFetchError):
        words = data[:300].decode("utf-8", "replace")
    return " ".join(words.split())[:300]
