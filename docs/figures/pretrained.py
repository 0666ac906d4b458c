"""Put a trained run into the package as `pretrained`, with the model card that its figures make.

`python docs/figures/pretrained.py FOLDER`: FOLDER holds `dataset`, the run `seed-0`, its `evaluation` and its `advice`,
as `make recipe-laptop` leaves them. The commands of the card are that recipe's.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from textwrap import dedent
from typing import Any

from endopilot.files import read_json

PACKAGED = Path(__file__).parents[2] / "src" / "endopilot" / "models" / "pretrained"
FILES = ("ff.safetensors", "if.safetensors", "manifest.json", "training.json", "xray.json")
CARD = """# Model card: `pretrained`

A forward and an inverse causal network (`endopilot.models.causal`) for the device {device} in coronary arteries.

| | |
| --- | --- |
| patients | {patients} synthetic coronary arteries, half of them left ones, `endopilot atlas` seed {atlas_seed} |
| split | {train} train, {calibrate} calibrate, {test} test |
| navigations | {sequences} of {seconds:g} s a patient, dataset seed {dataset_seed} |
| beside them | {moving} navigations of patients who move, and one of each patient in each world of the commands |
| trained on | {episodes} of all these; {held} of the same patients are held out |
| wires | friction {friction[0]:g} to {friction[1]:g}, stiffness of the tip ×{stiffness[0]:g} to ×{stiffness[1]:g} |
| training | seed {seed}, {epochs} epochs, learning rate {rate:g}, {steps} sequences a step |
| time | {hours:.2f} hours by the clock on one thread of {processor}, shared with other work |
| parameters | {parameters} |
| made by | endopilot {version} |
| licence | Apache-2.0 |

The commands that made it:

```bash
{commands}
```

Errors on new patients ({evaluated} navigations of {n_test} patients), P1, mean absolute error and median in mm,
over 0–10, 10–30 and 30–45 s after the 30 given states:

| | Δtip | γtip | γtip off the wall |
| --- | --- | --- | --- |
| this model | {ours} |
| holding slack and offset | {held_slack} |

Skill over holding slack and offset: {skill_abscissa:.2f} (Δ), {skill_offset:.2f} (γ).
P3 and P4 (its controls, simulated): Δ {p3:.3f} and {p4:.3f} mm over all 45 s; planned anew at an X-ray image every
10 s, {p4_replanned:.3f} mm.

X-ray advice by `xray.json`, calibrated on {calibrated} patients: on {advised} others the bands of level {level:g}
hold throughout {coverage:.0f} % of the intervals of 45 s; {missed:.1f} % of the events are missed with {exposures:.1f}
exposures a minute, {share:.2f} of what periodic imaging needs to miss as many. The adviser counts {offset_share:g} of
the half-width of γtip's band (docs/concepts/advice.md).

**Meant for** research with this device or one much like it, in coronary arteries, at rest or moved by heart and breath.
It gets each patient's vessel from simulations of the device (`models/patient.py`), fits a simulated wire to the given
states (`models/fitted_wires.py`), and simulates three wires under the controls that it predicts for
(`models/simulated_wires.py`). Where a wire snags, prolapses or may enter another branch, the errors are large and rare:
the means are several times the medians. The probability of a jump says where.
**Not for** other devices (refused), other vessels. **No medical device.**
"""


def recipe() -> str:
    """Return the commands of `make recipe-laptop`."""
    text = (PACKAGED.parents[3] / "Makefile").read_text(encoding="utf-8")
    lines = text.split("recipe-laptop: $(INSTALLED)\n")[1].split("\n\n")[0]
    return dedent(lines.expandtabs(4)).replace("$(BIN)/", "").replace("$(LEARNING)", "runs/causal").replace("$$", "$")


def card(folder: Path) -> str:
    """Return the text of the model card."""
    run, data = read_json(folder / "seed-0" / "manifest.json"), read_json(folder / "dataset" / "meta/manifest.json")
    metrics = read_json(folder / "evaluation" / "metrics.json")["splits"]["test"]
    advice = read_json(folder / "advice" / "advice.json")
    config, made = run["config"], data["config"]
    names = [record["name"] for record in data["anatomies"]]
    counts = {split: data["splits"].get(split, 0) for split in ("train", "seen_test", "calibrate", "test")}
    per = made["sequences"]
    atlas_seed = names[0].split("-")[1]
    rate = config["learning_rate"]
    tip = metrics["tip"]
    return CARD.format(
        device=run["device"]["name"],
        patients=len(names),
        atlas_seed=atlas_seed,
        train=(counts["train"] + counts["seen_test"]) // per,
        calibrate=counts["calibrate"] // per,
        test=counts["test"] // per,
        sequences=per,
        moving=sum(read_json(folder / "moving" / "meta/manifest.json")["splits"].values()),
        seconds=made["seconds"],
        dataset_seed=made["seed"],
        episodes=run["episodes"]["train"],
        held=run["episodes"]["seen_test"],
        friction=made["friction"],
        stiffness=made["tip_stiffness_factor"],
        seed=config["seed"],
        epochs=config["epochs"],
        rate=rate,
        steps=config["batch_size"],
        hours=sum(network["seconds"] for network in run["networks"].values()) / 3600,
        processor=run["machine"]["processor"],
        parameters=" and ".join(str(network["parameters"]) for network in run["networks"].values()),
        version=run["versions"]["endopilot"],
        commands=recipe() + "\npython docs/figures/pretrained.py runs/causal",
        evaluated=metrics["episodes"],
        n_test=len(metrics["anatomies"]),
        ours=_cells(tip["P1"]),
        held_slack=_cells(tip["hold_slack"]),
        skill_abscissa=tip["P1"]["abscissa"]["all"]["skill"]["hold_slack"],
        skill_offset=tip["P1"]["offset"]["all"]["skill"]["hold_slack"],
        p3=tip["P3"]["abscissa"]["all"]["mae"],
        p4=tip["P4"]["abscissa"]["all"]["mae"],
        p4_replanned=tip["P4_replanned"]["abscissa"]["all"]["mae"],
        calibrated=advice["calibration"]["anatomies"],
        advised=advice["coverage"]["patients"],
        level=advice["calibration"]["level"],
        coverage=100 * advice["coverage"]["simultaneous"],
        missed=100 * advice["adviser"]["missed_share"],
        exposures=advice["adviser"]["exposures_per_minute"],
        share=advice["share_of_the_exposures_of_periodic_imaging"],
        offset_share=advice["calibration"]["offset_share"],
    )


def _cells(series: dict[str, Any]) -> str:
    spans = ("0-10", "10-30", "30-45")
    errors = [
        " ".join(f"{series[name][span]['mae']:.3f} ({series[name][span]['median']:.3f})" for span in spans)
        for name in ("abscissa", "offset")
    ]
    return " | ".join([*errors, f"{series['offset_off_wall']['mae']:.3f}"])


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    text = card(folder)
    PACKAGED.mkdir(exist_ok=True)
    for name in FILES:
        shutil.copyfile(folder / "seed-0" / name, PACKAGED / name)
    (PACKAGED / "MODEL_CARD.md").write_text(text, encoding="utf-8")
