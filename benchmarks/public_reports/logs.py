"""Logs as public reports describe them, what a user writes first, and the cures.

    python benchmarks/public_reports/logs.py [--quick] [--json FILE] [--only WORD]

Every report is a function that writes the files of a log of `arm.py` in the form that
the report shows, and a list of attempts: the keys of the experiment file that a user
sets at first, and then those of each cure that is named, followed to the letter. What
counts is the error of the identified model's torques on another motion, over that of
the plain log. Where it is above `MAX_RATIO`, both are the mean of `DRAWS` draws of the
noise: lost rows cost accuracy.
"""

import dataclasses
import datetime
import re
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import timing
from arm import DT, identified, simulate
from timing import Row, hand_over

RANDOM = np.random.default_rng(5)
REPORTS = []
MAX_RATIO = 1.2
MAX_LOSS = 5.0
"""Error over that of the plain log above which a result is wrong, not less accurate."""
DRAWS = 3


@dataclasses.dataclass
class Report:
    """Public report, rebuilt.

    Attributes:
        source: Project and number of the report.
        kind: What is odd about the log.
        write: Function of a folder and a clean log that writes files, and returns
            their paths.
        attempts: Keys of the experiment file: of the first attempt, then of each cure,
            or a function that repairs the files as the words of the first attempt ask,
            and returns paths and keys.
        named: Words of the cure that the first attempt must name; empty if the log is
            read as it is.
        settings: Arguments of `arm.simulate`, for logs of another rate.
    """

    source: str
    kind: str
    write: Callable
    attempts: list
    named: tuple[str, ...] = ()
    settings: dict = dataclasses.field(default_factory=dict)


def report(source, kind, *attempts, named=(), settings=None):
    """Register a function that writes a log as a report."""

    def register(write):
        cures = [*attempts] or [{}]
        REPORTS.append(Report(source, kind, write, cures, named, settings or {}))
        return write

    return register


def text(path, columns, separator=",", head="", form="%.7g"):
    """Write columns as text; those of texts stay as they are."""
    cells = [
        values if np.asarray(values).dtype.kind == "U" else [form % x for x in values]
        for values in columns.values()
    ]
    lines = [separator.join(row) for row in zip(*cells, strict=True)]
    path.write_text("\n".join([head + separator.join(columns), *lines, ""]))
    return path


# Time


def _with_zero_stamps(log):
    """Return a log in ROS time whose first half second has the stamp zero."""
    stamps = 1682000000 + log.t
    stamps[:50] = 0.0
    return stamps


@report("ros2/rosbag2#1276", "stamps are zero until the simulated clock runs")
def zero_stamps(folder, log):
    columns = log.table() | {"time": _with_zero_stamps(log)}
    return [text(folder / "log.csv", columns, form="%.14g")]


