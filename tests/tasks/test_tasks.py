"""The ladder's tasks, and those of other benchmarks."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from endopilot.atlas.atlas import AtlasConfig, make_patient_tree
from endopilot.errors import InputError
from endopilot.ladder.scores import COAXIAL
from endopilot.settings import read_settings
from endopilot.tasks import task
from endopilot.tasks.targets import find_target, turn_rad
from endopilot.tasks.task import Task, find_task, list_tasks
from toy_tasks import own_tasks

FOLDER = Path(task.__file__).parent
FILES = sorted(FOLDER.glob("ladder_*/*.yaml"))
VERSIONS = (1, 2, "coaxial")


def test_there_are_twelve_tasks_one_a_level_each_with_its_environment():
    for version in (1, 2):
        assert [task.level for task in list_tasks(version)] == list(range(1, 13))
        own = [path for path in FILES if path.parent.name == f"ladder_{version}"]
        assert [path.stem for path in own] == sorted(task.name for task in list_tasks(version))
        assert {task.version for task in list_tasks(version)} == {version}
        for each in list_tasks(version):
            spec = gymnasium.spec(f"endopilot/{each.name.title()}-v{0 if version == 1 else 2}")
            assert spec.max_episode_steps == round(each.seconds * 7.5)


def test_tasks_of_version_2_and_of_wire_and_catheter_are_environments_in_their_training_patients():
    named = [(each.name, kind) for kind in (2, "coaxial") for each in list_tasks(kind)]
    for name, version in named:
        given = gymnasium.spec(f"endopilot/{name.title()}-v2").kwargs
        assert (given["task"], given["version"]) == (name, version)
    assert len(named) == 16
    (first, second), straight = task.training_navigations("straight", 1, 2, 2), find_task("straight", version=2)
    for place, navigation in ((1, first), (2, second)):
        assert navigation.anatomy.identity == straight.patient(straight.training, place).identity


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_task_has_twenty_patients_and_others_to_learn_on(path):
    task = read_settings(path, Task)
    assert task.training is not None
    assert len(set(task.ladder.numbers)) == len(set(task.training.numbers)) == 20
    assert task.ladder.seed != task.training.seed
    seeds = [other.ladder.seed for version in VERSIONS for other in list_tasks(version)]
    assert len(set(seeds)) == len(seeds) == len(FILES) and task.training.seed not in seeds


def test_coaxial_tasks_are_done_by_the_tip_of_a_catheter():
    tasks = list_tasks("coaxial")
    assert [each.level for each in tasks] == list(COAXIAL)
    for each in tasks:
        tree, _ = make_patient_tree(each.atlas(each.ladder.seed), each.ladder.numbers[0])
        target = each.target(tree)
        assert (each.start_catheter_mm or 0.0) < each.start_inserted_length_mm < target.abscissa
    navigation = find_task("follow", version="coaxial").ladder_navigation(0)
    assert navigation.arrives == "catheter" and [c.name for c in navigation.catheters] == ["microcatheter-1.7f"]
    steep = find_task("side-branch", version="coaxial")  # its branch leaves at 90° or more
    for place in (0, 7):
        tree, _ = make_patient_tree(steep.atlas(steep.ladder.seed), steep.ladder.numbers[place])
        assert turn_rad(tree, find_target(tree, steep.section or "", depth_mm=0.5).branch) >= np.pi / 2


@pytest.mark.parametrize("name", ["straight", "crux", "carotid"])
def test_the_target_lies_in_its_section(name):
    task = find_task(name)
    tree, _ = make_patient_tree(task.atlas(task.ladder.seed), task.ladder.numbers[0])
    target = task.target(tree)
    branch = tree.branches[target.branch]
    at = int(np.searchsorted(branch.centerline.abscissa, target.abscissa))
    assert tree.section_names[branch.section[at]] == task.section


def test_a_ladder_navigation_is_the_same_every_time():
    one, other, third = (find_task("straight").ladder_navigation(place) for place in (3, 3, 4))
    assert one.start_rotation_rad == other.start_rotation_rad != third.start_rotation_rad
    assert one.target == other.target
    assert np.array_equal(one.anatomy.distance_map.values, other.anatomy.distance_map.values)
    assert one.device.tip_bend_rad == pytest.approx(np.deg2rad(find_task("straight").tip_bend_deg))


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("level: 6", "level: 17", "level: 17; give a whole number from 1 to 16"),
        ("vessel: rca", "vessel: knee", "vessel: 'knee'; choose from"),
        ("device: workhorse-014", "device: rope", "device: 'rope'; choose from"),
        ("seed: 8006", "seed: 7006", "training: patient 4 is of ladder too, which nobody trains on; leave it out"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path, old, new, line):
    text = (FOLDER / "ladder_1" / "crux.yaml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "task.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError) as error:
        read_settings(path, Task)
    assert str(error.value).startswith(f"{path}: {line}") and "\n" not in str(error.value)


def test_a_target_outside_the_tree_is_refused():
    tree, _ = make_patient_tree(AtlasConfig(population="textbook"), 0)
    with pytest.raises(InputError, match="target: 'LAD'"):
        find_target(tree, "LAD", depth_mm=5.0)
    with pytest.raises(InputError, match="depth_mm: 500"):
        find_target(tree, "4", depth_mm=500.0)
    with pytest.raises(InputError, match="patient: 20"):
        find_task("crux").patient(find_task("crux").ladder, 20)


def test_a_folder_of_tasks_has_its_own_anatomies_targets_and_wire(tmp_path):
    task = own_tasks(tmp_path)
    assert task.targets_mm is not None
    navigation = task.ladder_navigation(1)
    place = navigation.target.position(navigation.anatomy)
    assert np.linalg.norm(place - task.targets_mm[1]) < 0.5 and place[2] == pytest.approx(30, abs=0.5)
    assert navigation.device.name == "workhorse-014" and navigation.target.near_mm == 5.0
    assert len({task.ladder_navigation(number).start_rotation_rad for number in (0, 1)}) == 2
    with pytest.raises(InputError, match="no patients to learn on; add training"):
        task.patient(task.training, 0)
    with pytest.raises(InputError, match="choose from 1, 2, coaxial, or give a folder of tasks"):
        list_tasks(str(tmp_path / "none"))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"targets_mm": [[0, 0, 20]]}, "targets_mm: 1 values; give one for each of ladder.numbers, 2"),
        ({"anatomies": ["a"]}, "anatomies: 1 values; give one for each of ladder.numbers, 2"),
        ({"anatomies": None}, "vessel: None; choose from"),
        ({"section": "G0"}, "section: 'G0'; give either the target's section or targets_mm"),
        ({"device": "no-such-wire"}, "no-such-wire"),
        ({"ladder": {"seed": 1 << 62, "numbers": [7, 3]}}, "seed: from 4611686018427387904 on seeds are of test"),
    ],
)
def test_what_is_wrong_in_a_task_of_ones_own_is_named(tmp_path, change, line):
    with pytest.raises(InputError, match=re.escape(line)):
        own_tasks(tmp_path, **change).ladder_navigation(0)


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
        ([".", "x"], "holds no curves"),
        (["other.npz", "x"], "other.npz: holds no array SSS_target_mm"),
        (["episodes.npz"], "usage: steve_tasks.py EPISODES.npz|CURVES FOLDER [SEED]"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(given, said, tmp_path, monkeypatch, capsys):
    from steve_tasks import made_up, main  # pyright: ignore[reportMissingImports]

    monkeypatch.chdir(tmp_path)
    made_up(Path("episodes.npz"))
    np.savez("other.npz", allow_pickle=False, lines=np.zeros(3))
    monkeypatch.setattr(sys, "argv", ["steve_tasks.py", *given])
    with pytest.raises(SystemExit) as leaving:
        main()
    line = capsys.readouterr().err
    assert leaving.value.code == 2 and line.startswith("steve_tasks.py: ") and said in line and line.count("\n") == 1
    assert not Path("x").exists()


@pytest.mark.skipif(not EPISODES.exists(), reason="the benchmark's episodes are not at hand")
def test_targets_of_the_benchmark_lie_on_centerlines(tmp_path):
    from steve_tasks import convert  # pyright: ignore[reportMissingImports]

    with np.load(EPISODES) as episodes:
        seeds = sorted({name[:3] for name in episodes.files})[::16]
        some = {name: episodes[name] for name in episodes.files if name[:3] in seeds}
    np.savez(tmp_path / "some.npz", allow_pickle=False, **some)
    assert convert(tmp_path / "some.npz", tmp_path / "steve") == seeds and len(seeds) == 4
    (task,) = list_tasks(str(tmp_path / "steve"))
    for place, point in enumerate(task.targets_mm or ()):
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
