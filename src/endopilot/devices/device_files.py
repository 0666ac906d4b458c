"""Where device files lie, and what the numbers in them can be (docs/concepts/devices.md says where ranges come from).

A device is called by its file's name without `.yaml`: the shipped ones, those in the folder that the environment
variable ENDOPILOT_DEVICES names, and those in `endopilot/devices` of the user's configuration folder: $XDG_CONFIG_HOME,
or ~/.config where that is not set.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

from endopilot.errors import InputError
from endopilot.files import read_text
from endopilot.settings import Within

FOLDER_VARIABLE = "ENDOPILOT_DEVICES"  # environment variable that names a folder of device files
_SHIPPED = Path(__file__).parent / "wires"


def list_wires() -> tuple[str, ...]:
    """Return the names of the shipped devices."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.yaml")))


def user_devices() -> tuple[str, ...]:
    """Return names of the devices in the user's folders; InputError if ENDOPILOT_DEVICES is no folder."""
    names = {path.stem for folder in _user_folders() for path in folder.glob("*.yaml")}
    return tuple(sorted(names - set(list_wires())))


def device_file(name_or_path: str | Path) -> Path:
    """Return a device's YAML file, by name or path; InputError for none, or several folders that hold the name."""
    folders = (_SHIPPED, *_user_folders())
    return named_file("device", name_or_path, folders, lambda: (*list_wires(), *user_devices()))


def named_file(
    kind: str, name_or_path: str | Path, folders: Sequence[Path], names: Callable[[], Sequence[str]]
) -> Path:
    """Return a YAML file by its name in one of some folders, or by its path; InputError as for `device_file`."""
    files = [path for folder in folders if there(path := folder / f"{name_or_path}.yaml")]
    if len(files) > 1:
        raise InputError(f"{kind} '{name_or_path}': {' and '.join(map(str, files))} both hold it; rename yours")
    path = files[0] if files else Path(name_or_path)
    if not there(path):
        choice = ", ".join(names())
        raise InputError(f"{kind} '{name_or_path}': no such {kind} or file; give a path, or choose from {choice}")
    return path


def there(path: Path) -> bool:
    """Return whether a path leads to something that can be read as a file; a name no file can have leads to nothing."""
    try:
        return path.exists() and not path.is_dir()
    except (OSError, ValueError):
        return False


def device_yaml(name_or_path: str | Path) -> tuple[Path, str]:
    """Return the YAML file of a device, as `device_file`, and the text in it; InputError if it is no text."""
    path = device_file(name_or_path)
    return path, read_text(path, what="device's YAML file")


def _user_folders() -> list[Path]:
    configuration = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    folders = [configuration / "endopilot" / "devices"]
    if named := os.environ.get(FOLDER_VARIABLE):
        if not Path(named).is_dir():
            raise InputError(f"{FOLDER_VARIABLE}={named}: no such folder; make it, or unset the variable")
        folders.insert(0, Path(named))
    return list(dict.fromkeys(folder.resolve() for folder in folders))


GRAM_FORCE_N = 9.80665e-3  # one gram-force in N, in which catalogues give tip loads
TIP_LENGTH_MM = 10.0  # floppy tip, mm: the buckling length of catalogues' tip loads, and a distal coil
MOST_VALUES = 1000  # values that a profile or a shape may have
_LENGTHS = (("m", 1000.0), ("inch", 25.4), ("cm", 10.0), ("µm", 0.001))
_FORCES = (("gf", GRAM_FORCE_N), ("mN", 0.001), ("kgf", 1000 * GRAM_FORCE_N))

Width = Annotated[
    float, Within(0.15, 10, unit="mm", mistaken=(("inch", 25.4), ("m", 1000.0), ("French", 1 / 3), ("µm", 0.001)))
]
"""An outer or an inner diameter, mm."""
Abscissa = Annotated[float, Within(0, 5000, unit="mm", mistaken=(("µm", 0.001),))]  # a distance from the tip, mm
Stiffness = Annotated[float, Within(1e-4, 1e6, unit="N·mm²", mistaken=(("N·m²", 1e6),))]  # EI or GJ, N·mm²
BendLength = Annotated[float, Within(0, 200, unit="mm", mistaken=(("µm", 0.001),))]  # of the tip, mm; 0: straight
ArcLength = Annotated[float, Within(0.1, 500, unit="mm", mistaken=_LENGTHS)]  # of a shape, or of a hand's bend, mm
Angle = Annotated[float, Within(0, 360, unit="°")]  # angle that a hand can bend a tip by, °
TipLoad = Annotated[float, Within(3e-4, 0.6, unit="N", mistaken=_FORCES)]  # load at which the tip buckles, N
Friction = Annotated[float, Within(0, 2, mistaken=(("%", 0.01),))]  # a Coulomb coefficient
Velocity = Annotated[
    float, Within(0.1, 500, unit="mm/s", mistaken=(("m/s", 1000.0), ("cm/s", 10.0), ("mm/min", 1 / 60)))
]
"""Fastest translation of a drive, mm/s."""
Rotation = Annotated[float, Within(0.05, 65, unit="rad/s", mistaken=(("°/s", math.pi / 180), ("rpm", math.pi / 30)))]
"""Fastest rotation of a drive, rad/s."""
Force = Annotated[float, Within(0.01, 50, unit="N", mistaken=_FORCES)]  # force at which a drive slips, N
Torque = Annotated[
    float, Within(1e-3, 1000, unit="N·mm", mistaken=(("N·m", 1000.0), ("mN·mm", 0.001), ("gf·mm", GRAM_FORCE_N)))
]
"""Torque at which a drive slips, N·mm."""
