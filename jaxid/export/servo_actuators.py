"""Identified servos for simulators: MJCF files, and numbers for Isaac Lab."""

from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from lxml.builder import E  # pyright: ignore[reportMissingModuleSource]

from jaxid.arrays import AnyArray, Joints
from jaxid.errors import InputError
from jaxid.io import FilePath, write_text
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Table,
    sort_remarks,
    with_deviation,
)
from jaxid.robot.mjcf import exact_text
from jaxid.rollout.body_loads import Bodies
from jaxid.rollout.determined_combinations import unit_of_joint
from jaxid.rollout.result import ServoFit
from jaxid.rollout.servo import INDEX, START

from .bodies_and_joint_dynamics import Quantities
from .feed_forward import body_parameters
from .mujoco_model import mjcf_text

STICKING_IMPEDANCE = "0.99 0.9999 0.001"
"""Impedance with which MuJoCo's dry friction holds a joint almost without creep."""
UNITS = {
    "stiffness": "N m/rad",
    "damping": "N m s/rad",
    "armature": "kg m²",
    "friction": "N m",
    "effort_limit": "N m",
    "delay": "s",
    "offset": "rad",
    "integral_gain": "N m/(rad s)",
    "feed_forward": "N m s/rad",
}
"""Units of `simulator_values` at joints that turn."""
GAIN_SYMBOLS = {"stiffness": "a", "damping": "B", "feed_forward": "f"}
"""Parameters of joints that tell the gains of their servos."""
OPTIONAL_VALUES = ("integral_gain", "feed_forward")
"""Values of `simulator_values` that most servos lack."""
FEED_FORWARD_CURE = (
    "position actuators have no velocity feed-forward: set the control to the command "
    "plus (feed forward / stiffness) times the rate of the command"
)
"""How a simulator moves like servos that feed the velocity of the command forward."""


def servo_stiffness(fit: ServoFit) -> Joints:
    """Return the stiffness of each servo: that of the fit, or of other joints.

    Raises:
        InputError: If no joint tells its stiffness and none was given.
    """
    values = fit.stiffness
    is_known = np.isfinite(values)
    if not is_known.any():
        raise InputError(
            "`stiffness` [N m/rad] of `identify_rollout` is needed: no known load "
            "determines it, and positions determine only ratios to it. For a robot "
            "without bodies, any number gives the same motion."
        )
    return np.where(is_known, values, np.median(values[is_known]))


def simulator_values(fit: ServoFit, parameters: AnyArray | None = None) -> Quantities:
    """Return the numbers of each joint that simulators of actuators take.

    Positions determine only the sum of viscous friction and the servo's damping.
    Friction that grows with load is included at the mean load of the logs.

    Args:
        fit: Identified servos.
        parameters: Other parameters of the joints, such as a draw from their
            distribution.

    Returns:
        `stiffness`, `damping`, `armature`, `friction`, `effort_limit` (infinite
        without), `delay` [s], `offset` of the command, `integral_gain`, and
        `feed_forward` of the command's velocity.
    """
    rows = fit.parameters if parameters is None else np.asarray(parameters)
    ratios = {symbol: rows[:, k] for symbol, k in INDEX.items()}
    compliance = ratios["a"]
    # Parameters are in units of the stiffness, which positions alone do not determine.
    # Where gravity determines it, `parameters` contain its inverse.
    has_own_stiffness = np.isfinite(fit.stiffness) & fit.free[:, INDEX["a"]]
    own_stiffness = 1.0 / np.maximum(compliance, 1e-9)
    K = np.where(has_own_stiffness, own_stiffness, servo_stiffness(fit))

    armature = K * ratios["J"] - _body_inertias(fit, compliance)
    load_friction = ratios["mu"] * np.abs(compliance) * fit.load
    friction = ratios["F"] + load_friction
    # The start value means that no limit was found.
    is_limited = ratios["um"] < START[INDEX["um"]]
    return {
        "stiffness": K,
        "damping": K * ratios["B"],
        "armature": np.maximum(armature, 0.0),
        "friction": K * friction,
        "effort_limit": np.where(is_limited, K * ratios["um"], np.inf),
        "delay": ratios["d"],
        "offset": ratios["b"],
        "integral_gain": K * ratios["ki"],
        "feed_forward": K * ratios["f"],
    }