def _echo(folder, log):
    """Write `ros2 topic echo --csv`: no header, seconds and nanoseconds apart."""
    ticks = 1748433646_250000000 + np.round(log.t * 1e9).astype(int)
    columns = {
        "sec": (ticks // 10**9).astype(str),
        "nanosec": (ticks % 10**9).astype(str),
    }
    columns |= {"frame": np.full(len(log.t), "", dtype="U9")}
    columns |= {f"name{j}": np.full(len(log.t), f"joint{j}") for j in (1, 2, 3)}
    columns |= {f"p{j + 1}": x for j, x in enumerate(log.q.T)}
    columns |= {f"v{j + 1}": x for j, x in enumerate(log.qd.T)}
    columns |= {f"e{j + 1}": x for j, x in enumerate(log.tau.T)}
    path = text(folder / "log.csv", columns)
    path.write_text(path.read_text().partition("\n")[2])
    return [path]


ECHO = {"angles": "[6, 7, 8]", "forces": "[12, 13, 14]"}
report(
    "MichaelGrupp/evo#725",
    "`ros2 topic echo --csv`: no header; `time` names the seconds alone",
    ECHO | {"time": "0"},
    ECHO | {"time": "[0, 1]"},
    ECHO | {"time": None, "sample_time": "0.01"},
    named=(
        "name both as `time`",
        "`sample_time`",
    ),
)(_echo)
report(
    "MichaelGrupp/evo#725",
    "the same; `time` names the nanoseconds alone",
    ECHO | {"time": "1", "time_unit": '"ns"'},
    ECHO | {"time": None, "sample_time": "0.01"},
    named=("`sample_time`",),
)(_echo)


FIELDS = {
    "angles": '"field.position{}"',
    "forces": '"field.effort{}"',
    "time_unit": '"ns"',
}


@report(
    "ros/ros_comm#330",
    "`%time` in nanoseconds, texts between the numbers (`rostopic echo -p`)",
    FIELDS | {"time": '"%time"'},
    FIELDS | {"time": '"time"'},
    named=("`time`",),
)
def echo_of_ros_1(folder, log):
    ticks = 1423155837_204827070 + np.round(log.t * 1e9).astype(int)
    columns = {
        "time": ticks.astype(str),
        "field.header.seq": np.arange(len(ticks)).astype(str),
    }
    columns |= {"field.header.frame_id": np.full(len(ticks), "", dtype="U9")}
    columns |= {
        f"field.name{j}": np.full(len(ticks), f"joint{j + 1}") for j in range(3)
    }
    columns |= {f"field.position{j}": x for j, x in enumerate(log.q.T)}
    columns |= {f"field.effort{j}": x for j, x in enumerate(log.tau.T)}
    return [text(folder / "log.csv", columns, head="%")]


BAGPY = {"angles": '"position_{}"', "forces": '"effort_{}"'}


@report(
    "jmscslgroup/bagpy#21",
    "`header.stamp.secs`, `header.stamp.nsecs` and a late time of recording",
    BAGPY | {"time": '"Time"'},
    BAGPY | {"time": '["header.stamp.secs", "header.stamp.nsecs"]'},
    BAGPY | {"time": None, "sample_time": "0.01"},
    named=("`sample_time`",),
)
def bagpy(folder, log):
    ticks = 1644150000_100000000 + np.round(log.t * 1e9).astype(int)
    late = ticks * 1e-9 + RANDOM.exponential(2e-4, len(ticks))
    columns = {"Time": np.array([f"{x:.9f}" for x in late])}
    columns |= {"header.seq": np.arange(len(ticks)).astype(str)}
    columns |= {"header.stamp.secs": (ticks // 10**9).astype(str)}
    columns |= {"header.stamp.nsecs": (ticks % 10**9).astype(str)}
    columns |= {"name_0": np.full(len(ticks), "joint1")}
    columns |= {f"position_{j}": x for j, x in enumerate(log.q.T)}
    columns |= {f"effort_{j}": x for j, x in enumerate(log.tau.T)}
    return [text(folder / "log.csv", columns)]


def _coarse(folder, log):
    columns = log.table() | {"time": np.floor(log.t / (10 * DT)) * 10 * DT}
    return [text(folder / "log.csv", columns)]


report(
    "ori-drs/pronto#54",
    "ten rows have the same stamp",
    {},
    {"time": None, "sample_time": "0.01"},
    named=("`sample_time`",),
)(_coarse)


@report(
    "swift-nav/piksi_tools#629",
    "the header says milliseconds, the column holds seconds",
    {"time": '"time [ms]"', "time_unit": '"ms"'},
    {"time": '"time [ms]"', "time_unit": '"s"'},
    named=("`time_unit`",),
)
def wrong_unit_in_the_header(folder, log):
    return [text(folder / "log.csv", log.table(time="time [ms]"))]


def _rounded(folder, log):
    columns = log.table() | {"time": np.array([f"{x:.8e}" for x in 1.6043e9 + log.t])}
    return [text(folder / "log.csv", columns)]


report(
    "viproma/coral#54",
    "stamps since 1970, of which the text keeps nine digits",
    {},
    {"time": None, "sample_time": "0.01"},
    named=("`sample_time`",),
)(_rounded)


def _single(folder, log):
    stamps = (1.707954127e9 + log.t).astype(np.float32)
    np.savez(folder / "log.npz", q=log.q, tau=log.tau, time=stamps)
    return [folder / "log.npz"]


report(
    "timeplus-io/proton#564",
    "stamps since 1970 as float32",
    {"angles": '"q"', "forces": '"tau"'},
    {"angles": '"q"', "forces": '"tau"', "time": None, "sample_time": "0.01"},
    named=("`sample_time`",),
)(_single)


def _date_and_time(folder, log):
    begin = datetime.datetime(2026, 1, 1, 10, 30, 25)
    times = [begin + datetime.timedelta(seconds=float(x)) for x in log.t]
    columns = {
        "Date": np.array([x.strftime("%Y-%m-%d") for x in times]),
        "Time": np.array([x.strftime("%H:%M:%S.%f")[:-3] for x in times]),
    }
    numbers = log.table()
    del numbers["time"]
    return [text(folder / "log.csv", columns | numbers)]


report(
    "PlotJuggler/PlotJuggler#1259",
    "date and time in two columns; time names the time",
    {"time": '"Time"'},
)(_date_and_time)
report(
    "PlotJuggler/PlotJuggler#1259",
    "the same; time names the date",
    {"time": '"Date"'},
    {"time": '"Time"'},
    named=("name one of numbers",),
)(_date_and_time)


def _episodes(folder, log):
    """Write four episodes one below the other, whose time begins at zero each."""
    columns = log.table() | {"time": np.round(log.t % (700 * DT), 6)}
    return [text(folder / "log.csv", columns)]


def _cut(folder, words):
    """Cut the log where the clock was set back."""
    lines = (folder / "log.csv").read_text().splitlines()
    for k in range(4):
        rows = lines[1 + 700 * k : 1 + 700 * (k + 1)]
        (folder / f"log{k}.csv").write_text("\n".join([lines[0], *rows, ""]))
    return [folder / f"log{k}.csv" for k in range(4)], {}


report(
    "unitreerobotics/unitree_lerobot#41",
    "time begins at zero in each of four episodes",
    {},
    _cut,
    {"time": None, "sample_time": "0.01"},
    named=(
        "cut the log there",
        "`sample_time`",
    ),
)(_episodes)


def _jumping(folder, log):
    """Write episodes that begin at other places than the ones before ended."""
    rows = np.concatenate([np.arange(0, 650) + 700 * k for k in range(4)])
    part = log.rows(rows)
    columns = part.table() | {"time": np.round(part.t % (700 * DT), 6)}
    return [text(folder / "log.csv", columns)]


def _cut_episodes(folder, words):
    lines = (folder / "log.csv").read_text().splitlines()
    for k in range(4):
        rows = lines[1 + 650 * k : 1 + 650 * (k + 1)]
        (folder / f"log{k}.csv").write_text("\n".join([lines[0], *rows, ""]))
    return [folder / f"log{k}.csv" for k in range(4)], {}


report(
    "huggingface/lerobot#933",
    "the same; an episode does not go on where the last one ended",
    {},
    _cut_episodes,
    named=("cut the log there",),
)(_jumping)


def _gap_as_named(folder, words):
    gap = re.search(r"`largest_gap` above ([\d.]+)", " ".join(words))[1]
    return [folder / "log.csv"], {"largest_gap": gap}


@report(
    "frankarobotics/franka_ros#355",
    "a third of the messages of 1000 Hz is lost",
    settings={"seconds": 6.0, "dt": 0.001},
)
def lost_messages_at_1000_hz(folder, log):
    return lost_messages(folder, log)


@report(
    "frankarobotics/franka_ros#355",
    "the same at 100 Hz",
    {},
    _gap_as_named,
    named=("`largest_gap` above",),
)
def lost_messages(folder, log):
    is_there = np.random.default_rng(3).random(len(log.t)) > 0.35
    return [text(folder / "log.csv", log.rows(is_there).table())]


# Texts


def _odd_numbers(folder, log):
    path = text(folder / "log.csv", log.table())
    lines = path.read_text().splitlines()
    for row, word in (
        (100, "-1.#IND"),
        (400, "1.#QNAN"),
        (700, "#N/A"),
        (900, "NULL"),
        (1100, "nan"),
    ):
        cells = lines[row].split(",")
        cells[5] = word
        lines[row] = ",".join(cells)
    path.write_text("\n".join([*lines, ""]))
    return [path]


report(
    "equinor/tagreader-python#61, NatLabRockies/SAM#45",
    "`-1.#IND`, `1.#QNAN`, `#N/A`, `NULL`, `nan` in five of 1400 rows",
    {},
    {"bad_rows": "0.0037"},
    named=("`bad_rows`",),
)(_odd_numbers)


@report("mendhak/gpslogger#529", "the header is repeated where a logger restarted")
def repeated_header(folder, log):
    path = text(folder / "log.csv", log.table())
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:700], lines[0], *lines[700:], ""]))
    return [path]


