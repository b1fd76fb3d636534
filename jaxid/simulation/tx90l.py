"""The paper's robot as a virtual one: its published numbers are the truth, the rest is assumed.

Published are six base parameters, cold and warm (Sec. 6), in the layout with seven parameters for
each body; the masses of the arm's CAD model; and the largest motor torques of the first and the
last axis. All else is plausible and assumed: what is in this file is the list.
"""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.terms import RigidBodies, RotorInertia
from jaxid.robot import library
from jaxid.robot.drives import Drives
from jaxid.robot.robot import Robot
from jaxid.simulation.disturbances import TorqueRipple
from jaxid.simulation.gear_friction import LuGreFriction
from jaxid.simulation.lubricant import Lubricant
from jaxid.simulation.sensors import Sensors
from jaxid.simulation.virtual import VirtualRobot


class PublishedState(NamedTuple):
    """What the paper says of one state of its robot (Sec. 6).

    Attributes:
        mass: p_B(1) [kg].
        moment: p_B(2) [kg m].
        viscous: p_B(27) [N s/m] and p_B(28) [N m s].
        coulomb: p_B(34) [N] and p_B(35) [N m].
    """

    mass: float
    moment: float
    viscous: tuple[float, float]
    coulomb: tuple[float, float]


COLD = PublishedState(273.40, 1.68, (248.41, 41.26), (312.50, 18.24))
WARM = PublishedState(273.62, 1.65, (90.19, 25.65), (233.00, 15.07))

MASSES = (16.93, 14.35, 7.50, 6.42, 0.569, 0.031)
"""Of the arm's bodies, by CAD [kg]; that of the rail's carriage follows from p_B(1)."""
GEAR_RATIOS = (3000.0 / 69.0, 100.0, 100.0, 80.0, 45.0, 45.0, 5.0)
"""Assumed, but for the first and the last, which follow from the published motor torques."""
ROTORS = (12.0, 3.5, 2.0, 1.2, 0.35, 0.30, 0.01)
"""Inertia of the rotors on the joints' side, assumed [kg m²; kg]."""
CENTRES = (
    (0.05, 0.02, 0.22),
    (0.0, -0.01, -0.12),
    (0.01, -0.10, 0.06),
    (0.0, -0.02, 0.01),
    (0.0, 0.01, 0.10),
    (0.0, -0.02, 0.0),
    (0.0, 0.0, -0.01),
)
"""Centres of mass in the bodies' frames, assumed [m]: near enough to the joints that these can hold
the arm. The x of the second follows from p_B(2)."""
GYRATION = (
    (0.25, 0.25, 0.25),
    (0.12, 0.12, 0.14),
    (0.08, 0.20, 0.07),
    (0.07, 0.07, 0.07),
    (0.06, 0.06, 0.18),
    (0.03, 0.04, 0.03),
    (0.015, 0.015, 0.008),
)
"""Standard deviations of the masses along the bodies' axes, assumed [m]."""
VISCOUS_SHARE, COULOMB_SHARE = 0.02, 0.04
"""Friction of the axes 3 to 7, cold, of the largest torques (at 1 rad/s), assumed."""
BREAKAWAY = 1.15
"""Stiction, of the dry friction at speed, assumed."""
STRIBECK_SPEED = (0.01, *(0.03,) * 6)
"""Assumed [m/s; rad/s]."""
BRISTLES = (2e-4, *(5e-4,) * 6)
"""Deflection at which a gear that sticks lets go, assumed [m; rad]."""
RIPPLE, NOISE = 0.01, 0.01
"""Of the largest torques: amplitude, and standard deviation at 1 kHz."""
RIPPLE_WAVES = 6.0
"""In one turn of the motor, assumed."""
ENCODER_LINES = 2**17
COLD_TEMPERATURE, WARM_TEMPERATURE = 20.0, 45.0
"""Of the two published states, assumed [°C]."""
BRISK = (0.45, 0.24, 0.21, 0.24, 0.31, 0.17, 0.21)
"""RMS speeds, of the largest, at which the gears come to the warm temperature: those of random
Fourier motions of 0.8 rad/s that use the limits; assumed."""
CAD_ERRORS = (0.15, -0.12, 0.18, -0.10, 0.14, -0.18, 0.11)
"""By which the CAD's bodies are off, assumed."""


