"""Device files with anything in them: read, or refused in one line. Nothing else comes out, whatever goes in."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from make_devices import catheter, wire
from make_fuzz import bounded

from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.errors import InputError

BOUNDED = bounded(50)
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**30), 10**30)
    | st.floats()
    | st.sampled_from(["", "0,36", "1_000", "017", "1:30", "3e-1", "nan", "x" * 300, "µm", "2024-05-01", "\x07"])
)
JUNK = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(SCALARS, inner, max_size=3), max_leaves=6
)


def outcome(path: Path, text: str | bytes, read: Any) -> Any:
    """Return what a file with this text is read as, or the line that refuses it."""
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
    try:
        return read(path)
    except InputError as error:
        line = str(error)
        assert line.startswith(str(path)) and "\n" not in line and len(line) < 1500, line
        return line


def places(content: Any, place: tuple = ()) -> list[tuple]:
    """Return the place of every value in nested mappings and lists."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [place, *(deeper for key, value in inner for deeper in places(value, (*place, key)))]


def changed(content: Any, place: tuple, value: Any) -> Any:
    """Return content with another value at a place."""
    if not place:
        return value
    content = copy.deepcopy(content)
    holder = content
    for part in place[:-1]:
        holder = holder[part]
    holder[place[-1]] = value
    return content


@pytest.mark.parametrize(("content", "read"), [(wire(), read_wire), (catheter(), read_catheter)])
@BOUNDED
@given(data=st.data())
def test_anything_in_the_place_of_a_value(tmp_path, content, read, data) -> None:
    bad = changed(content, data.draw(st.sampled_from(places(content))), data.draw(JUNK))
    found = outcome(tmp_path / "device.yaml", yaml.safe_dump(bad, allow_unicode=True), read)
    if not isinstance(found, str):
        device = getattr(found, "device", found)
        assert 0.15 <= device.diameter_mm <= 10 and all(map(math.isfinite, device.bend_stiffness_n_mm2))


@pytest.mark.parametrize(("content", "read"), [(wire(), read_wire), (catheter(), read_catheter)])
@BOUNDED
@given(data=st.data())
def test_numbers_by_many_orders_of_magnitude(tmp_path, content, read, data) -> None:
    numbers = [place for place in places(content) if isinstance(value_at(content, place), int | float)]
    place, power = data.draw(st.sampled_from(numbers)), data.draw(st.integers(-12, 12))
    bad = changed(content, place, value_at(content, place) * 10.0**power)
    found = outcome(tmp_path / "device.yaml", yaml.safe_dump(bad), read)
    # Six orders of magnitude, N·m² or micrometres, are beyond every range but that of a smooth device's friction.
    slight = power < 0 and ("friction" in place[0] or place[0] == "abscissa_mm")
    assert isinstance(found, str) or abs(power) < 6 or slight or bad == content, (place, power)


def value_at(content: Any, place: tuple) -> Any:
    for part in place:
        content = content[part]
    return content


@BOUNDED
@given(text=st.binary(max_size=60) | st.text(alphabet="[]{}:,-&*a1.!? \n\t'\"#|>%@`~<é\ufeff\x00", max_size=60))
def test_any_bytes(tmp_path, text) -> None:
    assert isinstance(outcome(tmp_path / "device.yaml", text, read_wire), str)


@BOUNDED
@given(data=st.data())
def test_a_device_file_cut_or_garbled_anywhere(tmp_path, data) -> None:
    text = yaml.safe_dump(wire())
    start, end = sorted(data.draw(st.tuples(*[st.integers(0, len(text))] * 2)))
    outcome(tmp_path / "device.yaml", text[:start] + data.draw(st.text(max_size=5)) + text[end:], read_wire)
