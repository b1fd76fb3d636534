"""The spectral sandwich in JAX: one table for a data set, many draws of its forces."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array, Float
from jaxid.identification.uncertainty.sandwich import (
    Windows,
    satterthwaite,
    scatter,
    variance_map,
)


class LineSums(eqx.Module):
    """Spectra of all chunks of a data set, added up; see `Lines`."""

    energy: Float[Array, "base joints lines"]
    leverage: Float[Array, "joints lines"]
    power: Float[Array, "draws joints lines"]
    exposure: Float[Array, " joints"]


def line_sums(
    own: tuple[tuple[int, ...], ...],
    weights: Float[Array, " joints"],
    inverse: Float[Array, "base base"],
    p: Float[Array, "draws base"],
    columns: list[Array],
    forces: list[Array],
    exposure: Float[Array, " joints"],
) -> LineSums:
    """The spectra of consecutive rows.

    Args:
        own: For each joint the base parameters that can act on it.
        weights: Of the joints' rows.
        inverse: Of the information.
        p: The estimates.
        columns: For each joint [columns, rows], zero where a row does not count.
        forces: For each joint [draws, rows], likewise.
        exposure: Share of each joint's rows that count.
    """
    length = columns[0].shape[-1]
    m = _multiplicity(length)[None]
    energy, leverage, power = [], [], []
    for k, A, Q, w in zip(own, columns, forces, weights, strict=True):
        mine = np.array(k, int)
        Z = jnp.fft.rfft(w * A)
        real, imaginary = inverse[:, mine] @ Z.real, inverse[:, mine] @ Z.imag
        r = jnp.fft.rfft(w * (Q - p[:, mine] @ A))
        energy.append(m / length * (real**2 + imaginary**2))
        both = real[mine] * Z.real + imaginary[mine] * Z.imag
        leverage.append(jnp.sum(both, axis=0) / length)
        power.append((r.real**2 + r.imag**2) / length)
    return LineSums(
        jnp.stack(energy, axis=1), jnp.stack(leverage), jnp.stack(power, axis=1), exposure
    )


def variances(
    sums: LineSums, length: int, row_time: float
) -> tuple[Float[Array, "draws base"], Float[Array, "draws base"]]:
    """Variances of the estimates, and their degrees of freedom.

    Args:
        sums: Of all chunks.
        length: Rows of a chunk.
        row_time: Between two rows [s].
    """
    frequency = np.fft.rfftfreq(length, row_time)
    windows = Windows(frequency, length * row_time)
    half = 0.5 * _multiplicity(length)
    there = jnp.broadcast_to(sums.exposure[:, None], sums.leverage.shape)
    C, _ = variance_map(jnp, windows, half, there, sums.leverage, sums.energy)
    variance = jnp.einsum("djf,ijf->di", sums.power, C)
    squares = jnp.einsum("djf,ijf->di", (sums.power * scatter(jnp, half, there)[None]) ** 2, C**2)
    return variance, jnp.maximum(satterthwaite(jnp, variance, squares), 1.0)


def _multiplicity(length: int) -> Float[np.ndarray, " lines"]:
    """How often a line stands for itself and its mirror image."""
    m = np.full(length // 2 + 1, 2.0)
    m[0] = 1.0
    if length % 2 == 0:
        m[-1] = 1.0
    return m
