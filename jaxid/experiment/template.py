"""Writes a commented experiment file for a robot: what `jaxid init` prints."""

import json
import os
import re
from pathlib import Path

import numpy as np

from jaxid.experiment.method_tables import CUTOFF
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import load_urdf

_WIDTH = 100
_COMMENT = 38
"""Column in which the comments behind keys begin."""
_TEMPLATE = """\
# Experiment file of {name}:
# what is known of the robot, what its logs hold, how it is identified.
# Lines that begin with `#` are comments; remove the `#` before a key to use it.
# Units: rad, m, s, N m (revolute joints) or N (prismatic joints), unless a key says otherwise.
#
#   jaxid inspect  {file}                      what can be identified
#   jaxid inspect  {file} log.csv              is this log sane?
#   jaxid excite   {file} -o trajectory.csv    the motion to record
#   jaxid identify {file} log.csv -o report/   parameters and torque errors

[robot]
urdf = {urdf}    # as seen from the folder of this file
{tip}      # link of the end-effector: only the chain from `base` to it
{base}    # link that stands on the ground
# gravity = [0.0, 0.0, -9.81]         # in the frame of the ground [m/s²]
# base_rotation = [0.0, 0.0, 0.0]     # of the robot on the ground: roll, pitch, yaw [deg]
# base_position = [0.0, 0.0, 0.0]     # [m]
# snap_tolerance = 1e-4               # angles so close to a quarter turn become exact [rad]
#
# Instead of `urdf`, one of the robots that jaxid knows:
# builtin = "tx40"                    # {builtin}
#                                     # iiwa14, kr300, planar_arm
# or a Denavit-Hartenberg table, one row for each joint (alpha and theta [deg], a and d [m]):
# convention = "modified"             # or "standard"
# name = "my robot"
# dh = [
#   {{ alpha = 0.0, a = 0.0, d = 0.3 }},
#   {{ alpha = -90.0, a = 0.05, d = 0.0, theta = 90.0, name = "shoulder" }},
#   {{ alpha = 0.0, a = 0.5, d = 0.0, slides = true }},
# ]

# A known load: its forces are subtracted, not identified.
# [robot.tool]
# mass = 1.5                          # [kg]
# centre_of_mass = [0.0, 0.0, 0.05]   # [m], in the frame of the end-effector
# inertia = {{ xx = 1e-3, yy = 1e-3, zz = 1e-3, xy = 0.0, xz = 0.0, yz = 0.0 }}
#                                     # about the centre of mass [kg m²]; a point mass if left out
# body = {last}    # in the frame of the body that this joint moves, instead

# A known load that is on the robot in some logs only: `jaxid gains` finds the drives' true forces.
# [load]
# mass = 5.0                          # [kg]; the other keys are those of [robot.tool]
# centre_of_mass = [0.0, 0.0, 0.1]    # [m]
# inertia = {{ xx = 2e-2, yy = 2e-2, zz = 1e-2, xy = 0.0, xz = 0.0, yz = 0.0 }}
# body = {last}

# The joints: {joints_said}.
[limits]                              # one number for each joint; inf: unlimited
{limits}

{drives}

# Which effects the model has, beside the rigid bodies.
[model]
principal_axes = false                # true: leave out products of inertia (seven per body, Eq. 12)
viscous = true                        # friction that grows with speed
rotor_inertia = true                  # motors' rotors, felt through the gears
offset = true                         # constant force at each joint (sensor offsets)
springs = false                       # linear spring at each joint (counterbalances)
# coupled_drives = true               # motors that turn several axes; by default where the matrix
#                                     # of `[drives]` has entries beside its diagonal
# coulomb = false                     # no dry friction; or its transition, in a table:
[model.coulomb]
epsilon = 0.01                        # speed of the smooth transition [rad/s or m/s]; or a list
dead_zone = 0.0                       # no dry friction below this speed [rad/s or m/s]; or a list
hard = false                          # true: a sign instead of tanh(speed / epsilon)
asymmetric = false                    # true: one level for each direction (and no `offset`)
# stribeck = 0.1                      # friction falls from a static level about this speed
#                                     # [rad/s or m/s]; or a list

# Which columns of a log hold what. Logs are CSV (any separator), Parquet, NPZ or MAT files.
# Columns are patterns ("{{}}" stands for the joint's number), lists of names, or positions from 0.
[recording]
angles = "q{{}}"                        # or {listed}
forces = "tau{{}}"                      # joint torques and forces, motor torques or motor currents
# velocities = "dq{{}}"                 # measured velocities, if they are good
time = "time"                         # column of the time stamps
# sample_time = 0.001                 # [s], instead of `time`: rows are equally far apart
time_unit = "s"                       # s, ms, us, ns
angle_unit = {angle_unit}
# velocity_unit = "rad/s"             # rad/s, deg/s, rpm, m/s, mm/s; default: angles' per second
force_unit = {force_unit}
# torque_constants = {ones}   # [N m/A], only with currents
# angle_signs = {signs}               # +1 or -1 for each joint; velocities alike
# force_signs = {signs}               # +1 or -1 for each joint
# angle_offsets = {zeros}             # added to the angles [rad or m]
# force_gains = {ones}   # true forces over those of the log: `jaxid gains` finds them
# force_delay = 0.001                 # forces stand in the log so much later than angles [s]
side = "joint"                        # "motor": the log is of the motors, before the gears
# forces_side = "motor"               # if the forces are on another side than the angles
# forces_file = "torques.csv"         # if the forces lie in another file, beside the log; "{{}}"
# velocities_file = "{{}}_speed.csv"    # in it stands for the log's name without its suffix
# largest_gap = 1.75                  # longest pause that is bridged, in sample times
# start = 0.0                         # part of every log that is used [s]
# stop = 10.0

# From angles to velocities and accelerations; forces and regressor columns are filtered alike.
[filter]
kind = "butterworth"                  # a low-pass, forward and backward, then differences
cutoff = {cutoff}                     # about five times the highest frequency of the motion [Hz];
#                                     # or a list: the one that predicts unseen parts best is taken
order = 4                             # of one direction
# force_cutoff = inf                  # of forces and columns [Hz], like `cutoff` by default;
#                                     # inf: only decimation limits their band
# margin = 0.1                        # time to drop at both ends [s]; default: until it settles
#
# kind = "paper"                      # differentiating filter of first order (Eq. 25)
# velocity = 1200.0                   # its cut-offs [rad/s]
# acceleration = 100.0
#
# kind = "periodic"                   # Fourier series, for periodic motions
# period = 10.0                       # of the motion [s]
# harmonics = 5                       # of the planned trajectory, or a few more
# force_harmonics = 50                # cut-off of forces and columns, in harmonics

# Which samples become rows of the least-squares problem.
[rows]
every = 1                             # every n-th sample, of signals below half of that rate
# factors = [10, 10]                  # instead: low-pass and decimate in stages, 13 at most
# slow = 0.05                         # rows below this speed do not count [rad/s or m/s]; or a list

[estimator]
kind = "weighted"                     # or "least_squares": every newton metre counts the same;
#                                     # "huber" or "tukey": rows that the model cannot explain count
#                                     # less; "correlated": with what joints' residuals have in
#                                     # common; "instrumental": for noisy angles; "consistent":
#                                     # complete bodies that could exist;
#                                     # "stepwise": axis by axis from the wrist inward
# weights = "maximum_forces"          # joints count by their largest forces (Eq. 30); or
#                                     # "residual_variances": by what the model leaves unexplained
# ridge = "cross_validated"           # pulls what the logs hardly decide towards zero, as much as
#                                     # serves left-out parts of the logs best; or a share like 0.01
# truncate = 0.01                     # leave out directions below this share of the best one
# single_axes = ["axis1.csv"]         # of "stepwise": logs beside this file in which one axis moves
#                                     # alone: friction comes from them
# nonlinear_friction = true           # finds `epsilon` and `stribeck` of each joint too, and keeps
#                                     # them if they predict unseen parts of the logs better
# prior = "urdf"                      # what is not decided stays as the URDF's inertias say, with
#                                     # `ridge`, `truncate`, or of "consistent"
# essential = 0.02                    # keeps only parameters without which unseen parts of the logs
#                                     # are predicted worse: by such a share in all, at most
# limit = 1.345                       # of "huber" or "tukey": residuals beyond count less [1]
# reference = "trajectory.json"       # of "instrumental": the motion that was commanded; or a list
# reference_start = 0.0               # with one for each log; the stamp at which it began [s]
# margin = 0.01                       # of "consistent": share of a ball that each body contains
# pull = 1.0                          # strength of a pull towards the prior, or towards balls
# mass_min = 0.5                      # of the bodies [kg]; or a list
# mass_max = 50.0                     # likewise
# radius = 0.6                        # spheres about the origins of the bodies' frames that hold
#                                     # them [m]; or a list
# centre_min = [-0.2, -0.2, 0.0]      # box for the centres of mass, in the bodies' frames [m]: two
# centre_max = [0.2, 0.2, 0.5]        # corners, inf for none; or lists with one for each body
# ellipsoid_centre = [0.0, 0.0, 0.2]  # ellipsoid for the centres of mass [m]: its own centre and
# ellipsoid_axes = [0.2, 0.2, 0.4]    # half axes; or lists with one for each body
# total_mass = 120.0                  # of all bodies together, if it is known [kg]
# uncertainty = "spectral"            # or "jackknife": from blocks of time left out in turn;
#                                     # "independent": as if rows were independent, far too small

# The motion that `jaxid excite` designs, within the limits above.
[excitation]
criterion = "d_optimal"               # smallest deviations on the whole; or a_optimal, e_optimal,
#                                     # condition_number (the paper's, Eq. 36),
#                                     # weighted_condition_number, scaled_condition_number
harmonics = 5                         # of the Fourier series
omega = 0.8                           # its ground frequency [rad/s]
rest = false                          # true: start and stop at rest
# spline = {{ points = 12, duration = 8.0 }}  # in place of a series: from rest to rest in 8 s
leads = true                          # a way into the periodic motion from standstill, and out;
#                                     # {{ time = 0.5, periods = 2 }}: of so many seconds, designed
#                                     # together with the motion, and two periods between them
# sample_time = 0.004                 # between two rows of the table: the controller's cycle [s];
#                                     # by default that of the samples
# ros = "json"                        # language of the file for ROS; by default "yaml"
samples = 800                         # that one run will measure
# noise = {ones}        # standard deviation of the forces' noise [N m or N];
#                                     # by default 1 % of the largest forces
starts = 32                           # random motions to start from
generations = 12                      # how often the motions found have children
polish = 4                            # how many of the best are polished
seed = 0                              # of the random motions
# nominal = "report"                  # an earlier result of `jaxid identify`, to compare with
# earlier = ["trajectory.json"]       # motions whose logs will be used together with this one's
# force_margin = 0.1                  # keep 10 % of the largest forces free, by nominal parameters
# tip_speed = 1.5                     # of the end-effector [m/s]
# tip_acceleration = 10.0             # [m/s²]
# workspace = [[-1.0, -1.0, 0.1], [1.0, 1.0, 1.5]]    # box for the end-effector: two corners [m]

# What may not touch while the motion of `jaxid excite` runs.
# [collision]
# distance = 0.03                       # that must remain [m]
# fit = true                            # capsules around the geometry of the URDF's links
# packages = "."                        # folder of what the URDF calls `package://`
# ground = 0.0                          # height of the floor [m]
# capsules = [{{ name = "gun", body = "joint1", start = [0, 0, 0], end = [0, 0, 1], radius = 0.1 }}]
# boxes = [{{ name = "table", centre = [0.8, 0, 0.2], size = [1, 1, 1], rotation = [0, 0, 45] }}]
# pairs = [["gun", "table"]]        # by default all that the joints can bring together
"""


