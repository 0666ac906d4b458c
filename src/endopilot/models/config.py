"""Settings of training; importing them needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from endopilot.errors import InputError

WINDOW = 30
"""States that each prediction sees: the paper gives 30 states in and one out."""


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
class TrainConfig:
    """Which networks are trained, and how long."""

    model: Literal["paper"] = "paper"
    """Kind of model: the paper's pair of Transformers."""
    network: Literal["both", "ff", "if"] = "both"
    """Forward network (ff), inverse network (if), or both."""
    epochs: int = 20
    """Passes over the training windows."""
    learning_rate: float = 1e-3
    """Adam's peak step size."""
    batch_size: int = 32
    """Windows of 30 states in one step."""
    windows_per_epoch: int | None = None
    """Windows drawn in one epoch; all of the training split if not given."""
    max_seconds: float | None = None
    """Wall time that each network may train for, s; epochs are shortened to what is left of it."""
    seed: int = 0
    """Seed of the initial weights, the order of the windows, and dropout."""
    size: TransformerConfig = field(default_factory=TransformerConfig)
    """Size of the networks; the paper's if not given."""

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
    def networks(self) -> tuple[str, ...]:
        """Names of the networks to train."""
        return ("ff", "if") if self.network == "both" else (self.network,)
