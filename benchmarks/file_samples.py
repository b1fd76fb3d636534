"""Small valid files of everything that `jaxid` reads, and functions that read them.

`SAMPLES` holds them by kind: a function that writes a folder, the file in it that is
damaged, and the function that reads the folder. All numbers are those of `motion()`.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

JOINTS = 3
STEP = 0.01
SAMPLES_OF_LOG = 200

PART = """<mujocoinclude><body name="hand" pos="0 0 .3">
<joint name="j3" axis="0 1 0" range="-1 1" damping=".2"/>
<geom type="mesh" mesh="wedge" mass=".5"/></body></mujocoinclude>"""
MJCF = """<mujoco model="arm"><compiler angle="radian"/>
<asset><mesh name="wedge" file="wedge.stl"/></asset>
<worldbody><body name="upper" pos="0 0 .2"><joint name="j1" axis="0 0 1" range="-2 2"/>
<geom type="capsule" size=".05" fromto="0 0 0 0 0 .3" mass="2"/>
<body name="lower" pos="0 0 .3"><joint name="j2" axis="0 1 0" stiffness="3"/>
<inertial pos="0 0 .1" mass="1" diaginertia=".01 .01 .002"/>
<include file="part.xml"/></body></body></worldbody>
<actuator><motor joint="j1" ctrlrange="-5 5" gear="20"/></actuator>
<equality><joint joint1="j3" active="false"/></equality></mujoco>"""
LINK = """<link name="{name}"><inertial><origin xyz="0 0 .1" rpy="0 0 0"/>
<mass value="2"/><inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/>
</inertial><collision><origin xyz="0 0 .1"/><geometry>{shape}</geometry></collision>
</link>"""
JOINT = """<joint name="j{number}" type="{kind}"><parent link="{parent}"/>
<child link="{child}"/><origin xyz="0 0 .3" rpy="0 .5 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="50" velocity="3"/><dynamics damping=".1"/>
</joint>"""
DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p">
<float_array id="a" count="12">0 0 0 .1 0 0 0 .1 0 0 0 .2</float_array>
<technique_common><accessor source="#a" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 1 2 3 0 3 2</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n">
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
OBJ = """v 0 0 0
v .1 0 0
v 0 .1 0
v 0 0 .2
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""
EXPERIMENT = """[robot]
urdf = "arm.urdf"

[recording]
time = "time"
angles = "q{}"
velocities = "dq{}"
forces = "tau{}"
angle_unit = "rad"

[model]
viscous = true

[limits]
acceleration = [10.0, 10.0, 10.0]

[filter]
kind = "butterworth"
cutoff = 10.0

[collision]
floor = 0.0
boxes = [{ name = "table", centre = [0.9, 0.0, 0.2], size = [0.2, 1.0, 0.4] }]
"""


class Sample(NamedTuple):
    """Files of one kind.

    Attributes:
        target: Name of the file that is damaged.
        write: Writes all files into a folder.
        read: Reads the files in a folder.
        is_text: Whether the file is text.
    """

    target: str
    write: Callable[[Path], None]
    read: Callable[[Path], object]
    is_text: bool = False


def motion() -> dict[str, np.ndarray]:
    """Return the columns of a log by name: time, angles, velocities and torques."""
    time = STEP * np.arange(SAMPLES_OF_LOG)
    columns = {"time": time}
    for symbol, shift in (("q", 0.0), ("dq", 0.5 * np.pi), ("tau", 0.3)):
        for joint in range(1, JOINTS + 1):
            phase = 3.0 * joint * time + shift
            columns[f"{symbol}{joint}"] = np.round(np.sin(phase), 9)
    return columns


def matrices() -> dict[str, np.ndarray]:
    """Return the same numbers as arrays of all joints."""
    columns = motion()
    arrays = {"time": columns["time"]}
    for symbol in ("q", "dq", "tau"):
        joints = [columns[f"{symbol}{j}"] for j in range(1, JOINTS + 1)]
        arrays[symbol] = np.stack(joints, axis=1)
    return arrays


# Logs


def read_columns(name, time="time", pattern="{}{{}}"):
    """Return a function that reads a log with one column for each joint."""

    def read(folder):
        import jaxid as jid

        names = [pattern.format(symbol) for symbol in ("q", "tau", "dq")]
        return jid.read_recording(folder / name, jid.Columns(*names, time=time))

    return read


