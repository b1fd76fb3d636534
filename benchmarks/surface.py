"""Public dynamics under JAX's transformations, beside the packed form and Pinocchio.

    python benchmarks/surface.py [--quick] [--json FILE]

Panda with bodies, friction and rotors (91 standard parameters), random motions,
float64, one core; medians of repeated calls in one process. The packed form is a
batch-last program that returns one array for each distinct entry. Rollouts: 100 steps
of semi-implicit Euler, value and gradient by the parameters and the forces; chains of
30 joints repeat the Panda's geometry.
"""

import functools
import statistics
import time

import numpy as np
import timing
from timing import Row, hand_over

LINK = [2.0, 0.05, -0.02, 0.1, 0.05, 0.06, 0.04, 0.002, -0.001, 0.003]


def median(function, *arguments, seconds=0.4, repeats=11):
    """Return the median time of a call [s], after one that compiles."""
    import jax

    def call():
        return function(*arguments)

    jax.block_until_ready(call())
    begun = time.perf_counter()
    jax.block_until_ready(call())
    each = max(1, int(seconds / repeats / max(time.perf_counter() - begun, 1e-7)))
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        for _ in range(each):
            jax.block_until_ready(call())
        times.append((time.perf_counter() - begun) / each)
    return statistics.median(times)


def motion(samples, joints=7):
    """Return a random motion in JAX."""
    import jax.numpy as jnp

    import jaxid as jid

    draws = np.random.default_rng(1).uniform(-1.0, 1.0, (3, samples, joints))
    return jid.Motion(*map(jnp.asarray, draws))


def packed_form(definition, *shapes):
    """Return the batch-last program of a method of a model."""
    import jax

    import jaxid as jid

    program = jid.program.trace(definition, *shapes)
    lowered, (nodes, _) = jid.program.lower(program), program.distinct
    first = [program.outputs.index(k) for k in nodes]

    def run(*arrays):
        values = lowered(*arrays)
        return tuple(values[k] for k in first)

    return jax.jit(run)


def geometry(model, p, rng):
    """Return the time with offsets and rotations as inputs over that as constants."""
    import dataclasses

    import equinox as eqx
    import jax
    import jax.numpy as jnp

    turns = np.linalg.qr(rng.normal(size=(7, 3, 3)))[0]
    robot = model.robot.replace(offset=rng.normal(size=(7, 3)), rotation=turns)
    model, x = dataclasses.replace(model, robot=robot), motion(16384)

    @jax.jit
    def as_inputs(offset, rotation, p, x):
        own = eqx.tree_at(
            lambda m: (m.robot.offset, m.robot.rotation), model, (offset, rotation)
        )
        return own.inverse_dynamics(p, x)

    numbers = jnp.asarray(robot.offset), jnp.asarray(robot.rotation)
    ratio = median(as_inputs, *numbers, p, x) / median(
        jax.jit(model.inverse_dynamics), p, x
    )
    label = "offsets and rotations as inputs, of constants, 16,384 samples"
    return Row("geometry", label, "", "<= 1.1x", f"{ratio:.2f}x")


def dynamics(model, p, quick):
    """Yield rows of inverse dynamics and of the regressor."""
    import jax

    n = (7,)
    forces = packed_form(model.forces, p.shape, n, n, n)
    columns = packed_form(model.columns, n, n, n)
    for samples in (64, 2048) if quick else (64, 2048, 16384, 100000):
        x = motion(samples)
        last = [a.T + 0 for a in (x.q, x.qd, x.qdd)]
        passed = jax.jit(model.inverse_dynamics)
        closed = jax.jit(functools.partial(model.inverse_dynamics, p))
        floor = median(forces, p, *last)
        times = [median(passed, p, x) / floor, median(closed, x) / floor]
        said = f"{times[0]:.2f} passed, {times[1]:.2f} closed over; packed takes "
        said += f"{1e9 * floor / samples:.0f} ns"
        yield Row(
            f"inverse/{samples}", "inverse dynamics over packed", "", "<= 1.15", said
        )
    for samples in (256, 2048) if quick else (256, 2048, 4096, 8192):
        x = motion(samples)
        host = jax.tree.map(np.asarray, x)
        last = [a.T + 0 for a in (x.q, x.qd, x.qdd)]
        dense, floor = jax.jit(model.regressor), median(columns, *last)
        loop = pinocchio_loop(samples)
        times = [median(dense, x), median(model.regressor, host)]
        said = (
            f"{times[0] / floor:.1f} of packed; a loop over Pinocchio takes "
            f"{loop / times[0]:.1f} times as long, {loop / times[1]:.1f} times with "
            "NumPy arrays, not compiled"
        )
        yield Row(
            f"regressor/{samples}", "dense regressor", "", "<= 4.5 of packed", said
        )


