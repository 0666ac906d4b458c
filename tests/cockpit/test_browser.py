"""The page in a real browser."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from browser import hold, opened, says, serving, until, value

from benchmarks.cockpit import BROWSER_FLAGS, find_browser
from endopilot.cockpit.recording import read_session, replayed

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytest.importorskip("starlette", reason="the extra `cockpit` is not installed")
pytest.importorskip("websockets", reason="the extra `cockpit` is not installed")

pytestmark = pytest.mark.skipif(find_browser() is None, reason="no Chromium or Chrome is installed")
IMAGE = "Array.from(document.getElementById('plane0').getContext('2d').getImageData(0, 0, 100, 100).data).join()"
PAD = """() => {
    const buttons = Array.from({length: 16}, () => ({pressed: false}));
    window.pad = {connected: true, axes: [0, 0, 0, 0], buttons};
    navigator.getGamepads = () => [null, window.pad];
}"""
"""A gamepad that tests hold."""


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=find_browser(), args=list(BROWSER_FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def context(chromium):
    made = chromium.new_context(viewport={"width": 1280, "height": 800})
    yield made
    made.close()


@pytest.fixture(scope="module")
def server(vessel, tmp_path_factory):
    """Return a server; the tests drive its wire on, one after the other, and the last kills it."""
    with serving(vessel, "--output", tmp_path_factory.mktemp("sessions")) as made:
        yield made


def test_a_policy_drives_and_a_hand_takes_over(context, server):
    page = opened(context, server)
    page.select_option("#autopilot-policy", "forward")
    page.click("#autopilot-start")
    until(page, "cockpit.shown.autopilot.status === 'drives' && cockpit.shown.velocity[0] > 0")
    hold(page, "KeyS", "cockpit.shown.autopilot.status === 'off' && cockpit.shown.velocity[0] < 0")
    page.keyboard.up("KeyS")
    page.evaluate("() => cockpit.connection.send('target', {branch: 0, abscissa: 12})")
    page.click("#autopilot-start")
    end = time.monotonic() + 120.0
    while value(page, "cockpit.shown.autopilot.status !== 'reached'"):
        assert time.monotonic() < end, page.inner_text("#autopilot-text")
        if value(page, "cockpit.shown.autopilot.status === 'paused'"):  # a busy machine let the page fall silent
            page.click("#autopilot-pause")
        time.sleep(0.2)
    target, tip = value(page, "cockpit.shown.target.abscissa"), value(page, "cockpit.shown.tip_mm")
    assert abs(tip - target) < 3.0
    says(page, "#autopilot-text", "reached")


def test_keys_move_the_wire_and_the_pedal_counts(context, server):
    requests, errors = [], []
    context.on("request", lambda request: requests.append(request.url))
    page = opened(context, server)
    page.on("pageerror", lambda error: errors.append(str(error)))
    assert "Not a medical device" in page.inner_text("header")
    began = value(page, "cockpit.shown.inserted_length_mm")
    hold(page, "KeyW", f"cockpit.shown.inserted_length_mm > {began + 3}")
    page.keyboard.up("KeyW")
    until(page, "cockpit.shown.velocity[0] === 0")
    until(page, "cockpit.space.canvas.width === cockpit.space.canvas.clientWidth")  # a view at rest is sharp
    held = value(page, "cockpit.shown.inserted_length_mm")
    turned = value(page, "cockpit.shown.rotation_deg")
    hold(page, "ArrowLeft", f"cockpit.shown.rotation_deg < {turned - 20}")
    page.keyboard.up("ArrowLeft")
    counted = value(page, "cockpit.shown.xray.frames")
    hold(page, "KeyX", f"cockpit.shown.xray.frames >= {counted + 3}")
    says(page, "#caption0", "live")
    page.keyboard.up("KeyX")
    until(page, "!cockpit.shown.xray.on")
    frames, image = value(page, "cockpit.shown.xray.frames"), value(page, IMAGE)
    hold(page, "KeyS", f"cockpit.shown.inserted_length_mm < {held - 2}")
    page.keyboard.up("KeyS")
    assert value(page, "cockpit.shown.xray.frames") == frames
    assert value(page, IMAGE) == image  # the last image is held while X-ray is off
    says(page, "#caption0", "last image")
    assert requests and all(url.startswith((server.origin, "data:")) for url in requests)
    assert not errors


def test_a_gamepad_drives_turns_and_exposes(context, server):
    context.add_init_script(f"({PAD})()")
    page = opened(context, server)
    began, turned, frames = value(
        page, "[cockpit.shown.inserted_length_mm, cockpit.shown.rotation_deg, cockpit.shown.xray.frames]"
    )
    page.evaluate("() => { pad.axes[1] = -0.5; pad.axes[2] = 1; pad.buttons[7].pressed = true; }")
    until(page, f"cockpit.shown.inserted_length_mm > {began + 2}")
    until(page, f"Math.abs(cockpit.shown.rotation_deg - {turned}) > 10 && cockpit.shown.xray.frames >= {frames + 2}")
    half = value(page, "cockpit.shown.command[0]")
    page.evaluate("() => { pad.axes[1] = -1; pad.buttons[5].pressed = true; }")
    until(page, f"cockpit.shown.command[0] > {2 * half - 1e-6}")
    page.evaluate("() => { pad.axes[1] = 0.05; pad.axes[2] = 0; pad.buttons[7].pressed = false; }")  # a worn stick
    until(page, "cockpit.shown.velocity[0] === 0 && cockpit.shown.velocity[1] === 0 && !cockpit.shown.xray.on")


def test_a_killed_server_goes_on_and_a_replay_shows_what_was(context, server):
    page = opened(context, server)
    began, turned = value(page, "[cockpit.shown.inserted_length_mm, cockpit.shown.rotation_deg]")
    hold(page, "KeyW", f"cockpit.shown.inserted_length_mm > {began + 2}")
    page.keyboard.up("KeyW")
    hold(page, "KeyD", f"cockpit.shown.rotation_deg > {turned + 20}")
    page.keyboard.up("KeyD")
    until(page, "cockpit.shown.velocity.every((v) => v === 0)")
    time.sleep(0.5)
    cycle, nodes = value(page, "[cockpit.state.cycle, Array.from(cockpit.state.nodes)]")
    server.kill()
    until(page, "!document.getElementById('banner').hidden")
    with serving("--resume", server.recording) as again:
        resumed = opened(context, again)
        assert value(resumed, "cockpit.shown.inserted_length_mm") == pytest.approx(began + 3, abs=3.0)
        hold(resumed, "KeyS", f"cockpit.shown.inserted_length_mm < {began}")
        resumed.keyboard.up("KeyS")
    recording = read_session(Path(server.recording))
    then = next((world.snapshot().nodes for world, _ in replayed(recording) if world.cycle == cycle), None)
    np.testing.assert_array_equal(np.array(nodes, dtype="<f4"), then.astype("<f4").ravel())
    with serving("--replay", server.recording) as shown:
        film = opened(context, shown)
        until(film, f"cockpit.state.replay.ready_s * 80 > {cycle}")
        film.evaluate(f"() => cockpit.connection.send('replay', {{at_s: {cycle // 4 / 20}, playing: false}})")
        until(film, f"cockpit.state.time_s === {cycle // 4 / 20} && !cockpit.state.replay.playing")
        at = next(world.snapshot().nodes for world, _ in replayed(recording) if world.cycle == cycle // 4 * 4)
        seen = np.array(value(film, "Array.from(cockpit.state.nodes)"), dtype="<f4")
        np.testing.assert_array_equal(seen, at.astype("<f4").ravel())
        film.wait_for_selector("#slider", state="visible")


def test_a_task_is_driven_by_x_ray_alone(context, tmp_path):
    with serving("--task", "straight", "--output", tmp_path) as server:
        page = opened(context, server)
        page.wait_for_selector("#blind", state="visible")
        page.click("#game-start")
        until(page, "cockpit.shown.game.phase === 'on'")
        hold(page, "KeyX", "cockpit.shown.xray.frames >= 2")
        page.keyboard.up("KeyX")
        assert value(
            page, "[cockpit.state.nodes, cockpit.state.tip_mm, cockpit.state.force_n].every((v) => v === undefined)"
        )
        page.keyboard.down("Shift")
        hold(page, "KeyW", "cockpit.shown.game.phase === 'over'", seconds=100)
        until(page, "document.querySelector('#scores')?.innerText.includes('you')")
        page.wait_for_selector("#blind", state="hidden")
        assert value(page, "cockpit.state.nodes.length") > 10


def test_the_hand_takes_the_catheter_and_both(context, vessel, tmp_path):
    errors = []
    with serving(vessel, "--catheter", "microcatheter-1.7f", "--output", tmp_path) as server:
        page = opened(context, server)
        page.on("pageerror", lambda error: errors.append(str(error)))
        assert "in microcatheter-1.7f" in page.inner_text("#patient")
        says(page, "#holds .on", "wire")
        hold(page, "KeyW", "cockpit.shown.inserted_length_mm > 9")
        assert value(page, "cockpit.shown.catheters[0].inserted_length_mm") == 0
        page.keyboard.press("KeyQ")  # W stays pressed, and moves nothing more
        says(page, "#holds .on", "microcatheter-1.7f")
        until(page, "cockpit.shown.velocity.every((v) => v === 0)")
        page.keyboard.up("KeyW")
        wire = value(page, "cockpit.shown.inserted_length_mm")
        hold(page, "KeyW", "cockpit.shown.catheters[0].inserted_length_mm > 4")
        page.keyboard.up("KeyW")
        until(page, "cockpit.shown.velocity.every((v) => v === 0)")
        assert value(page, "cockpit.shown.inserted_length_mm") == pytest.approx(wire, abs=0.2)
        says(page, "#figures", "microcatheter-1.7f")
        says(page, "#figures", ", microcatheter-1.7f ")  # where its tip is
        page.click("#holds button:last-child")
        says(page, "#holds .on", "both")
        hold(page, "KeyS", "cockpit.shown.catheters[0].inserted_length_mm < 3")
        page.keyboard.up("KeyS")
        assert value(page, "cockpit.shown.inserted_length_mm") < wire - 0.5
        drawn = "cockpit.space.catheters[0].mesh.geometry.drawRange.count"
        assert 0 < value(page, drawn) < value(page, "cockpit.space.wire.mesh.geometry.drawRange.count")
        page.click("#holds button >> nth=0")
        says(page, "#holds .on", "wire")
        page.evaluate(PAD)
        page.evaluate("() => { pad.buttons[3].pressed = true; }")
        says(page, "#holds .on", "microcatheter-1.7f")
        page.evaluate("() => { pad.buttons[3].pressed = false; pad.axes[1] = -0.5; }")
        until(page, "cockpit.shown.velocity[2] > 0 && cockpit.shown.velocity[0] === 0")
    assert not errors


def finger(page, kind, *points):
    """Put fingers onto the page's glass, move them, or lift them all."""
    touches = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
    page.touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})


