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
    was built, and stop only for one that was started. A component looks up the components that it
    needs in `BuildContext`, by their class.
    """

    name: str
    kind: type[T]
    """What `make` gives, and what other parts name in their `depends`."""
    make: Callable[[BuildContext], T]
    depends: tuple[type, ...] = ()
    """Parts above this one in the table that `make` uses."""
    later: tuple[type, ...] = ()
    """Other parts that it asks only once all are made, see `BuildContext.later`."""
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


class BuildContext:
    """What a component is built from: settings, channels, clock, and its dependencies."""

    def __init__(self, part: Component[Any], assembly: Assembly) -> None:
        self._part = part
        self._assembly = assembly
        self.config = assembly.config
        self.channels, self.clock = assembly.channels, assembly.clock

    def __getitem__(self, kind: type[T]) -> T:
        """The component of that class; LookupError if `depends` does not name it."""
        self._require_named(kind, self._part.depends)
        return self._assembly[kind]

    def get(self, kind: type[T]) -> T | None:
        """As `[]`, but None in a deployment without that component."""
        self._require_named(kind, self._part.depends)
        return self._assembly.get(kind)

    def later(self, kind: type[T]) -> Callable[[], T]:
        """A function that returns a component which is built later; call it once all are built.
        LookupError if the row's `later` does not name it.
        """
        self._require_named(kind, self._part.later)
        return lambda: self._assembly[kind]

    def on_failed_start(self, undo: Callable[[], None]) -> None:
        """Call `undo` if this start fails: perhaps repeatedly, and from a signal handler."""
        self._assembly.abandonments.append(undo)

    def _require_named(self, kind: type, named: tuple[type, ...]) -> None:
        if kind not in named:
            raise LookupError(
                f"part {self._part.name!r} uses {kind.__name__}, which its line in the table of "
                "parts does not name"
            )


class Assembly:
    """The components of one process, by class. clock: CLOCK_MONOTONIC, ns, or a record's time."""

    def __init__(
        self,
        config: CompanionConfig,
        parts: Sequence[Component[Any]],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        _check_order(parts)
        self.config, self.clock = config, clock
        self.channels = Channels()
        self.abandonments: list[Callable[[], None]] = []
        self._parts = tuple(part for part in parts if part.wanted(config))
        self._made: dict[type, Any] = {}

    def __getitem__(self, kind: type[T]) -> T:
        """The component of that class; KeyError if it is not built."""
        found: T = self._made[kind]
        return found

    def get(self, kind: type[T]) -> T | None:
        """The component of that class; None if it is not built."""
        found: T | None = self._made.get(kind)
        return found

    def make(self, up: ExitStack, *, ahead: bool = False) -> None:
        """Build every component that is not built yet; `up` closes them in reverse.

        ahead: only the components that a standby builds before it may fly.
        """
        for part in self._parts:
            if part.kind in self._made or (ahead and not part.ahead):
                continue
            made = part.make(BuildContext(part, self))
            self._made[part.kind] = made
            if part.close is not None:
                up.callback(part.close, made)

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


def _check_order(parts: Sequence[Component[Any]]) -> None:
    known: set[type] = set()
    every = {part.kind for part in parts}
    for part in parts:
        missing = (set(part.depends) - known) | (set(part.later) - every)
        if missing or part.kind in known:
            names = ", ".join(sorted(kind.__name__ for kind in missing)) or part.kind.__name__
            raise LookupError(
                f"table of parts: {part.name!r} depends on {names}, in the wrong place or twice"
            )
        known.add(part.kind)