def write_template(
    urdf: str | Path,
    *,
    tip: str | None = None,
    base: str | None = None,
    folder: str | Path | None = ".",
) -> str:
    """Writes a complete commented experiment file for a robot; it loads again as it is.

    Args:
        urdf: The robot's URDF file.
        tip: Link of the end-effector; the end of the longest chain if None.
        base: Link that stands on the ground; the root if None.
        folder: Where the experiment file is going to lie: the URDF's path is relative to it. If
            None, nobody knows, and the path is absolute.

    Raises:
        FileNotFoundError: If the URDF file does not exist.
        InputError: If it cannot be loaded.
    """
    robot = load_urdf(urdf, tip=tip, base=base)
    path = Path(urdf).resolve()
    if folder is not None:
        path = Path(os.path.relpath(path, Path(folder).resolve()))
    return render(robot, path.as_posix(), tip, base)


def render(robot: Robot, urdf: str, tip: str | None = None, base: str | None = None) -> str:
    """The file for a robot that a URDF file describes.

    Args:
        robot: As it was loaded.
        urdf: Path of the URDF file, as it is written into the file.
        tip: Link of the end-effector, if it was chosen.
        base: Link that stands on the ground, if it was chosen.
    """
    n = robot.joints
    slides = not all(robot.revolute)
    angle_units = ["rad" if r else "m" for r in robot.revolute]
    force_units = ["N m" if r else "N" for r in robot.revolute]
    kinds = ("slides", "turns")
    joints = ", ".join(
        f"{i + 1} {name} ({kinds[turns]})" if slides else f"{i + 1} {name}"
        for i, (name, turns) in enumerate(zip(robot.joint_names, robot.revolute, strict=True))
    )
    return _aligned(
        _TEMPLATE.format(
            name=robot.name,
            file="experiment.toml",
            urdf=_text(urdf),
            tip=f"tip = {_text(tip)}" if tip else '# tip = "flange"',
            base=f"base = {_text(base)}" if base else '# base = "base_link"',
            builtin="tx90l_on_rail, tx40, ur10, ur10e, panda,",
            last=_text(robot.joint_names[-1]),
            joints_said=_wrapped(joints),
            limits=_limits(robot),
            drives=_drives(robot),
            listed=_list([f"q{i + 1}" for i in range(min(n, 2))])[:-1] + (", …]" if n > 2 else "]"),
            angle_unit=_unit(angle_units, "rad, deg, rev; m, mm; or one for each joint"),
            force_unit=_unit(force_units, "N m, N; or currents: A, mA; or one for each joint"),
            ones=_list([1.0] * n),
            signs=_list([1] * n),
            zeros=_list([0.0] * n),
            cutoff=f"{CUTOFF:g}",
        )
    )


