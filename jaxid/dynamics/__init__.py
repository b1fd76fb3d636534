"""Dynamics linear in the unknowns: terms, models, base parameters.

As a namespace it has the Projection Equation of one sample, equation by equation.
"""

from .projection_equation import (
    body_motions as body_motions,
    body_regressor as body_regressor,
    momentum_matrix as momentum_matrix,
    partial_velocities as partial_velocities,
    rigid_body_forces as rigid_body_forces,
    rigid_body_mass_matrix as rigid_body_mass_matrix,
    rigid_body_regressor as rigid_body_regressor,
)
