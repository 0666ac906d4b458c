"""A session as an episode of a data set: what a person did, beside simulated navigations, to learn from."""

from __future__ import annotations

from pathlib import Path

from endopilot.anatomy.io import write_anatomy
from endopilot.cockpit.recording import read_session, replayed
from endopilot.dataset.generate import write_episode
from endopilot.errors import InputError
from endopilot.tasks.navigation import DECISION_PERIOD_S


def write_session_episode(session: str | Path, *, output: str | Path) -> None:
    """Write a recorded session as a data set of one episode. `endopilot train` reads that of a wire alone.

    The session is driven again and sampled every 0.5 s; what is left after the last whole sample is dropped. The vessel
    of a task is written beside the episode, into `OUTPUT-anatomy`.

    Args:
        session: a recording of the cockpit.
        output: folder of the data set.

    Raises:
        InputError: no such session, one shorter than a sample, or an output folder that holds
            something else.
    """
    session, output = Path(session), Path(output)
    recording = read_session(session)
    per_sample = round(DECISION_PERIOD_S / recording.config.cycle_s)
    samples = recording.cycles // per_sample
    if samples == 0:
        raise InputError(f"{session}: lasts less than {DECISION_PERIOD_S:g} s; drive for longer")
    targets = [event["target"] for event in recording.events if "target" in event]
    navigation, reality = recording.navigation, recording.reality
    *_, (world, _events) = replayed(recording)
    cycles = world.loop.robot.recorder.trajectory().samples(slice(samples * per_sample))
    folder = recording.where.patient
    if folder is None:
        folder = output.with_name(f"{output.name}-anatomy")
        write_anatomy(navigation.anatomy, output=folder)
    target = targets[-1] if targets else [navigation.target.branch, navigation.target.abscissa]
    write_episode(
        cycles.every(per_sample),
        folder,
        output,
        navigation.stack,
        task="navigation by hand",
        tip_stiffness_factor=reality.tip_stiffness_factor,
        seed=recording.seed,
        origin={"session": session.name, "target_branch": int(target[0]), "target_mm": float(target[1])},
    )
