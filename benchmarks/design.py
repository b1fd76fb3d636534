"""The cost of an excitation design, as the compile and run benchmarks need it.

Log det of the information matrix of a Fourier motion, in the base regressor's columns, and its
gradient with respect to all coefficients.
"""

import numpy as np

HARMONICS, SAMPLES, OMEGA = 5, 800, 2 * np.pi / 10


def joint_rows(base):
    """A function of a motion: for each joint its rows [columns that act on it, samples]."""
    from jaxid.dynamics.joint_rows import JointRows

    rows = JointRows.of_base(base).for_gradients
    return lambda motion: rows(motion.q.T, motion.qd.T, motion.qdd.T), rows.columns


def gram_product():
    """Y -> Y Y^T whose reverse pass is one product, where the plain rule takes two."""
    import jax

    gram = jax.custom_vjp(lambda y: y @ y.T)
    gram.defvjp(lambda y: (y @ y.T, y), lambda y, g: ((g + g.T) @ y,))
    return gram


def design_cost(base, series):
    """Value of (a, b) -> log det, joint by joint, so that zeros cost nothing."""
    import jax.numpy as jnp

    import jaxid as jid
    from jaxid.trajectory.fourier import FourierSeries

    rows, columns = joint_rows(base)
    gram = gram_product()
    # t is fixed, so sines and cosines of the base motion are constants.
    t = np.linspace(0.0, 2 * np.pi / OMEGA, SAMPLES, endpoint=False)

    def cost(coefficients):
        a, b = coefficients
        motion = FourierSeries(series.offset, a, b, OMEGA).motion(t)
        information = jnp.zeros((base.size, base.size))
        for block, acting in zip(
            rows(jid.Motion(motion.q, motion.qd, motion.qdd)), columns, strict=True
        ):
            place = np.ix_(acting, acting)
            information = information.at[place].add(gram(block))
        return 2 * jnp.sum(jnp.log(jnp.diag(jnp.linalg.cholesky(information / SAMPLES))))

    return cost


def arm_and_series():
    """The base parameters of the Panda, bodies with friction and rotors, and a motion of it."""
    import jaxid as jid
    from jaxid.trajectory.fourier import random_fourier_series

    robot = jid.robots.panda()
    base = jid.base_parameters(jid.Model(robot))
    return base, random_fourier_series(robot, omega=OMEGA, harmonics=HARMONICS, seed=1)
