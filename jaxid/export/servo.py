"""Identified servos for simulators: MJCF files, and the numbers that Isaac Lab takes."""

from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

from jaxid.arrays import AnyArray, Float, Numbers
from jaxid.errors import InputError
from jaxid.io import write_text
from jaxid.result_table import Column, Table
from jaxid.rollout.result import ServoFit
from jaxid.rollout.servo import INDEX, START

from .simulators import mjcf_text
from .torque_program import body_parameters

STICKING = "0.99 0.9999 0.001"
"""Impedance with which MuJoCo's dry friction holds a joint almost without creep."""


def servo_stiffness(
    fit: ServoFit, stiffness: Numbers | None = None
) -> Float[np.ndarray, " joints"]:
    """Return the stiffness of each servo: given, that of the fit, or that of the other joints.

    Args:
        fit: Identified servos.
        stiffness: Stiffness, one for all joints or one for each [N m/rad or N/m]; that
            of the fit where it is None or NaN.

    Raises:
        InputError: If no joint tells its stiffness and none is given.
    """
    found = fit.stiffness.copy()
    if stiffness is not None:
        given = np.broadcast_to(np.asarray(stiffness, np.float64), found.shape)
        found = np.where(np.isnan(given), found, given)
    known = np.isfinite(found)
    if not known.any():
        raise InputError(
            "`stiffness` [N m/rad] is needed: no known weight tells it, and positions "
            "tell ratios "
            "to it only. Any number gives the same motion of a robot without bodies."
        )
    return np.where(known, found, np.median(found[known]))


def simulator_values(
    fit: ServoFit, stiffness: Numbers | None = None, parameters: AnyArray | None = None
) -> dict[str, Float[np.ndarray, " joints"]]:
    """Return the numbers of each joint that simulators of actuators take.

    The damping is the sum of friction and of the servo's own: positions do not tell
    them apart. Friction that grows with load is included at the mean load of the logs.

    Args:
        fit: Identified servos.
        stiffness: Stiffness of each servo [N m/rad or N/m]; that of the fit if None.
        parameters: Other parameters of the joints, such as a draw from their
            distribution.

    Returns:
        `stiffness`, `damping`, `armature`, `friction`, `effort_limit` (infinite
        without), `delay` [s], `offset` of the command, and `integral_gain`.
    """
    x = fit.parameters if parameters is None else np.asarray(parameters)
    K, at = servo_stiffness(fit, stiffness), {key: x[:, k] for key, k in INDEX.items()}
    if stiffness is None:
        # A draw has its own stiffness where the weight tells it.
        told = np.isfinite(fit.stiffness) & fit.free[:, INDEX["a"]]
        K = np.where(told, 1.0 / np.maximum(at["a"], 1e-9), K)
    own = np.zeros(len(x))
    if fit.bodies is not None:
        # The simulator adds the inertia of the bodies, unless that has been taken out
        # already.
        bodies, rest = fit.bodies, np.zeros(len(x))
        M = np.asarray(bodies.model.mass_matrix(bodies.parameters, rest))
        own = np.where(bodies.coupled & (at["a"] > 0), 0.0, np.diag(M))
    limited = at["um"] < START[INDEX["um"]]
    return {
        "stiffness": K,
        "damping": K * at["B"],
        "armature": np.maximum(K * at["J"] - own, 0.0),
        "friction": K * (at["F"] + at["mu"] * np.abs(at["a"]) * fit.load),
        "effort_limit": np.where(limited, K * at["um"], np.inf),
        "delay": at["d"],
        "offset": at["b"],
        "integral_gain": K * at["ki"],
    }


def simulator_table(fit: ServoFit, stiffness: Numbers | None = None) -> Table:
    """Return the numbers of each joint for Isaac Lab, MuJoCo Playground and others.

    Args:
        fit: Identified servos.
        stiffness: Stiffness of each servo [N m/rad or N/m]; that of the fit if None.
    """
    values = simulator_values(fit, stiffness)
    units = ("N m/rad", "N m s/rad", "kg m²", "N m", "N m", "s", "rad", "N m/(rad s)")
    if fit.bodies is not None and not all(fit.bodies.model.robot.revolute):
        linear = ("N/m", "N s/m", "kg", "N", "N", "s", "m", "N/(m s)")
        units = [
            a if a == b else f"{a} or {b}" for a, b in zip(units, linear, strict=True)
        ]
    columns = [
        Column(name.replace("_", " "), value, unit)
        for (name, value), unit in zip(values.items(), units, strict=True)
        if name != "integral_gain" or value.any()
    ]
    known, given = np.isfinite(fit.stiffness), np.zeros(len(fit.joint_names), bool)
    for numbers in (stiffness, fit.given_stiffness):
        given |= numbers is not None and np.isfinite(np.asarray(numbers, np.float64))
    source = [
        "given" if named else "weight" if told else "other joints"
        for named, told in zip(given, known, strict=True)
    ]
    remarks = []
    if (values["delay"] < 0).any():
        remarks.append(
            "a negative delay means that positions are stamped later than commands: "
            "use 0"
        )
    if not fit.hold:
        remarks.append(
            "the delay counts for interpolated commands: held ones are later by half "
            "a step"
        )
    return Table(
        "actuators of simulators",
        Column("joint", fit.joint_names),
        *columns,
        Column("stiffness from", source),
        remarks=remarks,
    )