def virtual_tx90l_on_rail(*, warm: bool = False, disturbed: bool = True) -> VirtualRobot:
    """The paper's robot: a TX90L on its rail, whose published parameters are the truth.

    In the layout with seven parameters for each body, p_B(1), p_B(2), p_B(27), p_B(28), p_B(34) and
    p_B(35) of its base parameters are the published ones, cold or warm. Bodies and gears could
    exist; products of inertia vanish, as that layout assumes. The paper's two identifications
    differ a little in p_B(1) and p_B(2) too: so do the two robots, but `at` and `warmed` change
    friction only.

    Args:
        warm: The robot after half an hour of brisk motion, instead of right after its start.
        disturbed: With stiction, Stribeck friction and torque ripple; else with friction as the
            model has it. Encoder steps and noise of the torques are there in both cases.
    """
    state = WARM if warm else COLD
    robot = library.tx90l_on_rail()
    most = np.asarray(robot.limits.force)
    robot = robot.replace(
        drives=Drives(
            7,
            reduction=GEAR_RATIOS,
            max_torques=most / np.array(GEAR_RATIOS),
            rotor_inertia=np.array(ROTORS) / np.array(GEAR_RATIOS) ** 2,
        ),
        notes=(
            *robot.notes[:2],
            "assumed, for nobody published it: the gear ratios, but for those of the rail and the "
            "last axis, which follow from motor torques in the paper.",
        ),
    )
    friction, lubricant = _friction(robot)
    virtual = VirtualRobot(
        robot=robot,
        terms=(RigidBodies(principal_axes=True), RotorInertia()),
        values=np.concatenate([_bodies(state).ravel(), ROTORS]),
        friction=friction,
        sensors=Sensors(
            encoder_step=2.0 * np.pi / ENCODER_LINES,
            white_noise=NOISE * most,
            coloured_noise=np.zeros(7),
            motor_side=True,
        ),
        disturbances=(TorqueRipple(RIPPLE * most, np.full(7, RIPPLE_WAVES), np.linspace(0, 6, 7)),),
        lubricant=lubricant,
        temperature=np.full(7, WARM_TEMPERATURE if warm else COLD_TEMPERATURE),
    )
    return virtual if disturbed else virtual.undisturbed()


def cad_tx90l_on_rail() -> Float[np.ndarray, " standard"]:
    """What CAD would say of `virtual_tx90l_on_rail().model`: bodies and rotors, no friction.

    Masses and rotors are 10 to 18 % off, each body as a whole.
    """
    errors = 1.0 + np.array(CAD_ERRORS)
    bodies = _bodies(COLD) * errors[:, None]
    return np.concatenate([bodies.ravel(), np.zeros(14), np.array(ROTORS) * errors[::-1]])


def _bodies(state: PublishedState) -> Float[np.ndarray, "7 7"]:
    """Seven parameters of each body: principal axes, published base parameters (Eq. 24)."""
    m = np.array((0.0, *MASSES))
    r = np.array(CENTRES)
    # m4 r_c4z counts 20 times in p_B(1) and once in p_B(2): with l_2x = l_3z = 0.05 m.
    offset = m[3] * r[3, 2]
    m[0] = state.mass - m[1] - m[2] + 20.0 * offset - ROTORS[0]
    r[1, 0] = (state.moment - 0.05 * m[2] + offset) / m[1]
    # Second moments about the origin without products: possible if each leaves room for all others.
    spread = np.array(GYRATION) ** 2 + np.count_nonzero(r, axis=1)[:, None] * r**2
    moments = m[:, None] * (spread.sum(axis=1, keepdims=True) - spread)
    return np.concatenate([m[:, None], m[:, None] * r, moments], axis=1)


def _friction(robot: Robot) -> tuple[LuGreFriction, Lubricant]:
    """Friction when cold, and how it falls: like axis 2 where nothing is published."""
    most, fastest = np.asarray(robot.limits.force), np.asarray(robot.limits.velocity)
    levels, rates, warm = [], [], []
    for cold_two, warm_two, share in (
        (COLD.viscous, WARM.viscous, VISCOUS_SHARE),
        (COLD.coulomb, WARM.coulomb, COULOMB_SHARE),
    ):
        left = np.array(warm_two) / np.array(cold_two)
        levels.append(np.array([*cold_two, *(share * most[2:])]))
        factors = np.array([*left, *(left[1],) * 5])
        rates.append(-np.log(factors) / (WARM_TEMPERATURE - COLD_TEMPERATURE))
        warm.append(levels[-1] * factors)
    speed = np.array(BRISK) * fastest
    # Of a sine, the mean size is 0.9 of the RMS.
    power = warm[0] * speed**2 + warm[1] * 0.9 * speed
    friction = LuGreFriction(
        viscous=levels[0],
        coulomb=levels[1],
        breakaway=BREAKAWAY * levels[1],
        stribeck_speed=np.array(STRIBECK_SPEED),
        deflection=np.array(BRISTLES),
    )
    resistance = (WARM_TEMPERATURE - COLD_TEMPERATURE) / power
    return friction, Lubricant(rates[0], rates[1], resistance)
