"""The table that a flight ends with."""

from __future__ import annotations

import io

import numpy as np
from rich.console import Console
from rich.table import Table

from sitl.demo.analysis import Spread
from sitl.demo.report import add_spread


def test_an_error_that_was_never_measured_is_no_number() -> None:
    table = Table("error", "median", "p95", "max", "")
    add_spread(table, "car0, m", Spread.of(np.array([])), "0 fixes")
    add_spread(table, "point A, m", Spread(0.1, 0.2, 0.3), "9 fixes")
    text = io.StringIO()
    Console(file=text, width=80).print(table)
    assert "nan" not in text.getvalue()
    assert text.getvalue().count("none") == 3
    assert "0.10" in text.getvalue()
