"""Bags, LeRobot data sets, HDF5 and MAT 7.3: the table that CSV gives, bit for bit."""

import dataclasses
import importlib
import sys

import h5py
import numpy as np
import polars as pl
import pytest
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import jaxid as jid
from jaxid import units
from jaxid.measurement.columns import Columns
from jaxid.measurement.reading import read_recording

JOINTS = ("shoulder", "elbow", "wrist")
SAMPLES = 40
START = 1_700_000_000_123_456_789
STEP = 2_000_000
BY_PLACE = Columns("/js.position[{}]", "/js.effort[{}]", "/js.velocity[{}]")
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
STATE = "control_msgs/msg/JointTrajectoryControllerState"
ROS2.register(
    get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\n"
        "trajectory_msgs/JointTrajectoryPoint actual\ntrajectory_msgs/JointTrajectoryPoint output",
        STATE,
    )
)


def by_name(group):
    return tuple(f"/js.{group}.{joint}" for joint in JOINTS)


def numbers(shift=0):
    """Return angles, velocities and efforts; equal at equal times."""
    rng = np.random.default_rng(7)
    return [rng.normal(size=(SAMPLES, 3)) + shift for _ in range(3)]


def header(store, time):
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(int(time), 10**9))
    kind = store.types["std_msgs/msg/Header"]
    sequence = {"seq": 0} if store is ROS1 else {}
    return kind(**sequence, stamp=stamp, frame_id="base")


def joint_state(store, time, names, *values):
    kind = store.types["sensor_msgs/msg/JointState"]
    return kind(header(store, time), list(names), *(np.array(x, np.float64) for x in values))


def states(store, shuffled=False, joints=JOINTS, lag=0, topic="/js", start=0, stop=SAMPLES):
    """Return messages as (topic, time of recording, message)."""
    rng, messages = np.random.default_rng(1), []
    for k, row in enumerate(zip(*numbers(), strict=True)):
        order = rng.permutation(3) if shuffled and k else np.arange(3)
        stamp = START + k * STEP
        names = [joints[j] for j in order]
        message = joint_state(store, stamp + lag, names, *(x[order] for x in row))
        messages.append((topic, stamp + 5_000_000 + (k % 3) * 100_000, message))
    return messages[start:stop]


def write_ros1(path, messages):
    with rosbag1.Writer(path) as writer:
        connections = {}
        for topic, time, message in sorted(messages, key=lambda x: x[1]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(connections[topic], time, ROS1.serialize_ros1(message, kind))
    return path


def write_ros2(path, messages, plugin=rosbag2.StoragePlugin.SQLITE3):
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, time, message in sorted(messages, key=lambda x: x[1]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], time, ROS2.serialize_cdr(message, kind))
    return path


def write_mcap(path, messages):
    with path.open("wb") as file:
        writer, channels = McapWriter(file), {}
        writer.start(profile="ros2")
        for topic, time, message in sorted(messages, key=lambda x: x[1]):
            kind = message.__msgtype__
            if topic not in channels:
                text, _ = ROS2.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(ROS2.serialize_cdr(message, kind))
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


WRITERS = {
    "a.bag": (write_ros1, ROS1),
    "sqlite": (write_ros2, ROS2),
    "mcap": (lambda *x: write_ros2(*x, rosbag2.StoragePlugin.MCAP), ROS2),
    "a.mcap": (write_mcap, ROS2),
}


def check(recording, values=None, step=STEP * 1e-9):
    angles, velocities, forces = numbers() if values is None else values
    np.testing.assert_array_equal(recording.angles, angles)
    np.testing.assert_array_equal(recording.velocities, velocities)
    np.testing.assert_array_equal(recording.forces, forces)
    assert recording.sample_time == pytest.approx(step, rel=1e-12)
    assert recording.notes == ()


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("kind", list(WRITERS))
def test_bags_of_all_kinds(tmp_path, kind, shuffled):
    write, store = WRITERS[kind]
    path = write(tmp_path / kind, states(store, shuffled))
    check(read_recording(path, BY_PLACE))
    names = Columns(by_name("position"), by_name("effort"), by_name("velocity"))
    check(read_recording(path, names))
    whole = Columns("/js.position", "/js.effort", "/js.velocity", time="/js.header.stamp")
    check(read_recording(path, whole))
    late = read_recording(path, dataclasses.replace(BY_PLACE, time="/js.log_time"))
    np.testing.assert_array_equal(late.segments, [(0, SAMPLES)])
    assert late.notes  # the times of recording jitter