def test_a_phone_shows_all_panels_and_a_finger_drives(chromium, vessel, tmp_path):
    phone = chromium.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    with serving(vessel, "--output", tmp_path) as server:
        page = opened(phone, server)
        page.touch = phone.new_cdp_session(page)
        assert value(page, "document.documentElement.scrollWidth") == 390
        boxes = {
            name: page.locator(name).bounding_box() for name in ("#space", "#xray", "#autopilot", "#pad", "#pedal")
        }
        assert all(box["x"] >= 0 and box["x"] + box["width"] <= 390 for box in boxes.values())
        assert boxes["#space"]["y"] + boxes["#space"]["height"] <= boxes["#xray"]["y"]
        small = value(
            page,
            """[...document.querySelectorAll('button, select, input[type=number], summary, label, #pad')]
            .filter((one) => one.offsetParent !== null || one.id === 'pad')
            .map((one) => [one.textContent, one.getBoundingClientRect()])
            .filter(([, box]) => box.width < 44 || box.height < 44).map(([text]) => text)""",
        )
        assert small == []
        pad, pedal = boxes["#pad"], boxes["#pedal"]
        x, y = pad["x"] + pad["width"] / 2, pad["y"] + pad["height"] / 2
        began = value(page, "cockpit.shown.inserted_length_mm")
        finger(page, "touchStart", (x, y))
        finger(page, "touchMove", (x, y - 50))
        until(page, f"cockpit.shown.inserted_length_mm > {began + 2}")
        finger(page, "touchMove", (x + 50, y))
        until(page, "cockpit.shown.rotation_deg > 20")
        press = (pedal["x"] + 20, pedal["y"] + 20)
        finger(page, "touchStart", (x + 50, y), press)  # a second finger exposes meanwhile
        until(page, "cockpit.shown.xray.frames >= 2 && cockpit.shown.xray.on")
        finger(page, "touchEnd")
        until(page, "cockpit.shown.velocity.every((v) => v === 0) && !cockpit.shown.xray.on")
    phone.close()