def pinocchio_loop(samples):
    """Return the time of a loop over Pinocchio's joint torque regressor [s]."""
    import pinocchio as pin

    model = pin.Model()
    for k in range(7):
        axis = pin.JointModelRZ() if k % 2 else pin.JointModelRY()
        at = pin.SE3(np.eye(3), np.array([0.0, 0.1, 0.2]))
        model.addJoint(k, axis, at, f"j{k}")
        model.appendBodyToJoint(k + 1, pin.Inertia.Random(), pin.SE3.Identity())
    data, draws = (
        model.createData(),
        np.random.default_rng(1).uniform(-1, 1, (samples, 3, 7)),
    )

    def run():
        for q, qd, qdd in draws:
            pin.computeJointTorqueRegressor(model, data, q, qd, qdd)

    return median(run)


def rollout(model, p):
    """Return times to compile and to run the value and gradient of a rollout [s]."""
    import jax
    import jax.numpy as jnp

    n = model.robot.joints
    start, forces = (
        jnp.zeros(n),
        jnp.asarray(np.random.default_rng(2).normal(size=(100, n))),
    )

    def loss(p, forces):
        def step(state, u):
            q, qd = state
            qd = qd + 1e-3 * model.forward_dynamics(p, q, qd, u - 0.5 * qd)
            return (q + 1e-3 * qd, qd), q @ q

        return jax.lax.scan(step, (start, start), forces)[1].sum()

    begun = time.perf_counter()
    run = jax.jit(jax.value_and_grad(loss, (0, 1))).lower(p, forces).compile()
    return time.perf_counter() - begun, median(run, p, forces)


def main():
    """Print the table."""
    given = timing.parser(__doc__, "few samples").parse_args()
    timing.pin_to(1)
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import jaxid as jid

    panda = jid.robots.panda()
    model = jid.Model(panda)
    rng = np.random.default_rng(0)
    rest = rng.uniform(0.1, 0.5, model.size - 70)
    p = jnp.asarray(np.concatenate([LINK * 7, rest]))
    rows = list(dynamics(model, p, given.quick))
    rows.append(geometry(model, p, rng))
    x = motion(10**4 if given.quick else 10**6)
    gram = jax.jit(model.gram).lower(x).compile()
    memory = gram.memory_analysis().temp_size_in_bytes / 1e6
    said = f"{median(gram, x):.2f} s, {memory:.1f} MB"
    rows.append(
        Row("gram", f"gram of {len(x.q)} samples", "", "<= 1.5 s, <= 10 MB", said)
    )
    k = np.arange(30) % 7
    chain = jid.Robot(
        "chain",
        revolute=(True,) * 30,
        axis=np.asarray(panda.axis)[k],
        rotation=np.asarray(panda.rotation)[k],
        offset=0.5 * np.asarray(panda.offset)[k] + 0.05,
    )
    bodies = (jid.RigidBodies(),)
    arm, long = jid.Model(panda, bodies), jid.Model(chain, bodies)
    robots = {"bodies": (arm, p[:70]), "friction and rotors": (model, p)}
    if not given.quick:
        robots["30 joints"] = (long, jnp.asarray(LINK * 30))
    for name, (robot, numbers) in robots.items():
        compiling, running = rollout(robot, numbers)
        said = f"{compiling:.1f} s to compile, {1e3 * running:.1f} ms"
        rows.append(Row(f"rollout/{name}", f"rollout, {name}", "100 steps", "", said))
    if not given.quick:
        y, numbers = motion(1000, 30), jnp.asarray(LINK * 30)
        cases = {
            "inverse dynamics": (long.inverse_dynamics, (numbers, y)),
            "mass matrix": (long.mass_matrix, (numbers, y.q)),
            "forward dynamics": (long.forward_dynamics, (numbers, y.q, y.qd, y.qdd)),
        }
        for name, (method, arguments) in cases.items():
            begun = time.perf_counter()
            jax.jit(method).lower(*arguments).compile()
            said = f"{time.perf_counter() - begun:.1f} s"
            rows.append(
                Row(f"chain/{name}", f"{name}, 30 joints, compile", "", "<= 8 s", said)
            )
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
