"""A session becomes an episode of a data set, which is read and trained on as others are."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="the extra `learn` is not installed")

from endopilot.cockpit.messages import Drive, Target
from endopilot.cockpit.recording import read_session, replayed
from endopilot.errors import InputError


def drive(session, seconds, translation, rotation):
    for number in range(round(seconds / 0.0125)):
        if number % 8 == 0:
            session.handle(Drive(type="drive", translation=translation, rotation=rotation), number * 0.0125)
        session.cycle(number * 0.0125)


def test_an_episode_holds_the_wire_as_it_was(session, tmp_path):
    from endopilot.cockpit.recording import write_session_episode
    from endopilot.dataset.loader import read_dataset

    session.handle(Target(type="target", branch=0, abscissa=14.0), 0.0)
    drive(session, 1.2, 12.0, 2.0)
    drive(session, 0.9, -4.0, 1.0)
    session.close()
    path = tmp_path / "a.cockpit.jsonl"
    write_session_episode(path, output=tmp_path / "episode")
    data = read_dataset(tmp_path / "episode")
    ends = [world.snapshot() for world, _ in replayed(read_session(path)) if world.cycle and world.cycle % 40 == 0]
    assert data.inserted_length.shape == (1, 4, 1) == (1, len(ends), 1)
    np.testing.assert_allclose(data.tip_position[0, :, 0], [end.nodes[0] for end in ends], atol=1e-4)
    np.testing.assert_allclose(data.inserted_length[0, :, 0], [end.inserted_length_mm for end in ends], atol=1e-4)
    moved = np.diff([5.0 - 3.0, *(end.inserted_length_mm for end in ends)]) / 0.5
    np.testing.assert_allclose(data.control[0, 1:, 0, 0], moved[1:], atol=1e-3)
    assert data.manifest["settings"]["target_mm"] == 14.0


def test_a_session_without_a_sample_is_refused(session, tmp_path):
    from endopilot.cockpit.recording import write_session_episode

    drive(session, 0.3, 5.0, 0.0)
    session.close()
    with pytest.raises(InputError, match="drive for longer"):
        write_session_episode(tmp_path / "a.cockpit.jsonl", output=tmp_path / "episode")
    assert not (tmp_path / "episode").exists()
