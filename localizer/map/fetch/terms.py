"""Rejects services whose terms forbid storing their data or using them outside their program."""

from __future__ import annotations

from urllib.parse import urlsplit

from localizer.errors import MapFetchError

# Host (and all below it): whose it is, and what its terms say.
_FORBIDDEN = {
    "google.com": "Google's terms forbid to store, cut and derive from its map content",
    "googleapis.com": "Google's terms forbid to store, cut and derive from its map content",
    "gstatic.com": "Google's terms forbid to store, cut and derive from its map content",
    "googleusercontent.com": "Google's terms forbid to store its map content",
    "bing.com": "Microsoft's terms forbid to store Bing Maps' imagery",
    "virtualearth.net": "Microsoft's terms forbid to store Bing Maps' imagery",
    "apple.com": "Apple's terms forbid to store its map content",
    "apple-mapkit.com": "Apple's terms forbid to store its map content",
    "mapbox.com": "Mapbox's terms forbid to store its tiles outside its own programs",
    "arcgisonline.com": "Esri's basemaps may be kept by ArcGIS's own programs only",
    "here.com": "HERE's terms forbid to store its tiles",
    "hereapi.com": "HERE's terms forbid to store its tiles",
    "openstreetmap.org": "OpenStreetMap's tile servers do not serve bulk downloads",
    "yandex.net": "Yandex's terms forbid to store its tiles",
}
# Google publishes data of others under open licences in its cloud's storage.
_ALLOWED = ("storage.googleapis.com",)


def require_allowed(url: str) -> None:
    """`MapFetchError` for a forbidden service or an invalid URL."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise MapFetchError(f"{url}: no address of http or https")
    host = parts.hostname.lower().rstrip(".")
    if host in _ALLOWED:
        return
    labels = host.split(".")
    for i in range(len(labels)):
        why = _FORBIDDEN.get(".".join(labels[i:]))
        # Google's and Bing's names of every country: google.de, maps.google.co.uk.
        country = labels[i + 1 :]
        if labels[i] in ("google", "bing") and country and all(len(c) <= 3 for c in country):
            why = _FORBIDDEN[f"{labels[i]}.com"]
        if why is not None:
            raise MapFetchError(f"{host}: refused: {why}; name a source whose licence allows it")
