"""Recorded navigations become a data set with X-ray images, which holds what was seen and decided."""

from __future__ import annotations

import io
import itertools
import json
import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.dataset
import pytest
from PIL import Image

from endopilot.ladder.attempt import Recording, begun
from endopilot.ladder.demonstrations import PIXELS, write_demonstrations
from endopilot.ladder.ladder import LadderConfig, climb
from endopilot.tasks.task import find_task
from read_by_lerobot import read_by_lerobot
from toy_tasks import own_tasks

_POLICY = """
from endopilot.navigation.policy import Decision

class Looks:
    def start(self, navigation, seed): pass
    def decide(self, observation):
        return Decision(((5.0, 0.3),), expose=observation.time_s % 1.5 == 0.5)
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return the folder of a data set of two navigations with an exposure every 1.5 s, and the submission's content."""
    folder = tmp_path_factory.mktemp("demonstrations")
    own_tasks(folder, seconds=8.0, targets_mm=[[0, 0.5, 20], [0, 0, 55]])  # the second is not reached
    (folder / "looks.py").write_text(_POLICY)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        climb(output=folder / "run", config=LadderConfig(policy="looks:Looks", version=str(folder)))
    found = write_demonstrations(folder / "run/submission.json", output=folder / "set")
    assert (found["dataset"], found["episodes"]) == (folder / "set", 2)
    return folder / "set", json.loads((folder / "run/submission.json").read_text(encoding="utf-8")), found


def _samples(folder) -> list[pd.DataFrame]:
    return [pd.read_parquet(path) for path in sorted((folder / "data").rglob("*.parquet"))]


def _image(cell) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(cell["bytes"])))


def test_samples_are_what_was_measured_and_decided(made):
    folder, content, found = made
    task = find_task("along", version=content["ladder"])
    for place, samples in enumerate(_samples(folder)):
        entry = content["navigations"]["along"][place]
        recording = Recording.unpacked(entry["recording"])
        record = begun(recording, task.ladder_navigation(place), seed=entry["seed"]).run()
        state, action = np.stack(samples["observation.state"]), np.stack(samples["action"])
        np.testing.assert_array_equal(state[:, :2], np.float32(record.encoders[:-1, 0]))
        np.testing.assert_array_equal(state[:, 2:4], np.float32(record.load[:-1, 0]))
        np.testing.assert_array_equal(action[:, :2], np.float32(record.control[:-1, 0]))
        np.testing.assert_array_equal(action[:-1, 2] > 0, samples["exposed"][1:])
        np.testing.assert_allclose(samples["contact_force_max_n"].max(), record.peak_force_n, rtol=1e-6)
        assert samples["exposed"].sum() == entry["exposures"]
        ages = state[:, 4]
        assert (ages[samples["exposed"]] == 0).all() and ages.max() == 1.0
        assert samples["next.done"].tolist() == [False] * (len(samples) - 1) + [True]
        assert samples["next.success"].tolist() == (samples["next.done"] & entry["success"]).tolist()
        assert samples["next.reward"].sum() == float(entry["success"] and entry["safe"])
    assert found["exposures"] == sum(entry["exposures"] for entry in content["navigations"]["along"])


def test_images_are_kept_until_the_next_exposure_and_show_a_wire_that_comes_on(made):
    folder, *_ = made
    samples = _samples(folder)[0]
    for view in ("observation.images.view_1", "observation.images.view_2"):
        shown = [_image(cell) for cell in samples[view]]
        assert shown[0].shape == (PIXELS, PIXELS, 3) and shown[0].dtype == np.uint8
        changes = [not np.array_equal(a, b) for a, b in itertools.pairwise(shown)]
        np.testing.assert_array_equal(changes, samples["exposed"][1:])
        first, last = shown[0].astype(float), shown[-1].astype(float)
        assert (last < first - 30).sum() > 3 * 10  # pixels that the wire has darkened