def _restarted(folder, log):
    columns = log.table() | {"time": np.round(log.t % (1400 * DT), 6)}
    path = text(folder / "log.csv", columns)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:1401], lines[0], *lines[1401:], ""]))
    return [path]


def _cut_at_header(folder, words):
    lines = (folder / "log.csv").read_text().splitlines()
    (folder / "a.csv").write_text("\n".join([*lines[:1401], ""]))
    (folder / "b.csv").write_text("\n".join([*lines[1401:], ""]))
    return [folder / "a.csv", folder / "b.csv"], {}


report(
    "keras-team/keras#4426",
    "the header is repeated, and time begins again",
    {},
    _cut_at_header,
    named=("cut the log there",),
)(_restarted)


def _thousands(folder, log):
    """Write torques in mN m, with commas between thousands."""
    columns = log.table()
    for j in range(3):
        columns[f"tau{j + 1}"] = np.array([f'"{x:,.1f}"' for x in 1000 * log.tau[:, j]])
    return [text(folder / "log.csv", columns)]


report(
    "h2oai/datatable#771",
    "commas between thousands, in quotation marks",
    {"force_unit": "0.001"},
)(_thousands)


def _unquoted_thousands(folder, log):
    columns = log.table()
    for j in range(3):
        columns[f"tau{j + 1}"] = np.array([f"{x:,.1f}" for x in 1000 * log.tau[:, j]])
    return [text(folder / "log.csv", columns)]


