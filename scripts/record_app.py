"""Record docs/pictures/explore.gif: the Explore tab of the web app, driven by headless Chromium.

python scripts/record_app.py        # needs the extras app and dev, and Chromium on the PATH
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "explore.gif"
WIDTH, HEIGHT = 1000, 1080  # of the window
PLACES = [(0.30, 0.62), (0.62, 0.30), (0.86, 0.70)]  # of clicks on the map, as fractions of its width and height
SECONDS = 1.6  # per frame
SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def frames(page: Page, address: str) -> list[Image.Image]:
    """The window before and after every click."""
    page.goto(address)
    page.click("text=Explore")
    page.click("#explore-show")
    page.wait_for_selector("#explore-place h3")
    page.wait_for_selector("#explore-surface canvas")
    page.evaluate("document.querySelector('#explore-shown').scrollIntoView()")
    time.sleep(4)
    shown = []
    for across, down in PLACES:
        before = page.inner_text("#explore-place h3")
        box = page.locator("#explore-map .nsewdrag").first.bounding_box()
        assert box is not None
        x, y = box["x"] + across * box["width"], box["y"] + down * box["height"]
        page.mouse.move(x, y)  # once, because Plotly ignores moves in quick succession
        page.wait_for_selector("#explore-map .hoverlayer .hovertext")
        shown.append(shot(page))
        page.mouse.click(x, y)
        page.wait_for_function(
            "(before) => document.querySelector('#explore-place h3').innerText !== before", arg=before
        )
        page.mouse.move(5, 5)
        time.sleep(3)
        shown.append(shot(page))
    return shown


def shot(page: Page) -> Image.Image:
    """The window, in the palette of a GIF."""
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    return image.quantize(255, dither=Image.Dither.NONE)


def main() -> None:
    """Serve the app, use it, and save the picture."""
    command = [sys.executable, "-m", "lp_framework", "app", "port=0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as app, sync_playwright() as playwright:
        assert app.stdout is not None
        address = next(line.split()[1] for line in app.stdout if line.startswith("app:"))
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE)
        page = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}).new_page()
        page.set_default_timeout(300_000)
        first, *others = frames(page, address)
        app.terminate()
    first.save(PICTURE, save_all=True, append_images=others, duration=int(1000 * SECONDS), loop=0, optimize=True)
    print(PICTURE, f"{PICTURE.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
