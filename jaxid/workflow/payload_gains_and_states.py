"""Several runs of a robot: payload, gains of drives, states like cold and warm."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.drive_gains import DriveGains, identify_drive_gains
from jaxid.identification.estimators import Complete
from jaxid.identification.fit_result import Fit
from jaxid.identification.force_sensor import identify_sensor_rotation
from jaxid.identification.friction_laws import identify_transition_speeds
from jaxid.identification.identify import fit_problem
from jaxid.identification.operating_states import identify_states
from jaxid.identification.payload import (
    CENTRAL_NAMES,
    CENTRAL_UNITS,
    Payload,
    body_columns,
    identify_payload,
)
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.columns import Columns
from jaxid.measurement.observations import Observations
from jaxid.report.payload_gains_states_pages import (
    gains_answer,
    payload_answer,
    states_answer,
)
from jaxid.report.result_records import estimate_rows
from jaxid.report.several_runs_report import RunsReport
from jaxid.result_table import Remark, Status
from jaxid.robot.inertia import INERTIAL_NAMES, INERTIAL_UNITS, Tool
from jaxid.validation.diagnosis import mistakes_in_logs
from jaxid.validation.torque_errors import errors_of_parameters
from jaxid.validation.wrench_checks import wrench_remarks

from .force_sensor_payload import ForceSensor, with_drifting_bias
from .log_loading import load_logs, select_filter
from .setup import Paths, Progress, Setup, ignore_progress

PAYLOAD_KEYS = ("mass", "centre_of_mass", "inertia", "estimate", "distance")
"""Properties of a payload in its JSON file."""
MIN_CHANCE_OF_SHARING = 0.01
"""Chance below which states do not agree on what they share."""


class Runs(NamedTuple):
    """Fits of several runs by their names, and doubts about their logs."""

    fits: dict[str, Fit]
    logs: dict[str, list[Observations]]  # logs of each run
    remarks: list[Remark]
    sources: Mapping[str, Sequence[Path]]  # paths of the logs of each run
    gain_doubts: list[Remark]  # doubts about the gains of the forces


def fit_runs(
    setup: Setup,
    groups: Mapping[str, Sequence[Path]],
    columns: Columns,
    progress: Progress = ignore_progress,
) -> Runs:
    """Fit the logs of each run, by weighted least squares.

    Args:
        setup: How logs become parameters.
        groups: Logs of each run, by its name.
        columns: Meaning of the columns of the logs.
        progress: Callback, called with a stage and its completed fraction (0 to 1).
    """
    remarks = []
    if not has_plain_estimator(setup):
        text = (
            "this command always uses weighted least squares: the rest of "
            "`[estimator]` is ignored"
        )
        remarks.append(Remark(text, Status.DOUBTFUL))
    progress("finding base parameters", 0.0)
    paths = [path for group in groups.values() for path in group]
    setup = select_filter(setup, paths, columns, progress)
    runs = Runs({}, {}, remarks, groups, [])
    for name in groups:
        fit = add_run(runs, setup, name, columns, progress)
        # The columns of all runs must be the same.
        setup = dataclasses.replace(setup, unknowns=fit.base)
    return runs


def has_plain_estimator(setup: Setup) -> bool:
    """Return whether the estimator is least squares, perhaps with bounds of bodies."""
    is_complete = isinstance(setup.least_squares.solution, Complete)
    is_unbounded = setup.unbounded_estimator is setup.least_squares
    return is_unbounded and is_complete


def add_run(
    runs: Runs, setup: Setup, name: str, columns: Columns, progress: Progress
) -> Fit:
    """Add the fit to the logs of one run, these logs, and doubts."""
    logs = load_logs(setup, runs.sources[name], columns, progress)
    observations = [log.observations for log in logs]
    row_progress = partial(progress, f"factorising the rows, {name}")
    base = identify_transition_speeds(setup.base, observations)
    # The first run tells how a force sensor is turned.
    base = identify_sensor_rotation(base, observations, turns=not runs.fits)
    rows = RegressionProblem(base, observations, row_progress)
    fit = dataclasses.replace(fit_problem(rows, setup.least_squares), name=name)
    mistakes = mistakes_in_logs([log.diagnosis for log in logs], fit)
    runs.remarks.extend(_as_doubts([text for log in logs for text in log.findings]))
    doubts = runs.gain_doubts if mistakes.are_gains else runs.remarks
    doubts.extend(_as_doubts(mistakes.certain))
    runs.fits[name] = fit
    runs.logs[name] = observations
    return fit


def separate_groups(unloaded: Paths, loaded: Paths) -> dict[str, list[Path]]:
    """Return the logs without and with a load.

    Raises:
        InputError: If a log is in both.
    """
    groups = {
        "unloaded": [Path(log) for log in unloaded],
        "loaded": [Path(log) for log in loaded],
    }
    places = [{os.path.realpath(log) for log in logs} for logs in groups.values()]
    shared_places = set.intersection(*places)
    if shared_places:
        raise InputError(
            f"`{Path(min(shared_places)).name}` is given both as a log without and as "
            "a log with the load: name it once."
        )
    return groups


def identify_payload_from_logs(
    setup: Setup,
    unloaded: Paths,
    loaded: Paths,
    columns: Columns,
    body: int | None = None,
    mass: float | None = None,
    progress: Progress = ignore_progress,
    sensor: ForceSensor | None = None,
) -> RunsReport:
    """Identify a payload from logs without it and logs with it.

    Args:
        setup: How logs become parameters.
        unloaded: Logs without the payload.
        loaded: Logs with the payload.
        columns: Meaning of the columns of the logs.
        body: Joint that moves the payload; the last one by default.
        mass: Mass of the payload, if it is known [kg].
        progress: Callback, called with a stage and its completed fraction (0 to 1).
        sensor: Force sensor in front of the payload, if there is one: then logs without
            the payload may be missing, and forces of the joints.
    """
    groups = separate_groups(unloaded, loaded)
    if sensor is not None:
        if body is not None:
            raise InputError(
                "`body` (`--body`) must not be given with `[sensor]`: the payload is "
                "behind the sensor, on the end-effector."
            )
        setup = sensor.beside(setup, columns)
        columns = sensor.columns(columns)
        # The load tells how the sensor is turned.
        groups = {name: groups[name] for name in ("loaded", "unloaded") if groups[name]}
    elif not unloaded:
        raise InputError(
            "give a log without the payload, too; or describe a force sensor in "
            "`[sensor]`, behind which everything is payload."
        )
    runs = fit_runs(setup, groups, columns, progress)
    unloaded_fit = runs.fits.get("unloaded")
    loaded_fit = runs.fits["loaded"]
    logs = runs.logs["loaded"]
    payload = identify_payload(unloaded_fit, loaded_fit, body=body, mass=mass)
    remarks = [*runs.remarks, *runs.gain_doubts]
    if sensor is not None:
        payload = with_drifting_bias(payload, unloaded_fit, loaded_fit.base, logs, mass)
        wrench_doubts = _wrench_remarks(setup, logs)
        is_misread = any(x.status is Status.BAD for x in wrench_doubts)
        payload = dataclasses.replace(payload, is_misread=is_misread)
        remarks += wrench_doubts
    return payload_report(payload, loaded_fit, logs, runs.sources, remarks, progress)


def _wrench_remarks(setup: Setup, logs: Sequence[Observations]) -> list[Remark]:
    """Return what is wrong with the wrenches of a load, each behind its log's name."""
    return [
        dataclasses.replace(remark, text=f"{log.name}: {remark.text}")
        for log in logs
        for remark in wrench_remarks(setup.model, log)
    ]