def _without_thousands(folder, words):
    text(folder / "log.csv", simulate().table())
    return [folder / "log.csv"], {}


report(
    "zodiacon/PoolMonXv3#4",
    "commas between thousands, without quotation marks",
    {"force_unit": "0.001"},
    _without_thousands,
    named=("no commas between thousands",),
)(_unquoted_thousands)


@report("ERGO-Code/HiGHS#1618", "exponents with D, as Fortran writes them")
def fortran(folder, log):
    columns = {
        name: np.array([f"{x:.8E}".replace("E", "D") for x in values])
        for name, values in log.table().items()
    }
    return [text(folder / "log.csv", columns)]


@report(
    "mechatroner/vscode_rainbow_csv#108", "`sep=;` above the header, as Excel has it"
)
def separator_line(folder, log):
    return [text(folder / "log.csv", log.table(), ";", "sep=;\n")]


def _utf16(with_mark):
    def write(folder, log):
        path = text(folder / "log.txt", log.table(), "\t")
        words = path.read_text()
        path.write_bytes(words.encode("utf-16" if with_mark else "utf-16-le"))
        return [path]

    return write


def _to_utf8(folder, words):
    words = (folder / "log.txt").read_bytes().decode("utf-16")
    (folder / "log.txt").write_text(words, encoding="utf-8")
    return [folder / "log.txt"], {}


report(
    "genspark-ai/genoffice#438", "UTF-16 with a mark", {}, _to_utf8, named=("UTF-8",)
)(_utf16(True))
report(
    "genspark-ai/genoffice#438", "UTF-16 without a mark", {}, _to_utf8, named=("UTF-8",)
)(_utf16(False))


def _lists(folder, log):
    columns = {"time": log.t}
    for name, values in (("position", log.q), ("effort", log.tau)):
        columns[name] = np.array(
            ['"[' + ", ".join(f"{x:.7g}" for x in row) + ']"' for row in values]
        )
    return [text(folder / "log.csv", columns)]


def _one_number_in_each_cell(folder, words):
    lines = (folder / "log.csv").read_text().splitlines()
    names = ["time", *(f"{x}[{j}]" for x in ("position", "effort") for j in range(3))]
    rows = [re.sub(r'[\[\]" ]', "", line) for line in lines[1:]]
    (folder / "log.csv").write_text("\n".join([",".join(names), *rows, ""]))
    return [folder / "log.csv"], {"angles": '"position"', "forces": '"effort"'}


report(
    "AI4EPS/PhaseNet#9",
    "lists in one cell, as pandas writes them",
    {"angles": '"position"', "forces": '"effort"'},
    _one_number_in_each_cell,
    named=("one number in each cell",),
)(_lists)


@report(
    "autosportlabs/RaceCapture-Pro_firmware#782",
    "two empty lines of separators, and rows that are repeated",
)
def empty_rows(folder, log):
    path = text(folder / "log.csv", log.table())
    lines = path.read_text().splitlines()
    empty = "," * lines[0].count(",")
    for row in (300, 800):
        lines.insert(row, lines[row - 1])
    lines.insert(500, empty)
    path.write_text("\n".join([*lines, ""]))
    return [path]