def _aligned(text: str) -> str:
    """Comments behind keys begin in one column, or stand on the line before a long one."""
    lines = []
    for line in text.split("\n")[:-1]:
        found = re.fullmatch(r"(.*?\S) {2,}# (.*)", line)
        if found is None:
            lines.append(line)
        elif len(found[1]) < _COMMENT - 1:
            lines.append(f"{found[1]:<{_COMMENT}}# {found[2]}")
        else:
            lines += [f"# {found[2]}:", found[1]]
    return "\n".join(part for line in lines for part in _broken(line)) + "\n"


def _broken(line: str) -> list[str]:
    """A list that is too long for its line takes several."""
    found = re.fullmatch(r"(#? ?)(\w+ = \[)(.*)\]", line)
    if found is None or len(line) <= _WIDTH:
        return [line]
    mark, opening, content = found.groups()
    lines, row = [mark + opening], ""
    for item in content.split(", "):
        if len(row) + len(item) > _WIDTH - 8:
            lines.append(f"{mark}  {row.rstrip()}")
            row = ""
        row += f"{item}, "
    return [*lines, f"{mark}  {row.rstrip()}", f"{mark}]"]


def _limits(robot: Robot) -> str:
    limits = robot.limits
    slides = not all(robot.revolute)
    position, force = ("[rad or m]", "[N m or N]") if slides else ("[rad]", "[N m]")
    unit = position[1:-1]
    fields = (
        ("position_min", limits.position_min, position),
        ("position_max", limits.position_max, position),
        ("velocity", limits.velocity, f"[{' or '.join(f'{u}/s' for u in unit.split(' or '))}]"),
        (
            "acceleration",
            limits.acceleration,
            f"[{' or '.join(f'{u}/s²' for u in unit.split(' or '))}]",
        ),
        ("jerk", limits.jerk, f"[{' or '.join(f'{u}/s³' for u in unit.split(' or '))}]"),
        ("force", limits.force, force),
    )
    lines = ['angle_unit = "rad"                    # or "deg": of everything but forces and rails']
    for name, values, shown in fields:
        known = np.isfinite(np.asarray(values))
        found = "" if known.all() else " — the URDF says nothing" if not known.any() else ""
        lines.append(f"# {name} {shown}{found}")
        lines.append(f"{name} = {_list([float(v) for v in np.asarray(values)])}")
    return "\n".join(lines)


