"""jit, vmap and grad through everything; batches; geometry as input; float32."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trees
from scipy.spatial.transform import Rotation

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion

N = 3
TREE = trees.Tree(
    (-1, 0, 1),
    (True, False, True),
    *trees.geometry(np.random.default_rng(61), N),
    np.array([1.0, -3.0, -9.0]),
)
ROBOT = TREE.robot()
MODEL = Model(ROBOT)
P = np.random.default_rng(62).normal(size=MODEL.size)


def _all_methods(motion):
    q, qd = motion.q, motion.qd
    return {
        "regressor": MODEL.regressor(motion),
        "inverse_dynamics": MODEL.inverse_dynamics(P, motion),
        "mass_matrix": MODEL.mass_matrix(P, q),
        "bias_forces": MODEL.bias_forces(P, q, qd),
        "kinetic_energy": MODEL.kinetic_energy(P, q, qd),
        "potential_energy": MODEL.potential_energy(P, q),
    }


@pytest.fixture(scope="module")
def alone():
    """All methods of one instant, the definitions without a batch axis."""

    def methods(one):
        q, qd, qdd = one.q, one.qd, one.qdd
        rest = jnp.zeros(N)
        mass = jax.jacfwd(lambda x: MODEL.forces(P, q, rest, x))(rest)
        return {
            "regressor": MODEL.columns(q, qd, qdd),
            "inverse_dynamics": MODEL.forces(P, q, qd, qdd),
            "mass_matrix": mass,
            "bias_forces": MODEL.forces(P, q, qd, rest),
            "kinetic_energy": 0.5 * qd @ mass @ qd,
            "potential_energy": sum(
                t.potential_columns(ROBOT, q) @ x for t, x in MODEL.split(P)
            ),
        }

    return trees.compiled(methods)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (2, 0)])
def test_batch_axes_lead(batch, alone):
    """Every instant as if it were alone, by the definition itself."""
    motion = Motion(*trees.random_motion(np.random.default_rng(63), *batch, N))
    found = _all_methods(motion)
    assert {x.shape[: len(batch)] for x in found.values()} == {batch}
    assert {x.dtype for x in found.values()} == {np.dtype("float64")}
    for index in np.ndindex(*batch):
        one = Motion(*(x[index] for x in (motion.q, motion.qd, motion.qdd)))
        for name, value in alone(one).items():
            np.testing.assert_allclose(
                found[name][index], value, rtol=1e-12, atol=1e-12
            )


def _work(p, motion, axis, rotation, offset, gravity):
    """A number that depends on everything."""
    robot = ROBOT.replace(axis=axis, rotation=rotation, offset=offset, gravity=gravity)
    forces = Model(robot).inverse_dynamics(p, motion)
    return (forces * jnp.asarray(WEIGHTS)).sum()


WEIGHTS = np.random.default_rng(64).normal(size=(2, N))
MOTION = Motion(*trees.random_motion(np.random.default_rng(65), 2, N))
INPUTS = (P, MOTION, TREE.axis, TREE.rotation, TREE.offset, TREE.gravity)


@pytest.fixture(scope="module")
def slopes():
    """Gradient of the work by parameters, motion and geometry; and the work itself."""
    inputs = jax.tree.map(jnp.asarray, INPUTS)
    return trees.compiled(jax.grad(_work, argnums=tuple(range(6))))(
        *inputs
    ), trees.compiled(_work)


def _turned(rotation, body, direction, h):
    out = rotation.copy()
    out[body] = rotation[body] @ Rotation.from_rotvec(direction * h).as_matrix()
    return out


def test_gradients_are_central_differences(slopes):
    """By parameters, motion, a length, an attitude, an axis and gravity."""
    gradient, work = slopes
    rng = np.random.default_rng(66)
    h = 1e-6

    def check(which, plus, minus, slope):
        changed = [list(INPUTS), list(INPUTS)]
        changed[0][which], changed[1][which] = plus, minus
        central = (float(work(*changed[0])) - float(work(*changed[1]))) / (2 * h)
        assert abs(slope) > 1e-3
        assert float(slope) == pytest.approx(central, rel=1e-6, abs=1e-6)

    one_length = np.zeros((N, 3))
    one_length[2, 0] = 1.0
    for which, direction in (
        (0, rng.normal(size=P.shape)),
        (4, one_length),
        (4, rng.normal(size=(N, 3))),
        (5, rng.normal(size=3)),
    ):
        x = INPUTS[which]
        slope = (gradient[which] * direction).sum()
        check(which, x + h * direction, x - h * direction, slope)

    along = Motion(*rng.normal(size=(3, 2, N)))
    # Slower than the tanh of dry friction is wide, and no joint stands still here.
    assert np.abs(MOTION.qd).min() > 0.05
    slope = sum(
        (g * d).sum()
        for g, d in zip(
            jax.tree.leaves(gradient[1]), jax.tree.leaves(along), strict=True
        )
    )
    shifted = [
        jax.tree.map(lambda x, d, s=s: x + s * h * d, MOTION, along) for s in (1, -1)
    ]
    check(1, *shifted, slope)

    w = rng.normal(size=3)
    tangent = TREE.rotation[1] @ np.cross(np.eye(3), w)
    slope = (gradient[3][1] * tangent).sum()
    check(3, _turned(TREE.rotation, 1, w, h), _turned(TREE.rotation, 1, w, -h), slope)

    sideways = np.cross(w, TREE.axis[2])
    tilted = [TREE.axis + s * h * np.eye(N)[2][:, None] * sideways for s in (1, -1)]
    check(2, *tilted, (gradient[2][2] * sideways).sum())


def test_regressor_is_differentiable_by_the_motion():
    """What design of excitation asks: the regressor's slope is its difference."""
    rng = np.random.default_rng(67)
    dq, dqd, dqdd = rng.normal(size=(3, N))
    q, qd, qdd = (jnp.asarray(x[0]) for x in (MOTION.q, MOTION.qd, MOTION.qdd))
    h = 1e-5

    @trees.compiled
    def slope(q, qd, qdd):
        return jax.jvp(MODEL.columns, (q, qd, qdd), (dq, dqd, dqdd))[1]

    plus, minus = (
        MODEL.regressor(Motion(q + s * dq, qd + s * dqd, qdd + s * dqdd))
        for s in (h, -h)
    )
    assert trees.relative(slope(q, qd, qdd), np.asarray(plus - minus) / (2 * h)) < 1e-7


