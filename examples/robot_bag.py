"""A robot's log as a ROS 2 bag: `python examples/robot_bag.py log.csv log_bag`, after `pip install 'endopilot[ros]'`.

The bag has topics and messages as laboratories have them: /drive/cmd (TwistStamped) or /drive/goal (JointState),
/joint_states (JointState with the joints slide and roll), /tracker/tip (PointStamped) and /episode (Int32)::

    endopilot replay log_bag --topics command=/drive/cmd encoder=/joint_states:slide,roll tip=/tracker/tip ...
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import endopilot


def write_bag(table: dict[str, np.ndarray], path: Path) -> None:
    """Write the columns of a log into a new folder, in SI units."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    new, types = store.types, {"/drive/cmd": "geometry_msgs/msg/TwistStamped", "/episode": "std_msgs/msg/Int32"}
    types |= {"/joint_states": "sensor_msgs/msg/JointState", "/drive/goal": "sensor_msgs/msg/JointState"}
    types |= {"/tracker/tip": "geometry_msgs/msg/PointStamped"}
    vector, empty = new["geometry_msgs/msg/Vector3"], np.zeros(0)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {name: bag.add_connection(name, kind, typestore=store) for name, kind in types.items()}

        def say(topic: str, at: int, *parts: object) -> None:
            stamp = new["builtin_interfaces/msg/Time"](*divmod(at, 10**9))
            header = () if topic == "/episode" else (new["std_msgs/msg/Header"](stamp, "lps"),)
            bag.write(topics[topic], at, store.serialize_cdr(new[types[topic]](*header, *parts), types[topic]))

        for row, seconds in enumerate(table["time_s"]):
            at = round(1e9 * (1000.0 + seconds))
            is_there = {name: np.isfinite(values[row]) for name, values in table.items()}
            if row == 0 or table["episode"][row] != table["episode"][row - 1]:
                say("/episode", at, int(table["episode"][row]))
            if is_there.get("translation_mm_s"):
                speed = vector(table["translation_mm_s"][row] / 1000, 0.0, 0.0)
                spin = vector(table["rotation_rad_s"][row], 0.0, 0.0)
                say("/drive/cmd", at, new["geometry_msgs/msg/Twist"](speed, spin))
            if is_there.get("translation_mm"):
                place = np.array([table["translation_mm"][row] / 1000, table["rotation_rad"][row]])
                say("/drive/goal", at, ["slide", "roll"], place, empty, empty)
            if is_there.get("encoder_mm"):
                place = np.array([table["encoder_rad"][row], table["encoder_mm"][row] / 1000])
                say("/joint_states", at, ["roll", "slide"], place, empty, empty)
            if is_there.get("tip_x_mm"):
                tip = [float(table[f"tip_{axis}_mm"][row]) / 1000 for axis in "xyz"]
                say("/tracker/tip", at, new["geometry_msgs/msg/Point"](*tip))


def main(log: Path, bag: Path) -> None:
    """Write a bag of a CSV file, and read it again."""
    import pandas as pd

    table = pd.read_csv(log)
    write_bag({name: table[name].to_numpy(dtype=float) for name in table}, bag)
    command = "/drive/cmd" if "translation_mm_s" in table else "/drive/goal"
    topics = [f"command={command}", "encoder=/joint_states:slide,roll", "tip=/tracker/tip"]
    read = endopilot.read_log(bag, topics=topics)
    assert read.seen.sum() == endopilot.read_log(log).seen.sum()
    print(f"{bag}: {len(read)} messages, {read.commanded.sum()} commands")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
