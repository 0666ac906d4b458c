"""Run the commands of the guide's pages in their order, and renew what they print: `python docs/guide.py`.

A page is read block by block. All pages share one folder, so a command finds what the commands before it have made.

- A block of `bash` or `python` is run, unless the line before it is `<!-- not run: WHY -->`. After
  `<!-- until Ctrl-C -->` its last command is stopped once it has printed an address.
- A block of `text` after it shows some of the lines that it printed; a line that ends in `…` is cut.
- A block of `console` shows a command that is refused (`$ endopilot ...`) and the line that it ends with.
- `<!-- columns: FILE -->` stands before a table that names columns of a CSV file.
- `<!-- picture: FILE -->` stands before a picture, which is a smaller copy of that file.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).with_suffix("")
BLOCK = re.compile(
    r"^```(?P<kind>bash|python|text|console)\n(?P<text>.*?)^```$"
    r"|^<!-- (?P<mark>not run|until Ctrl-C|columns|picture)(?:: (?P<file>[^\n]*?))? -->\n(?P<next>(?:\|[^\n]*\n)*)",
    re.MULTILINE | re.DOTALL,
)
PICTURE_PIXELS, PICTURE_COLOURS = 1200, 256


@dataclass(frozen=True)
class Block:
    """A part of a page: its kind, its text, what it is about (a file), and from where to where it stands."""

    kind: str
    text: str
    file: str
    begin: int
    end: int


def pages() -> list[Path]:
    """Return the pages in their order, that of the table of contents in the guide's index."""
    contents = (FOLDER / "index.md").read_text(encoding="utf-8").split("```{toctree}")[1].split("```")[0]
    return [FOLDER / f"{name}.md" for name in contents.split() if (FOLDER / f"{name}.md").exists()]


def blocks(page: Path) -> Iterator[Block]:
    """Yield the blocks of a page; one that is not run, or runs until Ctrl-C, is of that kind."""
    mark = ""
    for found in BLOCK.finditer(page.read_text(encoding="utf-8")):
        kind = found["kind"] or found["mark"]
        if kind in ("not run", "until Ctrl-C"):
            mark = kind
            continue
        text = found["text"] if found["kind"] else found["next"]
        yield Block(mark or kind, text, found["file"] or "", *found.span("text" if found["kind"] else "next"))
        mark = ""


def walk(page: Path, folder: Path) -> Iterator[tuple[Block, str]]:
    """Run a page's commands in a folder, and yield each block that shows something, with what it is to show."""
    printed = ""
    for block in blocks(page):
        if block.kind == "bash":
            printed = run(block.text, folder)
        elif block.kind == "python":
            printed = _in_shell(f"python - <<'EOF'\n{block.text}EOF", folder)
        elif block.kind == "until Ctrl-C":
            printed = run_until_ready(block.text, folder)
        elif block.kind == "text":
            yield block, printed
        elif block.kind == "console":
            command = block.text.partition("\n")[0].removeprefix("$ ")
            yield block, f"$ {command}\n{run(command, folder, code=2)}"
        elif block.kind == "columns":
            yield block, (folder / block.file).read_text(encoding="utf-8").partition("\n")[0]
        elif block.kind == "picture":
            yield block, str(folder / block.file)


def run(script: str, folder: Path, code: int = 0) -> str:
    """Run commands in a folder, `endopilot` in this process, and return what they print; of a refusal, its one line."""
    printed, others = [], []
    for line in [*re.sub(r"\\\n\s*", " ", script).splitlines(), "endopilot"]:
        if not line.startswith("endopilot") or re.search(r"[|>;&]", line):
            others.append(line)
            continue
        if others:
            printed.append(_in_shell("\n".join(others), folder))
            others.clear()
        if line != "endopilot":
            printed.append(_in_process(_words(line, folder), folder, code))
    return "".join(printed)


