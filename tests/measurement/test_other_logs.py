"""Bags, LeRobot data sets, HDF5 and MAT 7.3: the table that CSV gives, bit for bit."""

import dataclasses
import importlib
import io
import sys
import zipfile
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.io import savemat

from jaxid import units
from jaxid.measurement.columns import Columns
from jaxid.measurement.log_files import READERS, open_log_file
from jaxid.measurement.reading import read_recording

ROOT = Path(__file__).resolve().parents[2]
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
        "trajectory_msgs/JointTrajectoryPoint "
        "actual\ntrajectory_msgs/JointTrajectoryPoint output",
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
    return kind(
        header(store, time), list(names), *(np.array(x, np.float64) for x in values)
    )


def states(
    store, shuffled=False, joints=JOINTS, lag=0, topic="/js", start=0, stop=SAMPLES
):
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


def write_mcap(path, messages, undefined=None):
    with path.open("wb") as file:
        writer, channels = McapWriter(file), {}
        writer.start(profile="ros2")
        for topic, time, message in sorted(messages, key=lambda x: x[1]):
            kind = message.__msgtype__
            if topic not in channels:
                text, _ = ROS2.generate_msgdef(kind, ros_version=2)
                written = (
                    ("", b"") if topic == undefined else ("ros2msg", text.encode())
                )
                schema = writer.register_schema(kind, *written)
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
    assert recording.notes == (), "let stamps in floats count from zero"


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("kind", list(WRITERS))
def test_bags_of_all_kinds(tmp_path, kind, shuffled):
    write, store = WRITERS[kind]
    path = write(tmp_path / kind, states(store, shuffled))
    check(read_recording(path, BY_PLACE))
    names = Columns(by_name("position"), by_name("effort"), by_name("velocity"))
    check(read_recording(path, names))
    whole = Columns(
        "/js.position", "/js.effort", "/js.velocity", time="/js.header.stamp"
    )
    check(read_recording(path, whole))
    late = read_recording(path, dataclasses.replace(BY_PLACE, time="/js.log_time"))
    np.testing.assert_array_equal(late.segments, [(0, SAMPLES)])
    assert late.notes  # the times of recording jitter


def refused(path, columns, *parts):
    with pytest.raises(ValueError) as caught:
        read_recording(path, columns)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith((".", "?"))
    for part in parts:
        assert part in message, message