def test_episodes_tasks_and_statistics_are_described(made):
    folder, content, found = made
    episodes = pd.read_parquet(folder / "meta/episodes")
    assert episodes["length"].sum() == found["samples"] == sum(map(len, _samples(folder)))
    assert episodes["tasks"].map(list).tolist() == [["Along a straight vessel"]] * 2
    assert episodes["success"].tolist() == [entry["success"] for entry in content["navigations"]["along"]]
    info = json.loads((folder / "meta/info.json").read_text(encoding="utf-8"))
    assert (info["total_frames"], info["total_tasks"]) == (found["samples"], 1)
    stats = json.loads((folder / "meta/stats.json").read_text(encoding="utf-8"))
    assert stats["action"]["mean"][0] == pytest.approx(5.0)
    depths = [np.stack(samples["observation.state"])[:, 0] for samples in _samples(folder)]
    for name, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):  # the mean of the episodes', as LeRobot has it
        wanted = np.average([np.quantile(each, share) for each in depths], weights=[len(each) for each in depths])
        assert stats["observation.state"][name][0] == pytest.approx(wanted, rel=1e-5)
    assert np.shape(stats["observation.images.view_1"]["q99"]) == (3, 1, 1)
    pixels = np.stack([_image(cell) for data in _samples(folder) for cell in data["observation.images.view_2"]]) / 255
    of_images = stats["observation.images.view_2"]
    np.testing.assert_allclose(of_images["mean"], np.full((3, 1, 1), pixels.mean()))
    np.testing.assert_allclose(of_images["std"], np.full((3, 1, 1), pixels.std()))


def test_lerobot_reads_navigations_with_images(made):
    folder, _, found = made
    read, samples = read_by_lerobot(folder, 3), _samples(folder)[0]
    assert (read["samples"], read["episodes"], read["fps"]) == (found["samples"], 2, 2)
    assert read["task"] == "Along a straight vessel"
    assert read["names"] == ["translation_mm_s", "rotation_rad_s", "expose"]
    np.testing.assert_array_equal(np.float32(read["state"]), samples["observation.state"][3])
    brightest = _image(samples["observation.images.view_1"][3]).max() / 255
    assert read["images"]["observation.images.view_1"] == [[3, PIXELS, PIXELS], pytest.approx(brightest)]
    assert set(map(tuple, read["of_images"].values())) == {(3, 1, 1)}


def test_minari_s_layout_holds_what_an_environment_would_have_observed(made, tmp_path):
    folder, content, found = made
    sets = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "offline_sets.py"))
    sets["write_minari"](folder.parent / "run/submission.json", tmp_path, "looks")
    about = json.loads((tmp_path / "metadata.json").read_text(encoding="utf-8"))
    assert (about["total_episodes"], about["total_steps"]) == (2, found["samples"])
    wide = {of: json.loads(about[f"{of}_space"])["shape"][0] for of in ("observation", "action")}
    assert wide == {"observation": 32, "action": 3}  # as `observation="xray"` has them
    for place, samples in enumerate(_samples(folder)):
        # as `minari`'s storage reads an episode: its folder as one table, whose last row is the end
        rows = pyarrow.dataset.dataset(tmp_path / str(place), format="arrow", ignore_prefixes=["metadata.json"])
        read = {name: np.array(values) for name, values in rows.to_table().to_pydict().items() if name != "infos"}
        entry, state = content["navigations"]["along"][place], np.stack(samples["observation.state"])
        assert {len(values) for values in read.values()} == {len(samples) + 1}
        assert np.isfinite(read["observations"]).all()
        np.testing.assert_allclose(read["observations"][:-1, 0], state[:, 0] / 100, rtol=1e-6)
        np.testing.assert_allclose(read["observations"][:-1, 6], state[:, 4] / 10, atol=1e-6)  # age of the exposure
        assert read["observations"][-1, 5] == pytest.approx(entry["seconds"] / 8.0)  # share of the time
        np.testing.assert_allclose(read["actions"][:-1, 0], 5 / 12, rtol=1e-6)
        np.testing.assert_array_equal(read["actions"][:-2, 2] > 0, samples["exposed"][1:])
        np.testing.assert_array_equal(read["rewards"][:-1], samples["next.reward"])
        ends = read["terminations"][:-1], read["truncations"][:-1]
        assert [end.sum() for end in ends] == [entry["reason"] == "reached", entry["reason"] == "time"]
        to_go = read["observations"][:-1, 11] * 100  # path length to the target at the last exposure
        assert to_go[0] > 15 and to_go[-1] < to_go[0] - 5
