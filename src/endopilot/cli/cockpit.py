"""`endopilot cockpit` and `drive`: a wire in a browser, driven by hand or by a policy; a simulated drive over TLS."""

from __future__ import annotations

import asyncio
import time
import webbrowser
from pathlib import Path
from typing import Annotated

from endopilot.devices.device import read_wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import ASSUMED, read_robot
from endopilot.errors import InputError
from endopilot.extras import require_extras
from endopilot.runs import Existing, Place
from endopilot.settings import CountOrZero, Finite, Text, Within, settings


@settings
class ListenConfig:
    """Where a server listens."""

    host: Text = "127.0.0.1"
    """Address to listen on; by default only this machine can connect. 0.0.0.0 or :: for all addresses of this
    machine."""
    port: Annotated[int, Within(0, 65535)] = 0
    """TCP port; 0 for a free one."""


def cockpit_command(
    patient: Existing | None = None,
    /,
    *,
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    robot: str | None = None,
    task: str | None = None,
    world: CountOrZero = 0,
    replay: Existing | None = None,
    episode: Path | None = None,
    film: Annotated[Path, Place("file")] | None = None,
    resume: Existing | None = None,
    ct: Existing | None = None,
    igtl: Annotated[int, Within(0, 65535)] | None = None,
    output: Path = Path("runs/cockpit"),
    browser: bool = True,
    listen: ListenConfig = ListenConfig(),
) -> None:
    """Open a web page on this machine in which a wire, alone or in catheters, is driven by hand or by a policy.

    No medical device.

    Args:
        patient: folder made by `endopilot anatomy` or `endopilot atlas`; a synthetic one if nothing is given.
        robot: name of a robot (docs/concepts/robot.md) or a YAML file that drives them; `assumed` if not given.
        task: task of the ladder to drive by hand, with X-ray as the only sight until the end.
        world: which patient of the task, world of the trajectory, or episode of the data set.
        replay: session, trajectory (.npz), folder of a plan, navigation or data set, or file of the ladder to look at
            instead.
        episode: with --replay SESSION: write the session into this folder as a data set of one episode to train on, and
            leave.
        film: with --replay: write the lines of the devices into this file for 3D Slicer, their motion (.seq.mrb) or
            their path at the end (.vtp), and leave.
        resume: go on with the session in this file, which a killed server left.
        ct: CT angiogram of the patient, for the X-ray's background; a phantom's if not given.
        igtl: TCP port of this machine at which 3D Slicer (OpenIGTLink) gets wire, tip, target and vessel, 18944 as a
            rule; 0 for a free one.
        output: folder of the sessions' recordings.
        browser: open the page in a browser; --no-browser only prints its address.
        listen: the page's address; whoever is given it, token included, can then drive.
    """
    for name, written in (("episode", episode), ("film", film)):
        if written is not None and replay is None:
            raise InputError(f"{name}: nothing is replayed; give --replay too")
    if replay is not None and episode is not None:
        from endopilot.cockpit.recording import write_session_episode

        write_session_episode(replay, output=episode)
        print(f"episode    {episode}")
        return
    if replay is not None and film is not None:
        from endopilot.cockpit.film import open_film, write_film

        write_film(open_film(replay, patient, world=world, task=task), film)
        print(f"film       {film}")
        return
    require_extras("cockpit")
    from endopilot.cockpit.open import open_replay, open_session, open_task, resume_session
    from endopilot.cockpit.server import serve

    if catheter and (replay is not None or task is not None or resume is not None):
        raise InputError("catheter: a replay, a task and a session have theirs; leave it out")
    if robot is not None and (replay is not None or resume is not None):
        raise InputError("robot: a replay and a session have theirs; leave it out")
    drives = read_robot(robot or ASSUMED)
    if replay is not None:
        opened = open_replay(replay, patient, world=world, task=task, ct=ct)
    elif task is not None:
        opened = open_task(task, world, robot=drives, output=output)
    elif resume is not None:
        opened = resume_session(resume, ct=ct)
    else:
        opened = open_session(patient, device=device, catheters=catheter, robot=drives, ct=ct, output=output)

    stage = opened.stage
    if igtl is not None:
        require_extras("slicer")
        from endopilot.cockpit.igtl import Streamed

        stage = Streamed(opened.stage, opened.scene, igtl)
        print(f"slicer     127.0.0.1:{stage.port} (OpenIGTLink)", flush=True)

    def listening(address: str) -> None:
        print(f"page       {address}", flush=True)
        if opened.recording is not None:
            print(f"recording  {opened.recording}", flush=True)
        if browser:
            webbrowser.open(address)

    serve(stage, opened.scene, cycle_s=opened.cycle_s, host=listen.host, port=listen.port, listening=listening)


def drive_command(
    *,
    certificates: Path,
    device: str = "workhorse-014",
    travel_mm: tuple[Finite, Finite] = (0.0, 300.0),
    listen: ListenConfig = ListenConfig(port=7345),
    robot: str = ASSUMED,
) -> None:
    """Run a simulated robotic drive until Ctrl-C, over TLS (docs/concepts/drive-protocol.md). No medical device.

    Args:
        certificates: folder with drive.key, drive.crt and client.crt; docs/concepts/drive-protocol.md makes them.
        device: name of a device (`endopilot devices`) or a YAML file; it sets the speed limits.
        travel_mm: least and largest inserted length, mm.
        listen: the drive's address.
        robot: name of a robot (docs/concepts/robot.md) or a YAML file: latency, accelerations and noise.
    """
    from endopilot.robot.drive import Drive, serve, tls_context  # slow to import

    wire = read_wire(device)
    limits = DriveLimits(
        max_velocity_mm_s=wire.max_velocity_mm_s, max_rotation_rad_s=wire.max_rotation_rad_s, travel_mm=travel_mm
    )
    context = tls_context(certificates, of_drive=True)
    low, high = travel_mm
    drive = Drive(limits, now=time.monotonic(), config=read_robot(robot), inserted_length=min(max(low, 0.0), high))
    asyncio.run(serve(drive, context, listen.host, listen.port, lambda line: print(line, flush=True)))
