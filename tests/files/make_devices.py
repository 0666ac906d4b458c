"""Device files for tests: wires and catheters that exist, and what a typing error makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml


def wire(**values: Any) -> dict[str, Any]:
    """Return what the file of a 0.014-inch wire holds; constants are replaced by name, None removes one."""
    constants = {
        "diameter_mm": 0.36,
        "abscissa_mm": [0, 10, 20, 60, 150, 300],
        "bend_stiffness_n_mm2": [0.3, 0.3, 1.2, 8, 30, 80],
        "twist_stiffness_n_mm2": [0.23, 0.23, 0.92, 6.2, 23, 62],
        "tip_load_n": 0.0074,
        "friction": 0.1,
        "max_velocity_mm_s": 40,
        "max_rotation_rad_s": 12.6,
        "push_limit_n": 0.5,
        "pull_limit_n": 0.5,
        "torque_limit_n_mm": 0.5,
    }
    bend = {"angle_deg": 45, "length_mm": 3, "source": "shaped by hand"}
    return _file("wire", constants, {"tip_bend": bend}, values)


def catheter(**values: Any) -> dict[str, Any]:
    """Return what the file of a 5 French catheter holds, likewise."""
    constants = {
        "diameter_mm": 1.67,
        "inner_diameter_mm": 1.2,
        "abscissa_mm": [0, 5, 20, 60],
        "bend_stiffness_n_mm2": [42, 42, 140, 196],
        "twist_stiffness_n_mm2": [30, 30, 100, 140],
        "friction": 0.15,
        "bore_friction": 0.08,
        "max_velocity_mm_s": 30,
        "max_rotation_rad_s": 6.3,
        "push_limit_n": 3,
        "pull_limit_n": 3,
        "torque_limit_n_mm": 10,
    }
    shape = {"arcs": [[6, 0], [9, 90], [35, 0]], "source": "as delivered"}
    return _file("catheter", constants, {"shape": shape}, values)


def uniform(diameter: float, stiffness: float, ratio: float = 0.75, **values: Any) -> dict[str, Any]:
    """Return what the file of a straight wire holds whose EI is the same everywhere."""
    straight = {"angle_deg": 0, "length_mm": 0, "source": "straight"}
    profiles = {"bend_stiffness_n_mm2": [stiffness], "twist_stiffness_n_mm2": [ratio * stiffness]}
    return wire(diameter_mm=diameter, abscissa_mm=[0], tip_load_n=None, tip_bend=straight, **profiles | values)


def write(path: Path, content: Any) -> Path:
    """Write content as a YAML file."""
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path


def _file(name: str, constants: dict, parts: dict, values: dict) -> dict[str, Any]:
    sourced = {key: {"value": values.get(key, value), "source": "assumed"} for key, value in constants.items()}
    return {"name": name} | sourced | {key: values.get(key, part) for key, part in parts.items()}
