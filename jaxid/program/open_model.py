"""Methods of a model with its numbers as inputs: traced ones, or different ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Indices, is_traced


class OpenModel(eqx.Module):
    """A method for one sample, whose first argument are numbers of the model."""

    model: eqx.Module  # model; in the place of these numbers it has any others
    method: str = eqx.field(static=True)  # name of the method
    # leaves of the model that have such numbers, and their positions in each
    places: tuple[tuple[int, Indices], ...] = eqx.field(static=True)

    def call(self, numbers: AnyArray, *arguments: AnyArray) -> Array:
        """Call the method of the model with these numbers."""
        leaves, structure = jax.tree.flatten(self.model)
        start = 0
        for leaf, positions in self.places:
            constants = leaves[leaf]
            size = constants.size
            count = len(positions)
            stop = start + count
            # Each entry of the leaf is one of its constants, or one of the numbers.
            order = np.arange(size)
            order[list(positions)] = size + np.arange(count)
            entries = jnp.concatenate([constants.ravel(), numbers[start:stop]])
            leaves[leaf] = entries[order].reshape(constants.shape)
            start = stop
        model = jax.tree.unflatten(structure, leaves)
        return getattr(model, self.method)(*arguments)


def opened(
    method: str, model: eqx.Module, *others: eqx.Module
) -> tuple[OpenModel, AnyArray]:
    """Return a method with numbers of the model as inputs: traced, or different ones.

    All other numbers stay constants of a program. The numbers are those of each model.
    """
    leaves, structure = jax.tree.flatten(model)
    leaves_of_models = [leaves, *map(jax.tree.leaves, others)]
    places = []
    numbers: list[AnyArray] = [np.zeros((len(leaves_of_models), 0))]
    for k, values in enumerate(zip(*leaves_of_models, strict=True)):
        first_value, *_ = values
        if is_traced(values):
            # All numbers of the leaf are inputs; zeros stand in the closed model.
            stack = jnp.stack
            leaves[k] = np.zeros(first_value.shape, first_value.dtype)
            positions = np.arange(first_value.size)
        else:
            stack = np.stack
            rows = np.array([np.ravel(x) for x in values])
            is_varying = (rows != rows[0]).any(axis=0)
            positions = np.flatnonzero(is_varying)
        if len(positions):
            variables = [x.ravel()[positions] for x in values]
            places.append((k, tuple(positions.tolist())))
            numbers.append(stack(variables))
    concatenate = jnp.concatenate if is_traced(numbers) else np.concatenate
    closed_model = jax.tree.unflatten(structure, leaves)
    open_model = OpenModel(closed_model, method, tuple(places))
    return open_model, concatenate(numbers, axis=1)


def with_open_numbers(model: eqx.Module, method: str) -> tuple[OpenModel, np.ndarray]:
    """Return a method with the numbers of the model as inputs.

    What is 0, 1 or -1 for all bodies alike stays a constant: other zeros would make the
    equations of the bodies differ.
    """
    places = []
    numbers = [np.zeros(0)]
    for k, leaf in enumerate(jax.tree.leaves(model)):
        if not isinstance(leaf, np.ndarray) or leaf.dtype.kind != "f":
            continue
        rows = np.atleast_2d(leaf)
        rows = rows.reshape(len(rows), -1)
        is_alike = (rows == rows[0]).all(axis=0)
        is_constant = is_alike & np.isin(rows[0], (0.0, 1.0, -1.0))
        is_open = np.isfinite(rows) & ~is_constant
        positions = np.flatnonzero(is_open)
        if len(positions):
            places.append((k, tuple(positions.tolist())))
            numbers.append(leaf.ravel()[positions])
    return OpenModel(model, method, tuple(places)), np.concatenate(numbers)
