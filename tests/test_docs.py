"""The documentation: its site builds strictly, its links lead somewhere, its lines can be read."""

import importlib.util
import re
import subprocess
import sys

import pytest

from benchmarks.site.__main__ import outdated
from benchmarks.site.kept import DATA, load
from tests.pages import PAGES, ROOT

_LINK = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")


def _prose(text):
    """Number and text of each line outside of code blocks and tables."""
    code = False
    for number, line in enumerate(text.splitlines(), start=1):
        code ^= line.lstrip().startswith("```")
        if not code and not line.startswith(("|", "<!-- kept")):
            yield number, line


def test_links_lead_somewhere():
    broken = [
        f"{page.relative_to(ROOT)}: {link}"
        for page, text in PAGES.items()
        for link, _ in _LINK.findall(text)
        if "://" not in link and not (page.parent / link).exists()
    ]
    assert not broken


def test_prose_fits_a_screen():
    long = [
        f"{page.relative_to(ROOT)}:{number}: {len(line)} characters"
        for page, text in PAGES.items()
        for number, line in _prose(text)
        if len(line) > 120
    ]
    assert not long


def test_every_leaf_of_the_hazard_analysis_has_its_test_and_each_test_exists():
    page = (ROOT / "docs/safety.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in page.splitlines() if line.startswith("| ")]
    leaves = [r for r in rows if len(r) == 8 and not r[1].strip().startswith(("**", "hazard"))]
    known = {p.stem for p in (ROOT / "tests").rglob("test_*.py")}
    known |= {p.stem for p in (ROOT / "sitl/scenarios").rglob("*.yaml")}
    known |= {"benchmarks." + p.name for p in (ROOT / "benchmarks").iterdir()}
    held = {r[1].strip(): set(re.findall(r"`([^`]+)`", r[6])) for r in leaves}
    assert len(held) > 30
    assert [leaf for leaf, names in held.items() if not names] == []
    assert set().union(*held.values()) - known == set()


def test_generated_pages_are_of_today():
    assert not outdated(ROOT), "python -m benchmarks.site"


@pytest.mark.skipif(
    importlib.util.find_spec("material") is None, reason="no mkdocs-material (extra docs)"
)
def test_the_site_builds_strictly_and_asks_no_network(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    asked = {
        f"{page.relative_to(tmp_path)}: {address}"
        for page in tmp_path.rglob("*.html")
        for address in re.findall(
            r"<(?:script|img|iframe)[^>]* src=\"?(https?:[^\"\s>]+)"
            r"|<link[^>]* rel=\"?(?:stylesheet|preconnect|icon)\"?[^>]* href=\"?(https?:[^\"\s>]+)",
            page.read_text(encoding="utf-8"),
        )
    }
    assert not asked
    for name, words in (("reference/cli", "companion try"), ("reference/api", "open_localizer")):
        assert words in (tmp_path / f"{name}.html").read_text(encoding="utf-8")
    assert (tmp_path / "source/configs/deployment.yaml.html").is_file()


def test_every_tutorial_says_what_comes_next() -> None:
    # A page that an edit cut off in its middle has good links, short lines, and no end.
    for page in sorted((ROOT / "docs" / "tutorials").glob("*.md")):
        last = page.read_text(encoding="utf-8").rstrip().splitlines()[-1]
        assert last.startswith("Next: ["), page


_FIGURE = re.compile(r"(?<![\w.])(\d+(?:\.\d+)? (?:m|%|ms)|\d+\.\d+)(?!\w)")


def test_the_readmes_figures_are_of_kept_results() -> None:
    cells = [
        cell
        for name in ("demo-seed0", "by-condition")
        for table in (load(ROOT / DATA / f"{name}.json"),)
        for part in (table.table, table.criteria)
        if part is not None
        for row in part.rows
        for cell in row
    ]
    known = set(re.findall(r"\d+(?:\.\d+)?", " ".join(cells)))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    without = re.sub(
        r"Python 3\.\d+|127\.0\.0\.1|within 1 m and 1°|100 % returned|20 % GNSS|1.4 km", "", text
    )
    strangers = {f for f in _FIGURE.findall(without) if f.split(" ")[0] not in known}
    assert not strangers, "kept by no command: docs/results/data"


def test_tables_of_results_say_their_origin() -> None:
    # Made from a command's JSON, or with the command beside it: in the table, before or behind it.
    without = []
    for page in sorted((ROOT / "docs" / "results").glob("*.md")):
        text = re.sub(
            r"<!-- (?:kept|criteria) .*?<!-- end -->", "", page.read_text("utf-8"), flags=re.S
        )
        parts = text.split("\n\n")
        for k, part in enumerate(parts):
            beside = "\n".join(parts[max(k - 1, 0) : k + 2])
            is_table = part.lstrip().startswith("|")
            if is_table and not re.search(
                r"`(?:python -m|make|pytest|companion|configs/|benchmarks\.)|\]\(", beside
            ):
                without.append(f"{page.name}: {part.lstrip().splitlines()[0]}")
    assert not without