def test_unknown_topics_and_fields_list_what_there_is(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", states(ROS2) + states(ROS2, topic="/other"))
    listed = (
        "`/js.position[{}]`",
        "`/js.effort.wrist`",
        "`/other.position[{}]`",
        "`/js.log_time`",
    )
    refused(
        path,
        Columns("/joints.position[{}]", "/js.effort[{}]"),
        "`/joints.position",
        *listed,
    )
    refused(
        path, Columns("/js.positions[{}]", "/js.effort[{}]"), "`/js.positions", *listed
    )
    refused(
        path,
        Columns("/js.position.hand", "/js.effort.wrist"),
        "`/js.position.hand`",
        *listed,
    )


@pytest.mark.parametrize("field", ["{}[{{}}]", "{}"])
@pytest.mark.parametrize("order", [(2, 0, 1), (1, 0, 2), (0, 1, 2)])
def test_arrays_are_read_in_the_order_that_messages_state(tmp_path, field, order):
    """Also where a gripper stands between the joints of the robot."""
    messages = []
    for k, row in enumerate(zip(*numbers(), strict=True)):
        names = [*(JOINTS[j] for j in order[:2]), "gripper", JOINTS[order[2]]]
        values = [np.insert(x[list(order)], 2, 9.0) for x in row]
        stamp = START + k * STEP
        messages.append(("/js", stamp, joint_state(ROS2, stamp, names, *values)))
    path = write_mcap(tmp_path / "a.mcap", messages)
    groups = [field.format(f"/js.{x}") for x in ("position", "effort", "velocity")]
    r = read_recording(path, Columns(*groups, joint_names=JOINTS))
    check(dataclasses.replace(r, notes=()))
    (note,) = r.notes
    assert f"the joints {', '.join(names)} in this order" in note
    assert "`/js.position.{name}`" in note
    others = ("a1", "a2", "a3", "a4")
    r = read_recording(path, Columns(*groups, joint_names=others))
    assert r.joints == 4
    assert "read by place" in r.notes[0]


def test_two_robots_on_one_topic_are_told_apart(tmp_path):
    hand = states(ROS2, joints=("thumb", "index", "palm"), lag=900_000)
    mixed = write_mcap(tmp_path / "a.mcap", states(ROS2, shuffled=True) + hand)
    refused(
        mixed,
        BY_PLACE,
        "`/js.position[1]`",
        "`/js.position.thumb`",
        "`/js.position.elbow`",
    )
    check(
        read_recording(
            mixed, Columns(by_name("position"), by_name("effort"), by_name("velocity"))
        )
    )


def test_topics_with_other_times_are_interpolated(tmp_path):
    """Forces 0.9 ms later, which begin later, end earlier and pause."""
    others = states(ROS2, topic="/e", lag=900_000, start=2, stop=15)
    others += states(ROS2, topic="/e", lag=900_000, start=25, stop=38)
    path = write_mcap(tmp_path / "a.mcap", states(ROS2) + others)
    r = read_recording(path, Columns("/js.position[{}]", "/e.effort[{}]"))
    assert r.notes[0].startswith(
        "`forces` of joints 1, 2, 3 have their own time stamps"
    )
    assert r.notes[1].startswith("16 of 40 rows of the angles were left out")
    assert r.segments == ((0, 12), (12, 24))
    angles, _, efforts = numbers()
    kept = [*range(3, 15), *range(26, 38)]
    np.testing.assert_array_equal(r.angles, angles[kept])
    expected = [0.45 * efforts[k - 1] + 0.55 * efforts[k] for k in kept]
    np.testing.assert_allclose(r.forces, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(r.time[12] - r.time[0], 23 * 0.002, rtol=1e-12)


def test_topics_that_share_their_times_are_not_interpolated(tmp_path):
    path = write_mcap(
        tmp_path / "a.mcap", states(ROS2) + states(ROS2, True, topic="/e")
    )
    check(
        read_recording(
            path, Columns("/js.position[{}]", "/e.effort", "/e.velocity[{}]")
        )
    )


def test_some_messages_that_a_topic_lost_are_interpolated(tmp_path):
    others = states(ROS2, topic="/e")
    del others[10], others[20]
    path = write_mcap(tmp_path / "a.mcap", states(ROS2) + others)
    r = read_recording(path, Columns("/js.position[{}]", "/e.effort[{}]"))
    angles, _, efforts = numbers()
    np.testing.assert_array_equal(r.angles, angles)
    efforts[10] = 0.5 * (efforts[9] + efforts[11])
    efforts[21] = 0.5 * (efforts[20] + efforts[22])
    np.testing.assert_allclose(r.forces, efforts, atol=1e-9)


def test_topics_without_common_times(tmp_path):
    messages = states(ROS2, stop=20) + states(ROS2, topic="/e", start=21)
    path = write_mcap(tmp_path / "a.mcap", messages)
    refused(path, Columns("/js.position[{}]", "/e.effort[{}]"), "`a.mcap`", "in time")


def trajectory_states():
    kind, point = (
        ROS2.types[STATE],
        ROS2.types["trajectory_msgs/msg/JointTrajectoryPoint"],
    )
    passed = ROS2.types["builtin_interfaces/msg/Duration"](0, 0)
    for k, (q, qd, tau) in enumerate(zip(*numbers(), strict=True)):
        order, none = np.roll(np.arange(3), k), np.zeros(0)
        points = (
            point(q[order], qd[order], none, none, passed),
            point(none, none, none, tau[order], passed),
        )
        time = START + k * STEP
        names = [JOINTS[j] for j in order]
        yield "/js", time, kind(header(ROS2, time), names, *points)


def test_states_of_a_controller(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", trajectory_states())
    fields = "actual.positions", "output.effort", "actual.velocities"
    check(read_recording(path, Columns(*(f"/js.{field}[{{}}]" for field in fields))))
    check(read_recording(path, Columns(*(by_name(field) for field in fields))))


def test_arrays_without_names_and_stamps(tmp_path):
    kind, layout = (
        ROS2.types[f"std_msgs/msg/{x}"]
        for x in ("Float64MultiArray", "MultiArrayLayout")
    )
    rows = zip(*numbers(), strict=True)
    messages = [
        ("/raw", START + k * STEP, kind(layout([], 0), np.concatenate(row)))
        for k, row in enumerate(rows)
    ]
    path = write_mcap(tmp_path / "a.mcap", messages)
    groups = [
        tuple(f"/raw.data[{k}]" for k in range(3 * g, 3 * g + 3)) for g in (0, 2, 1)
    ]
    check(read_recording(path, Columns(*groups)))
    check(read_recording(path, Columns(*groups, sample_time=0.002)))


def test_bags_that_are_cut_or_do_not_define_their_messages(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", trajectory_states())
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:2000])
    refused(tmp_path / "cut.mcap", BY_PLACE, "`cut.mcap`", "damaged")
    messages = [*trajectory_states(), *states(ROS2, topic="/known")]
    path = write_mcap(tmp_path / "a.mcap", messages, undefined="/js")
    refused(path, BY_PLACE, "`a.mcap`", "defines its messages", STATE)
    refused(path, Columns("/known.p", "/known.q"), "`/known.position[{}]`")


def write_lerobot(path, **kinds):
    angles, velocities, forces = numbers()
    pl.DataFrame(
        {
            "observation.state": np.hstack([angles, velocities])
            .astype(np.float32)
            .tolist(),
            "action": forces.astype(np.float32).tolist(),
            "timestamp": np.float32(0.02 * (np.arange(SAMPLES) % 20)),
            "episode_index": np.arange(SAMPLES) // 20,
            "task": ["reach"] * SAMPLES,
        },
        schema_overrides={"timestamp": pl.Float32, **kinds},
    ).write_parquet(path)
    return path


@pytest.mark.parametrize("fixed", [False, True])
def test_lerobot_data_sets(tmp_path, fixed):
    widths = {"observation.state": 6, "action": 3}
    kinds = {
        n: pl.Array(pl.Float32, w) if fixed else pl.List(pl.Float32)
        for n, w in widths.items()
    }
    path = write_lerobot(tmp_path / "episode_000000.parquet", **kinds)
    state = [f"observation.state[{k}]" for k in range(6)]
    for forces in ("action", "action[{}]"):
        r = read_recording(path, Columns(state[:3], forces, state[3:]))
        assert r.segments == ((0, 20), (20, 40))
        for found, values in zip(
            (r.angles, r.velocities, r.forces), numbers(), strict=True
        ):
            np.testing.assert_array_equal(found, values.astype(np.float32))
        # Stamps are in single precision.
        np.testing.assert_allclose(np.diff(r.time[:20]), 0.02, atol=1e-7)
    refused(
        path,
        Columns("observation.stat", "action"),
        "`observation.state[{}]`",
        "`action[{}]`",
    )


def write_hdf5(path, **groups):
    with h5py.File(path, "w") as file:
        for name, array in zip(("q", "dq", "tau"), numbers(), strict=True):
            file[f"arm/{name}"] = array
        file["arm/t"] = START + STEP * np.arange(SAMPLES)
        file.create_dataset("images", (SAMPLES, 480, 640, 3), np.uint8)
        file["note"] = "held"
    return path


def test_hdf5(tmp_path):
    path = write_hdf5(tmp_path / "a.h5")
    clock = {"time": "arm.t", "time_unit": units.NS}
    check(read_recording(path, Columns("arm.q", "arm.tau", "arm.dq", **clock)))
    check(
        read_recording(path, Columns("arm.q[{}]", "arm.tau[{}]", "arm.dq[{}]", **clock))
    )
    some = Columns(("arm.q[2]", "arm.q[0]"), ("arm.tau[2]", "arm.tau[0]"), **clock)
    np.testing.assert_array_equal(
        read_recording(path, some).angles, numbers()[0][:, [2, 0]]
    )
    refused(
        path, Columns("arm.p", "arm.tau", **clock), "`arm.q`", "`arm.q[{}]`", "`arm.t`"
    )
    refused(path, Columns("arm.q", "arm.tau"), "`a.h5`", "`time`", "`sample_time`")


def test_hdf5_with_arrays_that_were_declared_only(tmp_path):
    path = write_hdf5(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        for name in ("spare", "arm/effort"):
            file.create_dataset(name, (400_000_000, 8), "f4", chunks=(1000, 8))
    clock = {"time": "arm.t", "time_unit": units.NS}
    check(read_recording(path, Columns("arm.q", "arm.tau", "arm.dq", **clock)))
    columns = Columns("arm.q", "arm.effort", **clock)
    refused(path, columns, "`arm.effort`", "2.56e+10 bytes", "save it again")
    refused(path, Columns("arm.q", "arm.f", **clock), "`spare`", "`arm.effort`")


def npz_member(path, name, shape, content=b""):
    """Add an array to an NPZ file that declares a shape, whatever its content."""
    header = io.BytesIO()
    kind = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, kind)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.npy", header.getvalue() + content)


def declared_npz(path):
    """Write `effort`, which declares 3e9 numbers, and `zeros`, which hold 1.2e7."""
    write_arrays(path)
    npz_member(path, "effort", (1_000_000_000, 3))
    npz_member(path, "zeros", (4_000_000, 3), bytes(96_000_000))
    return path


def declared_mat(path):
    """Write `effort` and `zeros`, which hold 9e6 numbers of one byte each."""
    content = dict(zip(("q", "dq", "tau"), numbers(), strict=True))
    content["t"] = START + STEP * np.arange(SAMPLES)
    zeros = np.zeros((3_000_000, 3), np.uint8)
    savemat(path, content | {"effort": zeros, "zeros": zeros}, do_compression=True)
    return path


@pytest.mark.parametrize("write", [declared_npz, declared_mat])
def test_arrays_that_hardly_fill_their_file_are_read_only_if_wanted(tmp_path, write):
    name = f"a.{write.__name__.removeprefix('declared_')}"
    path = write(tmp_path / name)
    check(read_recording(path, ARRAYS))
    for array in ("zeros", "effort"):
        for column in (array, f"{array}[{{}}]"):
            columns = dataclasses.replace(ARRAYS, forces=column)
            refused(path, columns, f"`{array}` of `{name}` needs", "save it again")


def test_structures_of_mat_files_that_hardly_fill_their_file(tmp_path):
    path = tmp_path / "a.mat"
    log = {"q": np.zeros((3_000_000, 3)), "t": np.arange(9.0)}
    savemat(path, {"log": log}, do_compression=True)
    columns = Columns("log.q", "log.t", sample_time=0.1)
    refused(path, columns, "`log` of `a.mat` needs", "save it again")


def test_structures_of_mat_files_with_one_name(tmp_path):
    """Signals of a scope of Simulink, and cells."""
    signals = np.empty(2, dtype=[("values", object), ("label", object)])
    angles, velocities, forces = numbers()
    signals[0] = (angles, "q")
    signals[1] = (forces, "tau")
    cells = np.empty(2, object)
    cells[:] = [velocities, forces[:, 0]]
    time = STEP * 1e-9 * np.arange(SAMPLES)
    scope = {"time": time, "signals": signals}
    savemat(tmp_path / "a.mat", {"scope": scope, "cells": cells})
    names = ("scope.signals[0].values", "scope.signals[1].values", "cells[0]")
    check(read_recording(tmp_path / "a.mat", Columns(*names, time="scope.time")))
    columns = Columns("scope.signal", names[1], time="scope.time")
    refused(tmp_path / "a.mat", columns, "`scope.signals[0].values[{}]`")


@pytest.mark.parametrize("format_of_file", [{"format": "4"}, {"do_compression": False}])
def test_large_arrays_that_fill_their_file_are_read(tmp_path, format_of_file):
    path = tmp_path / "a.mat"
    savemat(path, {"q": np.arange(9_000_000.0).reshape(-1, 1)}, **format_of_file)
    angles = open_log_file(path, {"angles": "q"}).arrays["q"]
    np.testing.assert_array_equal(angles[[0, -1]], [0.0, 8_999_999.0])


def test_parquet_columns_that_hardly_fill_their_file(tmp_path):
    path = tmp_path / "a.parquet"
    table = dict.fromkeys(("q", "tau", "t"), np.zeros(5_000_000))
    pl.DataFrame(table).write_parquet(path)
    columns = Columns("q", "tau", time="t")
    refused(path, columns, "`a.parquet` needs 4e+07 bytes", "save it again")


def test_mat_of_version_7_3(tmp_path):
    """Written like MATLAB: transposed arrays, 512 bytes' head, structures as groups."""
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in zip(("q", "dq", "tau"), numbers(), strict=True):
            file[f"log/{name}"] = array.T
            file[f"log/{name}"].attrs["MATLAB_class"] = np.bytes_("double")
        file["t"] = 0.002 * np.arange(SAMPLES)[None, :]
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    check(read_recording(path, Columns("log.q", "log.tau", "log.dq", time="t")))
    check(
        read_recording(
            path, Columns("log.q[{}]", "log.tau[{}]", "log.dq[{}]", time="t")
        )
    )


@pytest.mark.parametrize(("name", "package"), [("a.mcap", "rosbags"), ("a.h5", "h5py")])
def test_missing_packages_and_damaged_files(tmp_path, monkeypatch, name, package):
    path = tmp_path / name
    path.write_bytes(b"damaged" * 20)
    refused(path, BY_PLACE, f"`{name}`", "damaged")
    for module in [
        module for module in sys.modules if module.partition(".")[0] == package
    ]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError):
        importlib.import_module(package)
    refused(path, BY_PLACE, f"`{package}`", 'pip install "jaxid-robotics[logs]"')


def test_turns_are_unwrapped(tmp_path):
    t = 0.01 * np.arange(200)
    angles = np.stack([5 * np.sin(2 * t), 0.3 * t], axis=1)
    wrapped = np.rad2deg((angles + np.pi) % (2 * np.pi) - np.pi)
    np.savez(tmp_path / "a.npz", q=wrapped, tau=angles)
    columns = Columns("q", "tau", sample_time=0.01, angle_unit=units.DEG, unwrap=True)
    found = read_recording(tmp_path / "a.npz", columns).angles
    np.testing.assert_allclose(found, angles, atol=1e-12)


def write_table(path):
    """Write the numbers as text or Parquet."""
    groups = zip(("q", "dq", "tau"), numbers(), strict=True)
    columns = {f"{name}{j}": x[:, j] for name, x in groups for j in range(3)}
    table = pl.DataFrame({"t": START + STEP * np.arange(SAMPLES), **columns})
    if path.suffix == ".parquet":
        table.write_parquet(path)
    else:
        separators = {".csv": ",", ".tsv": "\t", ".txt": " ", ".dat": ";"}
        table.write_csv(path, separator=separators[path.suffix])
    return path


def write_arrays(path):
    """Write the numbers as whole arrays."""
    content = dict(zip(("q", "dq", "tau"), numbers(), strict=True))
    content["t"] = START + STEP * np.arange(SAMPLES)
    if path.suffix == ".npz":
        np.savez(path, **content)
    elif path.suffix == ".mat":
        savemat(path, content)
    else:
        with h5py.File(path, "w") as file:
            file.update(content)
    return path


def write_db3(path):
    (file,) = write_ros2(path.with_suffix(""), states(ROS2)).glob("*.db3")
    return file


TABLE = Columns("q{}", "tau{}", "dq{}", time="t", time_unit=units.NS)
ARRAYS = Columns("q", "tau", "dq", time="t", time_unit=units.NS)
READ_AS = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat"), (write_table, TABLE)),
    ".parquet": (write_table, TABLE),
    **dict.fromkeys((".npz", ".mat", ".h5", ".hdf5"), (write_arrays, ARRAYS)),
    ".mcap": (lambda path: write_mcap(path, states(ROS2)), BY_PLACE),
    ".bag": (lambda path: write_ros1(path, states(ROS1)), BY_PLACE),
    ".db3": (write_db3, BY_PLACE),
}


@pytest.mark.parametrize("suffix", list(READERS))
def test_every_reader_gives_the_table_that_was_written(tmp_path, suffix):
    write, columns = READ_AS[suffix]
    path = write(tmp_path / f"log{suffix}")
    check(read_recording(path, columns))

    file = open_log_file(path, {})
    assert f"`{suffix}`" in (ROOT / "docs" / "data.md").read_text(), "name it there"
    assert len(set(file.names)) == len(file.names) > 3
    assert file.estimated_rows() in (0, pytest.approx(SAMPLES, abs=1))
    refused(path, Columns("hip", columns.forces, sample_time=0.1), "`hip`", path.name)
    (tmp_path / f"cut{suffix}").write_bytes(b"")
    refused(tmp_path / f"cut{suffix}", columns, f"`cut{suffix}`")
