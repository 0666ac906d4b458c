"""Settings of training; importing them needs no torch."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import model_validator

from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.settings import NonNegative, Positive, Seed, ShareBelowOne, Within, settings

WINDOW = 30
"""States that each prediction is made from: the paper gives 30 states in and one out."""


Processor = Literal["auto", "cpu", "cuda"]
"""What training computes on."""

PRETRAINED = "pretrained"
"""Name of the trained causal model that comes with the package, in place of a run's folder."""


def run_path(run: str | Path) -> Path:
    """Return the folder of a run: the package's own for `PRETRAINED`, else `run` itself.

    Raises:
        InputError: there is no such folder.
    """
    if str(run) == PRETRAINED:
        return Path(__file__).parent / PRETRAINED
    if not Path(run).is_dir():
        raise InputError(f"{run}: no such run; give a folder made by `endopilot train`, or '{PRETRAINED}'")
    return Path(run)


def read_run(run: str | Path) -> dict[str, Any]:
    """Return the manifest of a finished run, or of the packaged one, named "pretrained".

    Raises:
        InputError: there is no such folder, or it is no finished run.
    """
    path = run_path(run) / "manifest.json"
    record = read_json(path) if path.exists() else None
    if not isinstance(record, dict) or not {"config", "device", "networks"} <= record.keys():
        what = "is missing" if record is None else "is not of a run"
        raise InputError(f"{run}: no finished run here (manifest.json {what}); make one with `endopilot train`")
    return record


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
class CausalConfig:
    """Size of the causal network: see `models.causal`."""

    width: Annotated[int, Within(1, 4096)] = 96
    """Width of every layer."""
    layers: Annotated[int, Within(1, 64)] = 1
    """Recurrent layers."""
    drop_share: ShareBelowOne = 0.2
    """Share of activations that are dropped in training."""


@settings
class TwinConfig:
    """The ensemble of rod simulations that the twin is, and its largest model mismatch."""

    members: Annotated[int, Within(1, 4096)] = 32
    """Simulations of each navigation."""
    friction_spread: ShareBelowOne = 0.2
    """Largest relative error of the friction coefficient, in either direction."""
    stiffness_spread: ShareBelowOne = 0.2
    """Largest relative error of the stiffness of the tip, in either direction."""
    ostium_spread_mm: NonNegative = 0.5
    """The ostium may lie this much deeper or less deep along the catheter's axis, mm."""
    abscissa_sd_mm: Positive = 0.05
    """Scale of a good member's error at an observed tip along the centerline, mm."""
    offset_sd_mm: Positive = 0.025
    """The same away from the centerline, mm."""


@settings
class TrainConfig:
    """Which networks are trained, and how long."""

    model: Literal["paper", "causal", "twin"] = "paper"
    """Kind of model: the paper's pair of Transformers; ours, a pair of recurrent networks that also take the vessel;
    or the rod core itself, which needs no training."""
    network: Literal["both", "ff", "if"] = "both"
    """Forward network (ff), inverse network (if), or both."""
    epochs: Annotated[int, Within(1, 100000)] = 20
    """Passes over the training windows (causal: sequences)."""
    learning_rate: Positive = 1e-3
    """Adam's peak step size."""
    batch_size: Annotated[int, Within(1, 65536)] = 32
    """Windows of 30 states (causal: sequences) in one step."""
    windows_per_epoch: Annotated[int, Within(1, 10**9)] | None = None
    """Windows (causal: sequences) drawn in one epoch; all of the training split if not given."""
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
    """Size of the paper's networks; as published if not given."""
    causal: CausalConfig = field(default_factory=CausalConfig)
    """Size of the causal networks; of no use to the other models."""
    twin: TwinConfig = field(default_factory=TwinConfig)
    """The twin's ensemble; of no use to the other models."""

    @property
    def network_size(self) -> TransformerConfig | CausalConfig:
        """Size of the networks to train."""
        return self.causal if self.model == "causal" else self.size

    @property
    def networks(self) -> tuple[str, ...]:
        """Names of the networks to train."""
        if self.model == "twin":
            return ()
        return ("ff", "if") if self.network == "both" else (self.network,)
