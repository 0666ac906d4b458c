"""Episodes of a public benchmark become tasks of the ladder: `examples/steve_tasks.py`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from endopilot.tasks.targets import find_target
from endopilot.tasks.task import list_tasks

sys.path.append(str(Path(__file__).parents[2] / "examples"))
EPISODES = Path(__file__).parents[3] / "shared" / "data" / "steve_bench" / "archvariety_dev.npz"


def test_a_made_up_arch_becomes_a_task_with_the_benchmarks_wire(tmp_path):
    from steve_tasks import convert, made_up  # pyright: ignore[reportMissingImports]

    made_up(tmp_path / "episodes.npz")
    assert convert(tmp_path / "episodes.npz", tmp_path / "steve") == ["001"]
    (task,) = list_tasks(str(tmp_path / "steve"))
    navigation = task.ladder_navigation(0)
    wire, direction = navigation.device, navigation.anatomy.insertion.direction
    # 17 and 80 MPa on solid round sections of 0.7 and 0.89 mm; an arc of 72° with a radius of 12.1 mm.
    np.testing.assert_allclose(wire.bend_stiffness_n_mm2[::2], [0.2, 2.46], atol=0.01)
    np.testing.assert_allclose([np.degrees(wire.tip_bend_rad), wire.tip_bend_length_mm], [72, 15.2], atol=0.01)
    assert (wire.max_velocity_mm_s, wire.max_rotation_rad_s, wire.friction) == (35.0, 3.14, 0.1)
    assert navigation.target.near_mm == 5.0 and navigation.seconds == pytest.approx(1000 / 7.5)
    np.testing.assert_allclose(direction, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(navigation.target.position(navigation.anatomy), [32, 0, 74], atol=0.5)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["none.npz", "x"], "none.npz: is no file of episodes (.npz) and no folder of curves"),
        (["README.md", "x"], "README.md: is no file of episodes"),
        ([".", "x"], "holds no curves"),
        (["other.npz", "x"], "other.npz: holds no array SSS_target_mm"),
        (["episodes.npz"], "usage: steve_tasks.py EPISODES.npz|CURVES FOLDER [SEED]"),
        (["episodes.npz", "x", "seed"], "usage: "),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(given, said, tmp_path, monkeypatch, capsys):
    from steve_tasks import made_up, main  # pyright: ignore[reportMissingImports]

    monkeypatch.chdir(tmp_path)
    made_up(Path("episodes.npz"))
    np.savez("other.npz", allow_pickle=False, lines=np.zeros(3))
    Path("README.md").write_text("read me")
    monkeypatch.setattr(sys, "argv", ["steve_tasks.py", *given])
    with pytest.raises(SystemExit) as leaving:
        main()
    line = capsys.readouterr().err
    assert leaving.value.code == 2 and line.startswith("steve_tasks.py: ") and said in line and line.count("\n") == 1
    assert not Path("x").exists()


@pytest.mark.skipif(not EPISODES.exists(), reason="the benchmark's episodes are not at hand")
def test_every_target_of_the_benchmark_lies_on_a_centerline(tmp_path):
    from steve_tasks import convert  # pyright: ignore[reportMissingImports]

    assert len(convert(EPISODES, tmp_path / "steve")) == 49
    (task,) = list_tasks(str(tmp_path / "steve"))
    for place, point in list(enumerate(task.targets_mm or ()))[::6]:
        navigation = task.ladder_navigation(place)
        assert np.linalg.norm(navigation.target.position(navigation.anatomy) - point) < 1.0


@pytest.mark.skipif(not EPISODES.exists(), reason="the benchmark's curves are not at hand")
def test_targets_of_two_devices_lie_in_carotid_and_vertebral_arteries_alone(tmp_path):
    from steve_tasks import convert_curves  # pyright: ignore[reportMissingImports]

    targets = convert_curves(EPISODES.parent / "dualdevicenav", tmp_path / "dual", seed=3)
    (task,) = list_tasks(str(tmp_path / "dual"))
    navigation = task.ladder_navigation(0)
    (catheter,) = navigation.catheters
    # 1 MPa on solid sections of 0.36 mm, and of 0.6 and 0.7 mm: the benchmark's simulator knows no bore.
    np.testing.assert_allclose(navigation.device.bend_stiffness_n_mm2, 8.2e-4, atol=1e-5)
    np.testing.assert_allclose(catheter.bend_stiffness_n_mm2, [6.36e-3, 6.36e-3, 1.179e-2], atol=1e-5)
    assert catheter.inner_diameter_mm == 0.57 and np.rad2deg(catheter.turned(np.array([20.0]))[0]) == pytest.approx(72)
    # The aorta ends at 450 mm; no target lies in the tubes of the arteries behind the four.
    assert len(targets) == 20 and len({tuple(point) for point in targets}) == 20
    for point in targets:
        target = find_target(navigation.anatomy.tree, tuple(point))
        assert target.abscissa > 450
        assert np.linalg.norm(target.position(navigation.anatomy) - point) < 1.5
