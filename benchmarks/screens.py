"""Pictures of the console for the docs, one a size of screen.

    python -m benchmarks.screens URL [--out docs/img] [--wait 15]

Needs a console that shows a flight (`make demo` prints its address), Chromium and playwright
(the extra `dev`). --wait: seconds for the map's tiles.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from benchmarks.common.arguments import Parser, number
from benchmarks.common.named_errors import named_errors
from companion.errors import ReportError

_SIZES = {"console": (1280, 800), "console-phone": (390, 844)}
_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_PATIENCE_MS = 120_000


def take(url: str, out: Path, wait_s: float) -> None:
    """JPEGs of the page at `url`. ReportError where it or the browser cannot be had."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ModuleNotFoundError as error:
        raise ReportError("needs playwright: pip install '.[dev]'") from error

    out.mkdir(parents=True, exist_ok=True)
    try:
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=_GL)
            for name, (width, height) in _SIZES.items():
                page = browser.new_page(viewport={"width": width, "height": height})
                page.set_default_timeout(_PATIENCE_MS)
                page.goto(url)
                page.wait_for_timeout(1e3 * wait_s)
                picture = out / f"{name}.jpg"
                page.screenshot(path=picture, type="jpeg", quality=70, timeout=_PATIENCE_MS)
                page.close()
            browser.close()
    except Error as error:
        raise ReportError(f"{url}: no pictures of it: {error.message.splitlines()[0]}") from error


def main() -> None:
    """Take them."""
    parser = Parser(__doc__)
    parser.add_argument("url", help="of the console")
    parser.add_argument("--out", type=Path, default=Path("docs/img"), help="folder")
    parser.add_argument("--wait", type=number(0.0, 600.0), default=15.0, help="seconds")
    options = parser.parse_args()
    take(options.url, options.out, options.wait)


if __name__ == "__main__":
    with named_errors():
        main()
