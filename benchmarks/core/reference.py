"""The solution that the rod core's error is measured against: `Reference`, converged in elements, step and tolerance.

It is kept in `reference.npz` beside this module, with its recipe: `python -m benchmarks simulation --make-reference`
makes it anew. Its worlds are those of `make_scenes`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from benchmarks.core.errors import error_figures
from benchmarks.core.scenes import DEVICE, SAMPLES, SEED, WORLDS, Scene, Solution, make_scenes
from endopilot.devices.device import Wire
from endopilot.errors import InputError
from endopilot.files import json_text, manifest, writing
from endopilot.simulation.config import SimulatorConfig

REFERENCE_FILE = Path(__file__).with_name("reference.npz")
"""The reference that is shipped."""
CONVERGED = SimulatorConfig(element_mm=0.1, time_step_s=1e-3, tolerance_mm=1e-6)
"""Settings of the reference."""
FINER = SimulatorConfig(element_mm=0.07, time_step_s=5e-4, tolerance_mm=1e-6)
"""Settings that the reference's own error is measured against."""
FINER_WORLDS = 4
"""Worlds of each patient that the reference's own error is measured on."""
_ALIKE = 1e-3
"""Vessels and controls that differ by less are the same, mm, mm/s, rad/s; processors round differently."""
_MAP_STRIDE = 16
"""Every so many cells along each axis a value of the distance map is kept, to know the vessel by."""


@dataclass(frozen=True, eq=False)
class Reference:
    """A converged solution and what it is the solution of.

    Attributes:
        solution: its samples.
        recipe: how it was made; `worlds` and `samples` of each scene, and `own_error`, its figures against a finer one.
    """

    solution: Solution
    recipe: Mapping[str, Any]


def make_reference(
    path: Path = REFERENCE_FILE,
    *,
    worlds: int = WORLDS,
    samples: int = SAMPLES,
    converged: SimulatorConfig = CONVERGED,
    finer: SimulatorConfig = FINER,
    finer_worlds: int = FINER_WORLDS,
) -> Mapping[str, Any]:
    """Simulate the scenes with converged settings, measure how far a finer solution is off, and write both.

    Args:
        path: file to write.
        worlds: of each patient.
        samples: of each world.
        converged: settings of the reference.
        finer: settings that its own error is measured against.
        finer_worlds: worlds of each patient that this is measured on.

    Returns:
        The recipe.

    Raises:
        InputError: the file cannot be written.
    """
    started = time.perf_counter()
    scenes = make_scenes(worlds, samples)
    solution = Solution.of(scenes, [scene.run(converged) for scene in scenes])
    finest = Solution.of(scenes, [scene.run(finer, finer_worlds) for scene in scenes])
    rows = np.concatenate([place * worlds + np.arange(finer_worlds) for place in range(len(scenes))])
    recipe = manifest(
        config=_settings(converged),
        seed=SEED,
        command="python -m benchmarks simulation --make-reference",
        wall_seconds=round(time.perf_counter() - started, 1),
        worlds=worlds,
        samples=samples,
        device=_constants(scenes[0].device),
        finer=_settings(finer) | {"worlds": finer_worlds},
        own_error=error_figures(solution.worlds(rows), finest),
    )
    arrays: dict[str, Any] = {field.name: _compact(getattr(solution, field.name)) for field in fields(solution)}
    with writing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays, **_marks(scenes), recipe=np.array(json_text(recipe)))
    return recipe


def read_reference(path: Path = REFERENCE_FILE) -> Reference:
    """Read a reference.

    Raises:
        InputError: the file is missing or is no reference.
    """
    return _read(path)[0]


def check_reference(path: Path, scenes: Iterable[Scene]) -> None:
    """Check that a reference is the solution of these scenes.

    Raises:
        InputError: its vessels, wire or controls are others; the line says which.
    """
    reference, kept = _read(path)
    mend = "make it anew with `python -m benchmarks simulation --make-reference`"
    scenes = list(scenes)
    for name, value in _constants(scenes[0].device).items():
        then = reference.recipe["device"].get(name, value)
        if then != value:
            raise InputError(f"{path}: made for a {DEVICE} whose {name} is {then}, not {value}; {mend}")
    for name, now in _marks(scenes).items():
        then = kept.get(name)
        if then is None or then.shape != now.shape or not np.allclose(then, now, rtol=0, atol=_ALIKE):
            raise InputError(f"{path}: made for other {name.replace('_', ' ')}; {mend}")


def _read(path: Path) -> tuple[Reference, dict[str, np.ndarray]]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            kept = dict(stored)
        recipe = json.loads(str(kept.pop("recipe")))
        solution = Solution(**{field.name: kept.pop(field.name) for field in fields(Solution)})
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: no such file; `python -m benchmarks simulation --make-reference` makes a reference"
        ) from error
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise InputError(
            f"{path}: no reference ({error}); make it with `python -m benchmarks simulation --make-reference`"
        ) from error
    return Reference(solution, recipe), kept


def _settings(config: SimulatorConfig) -> dict[str, Any]:
    return {name: value for name, value in asdict(config).items() if name != "threads"}


def _constants(device: Wire) -> dict[str, Any]:
    """Return the numbers of a device as JSON has them."""
    constants = {name: value for name, value in asdict(device).items() if name not in ("name", "sources")}
    return json.loads(json_text(constants))


def _compact(values: np.ndarray) -> np.ndarray:
    kinds = {"f": np.float32, "i": np.int16, "b": np.bool_}
    return values.astype(kinds[values.dtype.kind])


def _marks(scenes: Iterable[Scene]) -> dict[str, Any]:
    """Return what scenes are known by: centerlines, a part of the distance maps, and controls."""
    marks = {}
    for scene in scenes:
        lines = [branch.centerline for branch in scene.anatomy.tree.branches]
        step = slice(None, None, _MAP_STRIDE)
        marks |= {
            f"centerlines_{scene.name}": np.concatenate(
                [np.column_stack([line.points, line.radius]) for line in lines]
            ),
            f"distance_map_{scene.name}": scene.anatomy.distance_map.values[step, step, step],
            f"initial_states_{scene.name}": scene.initial[:, 0],
            f"controls_{scene.name}": scene.control[:, :, 0],
        }
    return {name: values.astype(np.float32) for name, values in marks.items()}
