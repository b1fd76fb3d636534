"""Parameters in words, for readers who do not know their symbols."""

import re

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.result_table import Column, Table
from jaxid.robot.robot import Robot

BODY = {
    "m": "mass",
    **{f"m{a}": f"mass times {a} of the centre of mass" for a in "xyz"},
    **{
        symbol: f"moment of inertia about {a}"
        for symbol, a in zip("ABC", "xyz", strict=True)
    },
    **{
        s: f"product of inertia in {p}"
        for s, p in zip("DEF", ("y, z", "x, z", "x, y"), strict=True)
    },
}
"""Meanings of the inertial parameters of a body."""
JOINT = {
    "fv": "viscous friction: grows with speed",
    "fvp": "viscous friction, forwards",
    "fvn": "viscous friction, backwards",
    "fc": "Coulomb friction: the same at any speed",
    "fcp": "Coulomb friction, forwards",
    "fcn": "Coulomb friction, backwards",
    "fr": "friction that grows with the root of speed",
    "fs": "static friction, above Coulomb's",
    "fl": "friction in proportion to the load",
    "fo": "constant offset: of the sensor, or of friction",
    "ks": "stiffness of the spring",
    "Ia": "inertia of the motor's rotor, seen from the joint",
    "Iam": "inertia of the rotor of a coupled motor",
    "fvm": "viscous friction of a coupled motor",
    "fcm": "Coulomb friction of a coupled motor",
}
"""Meanings of the parameters of a joint."""


def in_words(name: str, robot: Robot) -> tuple[str, str]:
    """Return what a standard parameter is, and to which body or joint it belongs."""
    wave = re.fullmatch(r"([sc][mj])(\d+)_(\d+)", name)
    if wave:
        side, times, place = wave.groups()
        kind = "sine" if side[0] == "s" else "cosine"
        turns = "motor" if side[1] == "m" else "joint"
        return f"ripple: {kind}, {times} times a turn of the {turns}", _joint(
            robot, place
        )
    found = re.fullmatch(r"([A-Za-z]+?)(\d+)", name)
    symbol, place = found.groups() if found else (name, "")
    if symbol in BODY:
        return BODY[symbol], f"body {place}, moved by {_joint(robot, place)}"
    return JOINT.get(symbol, "effect of a model of your own"), _joint(robot, place)


def _joint(robot: Robot, place: str) -> str:
    if not place or not 0 < int(place) <= robot.joints:
        return ""
    name = robot.joint_names[int(place) - 1]
    return name if name.lower().startswith("joint") else f"joint {name}"


def word_columns(base: BaseParameters) -> list[Column]:
    """Return columns with what each base parameter is, and of which body or joint."""
    meanings, places = zip(
        *(in_words(name, base.model.robot) for name in base.names), strict=True
    )
    mixed = np.any(np.asarray(base.kappa) != 0.0, axis=1)
    shown = [
        f"{text}\N{NO-BREAK SPACE}*" if more else text
        for text, more in zip(meanings, mixed, strict=True)
    ]
    return [Column("in words", shown), Column("of", places)]


def glossary(base: BaseParameters) -> Table:
    """Return the symbols of a model with their meanings, each once."""
    model, rows = base.model, {}
    for name, unit in model.parameters:
        symbol = re.sub(r"\d+(_\d+)?$", "", name)
        meaning, _ = in_words(name, model.robot)
        rows.setdefault(symbol, (f"{symbol}1, …", meaning, unit))
    symbols, meanings, units = zip(*rows.values(), strict=True)
    text = (
        "Numbers count joints and bodies from the base. Masses times distances, and "
        "moments of "
        "inertia, are about the origin of the body's frame, which lies on the axis of "
        "its joint, "
        "and along the frame's axes. Friction and rotors are seen from the joint, "
        "behind the gear"
    )
    return Table(
        "",
        Column("symbol", symbols),
        Column("meaning", meanings),
        Column("unit", units),
        remarks=[text],
    )
