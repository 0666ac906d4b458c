"""Training by several processes and in mixed precision: the same as plain training, as far as rounding goes."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import asdict

import numpy as np
import pytest
import torch

from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.models.checkpoint import read_tensors
from endopilot.models.config import TrainConfig, TransformerConfig
from endopilot.models.train import train

SMALL = TransformerConfig(d_model=24, heads=2, encoder_layers=1, decoder_layers=1, feedforward=32, dropout=0.0)
SHORT = TrainConfig(network="ff", epochs=2, windows_per_epoch=69, batch_size=32, size=SMALL)  # batches of 32, 32, 5


@pytest.fixture(scope="module")
def plain(toy_dataset, tmp_path_factory):
    run = tmp_path_factory.mktemp("plain") / "run"
    train(toy_dataset, output=run, config=SHORT)
    return run


def test_two_processes_train_what_one_does(plain, toy_dataset, tmp_path):
    size = [part for name, value in asdict(SMALL).items() for part in (f"--{name.replace('_', '-')}", str(value))]
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone"]
    command += ["-m", "endopilot.cli", "train", str(toy_dataset), "-o", str(tmp_path / "run"), "--json"]
    command += ["--network", "ff", "--epochs", "2", "--windows-per-epoch", "69", "--batch-size", "32", *size]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, encoding="utf-8", timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count('"training"') == 1  # one of them tells
    ours, theirs = (read_tensors(run / "ff.safetensors")[0] for run in (tmp_path / "run", plain))
    for name, weights in theirs.items():
        np.testing.assert_allclose(ours[name], weights, atol=2e-4, err_msg=name)
    losses = [[e["loss"] for e in read_json(run / "training.json")["ff"]["curve"]] for run in (tmp_path / "run", plain)]
    np.testing.assert_allclose(*losses, rtol=1e-4)
    assert read_json(tmp_path / "run/manifest.json")["processes"] == 2


def test_mixed_precision_multiplies_in_bfloat16_and_keeps_float32(plain, toy_dataset, tmp_path):
    dtypes = set()
    real = torch.nn.functional.scaled_dot_product_attention

    def watched(query, key, value):
        dtypes.add(query.dtype)
        return real(query, key, value)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.nn.functional, "scaled_dot_product_attention", watched)
        train(toy_dataset, output=tmp_path / "run", config=TrainConfig(**{**vars(SHORT), "precision": "bfloat16"}))
    assert torch.bfloat16 in dtypes
    ours, theirs = (read_tensors(run / "ff.safetensors")[0] for run in (tmp_path / "run", plain))
    assert {weights.dtype for weights in ours.values()} == {torch.float32}
    assert any(not torch.equal(ours[name], theirs[name]) for name in theirs)
    losses = [[e["loss"] for e in read_json(run / "training.json")["ff"]["curve"]] for run in (tmp_path / "run", plain)]
    np.testing.assert_allclose(*losses, rtol=0.03)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_that_is_not_there_is_refused(toy_dataset, tmp_path):
    with pytest.raises(InputError, match="torch finds no GPU here"):
        train(toy_dataset, output=tmp_path / "run", config=TrainConfig(processor="cuda"))
    assert not (tmp_path / "run").exists()
