"""Queue of the newest frames with a memory limit."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

_MOST_BYTES = 96 << 20
_LEAST = 3  # pictures: a pose comes that many later at most
Item = TypeVar("Item")


class RecentPictures(Generic[Item]):
    """A queue that drops its oldest items beyond `most`, or beyond most_bytes if more than three
    are left. Not thread-safe.

    size: gives the bytes of an item.
    """

    def __init__(
        self, most: int, size: Callable[[Item], int], most_bytes: int = _MOST_BYTES
    ) -> None:
        self._most, self._size, self._most_bytes = most, size, most_bytes
        self._kept: deque[Item] = deque()
        self.nbytes = 0

    def append(self, item: Item) -> None:
        """Add the newest item."""
        self._kept.append(item)
        self.nbytes += self._size(item)
        while len(self._kept) > self._most or (
            len(self._kept) > _LEAST and self.nbytes > self._most_bytes
        ):
            self.nbytes -= self._size(self._kept.popleft())

    def retain(self, wanted: Callable[[Item], bool]) -> None:
        """Keep only the items for which `wanted` is true."""
        self._kept = deque(item for item in self._kept if wanted(item))
        self.nbytes = sum(self._size(item) for item in self._kept)

    def __iter__(self) -> Iterator[Item]:
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)
