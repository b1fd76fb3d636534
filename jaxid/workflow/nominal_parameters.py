"""Knowledge before an experiment: parameters, limits of forces, earlier motions."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float, Texts, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.excitation.constraints import ForceLimits
from jaxid.report.result_files import read_fit
from jaxid.robot.inertia import IMPOSSIBLE
from jaxid.robot.limits_and_drives import complete_limits
from jaxid.robot.loop_closing import reachable
from jaxid.robot.robot import Robot

from .excitation_settings import Excitation
from .robot_file import claimed_parameters
from .setup import Setup

UNKNOWN_SHARE = 0.3
"""Fraction of the largest forces kept free where friction or the like is unknown."""
RANDOM_POSES = 2000
"""Number of random poses in which the forces of gravity are computed."""

NO_INERTIAS = (
    "not checked: no inertias are known; give a report as `excitation.nominal`"
)
NO_MAX_FORCES = "not checked: no largest forces are known; give `limits.force`"


class Nominal(NamedTuple):
    """Base parameters as far as they are known before the experiment."""

    parameters: np.ndarray  # values; NaN where nothing is known
    # covariance of an earlier fit, zero for what it does not determine; None if they
    # are claims
    covariance: Float[np.ndarray, "base base"] | None
    undetermined: Texts = ()  # names of what an earlier fit leaves open


def find_nominal(setup: Setup, excitation: Excitation) -> Nominal | None:
    """Return parameters of an earlier result, or those that the robot's file claims.

    Raises:
        InputError: If the earlier result is of other parameters.
    """
    if excitation.nominal is not None:
        return _of_earlier_fit(setup.base, excitation.nominal)
    claims = {} if setup.robot_file is None else setup.robot_file.claims()
    if not claims:
        return None
    return Nominal(claimed_parameters(claims, setup.base), None)


def _of_earlier_fit(base: BaseParameters, report: str) -> Nominal:
    """Return the parameters of an earlier report."""
    fit = read_fit(Path(report))
    if fit.base.names != base.names:
        raise InputError(
            f"`nominal`: the base parameters of `{report}` "
            f"are not the {base.size} of this file."
        )
    covariance = np.array(fit.covariance)
    is_undetermined = ~np.isfinite(np.diag(covariance))
    covariance[is_undetermined | is_undetermined[:, None]] = 0.0
    names = tuple(base.names[k] for k in np.flatnonzero(is_undetermined))
    return Nominal(fit.parameters, covariance, names)


def require_weight(setup: Setup, nominal: Nominal | None) -> None:
    """Reject a robot on its feet of whose weight nothing is known: it might fall."""
    if nominal is None:
        raise InputError(
            f"`{setup.robot.name}` stands on its feet, and nothing is known of its "
            "masses, so that nobody can say whether a motion makes it fall: give a "
            "robot's file with inertias, or a report as `excitation.nominal`."
        )


class LimitedForces(NamedTuple):
    """Limits of the forces in a design; or why there are none."""

    limits: ForceLimits | None
    fault: str  # why forces are not checked; empty if they are


def limit_forces(
    setup: Setup, excitation: Excitation, nominal: Nominal | None
) -> LimitedForces:
    """Return limits of the forces by nominal parameters, or why there are none.

    Raises:
        InputError: If `force_margin` is given, but forces cannot be limited: nothing is
            known of them, or gravity alone exceeds the limits.
    """
    limits = None
    impossible_bodies = [note for note in setup.robot.notes if IMPOSSIBLE in note]
    fault = NO_INERTIAS
    if impossible_bodies:
        fault = f"not checked: {impossible_bodies[0].removesuffix('.')}"
    margin = excitation.force_margin
    if nominal is not None:
        has_unknown_parameters = np.isnan(nominal.parameters).any()
        default_margin = UNKNOWN_SHARE if has_unknown_parameters else 0.0
        limits = ForceLimits(
            setup.base,
            np.nan_to_num(nominal.parameters),
            nominal.covariance,
            default_margin if margin is None else margin,
        )
        is_limited = limits.entries(setup.robot)
        fault = gravity_fault(setup.robot, limits) if is_limited else NO_MAX_FORCES
    # A user who gives a margin relies on the limits: then a fault is an error.
    if fault and margin is not None:
        raise InputError(f"`force_margin`: {fault}.")
    return LimitedForces(None if fault else limits, fault)


def gravity_fault(robot: Robot, limits: ForceLimits) -> str:
    """Return which joint cannot hold any pose of its range; empty if all can."""
    q = random_poses(robot)
    rest_motion = Motion(q, np.zeros_like(q), np.zeros_like(q))
    with double_precision():
        excess = np.asarray(limits(robot, rest_motion))
    largest_excess = excess.max(axis=1)
    best_pose = int(largest_excess.argmin())
    if largest_excess[best_pose] <= 0:
        return ""
    finding = limits.entries(robot)[int(excess[best_pose].argmax())]
    force = finding.limit * (1.0 + largest_excess[best_pose])
    return (
        f"in each of {RANDOM_POSES} random poses, gravity exceeds a force limit; in "
        f"the best pose {finding.name} must be {force:.3g}, but the limit is "
        f"{finding.limit:.3g} {finding.unit}: check efforts and inertias of the "
        "robot's file, or give `limits.force`"
    )


def random_poses(robot: Robot) -> np.ndarray:
    """Return random poses within the joints' range, the first of them near zero."""
    limits = complete_limits(robot)
    low = limits.position_min
    high = limits.position_max
    poses = np.random.default_rng(0).uniform(low, high, (RANDOM_POSES, robot.joints))
    poses[0] = np.clip(0.0, low, high)
    return reachable(robot, poses)
