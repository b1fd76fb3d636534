"""Models with some of their numbers as inputs: those that JAX is tracing, or that differ."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, is_traced


class OpenModel(eqx.Module):
    """A method of a model for one sample, whose first argument are numbers of the model."""

    model: eqx.Module  # model; in the place of these numbers it has any others
    method: str = eqx.field(static=True)  # name of the method
    # leaves of the model that have such numbers, and their positions in each
    places: tuple[tuple[int, tuple[int, ...]], ...] = eqx.field(static=True)

    def call(self, numbers: Float[AnyArray, " numbers"], *arguments: AnyArray) -> Array:
        """Call the method of the model with these numbers."""
        leaves, structure = jax.tree.flatten(self.model)
        begun = 0
        for leaf, positions in self.places:
            fixed = leaves[leaf]
            order = np.arange(fixed.size)
            order[list(positions)] = fixed.size + np.arange(len(positions))
            own = numbers[begun : begun + len(positions)]
            leaves[leaf] = jnp.concatenate([fixed.ravel(), own])[order].reshape(fixed.shape)
            begun += len(positions)
        return getattr(jax.tree.unflatten(structure, leaves), self.method)(*arguments)


def opened(
    method: str, model: eqx.Module, *others: eqx.Module
) -> tuple[OpenModel, Float[AnyArray, "models numbers"]]:
    """Return a method whose inputs are the numbers that JAX is tracing, or in which models differ.

    All other numbers stay constants of a program. The numbers are those of each model.
    """
    leaves, structure = jax.tree.flatten(model)
    each = [leaves, *map(jax.tree.leaves, others)]
    places, numbers = [], []
    for k, values in enumerate(zip(*each, strict=True)):
        traced = is_traced(values)
        if traced:
            leaves[k] = np.zeros(np.shape(values[0]), values[0].dtype)
            positions = np.arange(leaves[k].size)
        else:
            rows = np.array([np.ravel(x) for x in values])
            positions = np.flatnonzero((rows != rows[0]).any(axis=0))
        if len(positions):
            stack = jnp.stack if traced else np.stack
            numbers.append(stack([x.ravel()[positions] for x in values]))
            places.append((k, tuple(positions.tolist())))
    closed = jax.tree.unflatten(structure, leaves)
    join = jnp.concatenate if is_traced(numbers) else np.concatenate
    together = join([np.zeros((len(each), 0)), *numbers], axis=1)
    return OpenModel(closed, method, tuple(places)), together
