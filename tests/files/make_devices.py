"""Device files for tests: a wire and a catheter that are shipped, and what a typing error makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from endopilot.devices.catheter import catheter_yaml
from endopilot.devices.device_files import device_yaml


def wire(**values: Any) -> dict[str, Any]:
    """Return what the file of a 0.014-inch wire holds; constants are replaced by name, None removes one."""
    content = _file(device_yaml("workhorse-014")[1], values)
    del content["tip_shaping"]
    return content


def catheter(**values: Any) -> dict[str, Any]:
    """Return what the file of a 5 French catheter holds, likewise."""
    return _file(catheter_yaml("vertebral-5f"), values)


def uniform(diameter: float, stiffness: float, ratio: float = 0.75, **values: Any) -> dict[str, Any]:
    """Return what the file of a straight wire holds whose EI is the same everywhere."""
    straight = {"angle_deg": 0, "length_mm": 0, "source": "straight"}
    profiles = {"bend_stiffness_n_mm2": [stiffness], "twist_stiffness_n_mm2": [ratio * stiffness]}
    return wire(diameter_mm=diameter, abscissa_mm=[0], tip_load_n=None, tip_bend=straight, **profiles | values)


def write(path: Path, content: Any) -> Path:
    """Write content as a YAML file."""
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path


def _file(shipped: str, values: dict[str, Any]) -> dict[str, Any]:
    return yaml.safe_load(shipped) | {
        key: value if isinstance(value, dict) else {"value": value, "source": "assumed"}
        for key, value in values.items()
    }
