"""Contents of the pages of a payload, of gains and of states: numbers and figures."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np

from jaxid.identification.drive_gains import DriveGains
from jaxid.identification.fit_result import Fit
from jaxid.identification.operating_states import StatesFit
from jaxid.identification.parameter_changes import Verdict
from jaxid.identification.payload import Payload
from jaxid.result_table import percent, significant, with_deviation
from jaxid.robot.collision_geometry import Shape
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors, relative_error

from .comparison_figure import comparison_figure
from .figure import Figure
from .figure_elements import CYCLE, GREY, Curve, Panel
from .friction_figures import friction_figure
from .motion_figures import pose_figure, surface_points
from .parameter_words import FRAMES_NOTE
from .several_runs_report import Answer
from .torques import model_force_figure

Errors = Sequence[TorqueErrors]
"""Torque errors on some logs."""
BALL_MASS = 11_310.0
"""Mass of an aluminium ball with a radius of 1 m [kg]."""


def payload_answer(
    payload: Payload, robot: Robot, unloaded: Errors, loaded: Errors
) -> Answer:
    """Return what the page of a payload says and shows.

    Args:
        payload: The payload.
        robot: Robot that carries it.
        unloaded: Errors of the model without the payload on the loaded logs.
        loaded: Errors of the model with it on the same logs.
    """
    joint = robot.body_names[payload.body]
    residual, loaded_residual = map(percent, payload.residuals)
    comparison = (f"{residual} %", "torque error on the logs without the payload")
    place = f"on {joint}"
    error = "torque error"
    if payload.sensor is not None:
        place = "at the sensor"
        # A sensor's log may have no torques.
        error = "error"
        rotation = np.rad2deg(np.linalg.norm(payload.sensor.rotation))
        comparison = (
            f"{significant(rotation, 2)} deg",
            "rotation of the force sensor against its description",
        )
    half_widths = payload.uncertainty.half_widths()
    mass, half_width = with_deviation(payload.mass, half_widths[0])
    figures = []
    for errors, loaded_errors in zip(unloaded, loaded, strict=True):
        title = (
            f"{errors.name}: {percent(errors.relative)} % error (RMS) without the "
            f"payload, {percent(loaded_errors.relative)} % with it"
        )
        predictions = {
            "model without the payload": errors,
            "model with the payload": loaded_errors,
        }
        figures.append(model_force_figure(predictions, robot, title))
    if loaded and payload.mass > 0:
        figures.insert(0, payload_figure(payload, robot, loaded[0]))
    return Answer(
        f"{robot.name}: payload",
        f"The payload {place} has a mass of {mass} ± {half_width} kg, and the {error} "
        f"of the model with it is {loaded_residual} %",
        [
            (f"{mass} ± {half_width} kg", "mass, with its 95 % interval"),
            (
                f"{loaded_residual} %",
                f"{error} (RMS over RMS) on the logs with the payload",
            ),
            comparison,
        ],
        figures,
        f"All values are in the frame of the body that {joint} moves. A_c to F_c are "
        "about the centre of mass, along the axes of this frame.",
        tool_lines(payload, robot),
    )


def payload_figure(payload: Payload, robot: Robot, log: TorqueErrors) -> Figure:
    """Return the robot along a log, with a ball of the payload's mass at its centre."""
    radius = np.cbrt(payload.mass / BALL_MASS)
    ball = surface_points(Shape(payload.centre_of_mass[None], radius))
    return pose_figure(
        robot,
        log.positions,
        time=log.time,
        title=f"{log.name}: the payload as an aluminium ball of "
        f"{significant(payload.mass)} kg",
        clouds=[(payload.body, ball)],
    )


def tool_lines(payload: Payload, robot: Robot) -> list[str]:
    """Return the table of an experiment file that subtracts a payload."""
    joint = robot.body_names[payload.body]
    centre_of_mass = payload.centre_of_mass
    inertia = payload.inertia
    if payload.sensor is not None:
        # The body behind the sensor is in no file: the load is at the end-effector.
        tip_rotation = robot.tip_rotation
        centre_of_mass = (centre_of_mass - robot.tip_offset) @ tip_rotation
        inertia = tip_rotation.T @ inertia @ tip_rotation
    centre = [f"{value:.6g}" for value in centre_of_mass]
    lines = [
        "[robot.tool]",
        # A text of JSON is one of TOML.
        f"body = {json.dumps(joint, ensure_ascii=False)}",
        f"mass = {payload.mass:.6g}",
        f"centre_of_mass = [{', '.join(centre)}]",
    ]
    if payload.sensor is not None:
        del lines[1]
    if payload.has_inertia:
        entries = []
        for i, j in zip(*np.triu_indices(3), strict=True):
            entries.append(f"{'xyz'[i]}{'xyz'[j]} = {inertia[i, j]:.6g}")
        lines.append(f"inertia = {{ {', '.join(entries)} }}")
    return lines


