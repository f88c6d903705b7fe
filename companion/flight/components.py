"""Builds and starts the components of the table in order; stops and closes them in reverse."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from companion.config import CompanionConfig
from companion.flight.channels import Channels

T = TypeVar("T")


@dataclass(frozen=True)
class Component(Generic[T]):
    """One row of the table: how a component is built, started, stopped and closed.

    All components are built before the first is started. close is called only for a component that
    was built, and stop only for one that was started.
    """

    name: str
    kind: type[T]
    """What `make` gives, and by what other parts look it up."""
    make: Callable[[Assembly], T]
    """Gets the assembly, in which it looks up the parts above this one in the table."""
    start: Callable[[T], None] | None = None
    stop: Callable[[T], None] | None = None
    """Undoes `start`; waits for the part's threads."""
    close: Callable[[T], None] | None = None
    """Undoes `make`, where that opened something."""
    hand_over: Callable[[T], None] | None = None
    """Called before an end that is none in order: another process takes over what it remembers."""
    wanted: Callable[[CompanionConfig], bool] = lambda _: True
    """Whether this deployment has the part at all."""
    ahead: bool = False
    """Whether a standby makes it before it may fly; it needs only parts that are made so, too."""


class Assembly:
    """The components of one process, by class. clock: CLOCK_MONOTONIC, ns, or a record's time."""

    def __init__(
        self,
        config: CompanionConfig,
        parts: Sequence[Component[Any]],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.config, self.clock = config, clock
        self.channels = Channels()
        self.abandonments: list[Callable[[], None]] = []
        self._parts = tuple(part for part in parts if part.wanted(config))
        self._made: dict[type, Any] = {}
        self._awaited: set[type] = set()

    def __getitem__(self, kind: type[T]) -> T:
        """The component of that class; KeyError if it is not built."""
        found: T = self._made[kind]
        return found

    def get(self, kind: type[T]) -> T | None:
        """The component of that class; None in a deployment without it."""
        return self[kind] if any(part.kind is kind for part in self._parts) else None

    def later(self, kind: type[T]) -> Callable[[], T]:
        """A function that returns a component which is built later; call it once all are built."""
        self._awaited.add(kind)
        return lambda: self[kind]

    def on_failed_start(self, undo: Callable[[], None]) -> None:
        """Call `undo` if this start fails: perhaps repeatedly, and from a signal handler."""
        self.abandonments.append(undo)

    def make(self, up: ExitStack, *, ahead: bool = False) -> None:
        """Build every component that is not built yet; `up` closes them in reverse.

        ahead: only the components that a standby builds before it may fly. LookupError if one
        needs a component that is not built, or not built before it.
        """
        for part in self._parts:
            if part.kind in self._made or (ahead and not part.ahead):
                continue
            made = part.make(self)
            self._made[part.kind] = made
            if part.close is not None:
                up.callback(part.close, made)
        if not ahead and not self._awaited <= self._made.keys():
            raise LookupError(f"no component builds {self._awaited - self._made.keys()}")

    def hand_over(self) -> None:
        """Tell all built components that a restart follows the coming stop, which is not clean:
        they keep their state for it. Call before the stop.
        """
        for part in self._parts:
            if part.hand_over is not None and part.kind in self._made:
                part.hand_over(self._made[part.kind])

    def forget(self) -> None:
        """Forget the built components after they were closed; `make` builds them again."""
        self._made.clear()

    def start(self, up: ExitStack) -> None:
        """Start every component, after `make`; `up` stops them in reverse."""
        for part in self._parts:
            made = self._made[part.kind]
            if part.start is not None:
                part.start(made)
            if part.stop is not None:
                up.callback(part.stop, made)
