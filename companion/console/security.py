"""Checks every request and WebSocket before anything else handles it.

Threats: another site open in the operator's browser (Origin, Host, a header that forms cannot set),
DNS rebinding (Host), another host on the network (token, TLS), floods (rate and size limits),
script in a record's text (CSP).
"""

from __future__ import annotations

import hmac
import ipaddress
import os
import stat
import time
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from companion.errors import ConfigError
from companion.live.config import ConsoleConfig

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

COOKIE = "companion-token"
ACTION_HEADER = b"x-console"  # a form or an image of another site cannot set it
MOST_BODY = 256 << 10
_LEAST_TOKEN = 16  # characters
_RATE, _BURST = 100.0, 400.0  # requests a second: a map that is dragged asks for many tiles
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; worker-src 'self' blob:; manifest-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
# A report is somebody's record laid out: it runs in an origin of its own, which may ask nothing.
REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'"
)
_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"x-frame-options", b"DENY"),
    (b"cache-control", b"no-store"),
)


def read_token(path: Path | None) -> str | None:
    """The token in a file that only its owner can read, else `ConfigError`. None without a path."""
    if path is None:
        return None
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # opening a pipe would wait for who writes into it
            raise ConfigError(f"console.token_file {path}: is no regular file")
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            raw = file.read(1025)
    except OSError as error:
        raise ConfigError(f"console.token_file {path}: cannot be read: {error}") from error
    if mode & 0o077:
        raise ConfigError(f"console.token_file {path}: chmod 600 it: others can read the token")
    token = raw.decode("ascii", "replace").strip()
    if not _LEAST_TOKEN <= len(token) <= 1024 or not token.isprintable() or " " in token:
        raise ConfigError(
            f"console.token_file {path}: needs one line of {_LEAST_TOKEN} characters or more, "
            "e.g. of `openssl rand -hex 24`"
        )
    return token


@dataclass
class _Bucket:
    rate: float
    burst: float
    level: float
    at: float

    def take(self, now: float) -> bool:
        self.level = min(self.burst, self.level + (now - self.at) * self.rate)
        self.at = now
        if self.level < 1.0:
            return False
        self.level -= 1.0
        return True


class RequestGuard:
    """An ASGI application that passes allowed requests to `app` and refuses the others."""

    def __init__(
        self,
        app: App,
        config: ConsoleConfig,
        token: str | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._app, self._config, self._token, self._clock = app, config, token, clock
        self._requests = _Bucket(_RATE, _BURST, _BURST, clock())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See the ASGI specification."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is not None:
            await _refuse(scope, receive, send, *refusal)
            return
        login = self._login(scope)
        if login is not None:
            await _redirect(send, login)
            return
        await self._app(scope, _bounded(receive), _with_headers(send))

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Status and reason of the refusal; None if the request is allowed."""
        headers: dict[bytes, list[bytes]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.lower(), []).append(value)
        length = _single_header(headers, b"content-length")
        if not self._requests.take(self._clock()):
            refusal = (429, "too many requests")
        elif not self._is_ours(_single_header(headers, b"host")):
            refusal = (421, "this console is not reached by that name (console.hosts)")
        elif self._is_foreign(scope, headers):
            refusal = (403, "a page of another site asked, or actions lack the header X-Console: 1")
        elif length is not None and not (length.isdigit() and int(length) <= MOST_BODY):
            refusal = (413, "too much")
        elif not self._knows_token(scope, headers):
            refusal = (401, "a token is needed: /?token=")
        else:
            return None
        return refusal

    def _is_foreign(self, scope: Scope, headers: dict[bytes, list[bytes]]) -> bool:
        """Whether the request may come from another site's page."""
        host, origin = _single_header(headers, b"host"), _single_header(headers, b"origin")
        same = f"{'https' if self._config.tls_certificate else 'http'}://{host}".lower()
        if b"origin" in headers and (origin is None or origin.lower() != same):
            return True
        if _single_header(headers, b"sec-fetch-site") not in (None, "same-origin", "none"):
            return True
        if scope["type"] == "websocket":
            return origin is None
        acts = scope["method"] not in ("GET", "HEAD")
        return acts and _single_header(headers, ACTION_HEADER) != "1"

    def _is_ours(self, host: str | None) -> bool:
        """Whether the Host header names this console: an IP address, localhost or a configured
        name. An attacker may have made another name point here.
        """
        if host is None:
            return False
        name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
        name = name.strip("[]").lower()
        if name in {h.lower() for h in self._config.hosts} or name == "localhost":
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or not self._config.is_loopback

    def _knows_token(self, scope: Scope, headers: dict[bytes, list[bytes]]) -> bool:
        if self._token is None:
            return True
        given = [
            _cookie(headers), _bearer(headers), *parse_qs(_query(scope)).get("token", ())[:1]
        ]  # fmt: skip
        shown = [g for g in given if g]
        return any(hmac.compare_digest(g.encode(), self._token.encode()) for g in shown)

    def _login(self, scope: Scope) -> str | None:
        """The cookie to set if the token came in the address, to remove the token there."""
        if self._token is None or scope["type"] != "http" or scope["path"] != "/":
            return None
        if not parse_qs(_query(scope)).get("token"):
            return None
        secure = "; Secure" if self._config.tls_certificate else ""
        return f"{COOKIE}={self._token}; HttpOnly; SameSite=Strict; Path=/{secure}"


def _single_header(headers: dict[bytes, list[bytes]], name: bytes) -> str | None:
    """The header's value; None if it is missing or there are several."""
    values = headers.get(name, [])
    return values[0].decode("latin-1") if len(values) == 1 else None


def _cookie(headers: dict[bytes, list[bytes]]) -> str:
    jar: SimpleCookie = SimpleCookie()
    try:
        jar.load(_single_header(headers, b"cookie") or "")
    except Exception:  # what is no cookie is none
        return ""
    return jar[COOKIE].value if COOKIE in jar else ""


def _bearer(headers: dict[bytes, list[bytes]]) -> str:
    scheme, _, token = (_single_header(headers, b"authorization") or "").partition(" ")
    return token if scheme.lower() == "bearer" else ""


def _query(scope: Scope) -> str:
    return bytes(scope.get("query_string", b"")[:2048]).decode("latin-1")


def _bounded(receive: Receive) -> Receive:
    """Stop a body that is longer than stated, or than allowed."""
    taken = 0

    async def bounded() -> MutableMapping[str, Any]:
        nonlocal taken
        message = await receive()
        if message["type"] == "http.request":
            taken += len(message.get("body", b""))
            if taken > MOST_BODY:
                return {"type": "http.disconnect"}
        return message

    return bounded


def _with_headers(send: Send) -> Send:
    async def sent(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            given = list(message.get("headers", ()))
            names = {name.lower() for name, _ in given}
            more = [*_HEADERS, (b"content-security-policy", _POLICY.encode())]
            message = {**message, "headers": given + [h for h in more if h[0] not in names]}
        await send(message)

    return sent


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()  # its connect
        await send({"type": "websocket.close", "code": 1008, "reason": why})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8"), *_HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": (why + "\n").encode()})


async def _redirect(send: Send, cookie: str) -> None:
    headers = [(b"location", b"/"), (b"set-cookie", cookie.encode("latin-1")), *_HEADERS]
    await send({"type": "http.response.start", "status": 303, "headers": headers})
    await send({"type": "http.response.body", "body": b""})