@report(
    "speeduino/speeduino#1258",
    "a row ends in its middle, and the next goes on in its line",
)
def merged_rows(folder, log):
    path = text(folder / "log.csv", log.table())
    lines = path.read_text().splitlines()
    lines[600] = lines[600][:25] + lines[601]
    del lines[601]
    path.write_text("\n".join([*lines, ""]))
    return [path]


@report(
    "frankarobotics/libfranka#87",
    "two columns of one name, as the robot's logger writes them",
    {"angles": '"q[{}]"', "forces": '"tau_J[{}]"', "time_unit": '"ms"'},
)
def repeated_names(folder, log):
    columns = log.table("q[{}]", "tau_J[{}]")
    columns = {
        k.replace("1]", "0]").replace("2]", "1]").replace("3]", "2]"): x
        for k, x in columns.items()
    }
    columns["time"] = np.round(1000 * columns["time"])
    names = [*columns, "q_d[0]", "q_d[0]"]
    table = np.column_stack([*columns.values(), log.q[:, 0], log.q[:, 0]])
    rows = [",".join(f"{x:.7g}" for x in row) for row in table]
    (folder / "log.csv").write_text("\n".join([",".join(names), *rows, ""]))
    return [folder / "log.csv"]


# Units, signs, sides


def _unsigned(folder, log):
    """Write currents in steps of 2.69 mA as unsigned numbers of 16 bits."""
    counts = np.round(log.tau / 20.0 / 2.69e-3).astype(int) % 65536
    columns = log.table()
    for j in range(3):
        columns[f"tau{j + 1}"] = counts[:, j].astype(str)
    return [text(folder / "log.csv", columns)]


CURRENTS = {"force_unit": "0.00269", "torque_constants": "[20.0, 20.0, 20.0]"}


