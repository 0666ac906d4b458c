"""Many patients at once: an anatomy of each file that can be read, and a list of the others with the reasons."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

from endopilot import files
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.io import write_anatomy
from endopilot.errors import InputError
from endopilot.parallel import each
from endopilot.runs import claiming
from endopilot.vessels.sources import MASK_SUFFIXES, SURFACE_SUFFIXES, AnatomySource, read_source


def extract_all(
    sources: Sequence[Path],
    output: Path,
    *,
    label: int | str | None = None,
    threshold: float | None = None,
    config: AnatomyConfig,
) -> tuple[list[Path], dict[str, str]]:
    """Make one anatomy a file, on all cores, each in a folder named after its file, or that's folder where names
    repeat; return the folders and what was wrong with each rejected file, as `output`/manifest.json does. Raises
    InputError for two patients of one name, one ostium for all, no good file, or a folder of another run."""
    if config.ostium_mm is not None and len(sources) > 1:
        raise InputError(f"ostium_mm={config.ostium_mm}: cannot serve {len(sources)} patients; make them one by one")
    folders = {source: output / name for source, name in zip(sources, _names(sources), strict=True)}
    reading = {"label": label, "threshold": threshold}
    with claiming(output, "endopilot anatomy", sources=list(folders), **reading, config=config):
        bad = each("Anatomies", list(folders), partial(_make, folders=folders, reading=reading, config=config))
        rejected = {str(source): str(bad[source]) for source in folders if source in bad}
        if len(rejected) == len(folders):
            raise InputError(
                f"none of the {len(folders)} files gives an anatomy; the first: {next(iter(rejected.values()))}"
            )
        files.write_json(output / "manifest.json", files.manifest(config=config, rejected=rejected))
    return [folder for source, folder in folders.items() if source not in bad], rejected


def claim_anatomy(
    folder: Path, content: AnatomySource, *, name: str | None, config: AnatomyConfig, **reading: Any
) -> AbstractContextManager[None]:
    """Return the claim of a folder by the anatomy of a source that was read so, see `runs.claiming`."""
    made_from = {"source": content.sha256, "name": name, "config": config}
    return claiming(folder, "endopilot anatomy", **made_from, **reading)


def _make(source: Path, *, folders: dict[Path, Path], reading: dict[str, Any], config: AnatomyConfig) -> None:
    folder, content = folders[source], read_source(source, **reading)
    with claim_anatomy(folder, content, name=folder.name, config=config, **reading):
        write_anatomy(extract_anatomy(content, name=folder.name, config=config), output=folder)


def _names(sources: Sequence[Path]) -> list[str]:
    names = [_stem(source) for source in sources]
    if len(set(names)) < len(names):
        names = [source.resolve().parent.name for source in sources]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise InputError(f"{repeated[0]}: several of the files would have this name; rename them or their folders")
    return names


def _stem(path: Path) -> str:
    for suffix in sorted((*MASK_SUFFIXES, *SURFACE_SUFFIXES, ".mrk.json"), key=len, reverse=True):
        if path.name.lower().endswith(suffix):
            return path.name[: -len(suffix)]
    return path.stem
