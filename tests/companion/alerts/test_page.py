"""The reference page of alerts is the catalogue's."""

from pathlib import Path

from companion.alerts.page import page

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "alerts.md"


def test_the_page_is_up_to_date() -> None:
    """Else: `python -m companion.alerts.page docs/reference/alerts.md`."""
    assert PAGE.read_text(encoding="utf-8") == page()
