"""Offline data sets of the ladder, for LeRobot (with images) and Minari: of the agent, of `cloned`, of random motions.

    python examples/offline_sets.py runs/offline --patients 2
    python examples/offline_sets.py runs/offline --tasks straight descending --policies cloned random

Each policy drives the same tasks, in patients that are drawn for it by `--drawn`: none of the ladder's own, in which
learned policies are scored. FOLDER/POLICY is what LeRobot reads, FOLDER/POLICY/minari/data what Minari reads, README.md
the card. An interrupted run goes on. A line of JSON is printed for each set: the SHA-256 of its data, its size, the
share of safe successes and the normalised score: 0 for random motions and 100 for the agent, as D4RL has it (Fu et al.,
arXiv 2004.07219).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather
from gymnasium.spaces import Box

from endopilot.anatomy.projection import TipProjector
from endopilot.dataset import parquet
from endopilot.env.exposures import Exposed
from endopilot.env.observation import RouteTables, observe_exposed, space
from endopilot.env.vector import ROTATION_RAD_S, TRANSLATION_MM_S
from endopilot.files import input_hash, write_json, writing
from endopilot.ladder.attempt import Recording, begun, navigation_seed
from endopilot.ladder.demonstrations import write_demonstrations
from endopilot.ladder.ladder import LadderConfig, climb
from endopilot.ladder.submission import SUBMISSION_FILE, read_submission
from endopilot.ladder.table import terms_in_words
from endopilot.navigation.policy import Decision, Observation
from endopilot.navigation.record import NavigationRecord
from endopilot.tasks.navigation import Navigation

POLICIES = {"agent": "agent", "cloned": "cloned", "random": f"{Path(__file__).resolve()}:Random"}
MINARI = "minari/data"
_MM_S, _RAD_S, _EXPOSES = (-6.0, 12.0), (-3.0, 3.0), 0.1
"""Velocities of random motions, and the share of decisions that expose; pushes prevail, or none gets far."""


class Random:
    """Drives at random."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Draw from a seed, whatever the navigation."""
        self._random = np.random.default_rng(seed)

    def decide(self, observation: Observation) -> Decision:
        """Draw the wire's velocities, and whether to expose."""
        drawn = self._random.uniform(*_MM_S), self._random.uniform(*_RAD_S)
        return Decision((drawn,), expose=self._random.random() < _EXPOSES)


def write_minari(submission: Path, folder: Path, name: str) -> None:
    """Drive the navigations of a submission again, and write them as Minari (0.5 and later, Apache Arrow) reads them.

    Observations are those of `observation="xray"`, actions its actions, at each decision, two a second; the reward is 1
    at a safe success.
    """
    read, steps, number = read_submission(submission), 0, 0
    tasks = [read.terms.task(task) for task in read.navigations]
    for task in tasks:
        for place, entry in enumerate(read.navigations[task.name]):
            navigation = task.ladder_navigation(place)
            recording = Recording.unpacked(vars(entry.recording), len(navigation.devices), read.terms)
            loop = begun(recording, navigation, seed=navigation_seed(task, place))
            steps += write_episode(folder, number, navigation, loop.run())
            number += 1
    (catheters,) = {int(task.catheter is not None) for task in tasks}
    done = Box(-10.0, 10.0, (3 + 2 * catheters,), np.float32)  # drives may be faster than an action of 1
    spaces = {"observation_space": space("xray", catheters, (0, 0, 0)), "action_space": done}
    content: dict[str, Any] = {"total_episodes": number, "total_steps": steps, "data_format": "arrow"}
    content |= {of: _serialized(each) for of, each in spaces.items()}
    write_json(folder / "metadata.json", content | {"dataset_id": f"ladder-{name}-v0", "minari_version": ">=0.5.0"})


def write_episode(folder: Path, number: int, navigation: Navigation, record: NavigationRecord) -> int:
    """Write a navigation, and return the number of its decisions."""
    seen, wire = _observed(navigation, record), np.tile([TRANSLATION_MM_S, ROTATION_RAD_S], len(navigation.devices))
    asked = np.where(np.append(record.exposed[1:-1], [False] * 2), 1.0, -1.0)
    count, end = len(seen) - 1, np.arange(len(seen)) == len(seen) - 2
    success, of_itself = record.success and record.safe, record.reason in ("reached", "invalid")
    columns = {
        "observations": seen,
        "actions": np.column_stack([record.control.reshape(len(seen), -1) / wire, asked]),
        "rewards": end * float(success),
        "terminations": end & of_itself,
        "truncations": end & (not of_itself),
    }
    table = {name: _column(values) for name, values in columns.items()}
    table["infos"] = pa.StructArray.from_arrays([_column(end & success)], ["success"])
    with writing(folder / str(number) / "part-0.arrow") as partial:
        pyarrow.feather.write_feather(pa.table(table), partial, compression="uncompressed")
    write_json(folder / str(number) / "metadata.json", {"id": number, "total_steps": count})
    return count