def scan(name):
    """Return a function that reads a log part by part."""

    def read(folder):
        import jaxid as jid

        columns = jid.Columns("q{}", "tau{}", "dq{}", time="time")
        robot = jid.robots.planar_arm(JOINTS, JOINTS * [0.3])
        smoothing = jid.ZeroPhaseButterworth(10.0)
        return jid.scan_log(folder / name, columns, robot, smoothing, jid.Subsample(5))

    return read


def read_topic(name):
    """Return a function that reads the joint states of a bag."""

    def read(folder):
        import jaxid as jid

        fields = ("position", "effort", "velocity")
        columns = jid.Columns(*(f"/js.{field}[{{}}]" for field in fields))
        return jid.read_recording(folder / name, columns)

    return read


def write_table(name, separator=",", decimal=".", head="", ending="\n"):
    """Return a function that writes a table of text."""

    def write(folder):
        columns = motion()
        rows = [separator.join(columns)]
        for row in np.stack([*columns.values()], axis=1).tolist():
            rows.append(separator.join(map(repr, row)).replace(".", decimal))
        text = head + ending.join(rows) + ending
        (folder / name).write_bytes(text.encode())

    return write


def write_parquet(folder):
    """Write a Parquet file with two groups of rows."""
    import polars as pl

    pl.DataFrame(motion()).write_parquet(folder / "log.parquet", row_group_size=100)


def write_lerobot(folder):
    """Write an episode of a LeRobot data set: lists in cells, and its own clock."""
    import polars as pl

    arrays = matrices()
    state = np.hstack([arrays["q"], arrays["dq"]]).astype(np.float32)
    frame = {
        "observation.state": state.tolist(),
        "action": arrays["tau"].tolist(),
        "timestamp": arrays["time"],
        "episode_index": np.zeros(SAMPLES_OF_LOG, np.int64),
    }
    path = folder / "episode_000000.parquet"
    pl.DataFrame(frame).write_parquet(path)


def read_lerobot(folder):
    """Read a LeRobot data set."""
    import jaxid as jid

    state = tuple(f"observation.state[{k}]" for k in range(2 * JOINTS))
    columns = jid.Columns(state[:JOINTS], "action", state[JOINTS:])
    return jid.read_recording(folder / "episode_000000.parquet", columns)


def write_npz(folder):
    """Write compressed arrays of NumPy."""
    np.savez_compressed(folder / "log.npz", **matrices())


def write_mat(version):
    """Return a function that writes a MAT file of MATLAB's version 4 or 5."""

    def write(folder):
        from scipy.io import savemat

        content = matrices() if version == "4" else {"log": matrices()}
        path = folder / "log.mat"
        savemat(path, content, format=version, do_compression=version == "5")

    return write


def write_hdf5(name):
    """Return a function that writes compressed arrays in HDF5; `.mat` is MATLAB 7.3."""

    def write(folder):
        import h5py

        is_mat = name.endswith(".mat")
        block = 512 if is_mat else 0
        with h5py.File(folder / name, "w", userblock_size=block) as file:
            for key, array in matrices().items():
                values = array.T if is_mat else array
                file.create_dataset(key, data=values, compression="gzip", chunks=True)

    return write


def joint_states(store, is_ros1):
    """Yield times [ns] and messages of the joint states."""
    arrays = matrices()
    types = store.types
    names = [f"j{j}" for j in range(1, JOINTS + 1)]
    sequence = {"seq": 0} if is_ros1 else {}
    for k, time in enumerate(arrays["time"]):
        nanoseconds = 10**18 + round(1e9 * time)
        stamp = types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
        kind = types["std_msgs/msg/Header"]
        header = kind(**sequence, stamp=stamp, frame_id="base")
        values = [arrays[symbol][k] for symbol in ("q", "dq", "tau")]
        yield nanoseconds, types["sensor_msgs/msg/JointState"](header, names, *values)


