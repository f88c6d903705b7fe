"""A report is one click away, and a log has its plain path."""

import io

from rich.console import Console

from companion.terminal.links import file_link


def test_a_terminal_gets_a_link_and_a_log_the_path(tmp_path):
    page = tmp_path / "a [b] c.html"
    terminal, log = io.StringIO(), io.StringIO()
    Console(file=terminal, force_terminal=True).print("open:", file_link(page), soft_wrap=True)
    Console(file=log, width=20).print("open:", file_link(page), soft_wrap=True)
    assert page.as_uri() in terminal.getvalue()
    assert log.getvalue() == f"open: {page}\n"
