"""Pictures of the console for the docs: ``python -m benchmarks.screens URL --out docs/img``.

Needs a console that shows a flight (`make demo` prints its address), Chromium and playwright.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

_SIZES = {"console": (1280, 800), "console-phone": (390, 844)}
_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def main(
    url: Annotated[str, typer.Argument(help="of the console")],
    out: Annotated[Path, typer.Option(help="folder of the pictures")] = Path("docs/img"),
    wait_s: Annotated[float, typer.Option(help="for the map's tiles")] = 15.0,
) -> None:
    """Take them, JPEG, one a size."""
    from playwright.sync_api import sync_playwright

    out.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=_GL)
        for name, (width, height) in _SIZES.items():
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(120_000)
            page.goto(url)
            page.wait_for_timeout(1e3 * wait_s)
            page.screenshot(path=out / f"{name}.jpg", type="jpeg", quality=70, timeout=120_000)
            page.close()
        browser.close()


if __name__ == "__main__":
    typer.run(main)
