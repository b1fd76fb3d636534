"""Many data sets in one call against a loop in NumPy.

    python benchmarks/batches.py [--quick] [--json FILE]

The loop does for each data set what a careful user of NumPy does: regressor rows of the
base parameters, weights, `numpy.linalg.lstsq`. Its rows come once from Pinocchio,
called for each sample from Python, and once from this package (in NumPy). One turn
takes the whole batch and a few data sets of each loop; the time for one data set is
compared. BLAS has one thread.
"""

import os

import timing
from timing import Row, hand_over, interleaved

ASKED = 20.0
EPSILON = 0.01
"""Width of the smooth sign of Coulomb friction [rad/s]."""


def motions(datasets, samples, joints):
    """Return Fourier series of five harmonics, different for each data set."""
    import numpy as np

    import jaxid as jid

    random = np.random.default_rng(0)
    t = np.linspace(0, 10, samples)
    w = 0.2 * np.pi * np.arange(1, 6)
    a, b = random.normal(scale=0.3, size=(2, datasets, joints, 5))
    c, s = np.cos(np.outer(w, t)), np.sin(np.outer(w, t))
    series = (
        a @ c + b @ s,
        (b * w) @ c - (a * w) @ s,
        -(a * w**2) @ c - (b * w**2) @ s,
    )
    return jid.Motion(*(np.ascontiguousarray(x.swapaxes(1, 2)) for x in series))


def seven_axes():
    """Return the base parameters of a Panda with friction."""
    import jaxid as jid

    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(jid.robots.panda(), terms))


def by_evaluation(base):
    """Return the rows of this package, evaluated in NumPy, [samples, joints, base]."""
    import numpy as np

    return lambda m: np.asarray(base.regressor(m))


def by_pinocchio(base):
    """Return the rows of Pinocchio, sample by sample, and columns of friction."""
    import numpy as np
    import pinocchio as pin
    from pinocchio_loop import Bodies, in_our_order, pinocchio_model

    n = base.model.robot.joints
    model = pinocchio_model(base.model.robot, Bodies(n))
    data = model.createData()
    columns = np.array(base.indices)
    bodies, friction = columns[columns < 10 * n], columns[columns >= 10 * n] - 10 * n

    def rows(m):
        found = np.empty((len(m.q), n, 10 * n))
        for k in range(len(m.q)):
            found[k] = pin.computeJointTorqueRegressor(
                model, data, m.q[k], m.qd[k], m.qdd[k]
            )
        rubbed = np.zeros((len(m.q), n, 2 * n))
        at = np.arange(n)
        rubbed[:, at, at], rubbed[:, at, n + at] = m.qd, np.tanh(m.qd / EPSILON)
        return np.concatenate(
            [in_our_order(found, n)[..., bodies], rubbed[..., friction]], axis=-1
        )

    return rows


def solved(rows, motion, forces, weights):
    """Solve weighted least squares of one data set, with columns of length one."""
    import numpy as np

    theta = (rows(motion) * weights[:, None]).reshape(forces.size, -1)
    scale = np.linalg.norm(theta, axis=0)
    return (
        np.linalg.lstsq(theta / scale, (forces * weights).ravel(), rcond=None)[0]
        / scale
    )


def against_loops(datasets, samples, turns):
    """Measure row 15."""
    import jax
    import numpy as np

    import jaxid as jid

    base = seven_axes()
    n = base.model.robot.joints
    motion = motions(datasets, samples, n)
    random = np.random.default_rng(1)
    forces = np.asarray(base.inverse_dynamics(random.normal(size=base.size), motion))
    forces = forces + 0.1 * random.normal(size=forces.shape)
    weights = 1.0 / np.asarray(base.model.robot.max_forces)
    some = range(min(4, datasets))

    def batch():
        return jax.block_until_ready(
            jid.identify_batch(base, motion, forces).parameters
        )

    ours, first = timing.elapsed(batch)
    ways = {"NumPy + this package's rows": by_evaluation(base)}
    if timing.missing("pinocchio") is None:
        ways["NumPy + Pinocchio's rows"] = by_pinocchio(base)
    else:
        print(timing.missing("pinocchio"))
    cases = {"batch": batch}
    for name, rows in ways.items():
        p = solved(rows, motion[0], forces[0], weights)
        np.testing.assert_allclose(ours[0], p, rtol=1e-8, atol=1e-8 * np.abs(p).max())
        cases[name] = lambda rows=rows: [
            solved(rows, motion[k], forces[k], weights) for k in some
        ]
    times = interleaved(cases, turns)
    mine = times["batch"].median / datasets
    found = []
    for name in ways:
        ratio = times[name] / times["batch"] * datasets / len(some)
        loop = times[name].median / len(some)
        found.append(
            Row(
                "15",
                f"{datasets} data sets x {samples} samples in one call, against "
                f"{name} + lstsq",
                f"Panda, {base.size} base parameters with friction, float64, two "
                f"cores, median of {turns} turns; the loop on {len(some)} data sets a "
                f"turn; compile {first - times['batch'].median:.1f} s apart",
                f"{ASKED:.0f}x",
                f"{ratio:.1f}x ({1e3 * mine:.2f} ms against {1e3 * loop:.1f} ms for a "
                "data set)",
                ratio >= ASKED,
            )
        )
    return found


def main():
    """Measure row 15 on two cores."""
    options = timing.parser(__doc__, "fewer data sets").parse_args()
    timing.pin_to(2)
    for name in timing.THREADS:
        os.environ[name] = "1"
    hand_over(against_loops(128 if options.quick else 1000, 800, 5), options.json)


if __name__ == "__main__":
    main()