def _signed(folder, words):
    lines = (folder / "log.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[4:] = [str((int(x) + 32768) % 65536 - 32768) for x in row[4:]]
    (folder / "log.csv").write_text("\n".join([lines[0], *map(",".join, rows), ""]))
    return [folder / "log.csv"], CURRENTS


report(
    "ROBOTIS-GIT/DynamixelSDK#281",
    "negative currents as 65527 (unsigned)",
    CURRENTS,
    _signed,
)(_unsigned)


def _counter(counts):
    """Return a function that writes a counter of 16 bits on the motors' side."""

    def write(folder, log):
        turns = 100.0 * log.q / (2 * np.pi)
        columns = log.table()
        for j in range(3):
            number = np.round(turns[:, j] * counts).astype(int) % 65536
            columns[f"q{j + 1}"] = number.astype(str)
        return [text(folder / "log.csv", columns)]

    return write


for COUNTS in (8192, 10000):
    ENCODER = {
        "angle_unit": str(2 * np.pi / COUNTS),
        "side": '"motor"',
        "forces_side": '"joint"',
        "gear_ratios": "[100.0, 100.0, 100.0]",
    }
    report(
        "PR2/pr2_ethercat_drivers#54",
        f"a counter of 16 bits that overflows; {COUNTS} counts a turn of the motor",
        ENCODER,
        ENCODER | {"unwrap": "true"},
    )(_counter(COUNTS))


MOTORS = {
    "angle_unit": '"rev"',
    "side": '"motor"',
    "gear_ratios": "[50.0, 50.0, 50.0]",
}


@report(
    "odriverobotics/ODrive#430",
    "turns of the motors, torques of the motors",
    MOTORS,
)
def turns(folder, log):
    scaled = dataclasses.replace(log, q=50 * log.q / (2 * np.pi), tau=log.tau / 50)
    return [text(folder / "log.csv", scaled.table(), form="%.9g")]


report(
    "Factor-Robotics/odrive_ros2_control#14",
    "the same, and the user forgets the gears",
    {"angle_unit": '"rev"'},
    MOTORS,
    named=("gear_ratios",),
)(turns)


@report(
    "ROBOTIS-GIT/open_manipulator#294",
    "efforts of 1e-308: bytes that were never set",
    named=("no joint needs more than",),
)
def tiny_efforts(folder, log):
    columns = log.table()
    for j in range(3):
        columns[f"tau{j + 1}"] = np.array(
            [f"{-abs(x):.6g}e-308" for x in 0.1 * log.tau[:, j]]
        )
    return [text(folder / "log.csv", columns)]


@report(
    "arebgun/dynamixel_motor#78",
    "a joint is flipped, its load is not",
    {},
    {"force_signs": "[1.0, -1.0, 1.0]"},
    named=("force_signs",),
)
def flipped(folder, log):
    return [
        text(
            folder / "log.csv",
            dataclasses.replace(log, tau=log.tau * [1, -1, 1]).table(),
        )
    ]


@report(
    "almond-bot/axol#208",
    "a joint starts 360° off",
    {},
    {"angle_offsets": "[0, -6.28319, 0]"},
    named=("angle_offsets",),
)
def one_turn_off(folder, log):
    return [
        text(
            folder / "log.csv",
            dataclasses.replace(log, q=log.q + 2 * np.pi * np.eye(3)[1]).table(),
        )
    ]


@report(
    "UniversalRobots/Universal_Robots_ROS_Driver#286",
    "efforts are currents, read as torques",
    {},
    {"force_unit": '"A"', "torque_constants": "[11.0, 11.0, 8.0]"},
    named=("torque_constants",),
)
def currents(folder, log):
    return [
        text(
            folder / "log.csv",
            dataclasses.replace(log, tau=log.tau / [11, 11, 8]).table(),
        )
    ]


@report(
    "UniversalRobots/Universal_Robots_ROS_Driver#619",
    "the order of the alphabet in a table without names",
    {"angles": "[1, 2, 3]", "forces": "[4, 5, 6]"},
    {"angles": "[3, 2, 1]", "forces": "[6, 5, 4]"},
    named=("seem to be exchanged",),
)
def alphabet(folder, log):
    order = [2, 1, 0]
    exchanged = dataclasses.replace(log, q=log.q[:, order], tau=log.tau[:, order])
    return [text(folder / "log.csv", exchanged.table())]


# Several drivers


def _two_publishers(first):
    def write(folder, log):
        """Write states whose every second row is a publisher of zeros."""
        table = np.column_stack([log.t, log.q, log.tau])
        zeros = np.column_stack([log.t, 0 * log.q, 0 * log.tau])
        pair = (zeros, table) if first else (table, zeros)
        rows = np.stack(pair, axis=1).reshape(-1, table.shape[1])
        return [text(folder / "log.csv", dict(zip(log.table(), rows.T, strict=True)))]

    return write


def _one_driver(folder, words):
    lines = (folder / "log.csv").read_text().splitlines()
    rows = [line for line in lines if not re.search(r"(,-?0){6}$", line)]
    (folder / "log.csv").write_text("\n".join([*rows, ""]))
    return [folder / "log.csv"], {}


report(
    "automaticaddison/yahboom_rosmaster#4",
    "a second publisher sends zeros with the same stamps, behind each row",
    {},
    _one_driver,
    named=("remove the rows of one",),
)(_two_publishers(False))
report(
    "automaticaddison/yahboom_rosmaster#4",
    "the same, before each row",
    {},
    _one_driver,
    named=("remove the rows of one",),
)(_two_publishers(True))


def _delay_as_named(folder, words):
    seconds = re.search(r"force_delay = ([-\d.e]+)", " ".join(words))[1]
    return [folder / "log.csv"], {"force_delay": seconds}


@report(
    "shadow-robot/sr_core#66",
    "angles come through a low-pass of 20 ms, torques do not",
    {},
    _delay_as_named,
    named=("force_delay",),
)
def late_angles(folder, log):
    q = log.q.copy()
    for k in range(1, len(q)):
        q[k] = q[k - 1] + (DT / (0.02 + DT)) * (log.q[k] - q[k - 1])
    return [text(folder / "log.csv", dataclasses.replace(log, q=q).table())]


@report(
    "ros-industrial/ros_canopen#168",
    "velocities are means of nine samples",
    {"velocities": '"dq{}"'},
    {},
    named=("leave `recording.velocities` out",),
)
def smooth_velocities(folder, log):
    mean = np.array([np.convolve(x, np.ones(9) / 9)[: len(x)] for x in log.qd.T])
    columns = log.table() | {f"dq{j + 1}": x for j, x in enumerate(mean)}
    return [text(folder / "log.csv", columns)]


@report(
    "ros-controls/ros2_controllers#1572",
    "velocities of one joint are `.nan`",
    {"velocities": '"dq{}"'},
    {},
    named=("leave `velocities` out",),
)
def silent_velocity(folder, log):
    columns = log.table() | {f"dq{j + 1}": x for j, x in enumerate(log.qd.T)}
    columns["dq2"] = np.full(len(log.t), ".nan")
    return [text(folder / "log.csv", columns)]


# Arrays


@report(
    "robotology/robometry#8",
    "a structure with time of Simulink, saved as MAT",
    {
        "angles": '"angles.signals.values"',
        "forces": '"torques.signals.values"',
        "time": '"angles.time"',
    },
)
def structure_with_time(folder, log):
    from scipy.io import savemat

    def scope(values, name):
        signals = {
            "values": values,
            "dimensions": 3.0,
            "label": name,
            "blockName": f"arm/{name}",
        }
        return {"time": log.t[:, None], "signals": signals, "blockName": f"arm/{name}"}

    savemat(
        folder / "log.mat",
        {"angles": scope(log.q, "q"), "torques": scope(log.tau, "tau")},
    )
    return [folder / "log.mat"]


@report(
    "robotology/robometry#8",
    "the same with several signals in one scope",
    {
        "angles": '"scope.signals.values"',
        "forces": '"scope.signals.values"',
        "time": '"scope.time"',
    },
    {
        "angles": '"scope.signals[0].values"',
        "forces": '"scope.signals[1].values"',
        "time": '"scope.time"',
    },
    named=("scope.signals[0].values",),
)
def several_signals(folder, log):
    from scipy.io import savemat

    signals = np.empty(2, dtype=[("values", object), ("label", object)])
    signals[0] = (log.q, "q")
    signals[1] = (log.tau, "tau")
    savemat(folder / "log.mat", {"scope": {"time": log.t[:, None], "signals": signals}})
    return [folder / "log.mat"]


def _dictionary(folder, log):
    content = {"q": log.q, "tau": log.tau, "time": log.t}
    np.savez(folder / "log.npz", log=np.array(content, dtype=object))
    return [folder / "log.npz"]


def _plain_arrays(folder, words):
    with np.load(folder / "log.npz", allow_pickle=True) as file:
        content = file["log"].item()
    np.savez(folder / "log.npz", **content)
    return [folder / "log.npz"], {"angles": '"q"', "forces": '"tau"'}


report(
    "sabjorn/NumpySocket#10",
    "a dictionary as an array of objects in an NPZ file",
    {"angles": '"log.q"', "forces": '"log.tau"', "time": '"log.time"'},
    _plain_arrays,
    named=("without objects",),
)(_dictionary)


def _stacked(folder, log):
    """Write a list of rows of which each is an array of objects."""
    np.savez(folder / "log.npz", q=log.q.astype(object), tau=log.tau, time=log.t)
    return [folder / "log.npz"]


def _plain_rows(folder, words):
    with np.load(folder / "log.npz", allow_pickle=True) as file:
        content = {name: file[name].astype(float) for name in file.files}
    np.savez(folder / "log.npz", **content)
    return [folder / "log.npz"], {"angles": '"q"', "forces": '"tau"'}


report(
    "sentinel-hub/eo-learn#478",
    "numbers as an array of objects in an NPZ file",
    {"angles": '"q"', "forces": '"tau"'},
    _plain_rows,
    named=("without objects",),
)(_stacked)


@report(
    "ARISE-Initiative/robomimic#133, vikashplus/robohive#95",
    "groups of HDF5, one for each demonstration, beside images",
    {
        "angles": '"data.demo_1.obs.robot0_joint_pos"',
        "forces": '"data.demo_1.obs.robot0_torques"',
        "time": '"data.demo_1.time"',
    },
)
def groups(folder, log):
    import h5py

    with h5py.File(folder / "log.hdf5", "w") as file:
        for k in range(2):
            group = file.create_group(f"data/demo_{k}")
            group["time"] = log.t
            group["obs/robot0_joint_pos"] = log.q if k else 0 * log.q
            group["obs/robot0_torques"] = log.tau if k else 0 * log.tau
            group["obs/agentview_image"] = np.zeros((20, 8, 8, 3), np.uint8)
    return [folder / "log.hdf5"]


@report("ros2/rosbag2#668", "a recording that was split into four files")
def split_files(folder, log):
    parts = np.array_split(np.arange(len(log.t)), 4)
    return [
        text(folder / f"log_{k}.csv", log.rows(rows).table())
        for k, rows in enumerate(parts)
    ]


# Judgement


class Result(NamedTuple):
    """What came of a report.

    Attributes:
        outcome: "read"; "said" or "refused", with cures that work; "loses" if the
            result is less accurate than that of the plain log; or "WRONG".
        ratio: Largest error of the last attempts over that of the plain log.
        words: What is said at first.
    """

    outcome: str
    ratio: float
    words: str


def attempts_of(report, draw):
    """Return the outcomes of all attempts at a report, with one draw of the noise."""
    folder = Path(tempfile.mkdtemp())
    paths = report.write(folder, simulate(draw=draw, **report.settings))
    outcomes = []
    for attempt in report.attempts:
        keys = attempt
        if callable(attempt):
            paths, keys = attempt(folder, outcomes[0].words)
        outcomes.append(identified(paths, keys, folder))
    return outcomes


def plain_error(settings, draw, errors={}):  # noqa: B006 (it keeps what was computed)
    """Return the error that the plain log gives."""
    key = (*settings.items(), draw)
    if key not in errors:
        folder = Path(tempfile.mkdtemp())
        path = text(folder / "log.csv", simulate(draw=draw, **settings).table())
        errors[key] = identified([path], {}, folder).error
    return errors[key]


def ratios_of(report, draws):
    """Return the errors of each attempt over those of the plain log; inf if refused."""
    errors = []
    for draw in range(draws):
        outcomes = attempts_of(report, draw)
        errors.append([np.inf if x.error is None else x.error for x in outcomes])
    plain_errors = [plain_error(report.settings, draw) for draw in range(draws)]
    return np.mean(errors, axis=0) / np.mean(plain_errors)


def judged(report):
    """Return what came of a report."""
    outcomes = attempts_of(report, 0)
    ratios = ratios_of(report, 1)
    first = outcomes[0]
    words = "; ".join(first.words) if first.is_doubted else ""
    is_cured = len(outcomes) > 1
    last_ratios = ratios[1:] if is_cured else ratios
    if MAX_RATIO < last_ratios.max() < np.inf:
        ratios = ratios_of(report, DRAWS)
        last_ratios = ratios[1:] if is_cured else ratios
    ratio = float(last_ratios.max())
    has_names = all(word in words for word in report.named)
    outcome = "read"
    if first.is_doubted:
        outcome = "refused" if first.error is None else "said"
    is_wrong = first.is_doubted and not (report.named and has_names)
    is_wrong |= is_cured and any(x.error is None for x in outcomes[1:])
    # Nothing cures a log without forces.
    if report.named and not is_cured:
        return Result("WRONG" if is_wrong else outcome, np.nan, words)
    if is_wrong or ratio > MAX_LOSS:
        outcome = "WRONG"
    elif ratio > MAX_RATIO:
        outcome = "loses"
    return Result(outcome, ratio, words)


def rows(quick=False, only=""):
    """Rebuild the reports; return the figures of all, and print each."""
    import jax

    jax.config.update("jax_enable_x64", True)
    chosen = [x for x in REPORTS if only in x.source + x.kind]
    results = []
    for report in chosen[::6] if quick else chosen:
        began = time.perf_counter()
        result = judged(report)
        results.append(result)
        seconds = time.perf_counter() - began
        print(f"{result.outcome:8} {result.ratio:9.3g} {seconds:5.1f} s  {report.kind}")
        print(
            f"{'':26}{report.source}"
            + f"\n{'':26}{result.words[:300]}" * bool(result.words),
            flush=True,
        )
    wrong = sum(x.outcome == "WRONG" for x in results)
    losses = sum(x.outcome == "loses" for x in results)
    recipe = "public_reports/logs.py: logs"
    counts = (
        ("rebuilt", "≥ 14", len(results), len(results) >= 14),
        ("wrong results or cures", "0", wrong, not wrong),
        (
            f"error above {MAX_RATIO:g} times that of the plain log",
            "0",
            losses,
            not losses,
        ),
    )
    return [
        Row("reports/logs", what, recipe, asked, str(count), holds)
        for what, asked, count, holds in counts
    ]


def main():
    """Rebuild all reports."""
    parser = timing.parser(__doc__, "every sixth report")
    parser.add_argument("--only", default="", help="a word of the source or the kind")
    options = parser.parse_args()
    timing.pin_to(1)
    hand_over(rows(options.quick, options.only), options.json)


if __name__ == "__main__":
    main()
