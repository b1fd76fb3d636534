"""Numbers that no robot has: degrees for radians, millimetres for metres, bodies that cannot be."""

import numpy as np

from jaxid.arrays import Float, Numbers

LARGEST_TURN = 8 * np.pi
"""Position of a revolute joint that is no angle in radians any more: four turns [rad]."""
LARGEST_ANGLE = 2 * np.pi + 0.01
"""Roll, pitch or yaw that is no angle in radians any more; a full turn may be rounded [rad]."""
ENDLESS = 1e4
"""From here on files say that a joint turns without end [rad]."""
FAST = 50.0
"""Speed of a joint that looks like one in degrees per second [rad/s]."""
FAR, FARTHEST = 10.0, 1000.0
"""Lengths that look like millimetres, and that no robot has [m]."""
HEAVIEST = 1e5
"""Mass that no body of a robot has [kg]."""
_ROUNDING = 0.01
"""Share of the largest moment of inertia by which those of a file may be wrong, of 1."""
_POINT = 1e-6
"""Moments of inertia of a point's kilogram: those of a millimetre [m²]."""


def beyond_range(low: float, high: float, revolute: bool) -> str:
    """What is wrong with a joint's range: empty, or how a sentence about the joint goes on.

    Args:
        low: Lower end of the range, infinite if unknown [rad or m].
        high: Upper end, likewise.
        revolute: Whether the joint turns.
    """
    bound = LARGEST_TURN if revolute else FARTHEST
    far = [x for x in (low, high) if np.isfinite(x) and abs(x) > bound]
    if not far:
        return ""
    if revolute:
        return f"ranges to {far[0]:g} rad, which is {abs(far[0]) / (2 * np.pi):.3g} turns"
    return f"ranges to {far[0]:g} m, which no robot does"


def far_notes(what: str, lengths: Numbers) -> tuple[str, ...]:
    """A sentence about a length [m] that exists, but looks like one in millimetres.

    Args:
        what: Has the lengths.
        lengths: Of one thing.
    """
    lengths = np.abs(np.asarray(lengths, np.float64))
    far = lengths[np.isfinite(lengths) & (lengths > FAR)].tolist()
    return (f"{what} is {max(far):g} m: is the length in millimetres?",) if far else ()


def fast_notes(joint: str, speed: float, revolute: bool) -> tuple[str, ...]:
    """A sentence about a largest speed [rad/s] that looks like degrees per second."""
    if not (revolute and FAST < speed < np.inf):
        return ()
    return (
        f"joint `{joint}`: a velocity of up to {speed:g} rad/s is "
        f"{30 * speed / np.pi:.4g} turns a minute: is the limit in degrees per second?",
    )


def impossible(
    mass: float, inertia: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, "3"]
) -> str:
    """Why no body has such a mass and such moments of inertia; empty if one may.

    Args:
        mass: [kg].
        inertia: About the centre of mass [kg m²].
        centre: Centre of mass in some frame of the body [m].
    """
    if not (np.isfinite(mass) and np.isfinite(inertia).all() and np.isfinite(centre).all()):
        return "it is not finite"
    if mass < 0.0:
        return f"its mass is {mass:g} kg"
    if mass > HEAVIEST:
        return f"its mass is {mass:g} kg, and no part of a robot is above {HEAVIEST:g} kg"
    if np.abs(centre).max() > FARTHEST:
        return f"its centre of mass lies {np.abs(centre).max():g} m away; are these millimetres?"
    largest = np.abs(inertia).max()
    if largest > FAR**2 * max(mass, 1.0):
        return f"it has {largest:g} kg m² at a mass of {mass:g} kg; are these kg mm²?"
    principal = np.linalg.eigvalsh(inertia)
    short = _ROUNDING * np.abs(principal).max() + _POINT * mass
    if principal[0] < -short or principal[2] > principal[0] + principal[1] + short:
        shown = ", ".join(f"{x:.3g}" for x in principal)
        return (
            f"its principal moments are {shown} kg m², but none may be negative or larger than "
            "the sum of the others"
        )
    return ""
