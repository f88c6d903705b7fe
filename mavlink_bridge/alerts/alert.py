"""An alert as components pass it on: an identifier and values. Its text exists only at the edge."""

from __future__ import annotations

import enum
import string
from dataclasses import dataclass, field

from mavlink_bridge.alerts.ids import AlertId

PREFIX = "PiLoT: "
Value = float | int | str
AlertKey = tuple[AlertId, bool, tuple[str, ...]]


class Severity(enum.IntEnum):
    """MAV_SEVERITY."""

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
    """What does not begin, or is not reported, while an alert is active."""

    NOTHING = 0
    INJECTION = enum.auto()
    """Injection and the switch to vision do not start; injection that runs goes on."""
    EKF_OK = enum.auto()
    """"The EKF follows" is not reported."""


@dataclass(frozen=True)
class AlertSpec:
    """One row of the catalogue.

    title: its name in tables and when it is cleared. text: template of the STATUSTEXT without the
    prefix, with the values by name. cleared_text: when it ends; None: "cleared: TITLE". units: of
    each value, in the order of `Alert.values`. raised, cleared: under which condition. raise_s,
    clear_s: how long the condition must last. repeat_s: period while it is active, 0 for once.
    lead: what the text begins with.
    """

    id: AlertId
    severity: Severity
    title: str
    text: str
    units: dict[str, str] = field(default_factory=dict)
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
        return tuple(self.units)

    @property
    def template(self) -> str:
        """The text with what the action adds."""
        held = "output held: " if self.action is not OutputAction.NONE else self.lead
        return f"{PREFIX}{held}{self.text}"

    def __post_init__(self) -> None:
        used = {name for _, name, _, _ in string.Formatter().parse(self.text) if name}
        if not used <= set(self.units):
            raise ValueError(f"{self.id}: the text uses {used}, the values are {set(self.units)}")


def event(
    of: AlertId, severity: Severity, text: str, units: dict[str, str], *told: str, lead: str = ""
) -> AlertSpec:
    """The row of what is told when it begins. told: raised, meaning, operator; and, where its end
    is told, cleared and its text.
    """
    raised, meaning, operator, *end = told
    cleared, cleared_text = end or ("", None)
    return AlertSpec(
        of, severity, of.words, text, units, raised, cleared, meaning, operator, cleared_text,
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
        """Equal for alerts that differ in numbers only."""
        return self.id, self.active, tuple(v for v in self.values if isinstance(v, str))
