"""Device files with odd numbers, or anything else in them: refused in one line, with the unit that would fit."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from make_devices import catheter, uniform, wire, write
from make_fuzz import bounded, read_or_refused, refusal

from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire

SOURCED = "{name}.value: {value}; give a number from"


def refused(tmp_path: Path, content: Any) -> str:
    """Return the line that refuses a device's or a catheter's file."""
    read = read_catheter if "inner_diameter_mm" in content else read_wire
    return refusal(tmp_path / "device.yaml", yaml.safe_dump(content, sort_keys=False, allow_unicode=True), read)


@pytest.mark.parametrize(
    ("name", "value", "meant"),
    [
        ("diameter_mm", 0.014, "0.014 inch is 0.3556 mm"),
        ("diameter_mm", 0.035, "0.035 inch is 0.889 mm"),
        ("diameter_mm", 0.00036, "0.00036 m is 0.36 mm"),
        ("diameter_mm", 360, "360 µm is 0.36 mm"),
        ("diameter_mm", 18, "18 French is 6 mm"),
        ("tip_load_n", 0.75, "0.75 gf is 0.007355 N"),
        ("tip_load_n", 7.4, "7.4 gf is 0.07257 N"),
        ("friction", 10, "10 % is 0.1"),
        ("max_velocity_mm_s", 0.04, "0.04 m/s is 40 mm/s"),
        ("max_velocity_mm_s", 2400, "2400 mm/min is 40 mm/s"),
        ("max_rotation_rad_s", 720, "720 °/s is 12.57 rad/s"),
        ("push_limit_n", 51, "51 gf is 0.5001 N"),
        ("pull_limit_n", 500, "500 gf is 4.903 N"),
        ("torque_limit_n_mm", 5e-4, "0.0005 N·m is 0.5 N·mm"),
        ("torque_limit_n_mm", 4000, "4000 mN·mm is 4 N·mm"),
    ],
)
def test_a_number_in_another_unit_is_answered_with_that_unit(tmp_path, name, value, meant) -> None:
    line = refused(tmp_path, wire(**{name: value}))
    assert line.startswith(SOURCED.format(name=name, value=value)) and f"({meant}" in line


@pytest.mark.parametrize("value", [50, 400, 900])
def test_a_torque_that_the_wire_cannot_bear_is_refused_with_its_unit(tmp_path, value) -> None:
    line = refused(tmp_path, wire(torque_limit_n_mm=value))
    assert line.startswith(f"torque_limit_n_mm: {value} N·mm shears off 0.3") and line.endswith(
        f"({value} mN·mm is {value / 1000:g} N·mm)"
    )


def bent(angle: float, length: float) -> dict[str, Any]:
    return wire(tip_bend={"angle_deg": angle, "length_mm": length, "source": "shaped by hand"})


def with_arcs(*arcs: list[float]) -> dict[str, Any]:
    return catheter(shape={"arcs": list(arcs), "source": "as delivered"})


SQUARE_METRES = [3e-7, 3e-7, 1.2e-6, 8e-6, 3e-5, 8e-5]
FROM_THE_SHAFT = {
    "bend_stiffness_n_mm2": [80, 30, 8, 1.2, 0.3, 0.3],
    "twist_stiffness_n_mm2": [62, 23, 6.2, 0.92, 0.23, 0.23],
}
TOO_UNLIKE = {"abscissa_mm": [0, 300], "bend_stiffness_n_mm2": [0.01, 5e3], "twist_stiffness_n_mm2": [7.5e-3, 3.8e3]}
MANY = {"abscissa_mm": list(range(2000)), "bend_stiffness_n_mm2": [1] * 2000, "twist_stiffness_n_mm2": [1] * 2000}
NOT_ROUND = "a round section has GJ = EI/(1 + ν)"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (wire(bend_stiffness_n_mm2=SQUARE_METRES), "bend_stiffness_n_mm2.value[0]: 3e-07; give"),
        (wire(bend_stiffness_n_mm2=SQUARE_METRES), "(3e-07 N·m² is 0.3 N·mm²)"),
        (uniform(6.0, 0.004), "0.004 N·m² is 4000 N·mm²"),  # in range, and yet too soft
        (wire(diameter_mm=0.18), "value[4]: 30 with diameter_mm = 0.18 takes a Young's modulus of 582 GPa"),
        (wire(diameter_mm=0.18), "the diameter, not the radius"),
        (wire(abscissa_mm=[0, 0.01, 0.02, 0.06, 0.15, 0.3]), "0.3 m is 300 mm"),
        (wire(abscissa_mm=[0, 10, 20, 60, 150, 30000]), "from 0 to 5000 mm"),
        (bent(0.785, 3), "0.785 rad is 44.98°"),
        (bent(3.1416, 9.42), "3.142 rad is 180°"),
        (bent(45, 0.003), "0.003 m is 3 mm"),
        (bent(45, 300), "from 0 to 200 mm"),
        (bent(360, 0.9), "less than the device's own"),
        (wire() | {"tip_shaping": {"angle_deg": [0, 1.57], "length_mm": [2, 10], "source": "by hand"}}, "89.95°"),
        (with_arcs([6, 0], [9, 1.57]), "1.57 rad is 89.95°"),
        (with_arcs([0.006, 0], [0.009, 90]), "0.006 m is 6 mm"),
        (with_arcs([6, 0], [0.9, 180]), "less than the device's own"),
        (catheter(inner_diameter_mm=1.67), "give less than the outer diameter, 1.67 mm"),
        (catheter(inner_diameter_mm=0.047), "0.047 inch is 1.194 mm"),
        (
            wire(tip_load_n=None, **FROM_THE_SHAFT),
            "bend_stiffness_n_mm2.value[2]: 8, and 80 nearer to the tip; list the tip first",
        ),
        (
            wire(diameter_mm=0.89, tip_load_n=None, **TOO_UNLIKE),
            "bend_stiffness_n_mm2.value[1]: 5000 is more than 100000 times the least, 0.01",
        ),
        *((uniform(0.89, 500.0, ratio), NOT_ROUND) for ratio in (0.3, 1.3, 0.77e-6, 2.6)),
        (wire(tip_load_n=0.3), "tip_load_n: 0.3; a tip of this EI buckles at 0.0074 N"),
        (wire(tip_load_n=0.3), "0.3 gf is 0.00294 N"),
        (
            wire(diameter_mm="0,36"),
            "'0,36'; give a number from 0.15 to 10 mm (0,36 with a decimal point is 0.36)",
        ),
        (wire(**MANY), "abscissa_mm: 2000 values; give at most 1000"),
    ],
)
def test_what_no_device_is_like_is_refused_with_what_may_be_meant(tmp_path, content, said) -> None:
    assert said in refused(tmp_path, content)


@pytest.mark.parametrize(
    "content",
    [
        wire(),
        wire(diameter_mm=0.2, bend_stiffness_n_mm2=[0.02, 0.02, 0.1, 1, 4, 12], tip_load_n=0.001,
             twist_stiffness_n_mm2=[0.015, 0.015, 0.077, 0.77, 3.1, 9.2]),  # a micro-wire of 0.008 inch
        wire(diameter_mm=0.3, bend_stiffness_n_mm2=[0.05, 0.05, 0.2, 2, 10, 60], tip_load_n=None,
             twist_stiffness_n_mm2=[0.038, 0.038, 0.15, 1.5, 7.7, 46]),  # of 0.012 inch
        uniform(0.36, np.pi / 64 * 0.36**4, 1 / 1.49),  # modulus 1 MPa, of a published simulation
        wire(diameter_mm=0.89, abscissa_mm=[0, 30], bend_stiffness_n_mm2=[0.2, 2.46], tip_load_n=None,
             twist_stiffness_n_mm2=[0.134, 1.65]),  # of another
        wire(diameter_mm=0.89, abscissa_mm=[0, 40, 200], bend_stiffness_n_mm2=[5, 60, 6100], tip_load_n=None,
             twist_stiffness_n_mm2=[3.8, 46, 4700]),  # an extra-stiff wire, all steel
        wire(diameter_mm=0.96),  # 0.038 inch
        wire(tip_load_n=None) | {"tip_bend": {"angle_deg": 180, "length_mm": 47, "source": "J of 15 mm radius"}},
        catheter(),
        catheter(diameter_mm=8.0, inner_diameter_mm=6.7, abscissa_mm=[0], bend_stiffness_n_mm2=[3e5],
                 twist_stiffness_n_mm2=[2e5], push_limit_n=20, torque_limit_n_mm=500),  # a sheath of 24 French
        catheter(diameter_mm=0.7, inner_diameter_mm=0.57, abscissa_mm=[0], bend_stiffness_n_mm2=[0.0066],
                 twist_stiffness_n_mm2=[0.0044]),  # modulus 1 MPa
        catheter(twist_stiffness_n_mm2=[80, 80, 280, 390, 390]),  # torque braid
    ],
)  # fmt: skip
def test_extreme_devices_are_read(tmp_path, content) -> None:
    path = write(tmp_path / "device.yaml", content)
    device = read_catheter(path) if "inner_diameter_mm" in content else read_wire(path)
    assert device.diameter_mm == content["diameter_mm"]["value"]
    assert list(device.bend_stiffness_n_mm2) == content["bend_stiffness_n_mm2"]["value"]


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
    found = read_or_refused(tmp_path / "device.yaml", yaml.safe_dump(bad, allow_unicode=True), read)
    if found is not None:
        device = getattr(found, "device", found)
        assert 0.15 <= device.diameter_mm <= 10 and all(map(math.isfinite, device.bend_stiffness_n_mm2))


@pytest.mark.parametrize(("content", "read"), [(wire(), read_wire), (catheter(), read_catheter)])
@BOUNDED
@given(data=st.data())
def test_numbers_by_many_orders_of_magnitude(tmp_path, content, read, data) -> None:
    numbers = [place for place in places(content) if isinstance(value_at(content, place), int | float)]
    place, power = data.draw(st.sampled_from(numbers)), data.draw(st.integers(-12, 12))
    bad = changed(content, place, value_at(content, place) * 10.0**power)
    found = read_or_refused(tmp_path / "device.yaml", yaml.safe_dump(bad), read)
    # Six orders of magnitude, N·m² or micrometres, are beyond every range but that of a smooth device's friction.
    slight = power < 0 and ("friction" in place[0] or place[0] == "abscissa_mm")
    assert found is None or abs(power) < 6 or slight or bad == content, (place, power)


def value_at(content: Any, place: tuple) -> Any:
    for part in place:
        content = content[part]
    return content