def payload_report(
    payload: Payload,
    loaded_fit: Fit,
    logs: Sequence[Observations],
    sources: Mapping[str, Sequence[Path]],
    doubts: Sequence[Remark],
    progress: Progress,
) -> RunsReport:
    """Return the report on a payload: its numbers, and errors on the logs with it."""
    robot = loaded_fit.base.model.robot
    estimates = estimate_rows(
        INERTIAL_NAMES, INERTIAL_UNITS, payload.parameters, payload.uncertainty
    )
    estimates += estimate_rows(CENTRAL_NAMES, CENTRAL_UNITS, *payload.central)
    content = {key: getattr(payload, key) for key in PAYLOAD_KEYS}
    content["body"] = robot.body_names[payload.body]
    if payload.sensor is not None:
        sensor = payload.sensor
        estimates += estimate_rows(
            sensor.names, sensor.units, sensor.values, sensor.uncertainty
        )
    progress("predicting torques", 0.0)
    parameters = payload.base_parameters[1]
    load = body_columns(loaded_fit.base, payload.body) @ payload.parameters
    answer = payload_answer(
        payload,
        robot,
        errors_of_parameters(loaded_fit, parameters - load, logs),
        errors_of_parameters(loaded_fit, parameters, logs),
    )
    return RunsReport(
        "payload",
        payload,
        answer,
        estimates,
        content,
        sources,
        doubts,
        model=loaded_fit if payload.sensor is not None else None,
    )


