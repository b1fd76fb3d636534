"""Functions that the tests of a program share, and hypothesis strategies for more."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st

UNARY = (
    jnp.sin,
    jnp.cos,
    jnp.tanh,
    jnp.abs,
    lambda x: -x,
    lambda x: x * x,
    jnp.exp,
    lambda x: x,
)
BINARY = (
    jnp.add,
    jnp.subtract,
    jnp.multiply,
    jnp.maximum,
    jnp.minimum,
    lambda x, y: x / (1.5 + y * y),
    lambda x, y: jnp.where(x < y, x, 0.5 * y),
)
SIZE = 3


@st.composite
def random_functions(draw, smooth=False):
    """A function of two vectors of `SIZE` entries, as random straight operations."""
    unary = (*UNARY[:3], *UNARY[4:6]) if smooth else UNARY
    binary = (*BINARY[:3], BINARY[5]) if smooth else BINARY
    constants = st.sampled_from([0.0, 1.0, -1.0, 2.0, -0.3, 0.7])
    steps = draw(
        st.lists(
            st.tuples(
                st.integers(0, len(unary) - 1),
                st.integers(0, len(binary) - 1),
                st.integers(0, 40),
                st.integers(0, 40),
                constants,
            ),
            min_size=1,
            max_size=7,
        )
    )

    def function(x, y):
        values = [x, y, x[::-1], np.array([0.0, 1.0, -2.0])]
        for u, b, i, j, c in steps:
            left, right = values[i % len(values)], values[j % len(values)]
            # Bounded, so that a chain of exponentials and squares stays a number.
            values.append(binary[b](c * jnp.sin(unary[u](jnp.asarray(left))), right))
        matrix = jnp.outer(values[-1], x)
        return {
            "vector": values[-1],
            "matrix": matrix @ matrix.T,
            "sum": jnp.sum(values[-2]),
        }

    return function


def every_operation(a, b):
    """All operations of two numbers, without division by zero."""
    inside = 0.9 * jnp.sin(a)
    return jnp.stack(
        [
            jnp.tan(inside), jnp.arcsin(inside), jnp.arccos(inside), jnp.arctan(a),
            jnp.sinh(a), jnp.cosh(a), jnp.tanh(a), jnp.sqrt(a * a), jnp.cbrt(a),
            jnp.exp(a), jnp.log(a * a), jnp.expm1(a), jnp.log1p(b * b),
            jnp.abs(a) ** 0.3, jnp.sign(b), jnp.arctan2(a, b), 1.0 / a,
            jnp.minimum(a, b), jnp.maximum(a, b), -a, a**5, a - 1e-7 * b, 1e20 * a,
            jnp.where((a > 0) & (b < 1) | ~(b != 0.5), a, -b),
        ]
    )  # fmt: skip


def samples(seed, batch, shape=(SIZE,), count=2):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, *shape, *batch))


def reference(function, *arrays):
    """The function on batch-last arrays by `vmap`: it shares nothing with programs."""
    first = [jnp.moveaxis(jnp.asarray(x), -1, 0) for x in arrays]
    found = jax.jit(jax.vmap(function))(*first)
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), 0, -1), found)


def chain(angles, rates):
    """Positions and velocities of a chain of skew axes: shared values, many results."""
    point, turn, results = jnp.zeros(3), jnp.eye(3), []
    offset = np.array([0.3, 0.0, 0.5])
    for k in range(3):
        c, s = jnp.cos(angles[k]), jnp.sin(angles[k])
        step = jnp.array([[c, -s, 0 * c], [0 * c, 0 * c, -1 + 0 * c], [s, c, 0 * c]])
        turn = turn @ step
        point = point + turn @ offset
        results.append(point * rates[k] + jnp.cross(turn[:, 2], point))
    return jnp.stack(results)
