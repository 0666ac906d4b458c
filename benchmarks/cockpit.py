"""The cockpit's speed, measured in a browser: `bench_cockpit`.

A server and a headless browser without a GPU run on this machine, side by side, as they would for a person.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import Bar, judged
from endopilot.anatomy.io import write_anatomy
from endopilot.devices.catheter import read_catheter
from endopilot.errors import InputError
from endopilot.tasks.task import reference_navigation

BARS = {
    "realtime_reserve": Bar(10.0, at_least=True),
    "latency_p95_ms": Bar(100.0),
    "frames_per_second": Bar(30.0, at_least=True),
    "frames_per_second_thinking": Bar(30.0, at_least=True),
    "ready_seconds": Bar(3.0),
}
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER_FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
"""A headless browser that draws in software and asks nobody anything."""
_SECONDS = 6.0
_DISTAL = "8"  # the end of the anterior descending artery
_PRESSES = 40
_MOST_S = 60.0
_WATCH = """() => {
    window.found = [];
    let pressed = null, before = 0;
    addEventListener("keydown", (event) => {
        if (event.repeat) return;
        pressed = event.timeStamp;
        before = cockpit.shown.inserted_length_mm;
    }, true);
    const look = () => {
        if (pressed !== null && Math.abs(cockpit.shown.inserted_length_mm - before) > 0.002) {
            found.push(performance.now() - pressed);
            pressed = null;
        }
        requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
}"""

_COUNT = """() => {
    window.counts = [];
    const look = () => {
        counts.push([performance.now(), cockpit.frames, cockpit.xray.images]);
        requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
}"""


def bench_cockpit(*, catheter: str | None = None) -> dict[str, Any]:
    """Measure the cockpit in a headless browser without a GPU: time in reserve, latency, frames per second, start.

    Args:
        catheter: around the wire (a name or a YAML file); both are then driven at once.

    Returns:
        `realtime_reserve`: simulated time over the time that simulating it takes, while the wire moves and both views
        change; `latency_p95_ms`: from a key's event to the end of the first frame that shows the wire moved, the
        simulated robot's latency of 50 ms included (and `latency_median_ms`); `frames_per_second`: the fewer of frames
        of the 3-D view and of new X-ray images of 512 × 512 pixels, and `frames_per_second_thinking` the same while the
        agent searches and drives; `ready_seconds`: from the command to the first frame; `bars` and `passed`.

    Raises:
        InputError: there is no browser, or playwright is not installed; no such catheter.
    """
    if catheter is not None:
        read_catheter(catheter)  # or the server's error would be all that is shown
    browser_path = find_browser()
    if browser_path is None:
        raise InputError("browser: none found; install Chromium or Chrome")
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError as error:
        raise InputError("needs playwright; install it with: pip install playwright") from error
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        patient = Path(folder) / "patient"
        write_anatomy(reference_navigation().anatomy, output=patient)
        browser = driver.chromium.launch(executable_path=browser_path, args=list(BROWSER_FLAGS))
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        began = time.perf_counter()
        with serving(patient, Path(folder) / "recordings", catheter) as address:
            page.goto(address)
            wait_for(page, "window.cockpit?.shown && cockpit.frames > 0")
            page.evaluate("() => cockpit.hands.hold(cockpit.hands.choices().length - 1)")  # all devices at once
            figures["ready_seconds"] = time.perf_counter() - began
            wait_for(page, "cockpit.shown.xray.background === 'phantom' && cockpit.shown.xray.ready")
            figures |= _views(page)
            page.evaluate("() => cockpit.hands.hold(0)")
            figures |= _latency(page)
            figures["frames_per_second_thinking"] = _thinking(page)
        browser.close()
    rounded = {name: round(float(value), 3) for name, value in figures.items()}
    return judged(rounded, BARS)


def find_browser() -> str | None:
    """Return the program of an installed browser, or None."""
    return next((found for found in map(shutil.which, _BROWSERS) if found), None)


def _views(page: Any) -> dict[str, float]:
    """Return the frames per second of both views while the wire moves under X-ray, and the simulation's reserve."""
    page.evaluate("() => cockpit.connection.send('c_arm', {frames_per_s: 30})")
    for key in ("KeyX", "KeyD", "KeyW"):
        page.keyboard.down(key)
    time.sleep(1.0)
    page.evaluate(_COUNT)
    reserve = []
    for _ in range(round(_SECONDS / 0.5)):
        time.sleep(0.5)
        reserve.append(page.evaluate("() => cockpit.shown.reserve"))
    space, images = _frames_per_second(page)
    for key in ("KeyX", "KeyD", "KeyW"):
        page.keyboard.up(key)
    return {
        "realtime_reserve": float(np.median(reserve)),
        "frames_per_second": min(space, images),
        "frames_per_second_space": space,
        "frames_per_second_xray": images,
    }


def _frames_per_second(page: Any) -> tuple[float, float]:
    """Return the frames per second of the 3-D view and of X-ray since they are counted.

    That is the slope of the counts: their difference from end to end would err by a frame at each end, 0.3 frames/s.
    """
    counts = np.array(page.evaluate("() => window.counts.splice(0)"))
    space, images = (round(1000 * np.polyfit(counts[:, 0], counts[:, view], 1)[0], 1) for view in (1, 2))
    return space, images


def _thinking(page: Any) -> float:
    """Return the fewer frames per second of both views while the agent drives to a distal section."""
    drives = "['drives', 'thinking'].includes(cockpit.shown.autopilot.status)"
    page.keyboard.down("KeyX")
    page.evaluate("section => cockpit.connection.send('target', {section})", _DISTAL)
    page.select_option("#autopilot-policy", "agent")
    page.click("#autopilot-start")
    wait_for(page, drives)
    page.evaluate("() => window.counts.splice(0)")
    end = time.perf_counter() + _SECONDS
    while time.perf_counter() < end and page.evaluate(f"() => {drives}"):
        time.sleep(0.1)
    frames = min(_frames_per_second(page))
    page.keyboard.up("KeyX")
    page.evaluate("() => cockpit.connection.send('autopilot', {action: 'stop'})")
    return frames


def _latency(page: Any) -> dict[str, float]:
    """Return how long it takes from a key's event to a frame in which the wire has moved, ms.

    The drive is pushed many times before it is pulled: where it reverses, its backlash takes 30 ms more.
    """
    page.evaluate(_WATCH)
    random = np.random.default_rng(0)
    for number in range(_PRESSES):
        key = "KeyW" if number < _PRESSES / 2 else "KeyS"
        page.keyboard.down(key)
        time.sleep(0.25)
        page.keyboard.up(key)
        time.sleep(float(random.uniform(0.3, 0.5)))
    found = np.array(page.evaluate("() => window.found"))
    return {"latency_median_ms": float(np.median(found)), "latency_p95_ms": float(np.percentile(found, 95))}


@contextmanager
def serving(patient: Path, output: Path, catheter: str | None = None) -> Iterator[str]:
    """Run `endopilot cockpit` in a process of its own and yield the page's address.

    Args:
        patient: folder of the anatomy.
        output: folder of the recordings.
        catheter: around the wire.
    """
    command = [sys.executable, "-m", "endopilot.cli", "cockpit", str(patient), "--no-browser", "--output", str(output)]
    command += [] if catheter is None else ["--catheter", catheter]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        found = re.search(r"page +(\S+)", process.stdout.readline())
        if found is None:
            raise RuntimeError("the cockpit's server did not start; its error stands above")
        yield found[1]
    finally:
        process.terminate()
        process.wait(timeout=20)


def wait_for(page: Any, script: str) -> None:
    """Wait for an expression in the page to be true.

    Raises:
        RuntimeError: it is not after a minute.
    """
    end = time.perf_counter() + _MOST_S
    while not page.evaluate(f"() => Boolean({script})"):
        if time.perf_counter() > end:
            raise RuntimeError(f"the page does not come so far: {script}")
        time.sleep(0.02)
