"""How forces change with the shapes of friction laws: a term like all others.

With it the linearised problem is an ordinary one. Whatever finds uncertainties of parameters finds
those of the shapes too, and what they add to the others.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm
from jaxid.identification.nonlinear.shapes import Shapes


class ShapeSlopes(AbstractTerm):
    """Forces of small changes of shapes, at some shapes and parameters.

    Attributes:
        terms: Of the model.
        shapes: Those that change.
        x: The shapes.
        p: Standard parameters of the model.
    """

    terms: tuple[AbstractTerm, ...]
    shapes_changed: Shapes
    x: Float[AnyArray, " shapes"]
    p: Float[AnyArray, " standard"]

    def parameters(self, robot):
        """The shapes."""
        return self.shapes_changed.parameters

    def columns(self, robot, q, qd, qdd):
        """The derivatives of the shaped terms' forces."""
        sizes = [len(term.parameters(robot)) for term in self.terms]
        ends = np.cumsum(sizes)

        def forces(x):
            terms = self.shapes_changed.set_in(self.terms, x)
            return sum(
                terms[i].columns(robot, q, qd, qdd)
                @ jnp.asarray(self.p)[ends[i] - sizes[i] : ends[i]]
                for i in self.shapes_changed.terms
            )

        return jax.jacfwd(forces)(jnp.asarray(self.x, q.dtype))


def with_slopes(
    base: BaseParameters, shapes: Shapes, p: Float[AnyArray, " base"]
) -> BaseParameters:
    """Base parameters to which small changes of shapes come as further parameters.

    Args:
        base: With the shapes at which forces are linearised.
        shapes: Those that change.
        p: Base parameters at which forces are linearised.
    """
    model, n = base.model, base.model.size
    terms, x = model.terms, shapes.values(base)
    slopes = ShapeSlopes(terms, shapes, x, np.asarray(base.to_standard(np.asarray(p))))
    kappa = np.asarray(base.kappa)
    return dataclasses.replace(
        base,
        model=Model(model.robot, (*terms, slopes)),
        indices=(*base.indices, *range(n, n + shapes.size)),
        kappa=np.vstack([kappa, np.zeros((shapes.size, kappa.shape[1]))]),
    )
