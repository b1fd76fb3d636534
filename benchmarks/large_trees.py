"""Compiling and running of robots with 18 joints and more, beside Pinocchio.

    python benchmarks/large_trees.py [--quick] [--only TEXT] [--json FILE]

Each figure is a process of its own on one core. The first call counts as compiling, in
seconds of CPU time; it includes the trace. The Python loop over Pinocchio's function
runs in turn with ours in the same process and stores each result into a new array of
as many samples: above 32 MB the pages of such an array are new in each turn. Where ours
stores no dense result, the loop uses the memory of some samples again.
Functions with large results take arrays of NumPy, as the loop does; all others, and
those called `compiled_`, are under `jit`. There XLA's memory has small pages, and
filling it takes longer than the loop, unless `GLIBC_TUNABLES=glibc.malloc.hugetlb=1` is
set.
Bodies only, float64. The floating base of Go2, Talos and G1 is a body on six virtual
joints, as `jid.load_urdf(file, floating=True)` makes it; Pinocchio takes its own free
flyer.
"""

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import timing

SAMPLES = 4096
SAMPLES_IN_CACHE = 50
SPARSE = ("gram", "packed_regressor")
LARGE = ("mass_matrix", "regressor")
FLOATING_JOINTS = 6
FILES = {
    "Go2": "go2_description/urdf/go2.urdf",
    "Talos": "talos_data/robots/talos_reduced.urdf",
    "G1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
}
# Largest compile time [CPU s] and smallest speed relative to the loop that are asked.
ASKED = {
    "Go2": {
        "inverse_dynamics": (8, 4.0),
        "gram": (15, 2.0),
        "packed_regressor": (15, 2.0),
        "regressor": (15, 1.0),
    },
    "chain of 30": {
        "inverse_dynamics": (8, 1.4),
        "forward_dynamics": (8, 1.1),
        "mass_matrix": (8, 1.0),
        "packed_regressor": (20, 1.4),
    },
    "Talos": {
        "inverse_dynamics": (8, 2.0),
        "forward_dynamics": (8, 1.1),
        "mass_matrix": (8, 1.0),
        "packed_regressor": (20, 1.4),
    },
}
FUNCTIONS = (
    "inverse_dynamics",
    "mass_matrix",
    "forward_dynamics",
    "gram",
    "packed_regressor",
    "regressor",
    "compiled_mass_matrix",
    "compiled_regressor",
)


class PinocchioTree(NamedTuple):
    """A robot in Pinocchio.

    Attributes:
        scalar: Model whose joints all have one coordinate.
        floating: The same with a free flyer, or None.
    """

    scalar: object
    floating: object


def chain(joints: int) -> PinocchioTree:
    """Return a serial robot with oblique axes."""
    import numpy as np
    import pinocchio as pin

    model = pin.Model()
    rng = np.random.default_rng(0)
    body = pin.Inertia(1.0, np.array([0.01, 0.02, 0.05]), np.diag([0.01, 0.012, 0.008]))
    joint = 0
    for i in range(joints):
        axis = rng.normal(size=3)
        attitude = pin.utils.rotate("x", 0.4 + i) @ pin.utils.rotate("z", 0.3 * i)
        placement = pin.SE3(attitude, np.array([0.05, 0.02, 0.1]))
        revolute = pin.JointModelRevoluteUnaligned(axis / np.linalg.norm(axis))
        joint = model.addJoint(joint, revolute, placement, f"joint{i}")
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    return PinocchioTree(model, None)


def floating(file: str) -> PinocchioTree:
    """Return a robot of `example-robot-data` on six joints without mass."""
    import cmeel
    import numpy as np
    import pinocchio as pin

    prefix = Path(next(iter(cmeel.__path__))).parent / "cmeel.prefix"
    text = (prefix / "share/example-robot-data/robots" / file).read_text()
    # Meshes are not needed.
    xml = re.sub(r"<(visual|collision)\b.*?</\1>", "", text, flags=re.DOTALL)
    base = pin.Model()
    joint = 0
    for kind in ("PX", "PY", "PZ", "RX", "RY", "RZ"):
        model = getattr(pin, f"JointModel{kind}")()
        joint = base.addJoint(joint, model, pin.SE3.Identity(), f"base {kind}")
    frame = pin.Frame("base", joint, pin.SE3.Identity(), pin.FrameType.OP_FRAME)
    base.addFrame(frame)
    legs = pin.buildModelFromXML(xml)
    place = base.getFrameId("base")
    tree = pin.appendModel(base, legs, place, pin.SE3.Identity())
    flyer = pin.buildModelFromXML(xml, pin.JointModelFreeFlyer())
    # An IMU on the base measures gravity too.
    for model in (tree, flyer):
        model.gravity.linear = np.zeros(3)
    return PinocchioTree(tree, flyer)