def gains_answer(
    drives: DriveGains, robot: Robot, key: str, values: Sequence[float]
) -> Answer:
    """Return what the page of drive gains says and shows.

    Args:
        drives: The gains.
        robot: Robot of the drives.
        key: Key of the experiment file that corrects the forces.
        values: Its values, one for each joint.
    """
    half_widths = drives.uncertainty.half_widths()
    is_determined = np.isfinite(half_widths)
    count = np.count_nonzero(is_determined)
    misfit, min_misfit = map(percent, drives.misfits)
    digits = ", ".join(significant(value, 5) for value in values)
    # A gain that is not determined has no interval.
    half_widths[~is_determined] = np.nan
    curve = Curve(
        drives.gains,
        np.arange(robot.joints),
        kind="intervals",
        low=drives.gains - half_widths,
        high=drives.gains + half_widths,
        texts=[": ".join(row[:2]) for row in drives.summary().rows],
    )
    panel = Panel(
        [curve],
        x="gain: true force over force of the log",
        y_names=robot.joint_names,
        levels=[("x", 1.0, GREY)],
    )
    height = 0.8 + 0.3 * robot.joints
    return Answer(
        f"{robot.name}: gains of the drives",
        f"The logs determine {count} of {robot.joints} gains, and the torque error of "
        f"the model with the load is {misfit} %",
        [
            (f"{count} of {robot.joints}", "gains that the logs determine"),
            (f"{misfit} %", "torque error (RMS over RMS) with the load as described"),
            (
                f"{min_misfit} %",
                "torque error with the best load of the same mass",
            ),
        ],
        [Figure("Gains with their 95 % intervals", [panel], height=height)],
        "The true force of a joint is its gain times the force of the log. A gain that "
        "the logs do not determine stays 1, and has no interval in the figure.",
        ["[recording]", f"{key} = [{digits}]"],
    )


def states_answer(states: StatesFit, errors: Mapping[str, Errors]) -> Answer:
    """Return what the page of several states says and shows.

    Args:
        states: The states.
        errors: Torque errors of each state's model on its logs, as far as given.
    """
    first_state, *other_states = states.states
    comparisons = [states.compare(first_state, state) for state in other_states]
    changes = max(x.verdicts.count(Verdict.CHANGED) for x in comparisons)
    count = f"{changes} of {len(states.varying)}"
    _, chance = states.sharing
    numbers = [
        (count, "parameters of friction and offsets that have changed"),
        (
            f"{percent(chance)} %",
            "probability of the other differences by chance",
        ),
    ]
    figures = [comparison_figure(x) for x in comparisons]
    groups = {state: logs for state, logs in errors.items() if logs}
    if groups:
        missed_share = percent(
            relative_error([x for logs in groups.values() for x in logs])
        )
        numbers.append(
            (f"{missed_share} %", ("torque error (RMS over RMS) over all states"))
        )
        fits = {state: states.fit(state) for state in groups}
        figures.insert(0, state_friction_figure(fits, errors))
    return Answer(
        f"{states.base.model.robot.name}: {len(states.states)} states",
        f"{count} parameters of friction and offsets have changed from {first_state} "
        f"to {', '.join(other_states)}",
        numbers,
        figures,
        FRAMES_NOTE,
    )


def state_friction_figure(
    fits: Mapping[str, Fit], errors: Mapping[str, Errors]
) -> Figure:
    """Return the friction of each joint against speed, of all states in one panel."""
    panels: dict[str, Panel] = {}
    curves: dict[str, list[Curve]] = {}
    for (state, fit), colour in zip(fits.items(), cycle(CYCLE), strict=False):
        for panel in friction_figure(fit, errors[state]).panels:
            panels.setdefault(panel.title, panel)
            model, measured = panel.curves[-2:]
            curves.setdefault(panel.title, []).extend(
                [
                    dataclasses.replace(model, name=state, colour=colour),
                    dataclasses.replace(
                        measured, name=f"{state}, measured", colour=colour
                    ),
                ]
            )
    merged_panels = [
        dataclasses.replace(panel, curves=curves[title], value="")
        for title, panel in panels.items()
    ]
    return Figure("Friction of the states", merged_panels, min(3, len(panels)))
