"""What logs teach, on made-up sessions in a straight vessel along x, whose left is y."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.errors import InputError
from endopilot.robot.learned import JUMP_MM, LoggedEpisode, figures, learn, left_out, read_learned

TIPS = 24


def session(name, random, *, map_mm=0.0, own_mm=0.0, noise_mm=0.1, jumps=False) -> list[LoggedEpisode]:
    """Return six episodes that go 20 mm forward; tips lie to the side by a sine of the place, and by the session."""
    found = []
    for _ in range(6):
        x = np.linspace(0.0, 20.0, TIPS) + random.uniform(0, 2)
        turned = np.cumsum(random.choice([0.0, 1.0], TIPS))
        side = map_mm * np.sin(x / 3) + own_mm + noise_mm * random.standard_normal(TIPS)
        if jumps:  # two turned steps in five
            leaps = (np.diff(turned, prepend=0.0) > 0) & (random.random(TIPS) < 0.4)
            side = side + 2 * JUMP_MM * (np.cumsum(leaps) % 2)
        at, zeros = np.column_stack([x, 0 * x, 0 * x]), np.zeros(TIPS)
        apart = np.column_stack([noise_mm * random.standard_normal(TIPS), side])
        axes = np.broadcast_to(np.eye(3)[:2], (2, TIPS, 2, 3))
        right = np.full(TIPS, random.random() < 0.7)
        both = (np.stack([at, at]), axes, np.stack([apart, apart]))
        core = np.linalg.norm(apart, axis=1)
        sure = np.full(TIPS, 0.9)
        found.append(
            LoggedEpisode(name, np.arange(TIPS) < TIPS // 2, *both, x - x[0], turned + zeros, sure, right, core)
        )
    return found


def sessions(seed=0, count=3, **kinds) -> list[LoggedEpisode]:
    random = np.random.default_rng(seed)
    own = kinds.pop("own_mm", 0.0)
    return [e for k in range(count) for e in session(f"s{k}", random, own_mm=own * (-1) ** k, **kinds)]


def test_the_map_that_sessions_share_is_known_in_one_that_was_never_seen() -> None:
    episodes = sessions(map_mm=0.6)
    found = figures(episodes, left_out(episodes, "v", sessions=2, before=False))
    assert found["gain"] is True and found["in_plane_of_learned_mm"] < 0.2 < 0.35 < found["in_plane_of_kinematics_mm"]
    assert 0.82 < found["bands_of_90_percent_hold_share"] < 0.96


def test_what_is_a_session_s_own_is_known_from_its_given_tips() -> None:
    episodes = sessions(own_mm=0.5)
    model, last = learn(episodes[:12], "v"), episodes[-1]
    assert model.predict(last).apart[:, 1].mean() == pytest.approx(0.5, abs=0.1)
    unseen = replace(last, apart=last.apart * 0.0)  # its given tips lie in the middle
    assert abs(model.predict(unseen).apart[:, 1].mean()) < 0.2


def test_where_there_is_nothing_to_learn_it_is_said() -> None:
    episodes = sessions()
    found = figures(episodes, left_out(episodes, "v", sessions=2))
    assert not found["gain"]
    assert found["in_plane_of_learned_mm"] == pytest.approx(found["in_plane_of_kinematics_mm"], rel=0.1)


def test_no_tip_that_is_not_given_is_read() -> None:
    episodes = sessions(map_mm=0.3)
    model, last = learn(episodes[:12], "v"), episodes[-1]
    later = ~last.given
    unseen = replace(last, apart=np.where(later[:, None], np.nan, last.apart), right=last.right & ~later)
    one, other = (model.predict(each, episodes[12:-1]) for each in (last, unseen))
    for name, value in vars(one).items():
        np.testing.assert_array_equal(getattr(other, name), value, err_msg=name)


def test_jumps_and_branches_come_as_often_as_is_said_and_jumps_where_the_wire_turns() -> None:
    episodes = sessions(seed=2, jumps=True)
    said = left_out(episodes, "v", sessions=2)
    found = figures(episodes, said)
    assert found["jumps_expected"] == pytest.approx(found["jumps"], rel=0.3) and found["jumps_skill"] > 0.0
    assert found["real_branch_ends_expected"] == pytest.approx(found["real_branch_ends"], abs=4)
    turns = np.diff(episodes[0].turned, prepend=0.0)[~episodes[0].given] > 0
    assert said[0].jump[turns].min() > 3 * said[0].jump[~turns].max()


def test_what_was_learned_is_written_and_read_and_a_damaged_file_named(tmp_path) -> None:
    episodes, path = sessions(count=2, map_mm=0.3), tmp_path / "learned.npz"
    model = learn(episodes, "v")
    model.write(path)
    back = read_learned(path)
    assert (back.sessions, back.vessel) == (("s0", "s1"), "v")
    np.testing.assert_array_equal(back.predict(episodes[3]).apart, model.predict(episodes[3]).apart)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match=r"learned\.npz.* make it again with `endopilot train --logs`"):
        read_learned(path)
    with pytest.raises(InputError, match=r"none\.npz: no such file"):
        read_learned(tmp_path / "none.npz")