def _observed(navigation: Navigation, record: NavigationRecord) -> np.ndarray:
    proximal = np.concatenate([record.encoders, record.load], axis=-1)
    if record.cycles is not None:  # nobody asks at the end, where the drives measured all the same
        last = [record.cycles.columns[name][0, -1] for name in ("encoders", "load")]
        proximal[-1] = np.concatenate(last, axis=-1)
    found = {at: tip.position for at, tip in enumerate(record.measured) if tip is not None}
    shown = np.array(list(found))[np.searchsorted(list(found), np.arange(len(proximal)), side="right") - 1]
    position = np.array([found[at] for at in shown.tolist()])
    exposed = Exposed(
        count=np.searchsorted(list(found), np.arange(len(proximal)), side="right"),
        time_s=record.time_s[shown],
        encoders=proximal[shown, 0, :2],
        position=position,
        tip=TipProjector(navigation.anatomy.tree, navigation.anatomy.insertion)(position)[:, None],
        image=np.zeros((len(proximal), 0, 0, 0), dtype=np.uint8),
        random=[],
    )
    routes = RouteTables.of([navigation] * len(proximal))
    return observe_exposed(proximal, exposed, routes, record.time_s, record.time_s / navigation.seconds)


def _column(values: np.ndarray) -> pa.Array:
    names = list(map(str, range(values.shape[1]))) if values.ndim > 1 else None
    return parquet.column(values, "float32" if names else str(values.dtype), names)


def _serialized(box: Any) -> str:
    bounds = {"low": box.low.tolist(), "high": box.high.tolist()}
    return json.dumps({"type": "Box", "dtype": str(box.dtype), "shape": list(box.shape)} | bounds)


def write_card(folder: Path, name: str, figures: dict[str, Any], submission: Path) -> None:
    """Write README.md, with the front matter that Hugging Face's hub reads."""
    read = read_submission(submission)
    rows = "".join(f"| {key.replace('_', ' ')} | {value} |\n" for key, value in figures.items())
    text = (
        "---\ntags: [LeRobot, Minari, robotics]\ntask_categories: [robotics]\n---\n"
        f"# The ladder, {name}\n\nNavigations of an endovascular guidewire in endopilot's simulator: "
        f"{terms_in_words(read.key)}. The policy comes from {read.origin}. No patient is real.\n\n"
        f"| figure | value |\n|---|---|\n{rows}\nThis folder is for LeRobot, with X-ray images; `{MINARI}` is for "
        'Minari: observations and actions are those of the environments with `observation="xray"`, two a second, and '
        "the reward is 1 at a safe success.\n"
    )
    with writing(folder / "README.md") as partial:
        partial.write_text(text, encoding="utf-8")


def main() -> None:
    """Make the sets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--policies", nargs="+", choices=list(POLICIES), default=list(POLICIES))
    parser.add_argument("--tasks", nargs="+", default=())
    parser.add_argument("--patients", type=int, default=2)
    given, safe, sets = parser.parse_args(), dict[str, float](), dict[str, dict[str, Any]]()
    for name in given.policies:
        run, folder = given.folder / "runs" / name, given.folder / name
        config = LadderConfig(
            policy=POLICIES[name], tasks=tuple(given.tasks), patients=given.patients, drawn="offline sets"
        )
        done = climb(output=run, config=config)
        made = write_demonstrations(run / SUBMISSION_FILE, output=folder)
        write_minari(run / SUBMISSION_FILE, folder / MINARI, name)
        entries = [one for each in read_submission(run / SUBMISSION_FILE).navigations.values() for one in each]
        safe[name] = float(np.mean([one.success and one.safe for one in entries]))
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        sets[name] = {"episodes": made["episodes"], "decisions": made["samples"], "exposures": made["exposures"]}
        sets[name] |= {"tasks": len({row["task"] for row in done if row["level"] is not None}), "bytes": size}
        sets[name] |= {"safe_success": round(safe[name], 4)}
        hashes = [*input_hash(folder / "data").values(), *input_hash(folder / MINARI).values()]
        sets[name] |= {"sha256 of data": hashes[0], "sha256 of minari": hashes[1]}
    for name, figures in sets.items():
        low, high = safe.get("random"), safe.get("agent")
        if low is not None and high is not None and high > low:
            figures["normalised_score"] = round(100 * (safe[name] - low) / (high - low), 1)
        write_card(given.folder / name, name, figures, given.folder / "runs" / name / SUBMISSION_FILE)
        print(json.dumps({"set": name} | figures))


if __name__ == "__main__":
    main()
