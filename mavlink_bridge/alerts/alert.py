"""An alert as components pass it on: an identifier and values.

It becomes text only where it leaves the process.
"""

from __future__ import annotations

import enum
import string
from dataclasses import dataclass, field

from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import ChosenSet, Name, RcChannel, Word

PREFIX = "PiLoT: "
Value = float | int | Word | Name | AlertId
Kind = str | type[Word | AlertId] | tuple[type[Word], type[Word | RcChannel | ChosenSet]]
"""Of a value: its unit (empty: none), "name" for a `Name`, or the list that it is one of."""
AlertKey = tuple[AlertId, bool, tuple[str, ...]]
NOTHING = "nothing"
"""What the operator does about an alert that only informs."""
WHILE = "that is no longer true"
"""End of an alert that is active just while the condition that raises it is true."""


class Severity(enum.IntEnum):
    """Severity of the STATUSTEXT (MAV_SEVERITY)."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class OutputAction(enum.IntEnum):
    """What an active alert does to the fixes, mildest first."""

    NONE = 0
    HOLD = 1
    """Nothing is sent."""
    EXCLUDE_AND_RESET = 2
    """Nothing is sent; the next fix that is sent announces a jump (`reset_counter`)."""


class Inhibits(enum.Flag):
    """What does not start, or is not reported, while an alert is active."""

    NOTHING = 0
    INJECTION = enum.auto()
    """Injection and the switch to vision do not start; injection that runs goes on."""
    EKF_OK = enum.auto()
    """"The EKF follows" is not reported."""


@dataclass(frozen=True)
class AlertSpec:
    """One row of the catalogue.

    title: its name in tables and when it is cleared. text: template of the STATUSTEXT without the
    prefix, with the values by name. kinds: unit or type of each value, in the order of
    `Alert.values`. raised, cleared: conditions in words; cleared is empty for an event, which
    happens once and does not end. cleared_text: sent when it ends; None: "cleared: TITLE"; empty:
    nothing is sent, the next alert or status follows. raise_s, clear_s: how long the condition must
    last. repeat_s: period while it is active, 0 for once. lead: what the text begins with.
    """

    id: AlertId
    severity: Severity
    title: str
    text: str
    kinds: dict[str, Kind] = field(default_factory=dict)
    raised: str = ""
    cleared: str = ""
    meaning: str = ""
    operator: str = ""
    cleared_text: str | None = None
    action: OutputAction = OutputAction.NONE
    inhibits: Inhibits = Inhibits.NOTHING
    raise_s: float = 0.0
    clear_s: float = 0.0
    repeat_s: float = 0.0
    lead: str = ""

    @property
    def values(self) -> tuple[str, ...]:
        """Names of the values, in the order in which an `Alert` holds them."""
        return tuple(self.kinds)

    @property
    def reports_end(self) -> bool:
        """Whether a text is sent when the alert is cleared."""
        return bool(self.cleared) and self.cleared_text != ""

    @property
    def template(self) -> str:
        """The text, with the prefix of its action."""
        held = "output held: " if self.action is not OutputAction.NONE else self.lead
        return f"{PREFIX}{held}{self.text}"

    def __post_init__(self) -> None:
        used = {name for _, name, _, _ in string.Formatter().parse(self.text) if name}
        if not used <= set(self.kinds):
            raise ValueError(f"{self.id}: the text uses {used}, the values are {set(self.kinds)}")


def event(
    of: AlertId, severity: Severity, text: str, kinds: dict[str, Kind], *rows: str, lead: str = ""
) -> AlertSpec:
    """Catalogue row of an alert that happens once and has no end. rows: raised,
    meaning, operator.
    """
    raised, meaning, operator = rows
    return condition(of, severity, text, kinds, raised, "", meaning, operator, lead=lead)


def condition(
    of: AlertId, severity: Severity, text: str, kinds: dict[str, Kind], *rows: str, lead: str = ""
) -> AlertSpec:
    """Catalogue row of an alert that lasts until it is cleared. rows: raised, cleared, meaning,
    operator, and cleared_text if one is sent.
    """
    raised, cleared, meaning, operator, *end = rows
    return AlertSpec(
        of, severity, of.words, text, kinds, raised, cleared, meaning, operator, "".join(end),
        lead=lead,
    )  # fmt: skip


@dataclass(frozen=True)
class Alert:
    """An alert that was raised (active) or cleared. values: in the order of `AlertSpec.values`."""

    id: AlertId
    values: tuple[Value, ...] = ()
    active: bool = True

    @property
    def key(self) -> AlertKey:
        """Value that is equal for alerts that differ only in numbers."""
        return self.id, self.active, tuple(v for v in self.values if isinstance(v, str))
