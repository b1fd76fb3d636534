"""Parameters in words, for readers who do not know their symbols."""

import re

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.result_table import Column, Table
from jaxid.robot.robot import Robot


def in_words(name: str, model: Model) -> tuple[str, str]:
    """Return the meaning of a standard parameter, and the body or joint that has it."""
    parts = re.fullmatch(r"(.+?)_?(\d+)", name)
    symbol, number = parts.groups() if parts else (name, "")
    joint = _joint(model.robot, number)
    for term in model.terms:
        if symbol in term.meanings:
            of_body = f"body {number}, moved by {joint}"
            return term.meanings[symbol], of_body if term.body_parameters else joint
    return "effect of a model of your own", joint


def _joint(robot: Robot, place: str) -> str:
    if not place or not 0 < int(place) <= robot.joints:
        return ""
    name = robot.joint_names[int(place) - 1]
    return name if name.lower().startswith("joint") else f"joint {name}"


def word_columns(base: BaseParameters) -> list[Column]:
    """Return columns with what each base parameter is, and of which body or joint."""
    meanings, places = zip(
        *(in_words(name, base.model) for name in base.names), strict=True
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
        meaning, _ = in_words(name, model)
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
