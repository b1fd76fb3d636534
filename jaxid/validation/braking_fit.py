"""Quick least squares with any geometry, and with friction that can only brake."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.sample_methods import in_numpy
from jaxid.robot.robot import Robot


class AnyGeometry(eqx.Module):
    """Regressor of a model with axes and gravity as arguments: it is traced once."""

    model: Model

    def columns(self, axis, gravity, q, qd, qdd, s=None):
        """Return a sample's regressor, followed by the forces of the known tool."""
        model = Model(
            self.model.robot.replace(axis=axis, gravity=gravity), self.model.terms
        )
        tool_forces = model.known_forces(q, qd, qdd)[:, None]
        return jnp.concatenate([model.columns(q, qd, qdd, s), tool_forces], axis=1)

    def __call__(self, robot: Robot, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Return the regressor of each sample, and the forces of the tool."""
        geometry = np.asarray(robot.axis), np.asarray(robot.gravity)
        samples = self.model.arguments(motion)
        columns = in_numpy(self, self.columns, *samples, shared=geometry)
        return columns[..., :-1], columns[..., -1]


def braking_misfit(rows: np.ndarray, is_friction: np.ndarray, folds: int = 1) -> float:
    """Return the fraction (0 to 1) of the forces that least squares miss.

    The rows are a regressor with the forces as last column [instants, joints, columns].
    All joints count equally. Friction, the columns of `is_friction`, is left out where
    it would come out negative. Each of several `folds`, of several stretches each, is
    left out of the fit for it.
    """
    forces = rows[..., -1]
    force_sizes = np.sqrt(np.mean(forces**2, axis=0))
    theta = rows / np.where(force_sizes > 0, force_sizes, np.inf)[:, None]
    if not np.isfinite(theta).all():
        return np.inf
    stretches = [
        stretch.reshape(-1, theta.shape[2])
        for stretch in np.array_split(theta, 4 * folds)
    ]
    # Products are scaled instead of the rows, which are many more numbers.
    stretch_products = [matrix.T @ matrix for matrix in stretches]
    lengths = np.sqrt(np.diag(np.sum(stretch_products, axis=0)))
    if not np.isfinite(lengths).all():
        return np.inf
    divisors = np.where(lengths > 0, lengths, 1.0)
    divisors[-1] = 1.0
    scales = np.outer(divisors, divisors)
    products = [
        np.sum(stretch_products[k::folds], axis=0) / scales for k in range(folds)
    ]
    total_products = np.sum(products, axis=0)
    square = 0.0
    for fold in products:
        fit_products = total_products - fold if folds > 1 else fold
        parameters = braking_parameters(fit_products, is_friction)
        combination = np.append(parameters, -1.0)
        square += max(float(combination @ fold @ combination), 0.0)
    return np.sqrt(square) / max(lengths[-1], 1e-300)


def braking_parameters(products: np.ndarray, is_friction: np.ndarray) -> np.ndarray:
    """Return the least-squares parameters, without friction that would not brake.

    Products of columns of length one suffice, with a little on their diagonal for those
    that depend on others: what both lose, 1e-6 of the forces, is far below
    the misfits of mistakes.
    """
    count = len(is_friction)
    matrix = products[:-1, :-1] + 1e-12 * np.eye(count)
    vector = products[:-1, -1]
    mask = np.ones(count, bool)
    while True:
        parameters = np.zeros(count)
        parameters[mask] = np.linalg.solve(matrix[np.ix_(mask, mask)], vector[mask])
        is_driving = is_friction & (parameters < 0)
        if not is_driving.any():
            return parameters
        mask &= ~is_driving


def friction_columns(speeds: np.ndarray, max_speeds: np.ndarray) -> np.ndarray:
    """Return friction columns of each braking joint: dry, with peaks, and quadratic."""
    v = speeds / np.where(max_speeds > 0, max_speeds, 1.0)
    sign = np.tanh(v / 0.01)
    shapes = [sign, np.tanh(v / 0.1)]
    shapes += [sign * np.exp(-((v / width) ** 2)) for width in (0.05, 0.2)]
    shapes += [v * abs(v)]
    identity = np.eye(v.shape[1])
    return np.concatenate([x[..., None] * identity for x in shapes], axis=2)