def tree(name: str) -> PinocchioTree:
    """Return one of the robots."""
    if name.startswith("chain"):
        return chain(int(name.split()[-1]))
    return floating(FILES[name])


def jaxid_robot(peer: PinocchioTree):
    """Return the robot of a Pinocchio model, and ten parameters of each solid body."""
    import numpy as np
    import pinocchio as pin
    from pinocchio_loop import ORDER, SIGNS

    import jaxid as jid

    model = peer.scalar
    has_base = peer.floating is not None
    n = model.nv
    data = model.createData()
    pin.computeJointJacobians(model, data, np.zeros(n))
    revolute, axes, rotations, offsets, parameters = [], [], [], [], []
    for joint in range(1, n + 1):
        column = pin.getJointJacobian(model, data, joint, pin.LOCAL)[:, joint - 1]
        turns = bool(np.linalg.norm(column[3:]) > 0.5)
        revolute.append(turns)
        axes.append(column[3:] if turns else column[:3])
        rotations.append(model.jointPlacements[joint].rotation)
        offsets.append(model.jointPlacements[joint].translation)
        numbers = model.inertias[joint].toDynamicParameters()
        parameters.append(numbers[ORDER] * SIGNS)
    robot = jid.Robot(
        "tree",
        parent=tuple(parent - 1 for parent in list(model.parents)[1:]),
        revolute=tuple(revolute),
        axis=np.array(axes),
        rotation=np.array(rotations),
        offset=np.array(offsets),
        gravity=model.gravity.linear.copy(),
        virtual=tuple(range(FLOATING_JOINTS)) if has_base else (),
        floating=has_base,
    )
    return robot, np.array(parameters)[list(robot.solid_bodies)]


class Call(NamedTuple):
    """The same quantity of many samples by both packages.

    Attributes:
        ours: Function of `arguments`.
        arguments: Arrays of NumPy or JAX.
        values: Result of ours for some samples, as Pinocchio gives it.
        loop: Pinocchio's function of one sample's number.
        shape: Shape of its result.
    """

    ours: object
    arguments: tuple
    values: object
    loop: object
    shape: tuple


def call(name: str, function: str, samples: int) -> Call:
    """Return the calls of a function for a robot."""
    is_compiled = function not in LARGE
    function = function.removeprefix("compiled_")
    import jax
    import jax.numpy as jnp
    import numpy as np
    import pinocchio as pin
    from pinocchio_loop import ORDER, SIGNS

    import jaxid as jid

    peer = tree(name)
    robot, bodies = jaxid_robot(peer)
    terms = (jid.RigidBodies(),)
    model = jid.Model(robot, terms)
    p = jnp.asarray(bodies.ravel())
    n = robot.joints
    q, qd, qdd = np.random.default_rng(1).normal(size=(3, samples, n))
    if peer.floating is not None:
        q[:, :FLOATING_JOINTS] = 0.0
    arrays = tuple(jnp.asarray(x) for x in (q, qd, qdd))

    # A free flyer takes a position, a quaternion and the angles.
    fast = peer.floating or peer.scalar
    coordinates = q
    if peer.floating is not None:
        still = np.zeros((samples, FLOATING_JOINTS))
        ones = np.ones((samples, 1))
        coordinates = np.hstack([still, ones, q[:, FLOATING_JOINTS:]])
    data = fast.createData()
    exact, exact_data = peer.scalar, peer.scalar.createData()

    def regressor(model, data, q, qd, qdd):
        return pin.computeJointTorqueRegressor(model, data, q, qd, qdd)

    def mass_matrix(model, data, q, qd, qdd):
        return pin.crba(model, data, q)

    peers = {
        "inverse_dynamics": (pin.rnea, (n,)),
        "mass_matrix": (mass_matrix, (n, n)),
        "forward_dynamics": (pin.aba, (n,)),
    }
    run, shape = peers.get(function, (regressor, (n, 10 * (fast.njoints - 1))))
    ours, arguments = {
        "inverse_dynamics": (model.inverse_dynamics, (p, *arrays)),
        "mass_matrix": (model.mass_matrix, (p, q)),
        "forward_dynamics": (model.forward_dynamics, (p, *arrays)),
        "gram": (lambda *x: model.gram(jid.Motion(*x)), arrays),
        "packed_regressor": (
            lambda *x: model.packed_regressor(jid.Motion(*x)).values,
            arrays,
        ),
        "regressor": (lambda *x: model.regressor(jid.Motion(*x)), arrays),
    }[function]
    if is_compiled:
        ours = jax.jit(lambda *x, run=ours: run(*x))
    else:
        arguments = tuple(map(np.asarray, arguments))

    def loop(k):
        return run(fast, data, coordinates[k], qd[k], qdd[k])

    def values(count):
        rows = [
            np.array(run(exact, exact_data, q[k], qd[k], qdd[k])) for k in range(count)
        ]
        if function == "mass_matrix":
            return np.array([np.triu(x) + np.triu(x, 1).T for x in rows])
        if run is not regressor:
            return np.array(rows)
        by_body = np.array(rows).reshape(count, n, n, 10)[..., ORDER] * SIGNS
        return by_body[:, :, list(robot.solid_bodies)].reshape(count, n, -1)

    return Call(ours, arguments, values, loop, shape)