def write_bag(name, plugin, compression=""):
    """Return a function that writes a bag: `rosbag1`, or a plug-in of ROS 2."""

    def write(folder):
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore

        is_ros1 = plugin == "rosbag1"
        stores = Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE
        store = get_typestore(stores)
        path = folder / name
        if is_ros1:
            writer = rosbag1.Writer(path)
            writer.set_compression(writer.CompressionFormat[compression])
            serialise = store.serialize_ros1
        else:
            storage = rosbag2.StoragePlugin[plugin]
            writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
            serialise = store.serialize_cdr
        kind = "sensor_msgs/msg/JointState"
        with writer:
            connection = writer.add_connection("/js", kind, typestore=store)
            for time, message in joint_states(store, is_ros1):
                writer.write(connection, time, serialise(message, kind))

    return write


def write_single_bag(name, plugin):
    """Return a function that writes a bag of ROS 2 without its `metadata.yaml`."""

    def write(folder):
        write_bag("bag", plugin)(folder)
        (content,) = (folder / "bag").glob("*" + Path(name).suffix)
        content.rename(folder / name)
        shutil.rmtree(folder / "bag")

    return write


# Robots


def write_urdf(name="arm.urdf"):
    """Return a function that writes a URDF with meshes of three formats."""

    def write(folder):
        import trimesh

        files = ("wedge.stl", "wedge.obj", "wedge.dae")
        mesh = '<mesh filename="{}" scale="1 1 1"/>'
        shapes = ['<box size=".2 .2 .2"/>', *map(mesh.format, files)]
        names = ["base", "upper", "lower", "hand"]
        parts = []
        for link, shape in zip(names, shapes, strict=True):
            parts.append(LINK.format(name=link, shape=shape))
        for number, kind in enumerate(("revolute", "prismatic", "continuous"), 1):
            ends = {"parent": names[number - 1], "child": names[number]}
            parts.append(JOINT.format(number=number, kind=kind, **ends))
        text = "\n".join(['<?xml version="1.0"?>', '<robot name="arm">', *parts])
        (folder / name).write_text(f"{text}\n</robot>\n", encoding="utf-8")
        (folder / "wedge.obj").write_text(OBJ, encoding="utf-8")
        (folder / "wedge.dae").write_text(DAE, encoding="utf-8")
        trimesh.load(folder / "wedge.obj").export(folder / "wedge.stl")

    return write


def write_xacro(folder):
    """Write a xacro file; without the program `xacro` it is refused."""
    write_urdf("arm.xacro")(folder)
    path = folder / "arm.xacro"
    prefix = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm">'
    prefix += '<xacro:property name="a" value="1"/>'
    path.write_text(path.read_text().replace('<robot name="arm">', prefix))


def write_mjcf(folder):
    """Write an MJCF file with an included part and a mesh."""
    write_urdf()(folder)
    (folder / "arm.xml").write_text(MJCF, encoding="utf-8")
    (folder / "part.xml").write_text(PART, encoding="utf-8")


def read_robot(name):
    """Return a function that reads a robot: joints, and capsules around its shapes."""

    def read(folder):
        import jaxid as jid

        robot = jid.load_urdf(folder / name)
        shapes = jid.collision.fit_capsules(folder / name)
        template = jid.experiment.write_template(folder / name)
        return robot.summary(), robot.remarks, shapes, template

    return read


# Experiments and results


def write_experiment(folder):
    """Write an experiment with the file of its robot."""
    write_urdf()(folder)
    (folder / "experiment.toml").write_text(EXPERIMENT, encoding="utf-8")


def read_experiment(folder):
    """Load an experiment."""
    import jaxid as jid

    return jid.experiment.load_experiment(folder / "experiment.toml")


def write_model(folder):
    """Write a model that was identified from a log."""
    import jaxid as jid

    robot = jid.robots.planar_arm(2, [0.5, 0.4])
    base = jid.base_parameters(jid.Model(robot))
    rows = np.random.default_rng(0).normal(size=(4, 200, 2))
    fit = jid.identify(base, jid.Observations.of(*rows, sample_time=STEP))
    fit.save(folder / "model.json")


def sign_again(path):
    """Give a damaged model the checksum of its content, as a program would."""
    import hashlib

    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        text = json.dumps(document["model"], sort_keys=True, separators=(",", ":"))
        digest = hashlib.sha256(text.encode()).hexdigest()
        document["checksum"] = f"sha256:{digest}"
        path.write_text(json.dumps(document), encoding="utf-8")
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        pass