def _body_inertias(fit: ServoFit, compliance: Joints) -> Joints:
    """Return the inertias of the bodies that servos' inertias contain [kg m² or kg].

    A simulator adds the inertia of the bodies, so that it must not count twice. Where
    coupled bodies load a joint, its inertia is without them.
    """
    joints = len(fit.joint_names)
    if fit.bodies is None:
        return np.zeros(joints)
    bodies = fit.bodies
    mass_matrix = bodies.model.mass_matrix(bodies.parameters, np.zeros(joints))
    has_no_bodies = bodies.coupled & (compliance > 0)
    return np.where(has_no_bodies, 0.0, np.diag(np.asarray(mass_matrix)))


def simulator_table(fit: ServoFit) -> Table:
    """Return the numbers of each joint for Isaac Lab, MuJoCo Playground and others.

    Args:
        fit: Identified servos.
    """
    values = simulator_values(fit)
    joints = range(len(fit.joint_names))
    columns = []
    for name, value in values.items():
        if name not in OPTIONAL_VALUES or value.any():
            units = [unit_of_joint(UNITS[name], j, fit.bodies) for j in joints]
            unit = " or ".join(dict.fromkeys(units))
            columns.append(Column(name.replace("_", " "), value, unit))
    remarks: list[Remark | str] = []
    if values["feed_forward"].any():
        remarks.append(Remark(FEED_FORWARD_CURE, Status.DOUBTFUL))
    if not fit.hold:
        remarks.append(
            "the delay is for interpolated commands; commands that are held act half "
            "a step later"
        )
    return Table(
        "actuators of simulators",
        Column("joint", fit.joint_names),
        *columns,
        Column("stiffness from", _stiffness_sources(fit)),
        remarks=remarks,
    )


def _stiffness_sources(fit: ServoFit) -> list[str]:
    """Return where the stiffness of each joint is from."""
    sources = np.where(np.isfinite(fit.stiffness), "weight", "other joints")
    if "stiffness" in fit.gains:
        sources = np.where(np.isfinite(fit.gains["stiffness"]), "given", sources)
    return sources.tolist()


def gain_findings(fit: ServoFit) -> list[Remark]:
    """Return whether the logs agree with gains that were given; nothing without any."""
    comparisons = [
        _compare_gain(fit, name, joint)
        for name, gains in fit.gains.items()
        for joint in np.flatnonzero(np.isfinite(gains)).tolist()
    ]
    if not comparisons:
        return []
    texts = " ".join(comparison.text for comparison in comparisons)
    return [Remark(f"Given gains: {texts}", sort_remarks(comparisons)[0].status)]


def _compare_gain(fit: ServoFit, name: str, joint: int) -> Remark:
    """Return what the logs tell of a given gain, and whether it differs."""
    gain = float(fit.gains[name][joint])
    unit = unit_of_joint(UNITS[name], joint, fit.bodies)
    text = f"{name.replace('_', ' ')} of {fit.joint_names[joint]} {gain:g} {unit}"
    combinations = (*fit.combinations, *fit.compliances)
    estimates = {(c.joint, c.name): c for c in combinations}
    combination = estimates.get((joint, GAIN_SYMBOLS[name]))
    if combination is None:
        return Remark(f"{text}, which cannot be determined from the logs")
    # Parameters are ratios to the stiffness, and that of the stiffness is its inverse.
    stiffness = float(servo_stiffness(fit)[joint])
    is_stiffness = name == "stiffness"
    ratio = 1.0 / gain if is_stiffness else gain / stiffness
    value = combination.value
    estimate = 1.0 / value if is_stiffness else stiffness * value
    deviation = estimate * combination.deviation / value
    low, high = combination.interval()
    # Viscous friction of the joint adds to the servo's damping.
    agrees = ratio <= high and (low <= ratio or name == "damping")
    texts = with_deviation(estimate, deviation)
    result = "agrees" if agrees else "differs"
    status = Status.GOOD if agrees else Status.DOUBTFUL
    text = f"{text}, estimated {' ± '.join(texts)}: {result}"
    if is_stiffness and not agrees:
        # Logs tell only the product of load and compliance.
        excess = 100.0 * (gain / estimate - 1.0)
        reason = f"the controller cancels {-excess:.0f} % of the gravity"
        if excess > 0.0:
            reason = f"the load is {excess:.0f} % larger than that of the given masses"
        text = f"{text}, or {reason}"
    return Remark(text, status)


