"""Pictures of the cockpit for README and docs, from a headless browser, in the reference patient.

    python docs/figures/cockpit.py [agent] [catheter]

writes docs/images/cockpit.png, docs/images/cockpit.gif and docs/images/cockpit-contrast.png, in which the agent drives,
and docs/images/cockpit-catheter.png, in which a hand drives wire and catheter; both if neither is named.
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, ViewportSize, sync_playwright

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.cockpit import BROWSER_FLAGS, find_browser, serving, wait_for
from endopilot.anatomy.io import write_anatomy
from endopilot.tasks.task import reference_navigation

IMAGES = Path(__file__).parents[1] / "images"
SIZE, SMALL = ViewportSize(width=1280, height=760), (720, 428)
FRAMES, EVERY_S = 26, 0.6
CATHETER, WIRE_MM, CATHETER_MM = "microcatheter-2.4f", 62.0, 40.0


def main() -> None:
    """Make the pictures that are asked for."""
    makers = {"agent": agent, "catheter": catheter}
    for name in sys.argv[1:] or makers:
        makers[name]()


@contextmanager
def opened(catheter: str | None = None) -> Iterator[Page]:
    """Serve the cockpit in the reference patient, with a catheter if one is named, and give its page in a browser."""
    with tempfile.TemporaryDirectory() as name, sync_playwright() as driver:
        folder = Path(name)
        write_anatomy(reference_navigation().anatomy, output=folder / "patient")
        browser = driver.chromium.launch(executable_path=find_browser(), args=list(BROWSER_FLAGS))
        page = browser.new_page(viewport=SIZE)
        with serving(folder / "patient", folder / "recordings", catheter) as address:
            page.goto(address)
            wait_for(page, "window.cockpit?.shown?.xray.background === 'phantom' && cockpit.shown.xray.ready")
            yield page
        browser.close()


def catheter() -> None:
    """Push the wire, then the catheter, and look at both."""
    with opened(CATHETER) as page:
        page.evaluate("() => cockpit.connection.send('c_arm', { zoom: 1.75 })")
        wait_for(page, "cockpit.shown.xray.zoom === 1.75 && cockpit.shown.xray.ready")
        hold(page, "KeyC", "cockpit.shown.xray.contrast > 0.9")
        hold(page, "KeyX", "cockpit.shown.xray.has_roadmap")
        page.check("#roadmap")
        hold(page, "KeyW", f"cockpit.shown.inserted_length_mm > {WIRE_MM}")
        page.keyboard.press("KeyQ")
        hold(page, "KeyW", f"cockpit.shown.catheters[0].inserted_length_mm > {CATHETER_MM}")
        wait_for(page, "cockpit.shown.xray.contrast === 0")
        hold(page, "KeyX", "cockpit.shown.xray.age_s < 0.05 && cockpit.shown.xray.on")
        page.click("text=to the tip")
        nearer = "const c = cockpit.space; c.camera.position.lerp(c.controls.target, 0.55); c.controls.update();"
        page.evaluate(f"() => {{ {nearer} }}")
        time.sleep(1.5)
        page.screenshot(path=IMAGES / "cockpit-catheter.png")


def hold(page: Page, key: str, script: str) -> None:
    """Hold a key, fast, until an expression is true; press it again where a busy machine made the page fall silent."""
    page.keyboard.down("Shift")
    page.keyboard.down(key)
    while not page.evaluate(f"() => Boolean({script})"):
        if page.evaluate("() => cockpit.state.stopped") == "silence":
            page.keyboard.up(key)
            time.sleep(0.1)
            page.keyboard.down(key)
        time.sleep(0.02)
    page.keyboard.up(key)
    page.keyboard.up("Shift")


def agent() -> None:
    """Let the agent drive, take pictures, and write them."""
    with opened() as page:
        page.evaluate("() => cockpit.space.look(-20, -8)")
        page.select_option("#autopilot-target", "4")
        page.keyboard.down("KeyX")
        page.keyboard.press("KeyC")
        time.sleep(1.5)
        page.keyboard.up("KeyX")
        page.screenshot(path=IMAGES / "cockpit-contrast.png")
        page.check("#roadmap")
        page.click("#autopilot-start")
        shots, best = [], None
        for _ in range(FRAMES):
            shots.append(page.screenshot())
            tip = page.evaluate("() => cockpit.shown.tip_mm")
            best = shots[-1] if best is None or tip < 80 else best
            if page.evaluate("() => cockpit.shown.autopilot.status") == "reached":
                break
            time.sleep(EVERY_S)
        shots.append(page.screenshot())
    assert best is not None
    (IMAGES / "cockpit.png").write_bytes(best)
    small = [Image.open(io.BytesIO(shot)).convert("RGB").resize(SMALL, Image.Resampling.LANCZOS) for shot in shots]
    palette = small[-1].quantize(128, method=Image.Quantize.MAXCOVERAGE)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in small]
    frames[0].save(IMAGES / "cockpit.gif", save_all=True, append_images=frames[1:], duration=350, loop=0, optimize=True)


if __name__ == "__main__":
    main()