def read_model(folder):
    """Read a model, and the same with a right checksum."""
    import jaxid as jid

    try:
        jid.load_fit(folder / "model.json")
    except jid.InputError:
        sign_again(folder / "model.json")
    fit = jid.load_fit(folder / "model.json")
    return fit.summary()


def write_trajectory(folder):
    """Write a trajectory."""
    import jaxid as jid

    robot = jid.robots.planar_arm(2, [0.5, 0.4])
    series = jid.trajectories.random_fourier_series(robot, omega=0.8, seed=1)
    jid.trajectories.save_trajectory(series, folder / "motion.json")


def read_trajectory(folder):
    """Read a trajectory and sample it."""
    import jaxid as jid

    return jid.trajectories.load_trajectory(folder / "motion.json").sample(STEP)


CSV = write_table("log.csv")
URDF = write_urdf()
SAMPLES = {
    "csv": Sample("log.csv", CSV, read_columns("log.csv"), is_text=True),
    "csv, part by part": Sample("log.csv", CSV, scan("log.csv"), is_text=True),
    "text with decimal commas": Sample(
        "log.txt",
        write_table("log.txt", ";", ",", "Rig 3\r\n# 2026-01-05\r\n", "\r\n"),
        read_columns("log.txt"),
        is_text=True,
    ),
    "text with tabs": Sample(
        "log.tsv", write_table("log.tsv", "\t"), read_columns("log.tsv"), is_text=True
    ),
    "text with spaces": Sample(
        "log.dat",
        write_table("log.dat", "   ", head="% "),
        read_columns("log.dat"),
        is_text=True,
    ),
    "parquet": Sample("log.parquet", write_parquet, read_columns("log.parquet")),
    "parquet, part by part": Sample("log.parquet", write_parquet, scan("log.parquet")),
    "lerobot": Sample("episode_000000.parquet", write_lerobot, read_lerobot),
    "npz": Sample("log.npz", write_npz, read_columns("log.npz", pattern="{}")),
    "mat 4": Sample("log.mat", write_mat("4"), read_columns("log.mat", pattern="{}")),
    "mat 5": Sample(
        "log.mat", write_mat("5"), read_columns("log.mat", "log.time", "log.{}")
    ),
    "mat 7.3": Sample(
        "log.mat", write_hdf5("log.mat"), read_columns("log.mat", pattern="{}")
    ),
    "hdf5": Sample(
        "log.h5", write_hdf5("log.h5"), read_columns("log.h5", pattern="{}")
    ),
    "mcap": Sample(
        "log.mcap", write_single_bag("log.mcap", "MCAP"), read_topic("log.mcap")
    ),
    "ros 2 sqlite": Sample(
        "log.db3", write_single_bag("log.db3", "SQLITE3"), read_topic("log.db3")
    ),
    "ros 2 metadata": Sample(
        "bag/metadata.yaml", write_bag("bag", "SQLITE3"), read_topic("bag"), True
    ),
    "ros 1, bz2": Sample(
        "log.bag", write_bag("log.bag", "rosbag1", "BZ2"), read_topic("log.bag")
    ),
    "ros 1, lz4": Sample(
        "log.bag", write_bag("log.bag", "rosbag1", "LZ4"), read_topic("log.bag")
    ),
    "urdf": Sample("arm.urdf", URDF, read_robot("arm.urdf"), is_text=True),
    "xacro": Sample("arm.xacro", write_xacro, read_robot("arm.xacro"), is_text=True),
    "stl": Sample("wedge.stl", URDF, read_robot("arm.urdf")),
    "obj": Sample("wedge.obj", URDF, read_robot("arm.urdf"), is_text=True),
    "dae": Sample("wedge.dae", URDF, read_robot("arm.urdf"), is_text=True),
    "mjcf": Sample("arm.xml", write_mjcf, read_robot("arm.xml"), is_text=True),
    "mjcf, part": Sample("part.xml", write_mjcf, read_robot("arm.xml"), is_text=True),
    "mjcf, mesh": Sample("wedge.stl", write_mjcf, read_robot("arm.xml")),
    "experiment": Sample(
        "experiment.toml", write_experiment, read_experiment, is_text=True
    ),
    "model": Sample("model.json", write_model, read_model, is_text=True),
    "trajectory": Sample(
        "motion.json", write_trajectory, read_trajectory, is_text=True
    ),
}
"""Files of every reader, by kind."""
