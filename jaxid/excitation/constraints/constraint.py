"""A constraint of a motion: excess of each quantity over its limit, and words."""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Int
from jaxid.dynamics.motion import Motion
from jaxid.program.gradient import pull_back
from jaxid.program.sample_methods import program_of
from jaxid.robot.robot import Robot

Excess = Float[AnyArray, "*batch values"]
"""Relative excess over each limit, at each sample."""
BLOCK = 256
"""Samples for which functions of constraints are compiled, whatever their number."""


class Finding(NamedTuple):
    """A limited quantity, and how far a motion is from the limit.

    Attributes:
        name: Name of the quantity, as it reads in a sentence: `torque of joint 3`.
        size: Physical size of a constraint's value of 1.
        unit: Physical unit.
        limit: Limit of the quantity in this unit; NaN if it has no name.
        is_lower_limit: Whether the quantity must not fall below the limit, rather than
            not rise above it.
        note: Origin of the limit: `12 less a margin of 50 %`.
        value: Relative excess over the limit; negative or zero where it is kept.
        has_use: Whether a fraction of the limit is used; not where it is a place.
    """

    name: str
    size: float
    unit: str
    limit: float = math.nan
    is_lower_limit: bool = False
    note: str = ""
    value: float = math.nan
    has_use: bool = True

    @property
    def excess(self) -> float:
        """Excess over the limit in physical units."""
        return self.value * self.size

    @property
    def used(self) -> float:
        """Used fraction of the limit, 1 if just kept; NaN where that means nothing."""
        if not self.has_use:
            return math.nan
        if not self.is_lower_limit:
            return self.reached / self.limit
        return self.limit / self.reached if self.reached > 0 else math.inf

    @property
    def reached(self) -> float:
        """Physical quantity where it is nearest to its limit, or furthest beyond it."""
        sign = -1.0 if self.is_lower_limit else 1.0
        return self.limit + sign * self.excess

    def __str__(self) -> str:
        """Return one sentence."""
        amount = f"{abs(self.excess):.3g} {self.unit}"
        if self.value <= 0:
            text = f"{self.name} keeps its limit with {amount} to spare"
        elif self.is_lower_limit:
            text = f"{self.name} falls short of its limit by {amount}"
        else:
            text = f"{self.name} exceeds its limit by {amount}"
            if self.has_use:
                text += f" ({100 * self.value:.3g} %)"
        if math.isnan(self.limit):
            return text
        word = "least" if self.is_lower_limit else "most"
        note = f" ({self.note})" if self.note else ""
        return f"{text}: at {word} {self.limit:.4g} {self.unit}{note}"


ValuesAndSlopes = tuple[
    Float[AnyArray, " samples"], Sequence[Float[AnyArray, "samples joints"]]
]
"""One value of each sample, and its derivatives by q, qd, qdd.

Derivatives by qd and qdd may be left out where values depend on q only.
"""
Linearisation = Callable[[Motion, Int[np.ndarray, " samples"]], ValuesAndSlopes]
"""Function of a motion [samples], and of the entry that counts at each sample."""


class AbstractConstraint(eqx.Module):
    """Limits on a motion that are not linear in the joints' motion.

    Each sample of a motion is evaluated by itself, so that solvers can ask for values
    and derivatives at any instants. Values are smooth where possible, and relative: in
    units of the limit, or of another size that `entries` names.
    """

    @abstractmethod
    def __call__(self, robot: Robot, motion: Motion) -> Excess:
        """Return the excess over each limit at each sample; not positive if kept.

        Runs under `jit`, `vmap` and derivatives with respect to the motion.

        Args:
            robot: Robot that moves.
            motion: Joint motion with any leading axes.
        """

    @abstractmethod
    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the limited quantities in the order of the values."""

    def linearisation(self, robot: Robot) -> Linearisation:
        """Return a function of a motion and the entry that counts at each sample.

        It returns the values of the entries and their derivatives. This one is compiled
        by JAX; a constraint that knows its derivatives in NumPy returns its own.

        Args:
            robot: Robot that moves.
        """

        @jax.jit
        def linearise_block(entries, *motion):
            values, slopes = linearise_values(self, robot, Motion(*motion), entries)
            return values, *slopes

        def linearise(motion, entries):
            arrays = (entries, motion.q, motion.qd, motion.qdd)
            values, *slopes = in_blocks(linearise_block, *arrays)
            return values, slopes

        return linearise

    def describe(self, robot: Robot, values: AnyArray) -> list[Finding]:
        """Return the limited quantities with the largest of their values."""
        entries = self.entries(robot)
        peaks = np.asarray(values).reshape(-1, len(entries)).max(axis=0)
        pairs = zip(entries, peaks.tolist(), strict=True)
        return [entry._replace(value=peak) for entry, peak in pairs]


def linearise_values(
    constraint: AbstractConstraint, robot: Robot, motion: Motion, entries: AnyArray
) -> ValuesAndSlopes:
    """Return the value of one entry at each sample, and its derivatives, in JAX."""

    def value(*motion):
        values = constraint(robot, Motion(*motion))
        return jnp.take_along_axis(values, entries[:, None], axis=1)[:, 0]

    values, pull = jax.vjp(value, motion.q, motion.qd, motion.qdd)
    return values, list(pull(jnp.ones_like(values)))


def in_blocks(function: Callable, *arrays: AnyArray) -> list[np.ndarray]:
    """Return the results of a compiled function of samples, block by block.

    Samples are repeated up to whole blocks: another number would compile anew.
    """
    samples = len(arrays[0])
    blocks = math.ceil(samples / BLOCK)
    places = np.resize(np.arange(samples), (blocks, BLOCK))
    results = [function(*(array[rows] for array in arrays)) for rows in places]
    parts_of_results = zip(*results, strict=True)
    return [np.concatenate(parts)[:samples] for parts in parts_of_results]


def pull_back_samples(
    owner: eqx.Module,
    method: Callable,
    weights: np.ndarray,
    *samples: AnyArray,
) -> list[np.ndarray]:
    """Return derivatives of weighted results of a method, for rows of samples."""
    program = program_of(owner, method, *(x.shape[1:] for x in samples))
    packed_weights = weights.reshape(len(weights), -1).T
    columns = [np.asarray(x).T for x in samples]
    return [
        np.asarray(slopes).T for slopes in pull_back(program, packed_weights, *columns)
    ]