def difference(function: str, result: Call, samples: int) -> float:
    """Return the largest difference from Pinocchio, relative to the largest entry."""
    import numpy as np

    values = result.ours(*result.arguments)
    if function == "gram":
        rows = result.values(samples)
        rows = rows.reshape(-1, rows.shape[-1])
        expected = rows.T @ rows
        found = np.asarray(values)
    else:
        expected = result.values(20)
        found = values
    if function == "packed_regressor":
        return float("nan")
    found = np.asarray(found)[: len(expected)]
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def work(name: str, function: str, samples: int) -> None:
    """Print the figures of one process as JSON."""
    timing.pin_to(1)
    import jax
    import numpy as np

    jax.block_until_ready(jax.jit(lambda x: x + 1)(np.zeros(3)))
    result = call(name, function, samples)
    start = time.process_time()
    jax.block_until_ready(result.ours(*result.arguments))
    compiling = time.process_time() - start

    def loop():
        size = samples if function not in SPARSE else SAMPLES_IN_CACHE
        stored = np.empty((size, *result.shape))
        for k in range(samples):
            stored[k % size] = result.loop(k)

    cases = {
        "ours": lambda: jax.block_until_ready(result.ours(*result.arguments)),
        "loop": loop,
    }
    times = timing.interleaved(cases, 7)
    figures = {
        "compile": compiling,
        "ours": times["ours"].median / samples,
        "loop": times["loop"].median / samples,
        "ratio": times["loop"] / times["ours"],
        "error": difference(function, result, samples),
    }
    print(json.dumps(figures))


def measure(name: str, function: str, samples: int) -> dict:
    """Return the figures of a process of its own."""
    command = [sys.executable, __file__, "--work", name, function]
    done = subprocess.run(
        [*command, "--samples", str(samples)], capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(f"{name}, {function}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1]) | {"stderr": done.stderr}


def main() -> None:
    """Measure all robots and functions."""
    parser = timing.parser(__doc__, "only inverse dynamics of Go2")
    parser.add_argument("--only", default="", help="robots or functions with this text")
    parser.add_argument("--work", nargs=2, help="one process: prints its figures")
    parser.add_argument("--samples", type=int, default=SAMPLES)
    options = parser.parse_args()
    if options.work:
        work(*options.work, options.samples)
        return
    rows = []
    for name in ("Go2", "chain of 30", "Talos", "G1"):
        for function in FUNCTIONS:
            if options.only not in f"{name}, {function}":
                continue
            if options.quick and rows:
                continue
            figures = measure(name, function, options.samples)
            measured = (
                f"compile {figures['compile']:.1f} CPU s; "
                f"{1e6 * figures['ours']:.2f} us a sample, "
                f"{figures['ratio']:.2f}x Pinocchio's {1e6 * figures['loop']:.2f} us; "
                f"difference {figures['error']:.0e}"
            )
            asked, holds = "-", None
            quantity = function.removeprefix("compiled_")
            if quantity in ASKED.get(name, {}):
                seconds, ratio = ASKED[name][quantity]
                asked = f"<= {seconds} CPU s, >= {ratio:g}x"
                holds = figures["compile"] <= seconds and figures["ratio"] >= ratio
            if "slow compile" in figures["stderr"]:
                measured += "; XLA printed its message on slow compiling"
                holds = False
            recipe = f"{options.samples} samples, one core"
            what = f"{name}, `{function}`"
            row = timing.Row("trees", what, recipe, asked, measured, holds)
            rows.append(row)
            print(f"{what}: {measured}; asked {asked}", flush=True)
    timing.hand_over(rows, options.json)


if __name__ == "__main__":
    main()