def _drives(robot: Robot) -> str:
    n = robot.joints
    rail = "; [rad/m] for a prismatic joint" if not all(robot.revolute) else ""
    return "\n".join(
        (
            "# Motors and gears: needed for logs on the motors' side.",
            f"[drives]                              # ratio of motor to joint speed{rail}",
            f"gear_ratios = {_list([1.0] * n)}",
            "# matrix = [[…], …]  # instead: a row for each motor, its ratio to each joint",
            f"# zero = {_list([0.0] * n)}             # joint angles at which the motors' are zero",
            '# angle_unit = "deg"                  # of `zero`',
            "# largest torques of the motors, before the gears [N m]:",
            f"# max_torques = {_list([1.0] * n)}",
            "# inertias of the rotors, before the gears [kg m²]; shown, not used",
            f"# rotor_inertia = {_list([1e-4] * n)}",
        )
    )


def _list(values: list) -> str:
    return "[" + ", ".join(_text(v) if isinstance(v, str) else _number(v) for v in values) + "]"


def _number(value: float | int) -> str:
    return repr(value).replace("Infinity", "inf")


def _text(value: str) -> str:
    """A text of TOML; nothing in it ends a line, or looks like a comment behind a key."""
    quoted = json.dumps(value, ensure_ascii=False).replace("  #", "  \\u0023")
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in quoted)


def _unit(units: list[str], others: str) -> str:
    shown = _text(units[0]) if len(set(units)) == 1 else _list(units)
    return f"{shown:<25s}# {others}" if len(shown) < 25 else f"{shown}  # {others}"


def _wrapped(text: str) -> str:
    lines, line = [], "# The joints: "
    for word in text.split(" "):
        if len(line) + len(word) > _WIDTH:
            lines.append(line.rstrip())
            line = "#   "
        line += word + " "
    lines.append(line.rstrip())
    return "\n".join(lines)[len("# The joints: ") :]
