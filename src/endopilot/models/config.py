"""Settings of training; importing them needs no torch."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import model_validator

from endopilot.errors import InputError
from endopilot.files import read_json, sha256
from endopilot.settings import Positive, Seed, ShareBelowOne, Within, settings

WINDOW = 30
"""States that each prediction is made from: the paper gives 30 states in and one out."""


Processor = Literal["auto", "cpu", "cuda"]
"""What training computes on."""

WIRES = "wires"
"""Name of the simulated wires (`models.simulated_wires`), which need no training, in place of a run's folder."""


def read_run(run: str | Path) -> dict[str, Any]:
    """Return the manifest of a finished run, or raise InputError; that of `WIRES` names no device and no patients."""
    if str(run) == WIRES:
        return {"config": {}, "device": None, "networks": {}, "patients": []}
    if not Path(run).is_dir():
        raise InputError(f"{run}: no such run; give a folder made by `endopilot train`, or '{WIRES}'")
    path = Path(run) / "manifest.json"
    record = read_json(path) if path.exists() else None
    if not isinstance(record, dict) or not {"config", "device", "networks", "patients"} <= record.keys():
        what = "is missing" if record is None else "is not of a run"
        raise InputError(f"{run}: no finished run here (manifest.json {what}); make one with `endopilot train`")
    return record


def run_inputs(run: str | Path) -> dict[str, str]:
    """Return the SHA-256 of the weights and of the manifest of a finished run, by file; empty of `WIRES`."""
    if str(run) == WIRES:
        return {}
    return {path.name: sha256(path) for path in sorted([*Path(run).glob("*.safetensors"), Path(run) / "manifest.json"])}


@settings
class TransformerConfig:
    """Size of the paper's Transformer (Kim et al. 2023). The paper does not state d_model; 12 heads must divide it."""

    d_model: Annotated[int, Within(1, 4096)] = 96
    """Width of the tokens."""
    heads: Annotated[int, Within(1, 256)] = 12
    """Attention heads."""
    encoder_layers: Annotated[int, Within(1, 64)] = 4
    """Layers of the encoder."""
    decoder_layers: Annotated[int, Within(1, 64)] = 4
    """Layers of the decoder."""
    feedforward: Annotated[int, Within(1, 65536)] = 128
    """Width of the feed-forward layers."""
    dropout: ShareBelowOne = 0.1
    """Share of activations that are dropped in training."""

    @model_validator(mode="after")
    def _consistent(self) -> TransformerConfig:
        if self.d_model % self.heads or self.d_model % 2:
            raise ValueError(f"d_model: {self.d_model} is not even and divisible by heads = {self.heads}; give e.g. 96")
        return self


@settings
class TrainConfig:
    """Which of the paper's networks are trained, and how long."""

    network: Literal["both", "ff", "if"] = "both"
    """Forward network (ff), inverse network (if), or both."""
    epochs: Annotated[int, Within(1, 100000)] = 20
    """Passes over the training windows."""
    learning_rate: Positive = 1e-3
    """Adam's peak step size."""
    batch_size: Annotated[int, Within(1, 65536)] = 32
    """Windows of 30 states in one step."""
    windows_per_epoch: Annotated[int, Within(1, 10**9)] | None = None
    """Windows drawn in one epoch; all of the training split if not given."""
    max_seconds: Annotated[float, Within(0, 10 * 86400, above_low=True)] | None = None
    """Wall time that each network may train for, s; epochs are shortened to what is left of it."""
    seed: Seed = 0
    """Seed of the initial weights, the order of the windows, and dropout."""
    processor: Processor = "auto"
    """Where to compute: "auto" takes a GPU where there is one."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the networks' products in training: "bfloat16" is mixed precision; weights, loss and what is written stay
    float32."""
    size: TransformerConfig = field(default_factory=TransformerConfig)
    """Size of the networks; as published if not given."""

    @property
    def networks(self) -> tuple[str, ...]:
        """Names of the networks to train."""
        return ("ff", "if") if self.network == "both" else (self.network,)
