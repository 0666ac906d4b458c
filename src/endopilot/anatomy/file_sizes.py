"""Whether a mesh file is as long as its header says: VTK's own readers crash or hang on some that are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from endopilot.errors import InputError

_FEWEST_BYTES = 16
"""No format holds a vessel in fewer bytes."""

_PLY_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_PLY_COUNTS = {"char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
               "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4"}  # fmt: skip


def check(path: Path) -> None:
    """Refuse a mesh file that is empty, or shorter than its header promises.

    Raises:
        InputError: it is; or the header of a PLY file cannot be understood.
    """
    size = path.stat().st_size
    if size < _FEWEST_BYTES:
        raise InputError(f"{path}: is empty or truncated; export it again")
    kind = path.suffix.lower()
    if kind == ".stl":
        with path.open("rb") as stream:
            head = stream.read(1024)
        if not is_ascii_stl(head.decode("latin-1")):
            count = int.from_bytes(head[80:84], "little")
            if size < 84 + 50 * count or len(head) < 84:
                raise InputError(
                    f"{path}: is truncated: its header promises {count} triangles, and it holds "
                    f"{max(size - 84, 0) // 50}; export it again"
                )
    elif kind == ".ply":
        _check_ply(path)


def is_ascii_stl(text: str) -> bool:
    """Return whether the first bytes of an STL file are those of the text format.

    A binary header may begin with "solid" too, but no facet follows it.
    """
    return text.lstrip().lower().startswith("solid") and ("facet" in text.lower() or "endsolid" in text.lower())


def _check_ply(path: Path) -> None:
    data = path.read_bytes()
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        raise InputError(f"{path}: has no PLY header; export it again")
    elements: list[tuple[str, int, list[list[str]]]] = []
    order = ""
    try:
        for line in data[:end].decode("latin-1").splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                order = words[1]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                elements[-1][2].append(words[1:])
        whole = _ascii_length if order == "ascii" else _binary_length
        if any(count < 0 or count > len(data) for _, count, _ in elements) or not whole(data, start, elements, order):
            raise InputError(f"{path}: is truncated: it holds fewer points or triangles than its header promises")
    except (IndexError, KeyError, ValueError) as error:
        raise InputError(f"{path}: its PLY header cannot be understood ({error!r}); export it again") from error


def _ascii_length(data: bytes, start: int, elements: list[tuple[str, int, list[list[str]]]], order: str) -> bool:
    rows = [len(line.split()) for line in data[start:].splitlines() if line.strip()]
    needed = [
        sum(1 for word in properties if word[0] != "list") for _, count, properties in elements for _ in range(count)
    ]
    return len(rows) >= len(needed) and all(held >= least for held, least in zip(rows, needed, strict=False))


def _binary_length(data: bytes, start: int, elements: list[tuple[str, int, list[list[str]]]], order: str) -> bool:
    """Return whether all elements lie within the data; lists have to be walked through."""
    endian = ">" if order == "binary_big_endian" else "<"
    position = start
    for _, count, properties in elements:
        if all(words[0] != "list" for words in properties):
            position += count * sum(_PLY_SIZES[words[0]] for words in properties)
            continue
        for _ in range(count):
            for words in properties:
                if words[0] != "list":
                    position += _PLY_SIZES[words[0]]
                    continue
                kind = np.dtype(endian + _PLY_COUNTS[words[1]])
                if position + kind.itemsize > len(data):
                    return False
                length = int(np.frombuffer(data, kind, 1, position)[0])
                if length < 0:
                    return False
                position += kind.itemsize + length * _PLY_SIZES[words[2]]
    return position <= len(data)
