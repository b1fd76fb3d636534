"""Parameters in words, for readers who do not know their symbols."""

import re

import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.result_table import Column
from jaxid.robot.robot import Robot

FRAMES_NOTE = (
    "Joints and bodies are numbered from the base. Masses times distances, and "
    "moments of inertia, are about the origin of the body's frame, which lies on the "
    "axis of its joint, and along the frame's axes. Friction and rotor inertia are "
    "given at the joint, on the output side of the gear."
)
"""Frames and sides in which parameters are given."""


def in_words(name: str, model: Model) -> tuple[str, str]:
    """Return the meaning of a standard parameter, and the body or joint that has it."""
    parts = re.fullmatch(r"(.+?)_?(\d+)", name)
    symbol, number = parts.groups() if parts else (name, "")
    joint = _joint(model.robot, number)
    for term in model.terms:
        if symbol in term.meanings:
            body = f"body of {joint}"
            return term.meanings[symbol], body if term.body_parameters else joint
    return "effect of a model of your own", joint


def _joint(robot: Robot, number: str) -> str:
    """Return a joint by its number; nothing if the robot has no such joint."""
    if not number or int(number) not in robot.numbers:
        return ""
    # All bodies of a group of virtual joints have one number; the last one has a mass.
    body = max(i for i, x in enumerate(robot.numbers) if x == int(number))
    if body in robot.virtual:
        return robot.body_names[body]
    name = robot.body_names[body]
    return name if name.lower().startswith("joint") else f"joint {name}"


def word_columns(base: BaseParameters) -> list[Column]:
    """Return columns with what each base parameter is, and of which body or joint.

    A star marks parameters that are combined with others.
    """
    is_combined = np.any(base.kappa != 0.0, axis=1)
    meanings = []
    places = []
    for name, needs_star in zip(base.names, is_combined, strict=True):
        meaning, place = in_words(name, base.model)
        meanings.append(f"{meaning}\N{NO-BREAK SPACE}*" if needs_star else meaning)
        places.append(place)
    return [Column("in words", meanings), Column("of", places)]
