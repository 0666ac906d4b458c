"""`endopilot difficulty`: anatomy -> how hard each of its sections is to reach."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Answer, Existing
from endopilot.control.difficulty import arch_type, assess_difficulty
from endopilot.devices.device import read_wire


def difficulty_command(
    anatomy: Positional[Existing], /, *, target: tuple[str, ...] = (), device: str = "workhorse-014"
) -> Answer:
    """Say before a procedure how hard each section of a vessel is to reach with a wire alone, the easiest first.

    Exposures and seconds are those that the policy `agent` would take, with intervals of 80 %, by what the navigations
    of the ladder took. An aortic arch is told its type.

    Args:
        target: sections such as 4 or PDA, or points X,Y,Z in LPS mm; the middles of all sections if none is given.
        device: name of a device (`endopilot devices`) or a YAML file.
    """
    patient = read_anatomy(anatomy)
    rows = assess_difficulty(patient, read_wire(device), places=target)
    kind = arch_type(patient.tree)
    return Answer(rows, [*([f"aortic arch of type {kind}"] if kind else []), [_shown(row) for row in rows]])


def _shown(row: dict[str, float | str | None]) -> dict[str, str]:
    """Return a row with each expectation and its interval in one cell, and no more digits than mean something."""

    def cell(measure: str) -> str:
        values = [row[f"{measure}{end}"] for end in ("", "_from", "_to")]
        return "-" if None in values else "{:.0f} ({:.0f} to {:.0f})".format(*values)

    forms = {"section": "{}", "length_mm": "{:.0f}", "turning_deg": "{:.0f}", "forks": "{}"}
    forms |= {"bore_mm": "{:.2f}", "tip_reaches": "{:.0%}"}
    plain = {name: form.format(row[name]) for name, form in forms.items()}
    return plain | {measure: cell(measure) for measure in ("exposures", "seconds")}
