"""What the numbers of a device's file can be: ranges by field.

docs/concepts/devices.md says where each range comes from. They hold every wire from 0.006 to 0.038 inch, catheters and
sheaths up to 24 French, and the soft rods of published benchmarks; what lies outside was most likely given in another
unit.
"""

from __future__ import annotations

import math
from typing import Annotated

from endopilot.settings import Within

GRAM_FORCE_N = 9.80665e-3
"""One gram-force in N, by the standard acceleration of gravity; catalogues give tip loads in it."""
TIP_LENGTH_MM = 10.0
"""Length of the floppy tip, mm: the buckling length of catalogues' tip loads, and the distal coil of coronary wires."""
MOST_VALUES = 1000
"""Values that a profile or a shape may have."""
_LENGTHS = (("m", 1000.0), ("inch", 25.4), ("cm", 10.0), ("µm", 0.001))
_FORCES = (("gf", GRAM_FORCE_N), ("mN", 0.001), ("kgf", 1000 * GRAM_FORCE_N))

Width = Annotated[
    float,
    Within(0.15, 10, unit="mm", mistaken=(("inch", 25.4), ("m", 1000.0), ("French", 1 / 3), ("µm", 0.001))),
]
"""An outer or an inner diameter, mm."""
Abscissa = Annotated[float, Within(0, 5000, unit="mm", mistaken=(("µm", 0.001),))]
"""A distance from the tip, mm."""
Stiffness = Annotated[float, Within(1e-4, 1e6, unit="N·mm²", mistaken=(("N·m²", 1e6),))]
"""EI or GJ, N·mm²."""
BendLength = Annotated[float, Within(0, 200, unit="mm", mistaken=(("µm", 0.001),))]
"""Length of a bend of the tip, mm; 0 for a straight one."""
ArcLength = Annotated[float, Within(0.1, 500, unit="mm", mistaken=_LENGTHS)]
"""Length of an arc of a catheter's shape, or that a hand can bend a tip over, mm."""
Angle = Annotated[float, Within(0, 360, unit="°")]
"""Angle that a hand can bend a tip by, °."""
TipLoad = Annotated[float, Within(3e-4, 0.6, unit="N", mistaken=_FORCES)]
"""Load at which the tip buckles, N."""
Friction = Annotated[float, Within(0, 2, mistaken=(("%", 0.01),))]
"""A Coulomb coefficient."""
Velocity = Annotated[
    float, Within(0.1, 500, unit="mm/s", mistaken=(("m/s", 1000.0), ("cm/s", 10.0), ("mm/min", 1 / 60)))
]
"""Fastest translation of a drive, mm/s."""
Rotation = Annotated[float, Within(0.05, 65, unit="rad/s", mistaken=(("°/s", math.pi / 180), ("rpm", math.pi / 30)))]
"""Fastest rotation of a drive, rad/s."""
Force = Annotated[float, Within(0.01, 50, unit="N", mistaken=_FORCES)]
"""Force at which a drive slips, N."""
Torque = Annotated[
    float, Within(1e-3, 1000, unit="N·mm", mistaken=(("N·m", 1000.0), ("mN·mm", 0.001), ("gf·mm", GRAM_FORCE_N)))
]
"""Torque at which a drive slips, N·mm."""