def test_geometry_may_be_a_batch_axis():
    """vmap over robots of one structure; the same as one robot after the other."""
    rng = np.random.default_rng(68)
    offsets = TREE.offset + rng.normal(size=(4, N, 3)) * 0.1

    def forces(offset):
        return Model(ROBOT.replace(offset=offset)).inverse_dynamics(P, MOTION)

    found = trees.compiled(jax.vmap(forces))(offsets)
    alone = trees.compiled(forces)
    expected = np.stack([alone(x) for x in offsets])
    assert trees.relative(found, expected) < 1e-14
    assert found.shape == (4, 2, N)


def test_a_model_is_a_tree_that_passes_through_jit():
    """The robot's arrays as inputs: a second robot of its kind compiles nothing new."""
    traces = []

    @eqx.filter_jit
    def forces(model, p, motion):
        traces.append(1)
        return model.inverse_dynamics(p, motion)

    other = Model(ROBOT.replace(offset=ROBOT.offset * 1.5))
    first, second = forces(MODEL, P, MOTION), forces(other, P, MOTION)
    assert len(traces) == 1
    expected = trees.compiled(lambda m: m.inverse_dynamics(P, MOTION))(other)
    assert trees.relative(second, expected) < 1e-13
    assert trees.relative(first, second) > 1e-2