def identify_gains_from_logs(
    setup: Setup,
    unloaded: Paths,
    loaded: Paths,
    columns: Columns,
    load: Tool | float,
    progress: Progress = ignore_progress,
) -> RunsReport:
    """Identify the gains of the drives from logs without and with a known load.

    Args:
        setup: How logs become parameters.
        unloaded: Logs without the load.
        loaded: Logs with the load.
        columns: Meaning of the columns of the logs.
        load: The load; or its mass if it is at the end-effector [kg].
        progress: Callback, called with a stage and its completed fraction (0 to 1).
    """
    groups = separate_groups(unloaded, loaded)
    runs = fit_runs(setup, groups, columns, progress)
    unloaded_fit = runs.fits["unloaded"]
    loaded_fit = runs.fits["loaded"]
    drives = identify_drive_gains(unloaded_fit, loaded_fit, load)
    names = drives.joint_names
    units = ("1",) * len(names)
    estimates = estimate_rows(names, units, drives.gains, drives.uncertainty)
    content = corrected_gains(columns, drives)
    ((key, values),) = content.items()
    answer = gains_answer(drives, setup.robot, key, values)
    # That forces seem to need gains is no doubt where gains are identified.
    return RunsReport(
        "gains",
        drives,
        answer,
        estimates,
        content,
        runs.sources,
        runs.remarks,
    )


def _as_doubts(texts: Sequence[str]) -> list[Remark]:
    """Return sentences as remarks that deserve attention."""
    return [Remark(text, Status.DOUBTFUL) for text in texts]


def corrected_gains(columns: Columns, drives: DriveGains) -> dict[str, list[float]]:
    """Return the argument of `Columns` that corrects the forces."""
    key = "force_gains" if columns.torque_constants is None else "torque_constants"
    present_values = getattr(columns, key)
    factors = np.array(1.0 if present_values is None else present_values)
    return {key: (factors * drives.gains).tolist()}


def identify_states_from_logs(
    setup: Setup,
    logs: Paths,
    columns: Columns,
    progress: Progress = ignore_progress,
) -> RunsReport:
    """Identify a robot in several states at once: one inertia, friction for each state.

    Args:
        setup: How logs become parameters.
        logs: A log for each state; their names are those of the states.
        columns: Meaning of the columns of the logs.
        progress: Callback, called with a stage and its completed fraction (0 to 1).
    """
    paths = [Path(log) for log in logs]
    groups = {Path(os.path.realpath(path)).stem: [path] for path in paths}
    if len(groups) < max(len(paths), 2):
        raise InputError(
            "give one log for each of two or more states, with different names."
        )
    runs = fit_runs(setup, groups, columns, progress)
    states = identify_states(list(runs.fits.values()))
    remarks = [*runs.remarks, *runs.gain_doubts]
    _, chance = states.sharing
    if chance < MIN_CHANCE_OF_SHARING:
        text = (
            "the states differ in more than friction and offsets (the probability of "
            f"such differences by chance is {100 * chance:.2g} %)"
        )
        remarks.append(Remark(text, Status.DOUBTFUL))
    first_state, *other_states = groups
    comparisons = [states.compare(first_state, state) for state in other_states]
    kind_tables = [comparison.group_summary() for comparison in comparisons]
    parameter_tables = [comparison.summary() for comparison in comparisons]
    progress("predicting torques", 0.0)
    errors = {
        state: errors_of_parameters(fit, states.fit(state).parameters, runs.logs[state])
        for state, fit in runs.fits.items()
    }
    content = {
        "states": states.states,
        "shared": [states.base.names[k] for k in states.shared],
        "varying": [states.base.names[k] for k in states.varying],
        "sharing_chance": chance,
    }
    return RunsReport(
        "states",
        states,
        states_answer(states, errors),
        estimate_rows(
            states.names, states.units, states.parameters, states.uncertainty
        ),
        content,
        {"states": paths},
        remarks,
        details=[*kind_tables, *parameter_tables],
        glance=kind_tables,
    )