def _words(line: str, folder: Path) -> list[str]:
    """Return a command's arguments, with the paths that a pattern stands for."""
    words = []
    for word in shlex.split(line, comments=True)[1:]:
        words += sorted(str(path.relative_to(folder)) for path in folder.glob(word)) if "*" in word else [word]
    return words


def run_until_ready(script: str, folder: Path) -> str:
    """Run commands until the last one prints an address, stop it as Ctrl-C does, and return what they printed."""
    line = ["bash", "-e", "-c", re.sub(r"^(endopilot .*)\Z", r"exec \1", script.strip(), flags=re.MULTILINE)]
    with subprocess.Popen(line, cwd=folder, env=_environment(), stdout=subprocess.PIPE, encoding="utf-8") as process:
        printed = []
        for row in process.stdout or ():
            printed.append(row)
            if "http://" in row:
                process.send_signal(signal.SIGINT)
    if not any("http://" in row for row in printed):
        raise RuntimeError(f"{script}ended with {process.returncode} before it was ready")
    return "".join(printed)


def _in_process(arguments: list[str], folder: Path, code: int) -> str:
    from endopilot.cli import main

    out, err = io.StringIO(), io.StringIO()
    ended: object = None
    with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(arguments)
        except SystemExit as leaving:
            ended = leaving.code
    if ended != code:
        raise RuntimeError(f"endopilot {shlex.join(arguments)}: ended with {ended}, not {code}: {err.getvalue()}")
    if code == 0:
        return out.getvalue()
    lines = [line for line in err.getvalue().splitlines() if not re.search(r": done in [\d.]+ s$", line)]
    return "\n".join([*lines, ""]).replace(f"{folder}{os.sep}", "")


def _in_shell(script: str, folder: Path) -> str:
    line = ["bash", "-e", "-o", "pipefail", "-c", script]
    done = subprocess.run(line, cwd=folder, env=_environment(), capture_output=True, encoding="utf-8")
    if done.returncode:
        raise RuntimeError(f"{script}\nended with {done.returncode}: {done.stderr}")
    return done.stdout


def _environment() -> dict[str, str]:
    """Return an environment in which `endopilot` and `python` are those that run this; `SOURCES` is this tree."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return os.environ | {"PATH": path, "SOURCES": str(FOLDER.parents[1])}


def key(line: str) -> str:
    """Return what names a line of output: what stands before two spaces, or its first word."""
    return re.split(r"\s{2,}|:", line.strip())[0]


def renewed(block: Block, made: str) -> str:
    """Return what a block of output is to hold: its lines as they were printed now, cut where they were cut."""
    lines = []
    for shown in block.text.splitlines():
        new = next((line.rstrip() for line in made.splitlines() if line and key(line) == key(shown)), None)
        if new is None:
            raise RuntimeError(f"{shown!r}: the command prints no such line, but\n{made}")
        lines.append(new[: len(shown) - 1] + "…" if shown.endswith("…") and len(new) >= len(shown) else new)
    return "\n".join([*lines, ""])


def renew(page: Path, folder: Path) -> None:
    """Run a page's commands, and write their output and pictures into the documentation."""
    text = page.read_text(encoding="utf-8")
    for block, made in reversed(list(walk(page, folder))):
        if block.kind == "picture":
            name = re.match(r"!\[[^\]]*\]\(([^)]*)\)", text[block.end :])
            _shrink(Path(made), page.parent / (name[1] if name else ""))
        elif block.kind in ("text", "console"):
            new = made if block.kind == "console" else renewed(block, made)
            text = text[: block.begin] + new + text[block.end :]
    page.write_text(text, encoding="utf-8")


def _shrink(source: Path, output: Path) -> None:
    from PIL import Image

    with Image.open(source) as image:
        small = image.convert("RGB")
        small.thumbnail((PICTURE_PIXELS, PICTURE_PIXELS))
        small.quantize(PICTURE_COLOURS).save(output, optimize=True)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        for each in pages():
            print(each.name)
            renew(each, Path(name))
