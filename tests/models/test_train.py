"""Training: it learns, repeats to the bit, survives a kill and stops at the first bad loss."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from endopilot.dataset.loader import read_dataset
from endopilot.errors import InputError
from endopilot.files import read_json, sha256
from endopilot.models.checkpoint import load_model, read_tensors
from endopilot.models.config import TrainConfig, TransformerConfig
from endopilot.models.episodes import Episodes
from endopilot.models.paper import NETWORKS, Windows
from endopilot.models.train import train

SMALL = TransformerConfig(d_model=24, heads=2, encoder_layers=1, decoder_layers=1, feedforward=32)
SHORT = {"epochs": 3, "windows_per_epoch": 64, "batch_size": 16, "size": SMALL}


@pytest.fixture(scope="module")
def short_run(toy_dataset, tmp_path_factory):
    """Return a run of both networks, three short epochs each."""
    run = tmp_path_factory.mktemp("short") / "run"
    train(toy_dataset, output=run, config=TrainConfig(**SHORT))
    return run


@pytest.mark.parametrize("name", ["ff", "if"])
def test_windows_hold_what_the_paper_says(toy_dataset, name):
    data = read_dataset(toy_dataset).of_split("train")
    tip, proximal, control, truth = Windows.of(Episodes.of_dataset(data)).window(
        name, torch.tensor([[2, 30], [5, 119]])
    )
    first = slice(0, 30) if name == "ff" else slice(1, 31)
    np.testing.assert_array_equal(tip[0, :, 0], data.tip_abscissa[2, first, 0])
    first = slice(1, 31) if name == "ff" else slice(0, 30)
    np.testing.assert_array_equal(proximal[0, :, 1], data.rotation[2, first, 0])
    np.testing.assert_array_equal(control[0], data.control[2, first, 0])
    expected = (data.tip_abscissa[5, 119, 0], data.tip_offset[5, 119, 0]) if name == "ff" else data.control[5, 119, 0]
    np.testing.assert_array_equal(truth[1], expected)


def test_writes_what_a_run_holds(short_run, toy_dataset):
    names = {path.name for path in short_run.iterdir()}
    networks = {"ff.safetensors", "if.safetensors"}
    assert names == networks | {"run.json", "training.json", "manifest.json", "checkpoints"}
    record = read_json(short_run / "manifest.json")
    assert (short_run / record["dataset"]).resolve() == toy_dataset.resolve()
    assert record["networks"]["ff"]["parameters"] == sum(p.numel() for p in NETWORKS["ff"](SMALL).parameters())
    curve = read_json(short_run / "training.json")["if"]["curve"]
    assert [entry["steps"] for entry in curve] == [4, 4, 4]
    assert all(np.isfinite(entry["validation_loss"]) for entry in curve)


def test_another_seed_is_another_run(short_run, toy_dataset, tmp_path):
    train(toy_dataset, output=tmp_path / "other", config=TrainConfig(**SHORT, network="ff", seed=1))
    assert sha256(tmp_path / "other/ff.safetensors") != sha256(short_run / "ff.safetensors")


def test_killed_and_resumed_continues_the_same_curve(short_run, toy_dataset, tmp_path):
    run = tmp_path / "run"
    script = (
        f"import sys; sys.path[:0] = {sys.path!r}\n"
        "from pathlib import Path\n"
        "import torch; torch.set_num_threads(1)\n"
        "from endopilot.models.config import TrainConfig, TransformerConfig\n"
        "from endopilot.models.train import train\n"
        f"train(Path({str(toy_dataset)!r}), output=Path({str(run)!r}), config=TrainConfig(**{SHORT!r}))\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 120
        while not (run / "checkpoints/ff.safetensors").exists():
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not (run / "manifest.json").exists()
    train(toy_dataset, output=run, config=TrainConfig(**SHORT))
    for name in ("ff", "if"):
        assert sha256(run / f"{name}.safetensors") == sha256(short_run / f"{name}.safetensors")
        curves = [read_json(folder / "training.json")[name]["curve"] for folder in (run, short_run)]
        losses = [[(entry["loss"], entry["validation_loss"]) for entry in curve] for curve in curves]
        assert losses[0] == losses[1]


def test_a_finished_run_returns_at_once(short_run, toy_dataset):
    before = sha256(short_run / "checkpoints/ff.safetensors")
    train(toy_dataset, output=short_run, config=TrainConfig(**SHORT))
    assert sha256(short_run / "checkpoints/ff.safetensors") == before


def test_the_first_bad_loss_stops_and_the_last_good_checkpoint_stays(toy_dataset, tmp_path, monkeypatch):
    config = TrainConfig(**SHORT, network="ff")
    real = Windows.window
    drawn = []

    def window(self, name, target):
        *given, truth = real(self, name, target)
        drawn.append(target)
        if len(drawn) == 8:  # scales, four steps of epoch 1, its validation, two steps of epoch 2
            truth = truth * torch.nan
        return (*given, truth)

    monkeypatch.setattr(Windows, "window", window)
    with pytest.raises(InputError, match=r"loss of ff became nan in epoch 2, batch 2 .* checkpoint of epoch 1 is kept"):
        train(toy_dataset, output=tmp_path / "run", config=config)
    monkeypatch.undo()
    tensors, facts = read_tensors(tmp_path / "run/checkpoints/ff.safetensors")
    assert [entry["epoch"] for entry in facts["curve"]] == [1] and not (tmp_path / "run/ff.safetensors").exists()
    assert all(torch.isfinite(tensor).all() for tensor in tensors.values())


def test_the_time_allowed_is_kept(toy_dataset, tmp_path):
    config = TrainConfig(network="ff", epochs=2, batch_size=16, max_seconds=0.5)
    train(toy_dataset, output=tmp_path / "run", config=config)
    result = read_json(tmp_path / "run/training.json")["ff"]
    assert result["parameters"] == 650_754
    everything = 77 * 90 / 16
    assert len(result["curve"]) == 2
    assert all(1 <= entry["steps"] < everything for entry in result["curve"])


def test_damaged_checkpoints_are_named(short_run, tmp_path):
    shutil.copytree(short_run, tmp_path / "run")
    file = tmp_path / "run/ff.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"ff\.safetensors: damaged"):
        load_model(tmp_path / "run")
    file.unlink()
    with pytest.raises(InputError, match=r"ff\.safetensors: no such checkpoint"):
        load_model(tmp_path / "run")


def test_mixed_precision_multiplies_in_bfloat16_and_keeps_float32(short_run, toy_dataset, tmp_path):
    train(toy_dataset, output=tmp_path / "run", config=TrainConfig(**SHORT, network="ff", precision="bfloat16"))
    ours, theirs = (read_tensors(run / "ff.safetensors")[0] for run in (tmp_path / "run", short_run))
    assert {weights.dtype for weights in ours.values()} == {torch.float32}
    assert any(not torch.equal(ours[name], theirs[name]) for name in theirs)
    curves = [read_json(run / "training.json")["ff"]["curve"] for run in (tmp_path / "run", short_run)]
    np.testing.assert_allclose(*([entry["loss"] for entry in curve] for curve in curves), rtol=0.03)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_that_is_not_there_is_refused(toy_dataset, tmp_path):
    with pytest.raises(InputError, match="torch finds no GPU here"):
        train(toy_dataset, output=tmp_path / "run", config=TrainConfig(processor="cuda"))
    assert not (tmp_path / "run").exists()
