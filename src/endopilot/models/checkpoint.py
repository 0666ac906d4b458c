"""Networks on disk: safetensors with JSON in the header. Nothing is ever unpickled. `load_model` reads a run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.errors import InputError
from endopilot.files import json_text, reading, regular, writing
from endopilot.models.config import WIRES, TransformerConfig, read_run
from endopilot.models.episodes import Predictor
from endopilot.models.paper import NETWORKS, Network, TransformerPredictor
from endopilot.models.simulated_wires import SimulatedWires
from endopilot.settings import from_record

FORMAT_VERSION = 2
"""Counts changes of the tensors or of their meaning."""


def write_network(path: Path, name: str, network: Network, config: TransformerConfig) -> None:
    """Write weights and scales of a network, whole or not at all."""
    write_tensors(path, network.state_dict(), {"network": name, "size": asdict(config)})


def read_network(path: Path) -> Network:
    """Return a network that `write_network` wrote; InputError for a file that is missing, damaged or of another
    version."""
    tensors, facts = read_tensors(path)
    try:
        network = NETWORKS[facts["network"]](TransformerConfig(**facts["size"]))
        network.load_state_dict(tensors)
    except (KeyError, TypeError, RuntimeError, InputError) as error:
        raise InputError(f"{path}: holds no network of this version ({error}); train it again") from error
    return network.eval()


def write_tensors(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write named tensors and JSON facts into one safetensors file, whole or not at all."""
    header = {"endopilot": json_text({"format_version": FORMAT_VERSION, **facts})}
    with writing(path) as partial:
        save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, partial, header)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return tensors and facts of a file that `write_tensors` wrote; raises InputError as `read_network`."""
    if not regular(path).exists():
        raise InputError(f"{path}: no such checkpoint; train one with `endopilot train`")
    try:
        with safe_open(path, framework="pt") as stream:
            facts = json.loads((stream.metadata() or {})["endopilot"])
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, KeyError, ValueError, RecursionError, OSError) as error:
        raise InputError(f"{path}: damaged, or not a checkpoint of endopilot ({error}); train it again") from error
    version = facts.get("format_version") if isinstance(facts, dict) else None
    if version != FORMAT_VERSION:
        raise InputError(f"{path}: format version {version}, not {FORMAT_VERSION}; train it again")
    return tensors, facts


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return an optimizer's state as named tensors."""
    state = optimizer.state_dict()["state"]
    return {f"optimizer.{i}.{name}": tensor for i, entry in state.items() for name, tensor in entry.items()}


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Set an optimizer to the state that `optimizer_tensors` gave."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        if key.startswith("optimizer."):
            _, i, name = key.split(".")
            state.setdefault(int(i), {})[name] = tensor
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def load_model(run: str | Path = WIRES) -> Predictor:
    """Return the predictor of a run made by `endopilot train`, or the simulated wires, named "wires"; InputError for a
    run that is unfinished, or of which a file is damaged or of another version."""
    if str(run) == WIRES:
        return SimulatedWires()
    record, folder = read_run(run), Path(run)
    with reading(folder, "train anew"):
        files = {name: folder / f"{name}.safetensors" for name in record["networks"]}
        networks = {name: read_network(file) for name, file in files.items()}
        limits = DriveLimits.of(from_record(Wire, record["device"]))
        return TransformerPredictor(forward=networks.get("ff"), inverse=networks.get("if"), limits=limits)
