"""Options that hold several numbers, as LAT,LON,HEIGHT."""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.errors import ConfigError


def numbers(text: str, option: str, names: Sequence[str]) -> tuple[float, ...]:
    """Parse the text of an option, as 47.1,8.5,500; `names`: meanings of the numbers, one each.
    `ConfigError` for another count, or what is no finite number.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(names) or not all(map(math.isfinite, values)):
        raise ConfigError(f"{option} is {','.join(names)}, {len(names)} numbers, not {text!r}")
    return values
