"""A stage that notes what it is asked, a server in a process of its own, a browser, and films that are driven."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

from endopilot.cockpit.frames import encode


class Stage:
    """Notes what it is asked, and breaks at its 5000th cycle."""

    def __init__(self):
        self.heard, self.halted, self.cycles = [], [], 0

    def handle(self, message, now_s):
        self.heard.append(message)

    def halt(self, why):
        self.halted.append(why)

    def cycle(self, now_s):
        self.cycles += 1
        if self.cycles == 5000:
            raise RuntimeError("broken")
        return [("state", encode("state", {"cycle": self.cycles}))]

    def close(self):
        self.halted.append("closed")


class Server:
    """`endopilot cockpit` in a process of its own."""

    def __init__(self, *arguments):
        command = [sys.executable, "-m", "endopilot.cli", "cockpit", "--no-browser", *map(str, arguments)]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
        )
        lines = []
        while not lines or (lines[-1].startswith("page") and "--replay" not in arguments):
            line = self.process.stdout.readline()
            assert line, "the server ended before it listened"
            lines.append(line)
        text = "".join(lines)
        self.address = re.search(r"page +(\S+)", text)[1]
        recording = re.search(r"recording +(\S+)", text)
        self.recording = recording and recording[1]
        self.origin = self.address.partition("/?")[0]

    def kill(self):
        """Kill it as a crash does."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                self.kill()


@contextmanager
def serving(*arguments):
    server = Server(*arguments)
    try:
        yield server
    finally:
        server.stop()


def ready(unit):
    """Return an X-ray unit whose C-arm stands still."""
    end = time.monotonic() + 20
    while not unit.ready and time.monotonic() < end:
        time.sleep(0.01)
    return unit


def shown(film, *, start=True):
    """Return a film that was driven to its end."""
    if start:
        film.start()
    end = time.monotonic() + 60
    while not film.done and time.monotonic() < end:
        time.sleep(0.01)
    assert film.done and not film.failure, film.failure
    return film


def value(page, script):
    """Return the value of an expression in the page."""
    return page.evaluate(f"() => {script}")


def until(page, script, seconds=40.0):
    """Wait for an expression in the page to be true."""
    end = time.monotonic() + seconds
    while not value(page, f"Boolean({script})"):
        assert time.monotonic() < end, f"{script} is not so; the page says: {page.inner_text('#banner')!r}"
        time.sleep(0.05)


def says(page, element, text, seconds=10.0):
    """Wait for an element's text, which is written a few times a second, to contain a text."""
    end = time.monotonic() + seconds
    while text not in page.inner_text(element):
        assert time.monotonic() < end, f"{element} says {page.inner_text(element)!r}, not {text!r}"
        time.sleep(0.05)


def hold(page, key, script, *, watcher=None, seconds=60.0):
    """Hold a key until an expression is true; where a busy machine lets the page fall silent, press it again.

    Args:
        page: that drives.
        key: which stays pressed.
        script: the expression.
        watcher: the page that it is true in; the same one if not given.
        seconds: to wait at most.
    """
    end = time.monotonic() + seconds
    page.keyboard.down(key)
    while not value(watcher or page, f"Boolean({script})"):
        assert time.monotonic() < end, f"{script} is not so; the page says: {page.inner_text('#figures')!r}"
        if value(page, "cockpit.state.stopped === 'silence'"):
            page.keyboard.up(key)
            time.sleep(0.1)
            page.keyboard.down(key)
        time.sleep(0.05)


def opened(context, server):
    """Open the page and wait until it shows the wire's state and the C-arm stands still."""
    page = context.new_page()
    page.goto(server.address)
    until(page, "window.cockpit?.shown?.xray.ready")
    return page
