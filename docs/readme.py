"""Write the figures and pictures of README.md from what the commands left in `runs/`.

`make readme` runs it after `make demo` and, for the real CT angiogram, after the command in the README. A part whose
run is not there stays as it is.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from endopilot.cli import COMMANDS

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
SPANS = ("0–10 s", "10–30 s", "30–45 s")


def main() -> None:
    """Replace each part of README.md between its markers."""
    readme = ROOT / "README.md"
    text = _replace(readme.read_text(encoding="utf-8"), "commands", _commands())
    demo, cta = ROOT / "runs" / "demo", ROOT / "runs" / "cta-thorax"
    if (demo / "manifest.json").exists():
        shutil.copyfile(demo / "scene.png", IMAGES / "demo.png")
        text = _replace(text, "demo", _demo(demo))
    if (cta / "dice.json").exists():
        text = _replace(text, "cta", _cta(cta))
    readme.write_text(text, encoding="utf-8")


def _replace(text: str, name: str, content: str) -> str:
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    head, rest = text.split(begin)
    return f"{head}{begin}\n{content}\n{end}{rest.split(end)[1]}"


def _commands() -> str:
    rows = [f"| `endopilot {name}` | {summary} |" for name, summary in COMMANDS.items()]
    return "\n".join(["| command | what it does |", "| --- | --- |", *rows])
