"""Estimates that belong to bodies which could exist, with a mass matrix that is always definite."""

import dataclasses
from types import ModuleType

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters, Identifiability
from jaxid.errors import InputError
from jaxid.identification.consistency.bounds import BodyBounds
from jaxid.identification.consistency.cone_program import ConeProgram
from jaxid.identification.consistency.consistency import Consistency
from jaxid.identification.consistency.data import Data, whitened
from jaxid.identification.consistency.interior_point import MOST, Optimum, Outcome, solve_at_once
from jaxid.identification.consistency.possible import PossibleParameters, nominal_bodies
from jaxid.identification.consistency.priors import EntropicPull, ParameterPrior
from jaxid.identification.consistency.program import program_of
from jaxid.identification.consistency.pseudo_inertia import share_of_a_body
from jaxid.identification.estimators import AbstractEstimator, Estimate
from jaxid.identification.solutions import Complete
from jaxid.identification.weights import AbstractWeights, MaximumForces

FLAT = 1e-4
"""Share of a body below which it counts as flat: on the boundary of what can exist."""


class PhysicallyConsistent(AbstractEstimator):
    r"""Weighted least squares over all standard parameters of bodies that could exist.

    Every body's pseudo-inertia is positive semidefinite, masses and spheres are bounded, friction
    and rotor inertias are not negative, and coupled drives have semidefinite matrices. The optimum
    is found with a bound of its error, and the mass matrix is positive definite in every pose.
    Masses that forces cannot tell apart reflect the bounds: `fit.consistency` says which.

    Attributes:
        weights: Of the joints' rows; by default the reciprocals of the largest forces (Eq. 30).
        bounds: Of the bodies; wide ones from the robot's geometry if None.
        margin: Share of a nominal ball that every body contains, of 1: the mass matrix then exceeds
            that share of the nominal balls' in every pose.
        pull: Towards bodies of a prior, along what the data cannot see.
        prior: Standard parameters that are known roughly.
        throw: Whether an optimum without proof is an error; otherwise it is a note.
    """

    weights: AbstractWeights = MaximumForces()
    bounds: BodyBounds | None = None
    margin: float = 0.0
    pull: EntropicPull | None = None
    prior: ParameterPrior | None = None
    throw: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if not 0.0 <= self.margin < 1.0:
            raise InputError(f"`margin` must be between 0 and 1, but is {self.margin}.")

    def __call__(self, rows):
        """Solves a small convex program on the rows' triangular factor.

        Raises:
            InputError: If weights are not known, or bounds and margin leave no body.
            RuntimeError: If the optimum was not proved and `throw` is set.
        """
        weights = self.weights(rows.robot, rows.factors)
        free = Estimate.solved(rows, weights, Complete())
        R, z = rows.factors.weighted(weights)
        possible = self.possible(rows.base)
        data = self.with_prior(np, whitened(np, rows.base, R, z, int(rows.factors.rows.sum())))
        program = self.program(np, possible, data)
        program.require_interior()
        optimum = solve_at_once(program)
        outcome = _outcome(optimum)
        if self.throw and outcome is not Outcome.CERTIFIED:
            raise RuntimeError(
                f"no physically consistent estimate with a proof: {outcome.value} The bound is "
                f"{float(optimum.error / max(optimum.value, program.scale)):.1e} of the objective."
            )
        p = possible.standard(np, data.A, data.b, optimum.y)
        estimate = np.asarray(rows.base.from_standard(p))
        bodies = p[np.array(possible.bodies)]
        bodies = np.pad(bodies, ((0, 0), (0, 10 - bodies.shape[1])))
        squares = [float(np.sum((R @ x - z) ** 2)) for x in (estimate, np.asarray(free.parameters))]
        found = Consistency(
            bodies=bodies,
            shares=share_of_a_body(bodies),
            bounds=possible.bounds,
            price=float(np.sqrt(squares[0] / squares[1]) - 1.0) if squares[1] > 0 else np.inf,
            error_bound=float(optimum.error / max(optimum.value, program.scale)),
            outcome=outcome,
            iterations=int(optimum.iterations),
            decided=decided(rows.base),
            active=_active(rows.base, possible, program, optimum, bodies),
        )
        return dataclasses.replace(
            free,
            parameters=estimate,
            standard=p,
            consistency=found,
            notes=(*free.notes, *found.notes),
        )

    def possible(self, base: BaseParameters) -> PossibleParameters:
        """The parameters among which the best are looked for.

        Args:
            base: Of the model.

        Raises:
            InputError: If the bounds do not fit the model.
        """
        robot = base.model.robot
        bounds = BodyBounds.from_geometry(robot) if self.bounds is None else self.bounds
        return PossibleParameters.of(base.model, bounds, self.margin)

    def with_prior(self, xp: ModuleType, data: Data) -> Data:
        """The data, with a row for each parameter that is known roughly."""
        if self.prior is None:
            return data
        A, b = self.prior.rows(data.A.shape[1])
        A, b = xp.concatenate([data.A, A]), xp.concatenate([data.b, b])
        return Data(A, b, data.noise, data.scale)

    def program(self, xp: ModuleType, possible: PossibleParameters, data: Data) -> ConeProgram:
        """The convex program."""
        strength, bodies = 0.0, None
        if self.pull is not None:
            strength = self.pull.strength
            bodies = self.pull.pseudo_inertias(nominal_bodies(possible.bounds))
        return program_of(xp, possible, data.A, data.b, data.scale, strength, bodies)


def decided(base: BaseParameters) -> np.ndarray:
    """Which standard parameters the forces determine alone."""
    return np.array([x is Identifiability.ALONE for x in base.identifiability])


def _outcome(optimum: Optimum) -> Outcome:
    if bool(optimum.certified):
        return Outcome.CERTIFIED
    return Outcome.ITERATIONS if int(optimum.iterations) >= MOST else Outcome.STALLED


def _active(
    base: BaseParameters,
    possible: PossibleParameters,
    program: ConeProgram,
    optimum: Optimum,
    bodies: Float[AnyArray, "bodies 10"],
) -> tuple[str, ...]:
    """Bounds whose multipliers exceed their slacks: where strict complementarity puts them."""
    slacks = program.slacks(np, optimum.y) + program.constant_slacks(np)
    tight = np.asarray(optimum.multipliers) > slacks
    K, n = program.bodies, program.drives
    linear = tight[: K * program.rows.shape[1]].reshape(K, -1)
    said = []
    for label, held in zip(possible.bound_names, linear.T, strict=True):
        where = [str(k + 1) for k in np.flatnonzero(held)]
        if where:
            said.append(f"{label} of body {', '.join(where)}")
    names = base.model.parameter_names
    drives = tight[K * program.rows.shape[1] :]
    for label, held in (("0", drives[:n]), ("their largest value", drives[n:])):
        where = [names[possible.drives[k]] for k in np.flatnonzero(held)]
        if where:
            said.append(f"{', '.join(where)} at {label}")
    flat = [str(k + 1) for k in np.flatnonzero(share_of_a_body(bodies) < FLAT)]
    if flat:
        said.append(f"body {', '.join(flat)} as flat as a body can be")
    return tuple(said)
