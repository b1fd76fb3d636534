"""The paper's robot as a virtual one: published numbers are the truth, others assumed.

Published are six base parameters, cold and warm (Sec. 6), in the layout with seven
parameters for each body; the masses of the arm's CAD model; and the largest motor
torques of the first and the last axis. All else is plausible and assumed: this file is
the list.
"""

import numpy as np

from jaxid.dynamics.terms import RigidBodies, RotorInertia
from jaxid.robot import library
from jaxid.robot.limits_and_drives import Drives
from jaxid.robot.robot import Robot

from .friction_and_ripple import (
    FrictionTemperature,
    LuGreFriction,
    SmoothFriction,
    TorqueRipple,
)
from .virtual import Sensors, VirtualRobot

COLD = {1: 273.40, 2: 1.68, 27: 248.41, 28: 41.26, 34: 312.50, 35: 18.24}
WARM = {1: 273.62, 2: 1.65, 27: 90.19, 28: 25.65, 34: 233.00, 35: 15.07}
"""Published base parameters by their numbers (Sec. 6).

They are mass [kg], first moment [kg m], viscous friction [N s/m, N m s] and dry
friction [N, N m] of the first two axes.
"""
TEMPERATURES = (20.0, 45.0)
"""Temperatures of the two published states, assumed [°C]."""
ROTORS = (12.0, 3.5, 2.0, 1.2, 0.35, 0.30, 0.01)
"""Inertia of the rotors on the joint side, assumed [kg m²; kg]."""


def virtual_tx90l_on_rail(
    *, warm: bool = False, disturbed: bool = True
) -> VirtualRobot:
    """Return the paper's robot: a TX90L on its rail with the published parameters.

    In the layout with seven parameters for each body, p_B(1), p_B(2), p_B(27), p_B(28),
    p_B(34) and p_B(35) of its base parameters are the published ones, cold or warm.
    Bodies and gears can exist; products of inertia vanish, as that layout assumes. The
    paper's two identifications differ slightly in p_B(1) and p_B(2) too: so do the two
    robots, but `at` changes friction only.

    Args:
        warm: Robot after half an hour of fast motion, instead of right after its start.
        disturbed: Robot with stiction, Stribeck friction and torque ripple; otherwise
            with friction as in the model. Encoder steps and noise of the torques are
            there in both cases.
    """
    robot = library.tx90l_on_rail()
    max_forces = np.asarray(robot.limits.force)
    # The first and the last follow from published motor torques; others are assumed.
    ratios = np.array([3000.0 / 69.0, 100.0, 100.0, 80.0, 45.0, 45.0, 5.0])
    robot = robot.replace(
        drives=Drives(
            7,
            reduction=ratios,
            max_torques=max_forces / ratios,
            rotor_inertia=np.array(ROTORS) / ratios**2,
        ),
        notes=(
            *robot.notes[:2],
            "assumed, since they are not published: the gear ratios, except those of "
            "the rail and the last axis, which follow from motor torques in the paper.",
        ),
    )
    friction, heating = _friction(robot)
    virtual_robot = VirtualRobot(
        robot=robot,
        terms=(RigidBodies(principal_axes=True), RotorInertia()),
        values=np.concatenate([_bodies(WARM if warm else COLD).ravel(), ROTORS]),
        friction=friction,
        sensors=Sensors(
            encoder_step=2.0 * np.pi / 2**17,
            white_noise=0.01 * max_forces,  # at 1 kHz
            coloured_noise=np.zeros(7),
            motor_side=True,
        ),
        ripple=TorqueRipple(0.01 * max_forces, np.full(7, 6.0), np.linspace(0, 6, 7)),
        heating=heating,
    )
    if not disturbed:
        smooth_friction = SmoothFriction(friction.viscous, friction.coulomb)
        virtual_robot = virtual_robot.replace(friction=smooth_friction, ripple=None)
    return virtual_robot.at(TEMPERATURES[warm])


def _bodies(published: dict[int, float]):
    """Return seven parameters of each body with published base parameters (Eq. 24)."""
    entry = library.entries()["virtual_tx90l_on_rail"]
    m = np.array(entry["masses"])
    r = np.array(entry["centres"])
    gyration = np.array(entry["gyration"])
    # m4 r_c4z counts 20 times in p_B(1) and once in p_B(2): with l_2x = l_3z = 0.05 m.
    forearm_moment = m[3] * r[3, 2]
    carried_masses = m[1] + m[2] + ROTORS[0]
    m[0] = published[1] - carried_masses + 20.0 * forearm_moment
    first_moment = published[2] - 0.05 * m[2] + forearm_moment
    r[1, 0] = first_moment / m[1]
    # Second moments about the origin without products: possible if each leaves room for
    # all others.
    shares = np.count_nonzero(r, axis=1)[:, None]
    spread = gyration**2 + shares * r**2
    planes = spread.sum(axis=1, keepdims=True) - spread
    masses = m[:, None]
    moments = masses * planes
    return np.hstack([masses, masses * r, moments])


def _friction(robot: Robot):
    """Return the friction of cold gears, and how it falls with their temperature.

    Axes whose fall is not published have that of axis 2.
    """
    max_forces = np.asarray(robot.limits.force)
    # Fractions: cold friction of the axes 3 to 7 over the largest torques (at 1 rad/s),
    # assumed.
    viscous_friction = np.array([COLD[27], COLD[28], *(0.02 * max_forces[2:])])
    dry_friction = np.array([COLD[34], COLD[35], *(0.04 * max_forces[2:])])
    viscous_factors = _warm_factors(27, 28)
    dry_factors = _warm_factors(34, 35)
    rise = TEMPERATURES[1] - TEMPERATURES[0]

    friction = LuGreFriction(
        viscous=viscous_friction,
        coulomb=dry_friction,
        breakaway=1.15 * dry_friction,  # these three are assumed
        stribeck_speed=np.array([0.01, *(0.03,) * 6]),
        deflection=np.array([2e-4, *(5e-4,) * 6]),
    )
    heating = FrictionTemperature(
        viscous_rate=-np.log(viscous_factors) / rise,
        dry_rate=-np.log(dry_factors) / rise,
        temperature=TEMPERATURES[0],
    )
    return friction, heating


def _warm_factors(number_1: int, number_2: int):
    """Return warm over cold friction of all axes, by two numbers of base parameters."""
    factor_1 = WARM[number_1] / COLD[number_1]
    factor_2 = WARM[number_2] / COLD[number_2]
    return np.array([factor_1, *(factor_2,) * 6])
