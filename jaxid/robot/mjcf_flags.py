"""Flags of MuJoCo that switch effects of an MJCF file off."""

from typing import Any

import numpy as np

SWITCHED_ARRAYS = {
    "SPRING": (
        "jnt_stiffness",
        "jnt_stiffnesspoly",
        "jnt_springyield",
        "tendon_stiffness",
        "tendon_stiffnesspoly",
    ),
    "DAMPER": (
        "dof_damping",
        "dof_dampingpoly",
        "tendon_damping",
        "tendon_dampingpoly",
        "actuator_damping",
        "actuator_dampingpoly",
    ),
    "FRICTIONLOSS": ("dof_frictionloss", "tendon_frictionloss"),
    "EQUALITY": ("eq_active0",),
    "CONSTRAINT": ("dof_frictionloss", "tendon_frictionloss", "eq_active0"),
    "GRAVITY": ("body_gravcomp",),
}
"""Arrays of effects that a flag of MuJoCo switches off, by the name of its bit."""


def switch_off(mujoco: Any, model: Any) -> None:
    """Set to zero what the flags of a compiled model switch off."""
    bits = mujoco.mjtDisableBit
    flags = model.opt.disableflags
    for name, arrays in SWITCHED_ARRAYS.items():
        if flags & getattr(bits, f"mjDSBL_{name}"):
            for array in arrays:
                # Earlier versions of MuJoCo lack some arrays.
                getattr(model, array, np.zeros(0))[:] = 0
    if flags & bits.mjDSBL_GRAVITY:
        model.opt.gravity[:] = 0.0
    # Without springs and dampers MuJoCo computes no passive forces at all.
    if flags & bits.mjDSBL_SPRING and flags & bits.mjDSBL_DAMPER:
        model.body_gravcomp[:] = 0.0
        model.opt.density = 0.0
        model.opt.viscosity = 0.0
