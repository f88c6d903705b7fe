"""The feed hands frames on, whatever becomes of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from companion.flight.feed import Feed


class Source:
    """Three frames; then its regular end, or an error."""

    def __init__(self, error: Exception | None = None) -> None:
        self._error = error

    def frames(self) -> Iterator[Any]:
        yield from range(3)
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        pass


def fed(source: Source, take: Any) -> Feed:
    feed = Feed(source, take)  # type: ignore[arg-type]
    feed.start()
    assert feed.ended.wait(20.0)
    feed.stop()
    return feed


def test_a_part_that_fails_on_a_frame_does_not_end_the_flight(caplog):
    """One picture that the console or a recorder could not take ended the process in the air."""
    taken: list[int] = []

    def take(frame: int) -> None:
        taken.append(frame)
        if frame < 2:
            raise ValueError(f"frame {frame}")

    feed = fed(Source(), take)
    assert taken == [0, 1, 2]
    assert feed.error is None
    assert feed.failures == 2
    assert len([r for r in caplog.records if "a part failed" in r.getMessage()]) == 1


def test_what_ends_the_source_is_kept() -> None:
    assert isinstance(fed(Source(OSError("gone")), lambda _: None).error, OSError)
