"""Parses a server's XML without entities and external references."""

from __future__ import annotations

from xml.etree import ElementTree

from localizer.errors import MapFetchError

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