def export_servo_mjcf(
    fit: ServoFit,
    path: str | Path,
    *,
    stiffness: Numbers | None = None,
    samples: int = 0,
    seed: int = 0,
    timestep: float = 0.002,
) -> list[Path]:
    """Write the robot for MuJoCo, with its identified servos as position actuators.

    Controls are the commanded positions, one each in the order of the joints. MJCF has
    no delay of commands and no bias: both stand in a comment and in `<custom>` numbers
    (`delay`, `offset`). Servos with integral action are `mujoco.pid` plugins, which
    come with MuJoCo. They start without
    integral: wait until loaded joints have settled, or set `data.act`.

    Args:
        fit: Identified servos of a robot whose bodies are known.
        path: Path of the file.
        stiffness: Stiffness of each servo [N m/rad or N/m]; that of the fit if None.
        samples: Number of further files, `NAME_000.xml` …, drawn from the estimates'
            distribution.
        seed: Seed of the draws.
        timestep: Time step of the simulation [s].

    Raises:
        InputError: If the fit has no bodies, or the stiffness is not known.
    """
    if fit.bodies is None:
        raise InputError(
            "`fit` has no bodies: identify with `bodies`, or use `simulator_table`."
        )
    path = Path(path)
    paths = [path, *(path.with_stem(f"{path.stem}_{k:03d}") for k in range(samples))]
    draws = [fit.parameters, *fit.samples(samples, seed)]
    for one, parameters in zip(paths, draws, strict=True):
        values = simulator_values(fit, stiffness, parameters)
        write_text(one, servo_mjcf(fit, values, timestep))
    return paths


def servo_mjcf(fit: ServoFit, values: dict[str, Any], timestep: float) -> str:
    """Return a robot with position actuators of these values as MJCF."""
    if fit.bodies is None:
        raise InputError("`fit` has no bodies.")
    model = fit.bodies.model
    rigid = np.asarray(body_parameters(model, np.asarray(fit.bodies.parameters)))
    text = mjcf_text(
        model.robot, rigid, values, timestep, " Delays [s] and offsets in <custom>. "
    )
    root = etree.fromstring(text)
    root.find("option").set("integrator", "implicitfast")
    actuators, integral = root.find("actuator"), values["integral_gain"]
    for joint in root.iter("joint"):
        # MuJoCo takes no stiffer friction than that of two time steps.
        joint.set("solreffriction", f"{2.0 * timestep!r} 1")
        joint.set("solimpfriction", STICKING)
    for k, motor in enumerate(list(actuators)):
        name, K, limit = (
            fit.joint_names[k],
            values["stiffness"][k],
            values["effort_limit"][k],
        )
        actuators.remove(motor)
        kind = "plugin" if integral[k] > 0.0 else "position"
        servo = etree.SubElement(actuators, kind, name=name, joint=motor.get("joint"))
        if integral[k] > 0.0:
            servo.set("plugin", "mujoco.pid")
            servo.set("actdim", "1")
            for key, gain in (("kp", K), ("ki", integral[k])):
                etree.SubElement(servo, "config", key=key, value=repr(float(gain)))
        else:
            servo.set("kp", repr(float(K)))
        if np.isfinite(limit):
            servo.set("forcerange", f"{-float(limit)!r} {float(limit)!r}")
    if integral.any():
        extension = etree.SubElement(root, "extension")
        etree.SubElement(extension, "plugin", plugin="mujoco.pid")
    custom = etree.SubElement(root, "custom")
    for key in ("delay", "offset"):
        numbers = " ".join(repr(float(x)) for x in values[key])
        etree.SubElement(custom, "numeric", name=key, data=numbers)
    return etree.tostring(root, pretty_print=True, encoding="unicode")
