"""Pictures of the console for the docs, one a size of screen.

    python -m benchmarks.screens [URL] [--report report/report.html] [--out docs/img] [--wait 15]

URL: of a console that shows a flight or a record (`make demo` and `companion replay --console`
print it). --wait: seconds for the map's tiles; --report: a report, too, or alone. Needs Chromium
and playwright (the extra `dev`).
"""

from __future__ import annotations

import shutil
from pathlib import Path

from benchmarks.common.arguments import Parser, existing, number
from benchmarks.common.named_errors import named_errors
from companion.errors import ReportError

_SIZES = {"console": (1280, 800), "console-phone": (390, 844)}
# As a Chromium without a GPU does by itself: only WebGL, the map, is drawn by SwiftShader. Without
# the last two all of the page is, at fifteen times the processor time.
BROWSER_OPTIONS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing", "--disable-accelerated-2d-canvas",
)  # fmt: skip
_PATIENCE_MS = 120_000


def chromium() -> str | None:
    """The system's; None: playwright's own."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


def take(url: str | None, out: Path, wait_s: float, report: Path | None = None) -> None:
    """JPEGs of the page and of the report. ReportError where they or the browser cannot be had."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ModuleNotFoundError as error:
        raise ReportError("needs playwright: pip install '.[dev]'") from error

    out.mkdir(parents=True, exist_ok=True)
    try:
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=chromium(), args=list(BROWSER_OPTIONS))
            for name, (width, height) in _SIZES.items():
                if url is None:
                    break
                page = browser.new_page(viewport={"width": width, "height": height})
                page.set_default_timeout(_PATIENCE_MS)
                page.goto(url)
                page.wait_for_timeout(1e3 * wait_s)
                picture = out / f"{name}.jpg"
                page.screenshot(path=picture, type="jpeg", quality=70, timeout=_PATIENCE_MS)
                page.close()
            if report is not None:
                width, height = _SIZES["console"]
                page = browser.new_page(viewport={"width": width, "height": 2 * height})
                page.goto(report.resolve().as_uri())
                page.screenshot(path=out / "report.jpg", type="jpeg", quality=60)
            browser.close()
    except Error as error:
        raise ReportError(
            f"{url or report}: no pictures of it: {error.message.splitlines()[0]}"
        ) from error


def main() -> None:
    """Take them."""
    parser = Parser(__doc__)
    parser.add_argument("url", nargs="?", help="of the console")
    parser.add_argument("--out", type=Path, default=Path("docs/img"), help="folder")
    parser.add_argument("--wait", type=number(0.0, 600.0), default=15.0, help="seconds")
    parser.add_argument("--report", type=existing, help="report.html of a flight")
    options = parser.parse_args()
    if options.url is None and options.report is None:
        raise ReportError("give the address of a console, or --report")
    take(options.url, options.out, options.wait, options.report)


if __name__ == "__main__":
    with named_errors():
        main()
