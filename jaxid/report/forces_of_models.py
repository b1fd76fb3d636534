"""Figure of the forces of a log, and what several models predict of it."""

from collections.abc import Mapping

import numpy as np

from jaxid.identification.model_selection import HeldOutPrediction
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors

from .figure import Figure
from .figure_elements import (
    BLUE,
    GREY,
    MEASUREMENT_COLOUR,
    PREDICTION_COLOUR,
    Curve,
    Panel,
)

MODEL_COLOURS = (BLUE, PREDICTION_COLOUR)
"""Colours of two models over one log."""


Predictions = Mapping[str, HeldOutPrediction | TorqueErrors]
"""Predictions of two models for one log, by their names."""


def model_force_figure(predictions: Predictions, robot: Robot, title: str) -> Figure:
    """Return the measured forces of each joint, those of two models, and their errors.

    Args:
        predictions: What each model predicts, by its name; all of one log.
        robot: Robot of the log.
        title: Title of the figure.
    """
    errors = np.asarray(next(iter(predictions.values())).errors)
    # Forces of some joints may not be measured.
    is_measured = np.isfinite(errors).any(axis=0)
    joints = np.flatnonzero(is_measured).tolist()
    panels = [_joint_panel(predictions, robot, j) for j in joints]
    columns = 2 if len(panels) > 2 else 1
    return Figure(title, panels, columns, height=3.2)


def _joint_panel(predictions: Predictions, robot: Robot, joint: int) -> Panel:
    """Return the forces of a joint, with the errors of the models below."""
    unit = robot.force_unit(joint)
    log = next(iter(predictions.values()))
    measured_forces = np.asarray(log.measured)[:, joint]
    curves = [
        Curve(log.time, measured_forces, "measured", MEASUREMENT_COLOUR, width=1.9)
    ]
    error_curves = []
    for (name, prediction), colour in zip(
        predictions.items(), MODEL_COLOURS, strict=True
    ):
        errors = np.asarray(prediction.errors)[:, joint]
        predicted_forces = measured_forces + errors
        curves.append(Curve(log.time, predicted_forces, name, colour, width=0.8))
        error_curves.append(Curve(log.time, errors, name, colour, width=0.6))
    error_panel = Panel(
        error_curves, y="error", unit=unit, levels=[("y", 0.0, GREY)], share=0.6
    )
    return Panel(
        curves,
        title=robot.joint_names[joint],
        y="torque" if robot.revolute[joint] else "force",
        unit=unit,
        below=[error_panel],
    )
