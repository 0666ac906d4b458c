"""What pages may send, and what they may not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from endopilot.cockpit.frames import decode, encode
from endopilot.cockpit.messages import LONGEST_MESSAGE, CArm, Drive, read_message


def test_messages_are_read():
    drive = read_message('{"type": "drive", "translation": 3, "rotation": -0.5}')
    assert drive == Drive(type="drive", translation=3.0, rotation=-0.5)
    c_arm = read_message('{"type": "c_arm", "angles_deg": [[30, 20], [-60, 0]]}')
    assert c_arm == CArm(type="c_arm", angles_deg=((30, 20), (-60, 0)))


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "JSON"),
        ("[]", "object"),
        ('{"type": "fly"}', "drive"),
        ('{"type": "drive", "translation": NaN, "rotation": 0}', "finite"),
        ('{"type": "drive", "translation": 1e9, "rotation": 0}', "translation"),
        ('{"type": "drive", "translation": 1}', "rotation"),
        ('{"type": "drive", "translation": "1", "rotation": 0}', "translation"),
        ('{"type": "drive", "translation": true, "rotation": 0}', "translation"),
        ('{"type": "pedal", "down": 1}', "down"),
        ('{"type": "ping", "number": 1.0}', "number"),
        ('{"type": "fly\\nhigh"}', "drive"),
        ('{"type": "drive", "a\\nb": ' + "[" * 900 + "]" * 900 + "}", "message|rotation|translation"),
        ("[" * 2000, "JSON"),
        ('{"type": "' + "x" * 2000 + '"}', "tag"),
        ('{"type": "drive", "translation": 1, "rotation": 0, "force": 9}', "force"),
        ('{"type": "c_arm", "frames_per_s": 1000}', "frames_per_s"),
        ('{"type": "c_arm", "zoom": 0}', "zoom"),
        (" " * (LONGEST_MESSAGE + 1), "longest"),
    ],
)
def test_other_messages_are_refused_in_one_line(text, word):
    with pytest.raises(ValueError, match=word) as caught:
        read_message(text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) <= 300


@given(st.lists(st.tuples(st.sampled_from(["<f4", "<u4", "u1"]), st.integers(0, 7)), max_size=4))
def test_a_frame_comes_back_as_it_was(shapes):
    arrays = {f"a{i}": np.arange(n * 3).reshape(n, 3).astype(kind) for i, (kind, n) in enumerate(shapes)}
    header, back = decode(encode("state", {"name": "ä"}, **arrays))
    assert header["type"] == "state" and header["name"] == "ä"
    assert list(back) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(back[name], array)