def export_servo_mjcf(
    fit: ServoFit,
    path: FilePath,
    *,
    samples: int = 0,
    timestep: float = 0.002,
) -> list[Path]:
    """Write the robot for MuJoCo, with its identified servos as position actuators.

    Controls are the commanded positions, one each in the order of the joints. MJCF has
    no delay of commands, no bias, and no velocity feed-forward: a comment says so, and
    they are `<custom>` numbers (`delay`, `offset`, `feed_forward` over the stiffness).
    Servos with integral action are `mujoco.pid` plugins, which come with MuJoCo. They
    start without integral: wait until loaded joints have settled, or set `data.act`.

    Args:
        fit: Identified servos of a robot whose bodies are known.
        path: Path of the file.
        samples: Number of further files, `NAME_samples/000.xml` …, drawn from the
            estimates' distribution.
        timestep: Time step of the simulation [s].

    Raises:
        InputError: If the fit has no bodies, or the stiffness is not known.
    """
    if fit.bodies is None:
        raise InputError(
            "`fit` has no bodies: identify with `bodies`, or use `simulator_table`."
        )
    path = Path(path)
    folder = path.with_name(f"{path.stem}_samples")
    paths = [path, *(folder / f"{k:03d}.xml" for k in range(samples))]
    draws = [fit.parameters, *fit.samples(samples)]
    for file, parameters in zip(paths, draws, strict=True):
        values = simulator_values(fit, parameters)
        write_text(file, _servo_mjcf(fit.bodies, values, timestep))
    return paths


def _servo_mjcf(bodies: Bodies, values: Quantities, timestep: float) -> str:
    """Return a robot with position actuators of these values as MJCF."""
    model = bodies.model
    rigid_bodies = body_parameters(model, np.asarray(bodies.parameters))
    comment = " Delays [s] and offsets in <custom>. "
    if values["feed_forward"].any():
        comment = f"{comment}Beware: {FEED_FORWARD_CURE} (`feed_forward` in <custom>). "
    text = mjcf_text(model.robot, rigid_bodies, values, timestep, comment)
    root = etree.fromstring(text)
    root.find("option").set("integrator", "implicitfast")
    for joint in root.iter("joint"):
        # MuJoCo takes no stiffer friction than that of two time steps.
        joint.set("solreffriction", f"{2.0 * timestep!r} 1")
        joint.set("solimpfriction", STICKING_IMPEDANCE)

    actuators = root.find("actuator")
    actuators.clear()
    for k, name in enumerate(model.robot.joint_names):
        actuators.append(_actuator(name, k, values))
    if values["integral_gain"].any():
        root.append(E.extension(E.plugin(plugin="mujoco.pid")))
    numbers = {
        "delay": values["delay"],
        "offset": values["offset"],
        "feed_forward": values["feed_forward"] / values["stiffness"],
    }
    elements = (E.numeric(name=k, data=exact_text(x)) for k, x in numbers.items())
    root.append(E.custom(*elements))
    return etree.tostring(root, pretty_print=True, encoding="unicode")


def _actuator(name: str, joint: int, values: Quantities) -> Any:
    """Return the element of a joint's servo."""
    gain = exact_text(values["stiffness"][joint])
    integral_gain = values["integral_gain"][joint]
    if integral_gain > 0.0:
        element: Any = E.plugin(
            E.config(key="kp", value=gain),
            E.config(key="ki", value=exact_text(integral_gain)),
            name=name,
            joint=name,
            plugin="mujoco.pid",
            actdim="1",
        )
    else:
        element = E.position(name=name, joint=name, kp=gain)
    limit = values["effort_limit"][joint]
    if np.isfinite(limit):
        element.set("forcerange", exact_text((-limit, limit)))
    return element
