"""ROS bags, written as others write them, are read as the same log in CSV is."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from endopilot.errors import InputError
from endopilot.robot.log import read_log

pytest.importorskip("rosbags", reason="the extra `ros` is not installed")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

WRITE = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "robot_bag.py"))["write_bag"]
TOPICS = ("command=/drive/cmd", "encoder=/joint_states:slide,roll", "tip=/tracker/tip")
TABLE = {
    "time_s": [0.0, 0.1, 0.2, 0.3, 0.4],
    "episode": [3, 3, 3, 4, 4],
    "translation_mm_s": [2.0, np.nan, -1.0, 4.0, 0.0],
    "rotation_rad_s": [0.5, np.nan, 0.0, 0.0, 0.0],
    "encoder_mm": [5.0, 5.2, 5.4, 5.0, np.nan],
    "encoder_rad": [0.0, 0.1, 0.2, 0.3, np.nan],
    "tip_x_mm": [1.0, np.nan, 1.5, 2.0, 2.5],
    "tip_y_mm": [-1.0, np.nan, -1.5, -2.0, -2.5],
    "tip_z_mm": [7.0, np.nan, 7.5, 8.0, 8.5],
}
TABLE = {name: np.array(values, dtype=float) for name, values in TABLE.items()}


def test_a_bag_is_the_log_that_its_table_is(tmp_path) -> None:
    WRITE(TABLE, tmp_path / "bag")
    pd.DataFrame(TABLE).to_csv(tmp_path / "log.csv", index=False)
    log, same = read_log(tmp_path / "bag", topics=TOPICS), read_log(tmp_path / "log.csv")
    assert log.by_velocity
    for name in ("command", "encoders"):
        read, known = getattr(log, name)[:, 0], getattr(same, name)[:, 0]
        read, known = (each[np.isfinite(each[:, 0])] for each in (read, known))
        np.testing.assert_allclose(read, known, atol=1e-6)
    np.testing.assert_allclose(log.tip[log.seen], same.tip[same.seen], atol=1e-9)
    np.testing.assert_allclose(log.time_s[log.seen], same.time_s[same.seen], atol=1e-6)
    assert log.episode[log.seen].tolist() == same.episode[same.seen].tolist() == [3, 3, 4, 4]
    (file,) = (tmp_path / "bag").glob("*.mcap")  # will do without its folder
    np.testing.assert_array_equal(read_log(file, topics=TOPICS).command, log.command)


def test_a_bag_of_ros_1_with_places_and_loads_under_the_usual_names(tmp_path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    new, none = store.types, np.zeros(0)
    with Writer1(tmp_path / "log.bag") as bag:
        drive = bag.add_connection("/command", "sensor_msgs/msg/JointState", typestore=store)
        load = bag.add_connection("/load", "geometry_msgs/msg/Wrench", typestore=store)
        tip = bag.add_connection("/tip", "geometry_msgs/msg/PoseStamped", typestore=store)
        for k in range(3):
            header = new["std_msgs/msg/Header"](k, new["builtin_interfaces/msg/Time"](0, 0), "")
            place = new["geometry_msgs/msg/Point"](0.001 * k, 0.002, 0.003)
            pose = new["geometry_msgs/msg/Pose"](place, new["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
            vector = new["geometry_msgs/msg/Vector3"]
            for connection, message in (
                (drive, new[drive.msgtype](header, list("abcd"), np.array([0.01 * k, 0.2, 0.03, 0.4]), none, none)),
                (load, new[load.msgtype](vector(0.0, 0.0, 0.5), vector(0.0, 0.0, -0.002))),
                (tip, new[tip.msgtype](header, pose)),
            ):
                bag.write(connection, 10**9 * (5 + k), store.serialize_ros1(message, connection.msgtype))
    log = read_log(tmp_path / "log.bag")
    np.testing.assert_allclose(log.command[log.commanded], [[[10 * k, 0.2], [30, 0.4]] for k in range(3)])
    np.testing.assert_allclose(log.load[np.isfinite(log.load[:, 0, 0]), 0], [[0.5, -2.0]] * 3)
    np.testing.assert_allclose(log.tip[log.seen], [[k, 2, 3] for k in range(3)])
    assert log.time_s.max() == 2.0 and not log.by_velocity  # without stamps, by the bag's clock


@pytest.mark.parametrize(
    ("topics", "said"),
    [
        (
            (),
            r"which topic commands the drive\? Give --topics command=TOPIC, of .*/drive/cmd \(TwistStamped\)",
        ),
        (("command=/no",), r"topics: 'command=/no'; give command, encoder, .*=TOPIC, of the topics "),
        (("speed=/drive/cmd",), r"topics: 'speed=/drive/cmd'; give command, "),
        (("command=/joint_states:slide,turn",), r"/joint_states: has no joint turn \(roll, slide\); name others"),
        (("command=/joint_states:slide",), r"command: 1 numbers in a message; give 2 for each device"),
        (("command=/tracker/tip",), r"give a topic that holds the numbers of a geometry_msgs/msg/PointStamped"),
    ],
)
def test_what_a_bag_lacks_is_said_in_a_line(tmp_path, topics, said) -> None:
    WRITE(TABLE, tmp_path / "bag")
    with pytest.raises(InputError, match=said):
        read_log(tmp_path / "bag", topics=topics)


def test_a_twist_along_two_axes_and_a_file_that_is_no_bag_are_refused(tmp_path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topic, vector = "geometry_msgs/msg/Twist", store.types["geometry_msgs/msg/Vector3"]
        twist = store.types[topic](vector(0.1, 0.0, 0.2), vector(0.0, 0.0, 0.0))
        connection = bag.add_connection("/command", topic, typestore=store)
        bag.write(connection, 1, store.serialize_cdr(twist, topic))
    with pytest.raises(InputError, match="/command: moves along several axes"):
        read_log(tmp_path / "bag")
    (tmp_path / "log.mcap").write_bytes(b"time_s,translation_mm\n0,1\n")
    with pytest.raises(InputError, match="no ROS bag that can be read"):
        read_log(tmp_path / "log.mcap")
