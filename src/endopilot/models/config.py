"""Settings of training; importing them needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from endopilot.errors import InputError
from endopilot.files import read_json

WINDOW = 30
"""States that each prediction sees: the paper gives 30 states in and one out."""


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


@dataclass(frozen=True, kw_only=True)
class TransformerConfig:
    """Size of the paper's Transformer (Kim et al. 2023). The paper does not state d_model; 12 heads must divide it."""

    d_model: int = 96
    """Width of the tokens."""
    heads: int = 12
    """Attention heads."""
    encoder_layers: int = 4
    """Layers of the encoder."""
    decoder_layers: int = 4
    """Layers of the decoder."""
    feedforward: int = 128
    """Width of the feed-forward layers."""
    dropout: float = 0.1
    """Share of activations that are dropped in training."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        for name in ("d_model", "heads", "encoder_layers", "decoder_layers", "feedforward"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: {getattr(self, name)} is not positive; give at least 1")
        if self.d_model % self.heads or self.d_model % 2:
            raise InputError(f"d_model: {self.d_model} is not even and divisible by heads = {self.heads}; give e.g. 96")
        if not 0 <= self.dropout < 1:
            raise InputError(f"dropout: {self.dropout} is not in [0, 1); give e.g. 0.1")


@dataclass(frozen=True, kw_only=True)
class CausalConfig:
    """Size of the causal network: see `models.causal`."""

    width: int = 96
    """Width of every layer."""
    layers: int = 1
    """Recurrent layers."""
    drop_share: float = 0.2
    """Share of activations that are dropped in training."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        for name in ("width", "layers"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: {getattr(self, name)} is not positive; give at least 1")
        if not 0 <= self.drop_share < 1:
            raise InputError(f"drop_share: {self.drop_share} is not in [0, 1); give e.g. 0.2")


@dataclass(frozen=True, kw_only=True)
class TwinConfig:
    """The ensemble of rod simulations that the twin is, and how far it is from the truth at most."""

    members: int = 32
    """Simulations of each navigation."""
    friction_spread: float = 0.2
    """The friction coefficient may be off by this share, either way."""
    stiffness_spread: float = 0.2
    """The stiffness of the tip may be off by this share, either way."""
    ostium_spread_mm: float = 0.5
    """The ostium may lie this much deeper or less deep along the catheter's axis, mm."""
    abscissa_sd_mm: float = 0.05
    """Scale of what a good member misses a seen tip by along the centerline, mm."""
    offset_sd_mm: float = 0.025
    """The same away from the centerline, mm."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        if self.members < 1:
            raise InputError(f"members: {self.members} is not positive; give at least 1")
        for name in ("friction_spread", "stiffness_spread"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"{name}: {getattr(self, name)} is not in [0, 1); give e.g. 0.2")
        if not self.ostium_spread_mm >= 0:
            raise InputError(f"ostium_spread_mm: {self.ostium_spread_mm}; give 0 or more")
        for name in ("abscissa_sd_mm", "offset_sd_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name}: {getattr(self, name)} is not positive; give e.g. 0.05")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Which networks are trained, and how long."""

    model: Literal["paper", "causal", "twin"] = "paper"
    """Kind of model: the paper's pair of Transformers; ours, a pair of recurrent networks that are told of the vessel;
    or the rod core itself, which needs no training."""
    network: Literal["both", "ff", "if"] = "both"
    """Forward network (ff), inverse network (if), or both."""
    epochs: int = 20
    """Passes over the training windows (causal: sequences)."""
    learning_rate: float = 1e-3
    """Adam's peak step size."""
    batch_size: int = 32
    """Windows of 30 states (causal: sequences) in one step."""
    windows_per_epoch: int | None = None
    """Windows (causal: sequences) drawn in one epoch; all of the training split if not given."""
    max_seconds: float | None = None
    """Wall time that each network may train for, s; epochs are shortened to what is left of it."""
    seed: int = 0
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

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        for name in ("epochs", "learning_rate", "batch_size", "windows_per_epoch", "max_seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"{name}: {value} is not positive; give a positive number")
        if self.seed < 0:
            raise InputError(f"seed: {self.seed} is negative; give 0 or more")

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
