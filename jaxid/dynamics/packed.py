"""The regressor of many samples without its zeros: operators, and a matrix when asked for."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, namespace
from jaxid.dynamics.machine import Packed, packed_on_samples
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError


class PackedRegressor(eqx.Module):
    r"""A stacked regressor $\bar\Theta$ as the entries that are not always zero (Eq. 26).

    Most of a regressor is zero: a joint feels only the bodies beyond it. This form has one array
    over the samples for each entry that varies, computes with these, and writes zeros only into the
    `matrix`.

    Attributes:
        values: Each distinct entry that varies with the motion, over the samples.
        places: For each joint the pairs of a column and either the number of the array in `values`
            or the constant, a float, that stand there.
        samples: Number of samples.
        columns: Number of parameters.
    """

    values: tuple[Float[AnyArray, " samples"], ...]
    places: tuple[tuple[tuple[int, int | float], ...], ...] = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    columns: int = eqx.field(static=True)

    @classmethod
    def of(cls, owner: eqx.Module, definition: Callable, motion: Motion) -> "PackedRegressor":
        """The regressor that a method of a model defines for one sample, at many.

        Raises:
            InputError: If the motion does not have one axis of samples, or JAX is tracing the
                model's own numbers.
        """
        if motion.q.ndim != 2:
            raise InputError(
                f"`motion` must have the shape [samples, joints], but has {motion.q.shape}."
            )
        packed = packed_on_samples(owner, definition, motion.q, motion.qd, motion.qdd)
        return cls.of_result(packed, motion.q.shape[0])

    @classmethod
    def of_result(cls, packed: Packed, samples: int) -> "PackedRegressor":
        """The regressor that a program has computed for so many samples."""
        ((joints, columns),) = packed.shapes
        places = tuple(
            tuple(
                (k, x)
                for k, x in enumerate(packed.entries[j * columns : (j + 1) * columns])
                if isinstance(x, int) or x != 0
            )
            for j in range(joints)
        )
        return cls(packed.values, places, samples, columns)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.places)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the matrix: rows, joint after joint, and columns."""
        return self.joints * self.samples, self.columns

    def acting(self, joint: int) -> np.ndarray:
        """The columns that can act on a joint."""
        return np.array([k for k, _ in self.places[joint]], int)

    def rows(self, joint: int) -> Float[AnyArray, "acting samples"]:
        """The entries of a joint in the columns that can act on it, columns first."""
        xp = namespace(*self.values)
        entries = [self.values[x] if isinstance(x, int) else x for _, x in self.places[joint]]
        full = [xp.broadcast_to(xp.asarray(x, float), (self.samples,)) for x in entries]
        return xp.stack(full) if full else xp.zeros((0, self.samples))

    @eqx.filter_jit
    def matvec(self, p: Float[AnyArray, " columns"]) -> Float[AnyArray, "samples joints"]:
        r"""The generalized forces $\Theta p$ [N m or N] (Eq. 16).

        Args:
            p: One number for each column.
        """
        p = jnp.asarray(p)
        return jnp.stack([p[self.acting(j)] @ self.rows(j) for j in range(self.joints)], axis=-1)

    @eqx.filter_jit
    def transposed_matvec(
        self, forces: Float[AnyArray, "samples joints"]
    ) -> Float[AnyArray, " columns"]:
        r"""The products $\bar\Theta^T Q$ of all columns with forces."""
        forces = jnp.asarray(forces)
        total = jnp.zeros(self.columns, forces.dtype)
        for j in range(self.joints):
            total = total.at[self.acting(j)].add(self.rows(j) @ forces[:, j])
        return total

    @eqx.filter_jit
    def gram(
        self, weights: Float[AnyArray, " joints"] | None = None
    ) -> Float[AnyArray, "columns columns"]:
        r"""The information matrix $\bar\Theta^T W^2 \bar\Theta$ (Eq. 33).

        Args:
            weights: Diagonal of $W$ for each joint; ones if None.
        """
        w = jnp.ones(self.joints) if weights is None else jnp.asarray(weights)
        total = jnp.zeros((self.columns, self.columns))
        for j in range(self.joints):
            rows, own = self.rows(j), self.acting(j)
            total = total.at[own[:, None], own].add(w[j] ** 2 * (rows @ rows.T))
        return total

    def factor(
        self, weights: Float[AnyArray, " joints"] | None = None
    ) -> Float[np.ndarray, "columns columns"]:
        r"""The triangular factor $R$ of $W \bar\Theta = Q R$, without forming the matrix.

        Each joint's rows are decomposed by themselves, in float64, then the factors of all joints.

        Args:
            weights: Diagonal of $W$ for each joint; ones if None.
        """
        w = np.ones(self.joints) if weights is None else np.asarray(weights, np.float64)
        stacked = [np.zeros((self.columns, self.columns))]
        for j in range(self.joints):
            R = np.linalg.qr(np.asarray(self.rows(j), np.float64).T, mode="r")
            placed = np.zeros((len(R), self.columns))
            placed[:, self.acting(j)] = w[j] * R
            stacked.append(placed)
        return np.asarray(np.linalg.qr(np.concatenate(stacked), mode="r"))

    def matrix(self) -> Float[np.ndarray, "rows columns"]:
        """The whole matrix in Fortran's order: all samples of joint 1, then of joint 2 and so on.

        `packed.matrix().reshape(joints, samples, columns)` is a view by joint and sample.
        """
        dtype = np.result_type(*(x.dtype for x in self.values), np.float32)
        out = np.zeros((self.columns, self.joints, self.samples), dtype)
        values = jax.device_get(self.values)
        for joint, places in enumerate(self.places):
            for k, x in places:
                out[k, joint] = values[x] if isinstance(x, int) else x
        return out.reshape(self.columns, -1).T
