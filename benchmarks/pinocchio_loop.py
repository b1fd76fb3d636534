"""The same arm in Pinocchio, and a C++ loop over samples, built from its headers.

The loop is compiled with all of this processor's instructions; it needs `g++`, Boost's
headers (which come with the wheel of Pinocchio) and Eigen's. Eigen is looked for in
`EIGEN3_INCLUDE`, in the wheel `cmeel-eigen`, and where distributions put it.
"""

import ctypes
import hashlib
import importlib.util
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("pinocchio_loop.cpp")
GENERATOR = Path(__file__).with_name("pinocchio_casadi.cpp")
# Column of Pinocchio's regressor for each of (m, mx, my, mz, A, B, C, D, E, F); D, E
# and F are integrals, Pinocchio has the entries of the tensor.
ORDER = [0, 1, 2, 3, 4, 6, 9, 8, 7, 5]
SIGNS = np.array([1, 1, 1, 1, 1, 1, 1, -1, -1, -1.0])
BOOST = {
    "BOOST_MPL_LIMIT_LIST_SIZE": 30,
    "BOOST_MPL_LIMIT_VECTOR_SIZE": 30,
    "BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS": 1,
    "BOOST_FUSION_INVOKE_MAX_ARITY": 12,
}


class Bodies:
    """Solid spheres of various masses, off the origin of their frames."""

    def __init__(self, joints):
        random = np.random.default_rng(joints)
        self.mass = random.uniform(0.5, 4.0, joints)
        self.centre = random.uniform(-0.1, 0.1, (joints, 3))
        self.inertia = self.mass[:, None, None] * 0.003 * np.eye(3)

    @property
    def parameters(self):
        """Ten standard parameters of each body."""
        rows = []
        for m, c, inertia in zip(self.mass, self.centre, self.inertia, strict=True):
            J = inertia + m * (c @ c * np.eye(3) - np.outer(c, c))
            rows.append(
                [m, *(m * c), J[0, 0], J[1, 1], J[2, 2], -J[1, 2], -J[0, 2], -J[0, 1]]
            )
        return np.array(rows)


def pinocchio_model(robot, bodies):
    """Return a model with the joints of a robot, in the robot's order."""
    import pinocchio as pin

    model = pin.Model()
    axes = {
        (1, 0, 0): pin.JointModelRX,
        (0, 1, 0): pin.JointModelRY,
        (0, 0, 1): pin.JointModelRZ,
    }
    for i in range(robot.joints):
        axis = np.asarray(robot.axis[i])
        aligned = axes.get(tuple(axis))
        joint = aligned() if aligned else pin.JointModelRevoluteUnaligned(axis)
        place = pin.SE3(np.asarray(robot.rotation[i]), np.asarray(robot.offset[i]))
        k = model.addJoint(robot.parent[i] + 1, joint, place, f"joint{i}")
        inertia = pin.Inertia(bodies.mass[i], bodies.centre[i], bodies.inertia[i])
        model.appendBodyToJoint(k, inertia, pin.SE3.Identity())
    return model


def in_our_order(regressors, joints):
    """Return columns [samples, joints, columns] in the order of `RigidBodies`."""
    columns = regressors.reshape(-1, joints, joints, 10)[..., ORDER] * SIGNS
    return columns.reshape(-1, joints, 10 * joints)


def prefixes():
    """Return folders that may hold headers, first the common prefix of wheels."""
    import cmeel

    found = [Path(p).parent / "cmeel.prefix" for p in cmeel.__path__]
    return [*found, Path("/usr"), Path("/usr/local")]


def build(source=SOURCE, *extra):
    """Compile the loop, or take that of an earlier run with the same source.

    Raises:
        RuntimeError: If it cannot be built, with the reason.
    """
    places = [p / "include/eigen3" for p in prefixes()]
    if "EIGEN3_INCLUDE" in os.environ:
        places.insert(0, Path(os.environ["EIGEN3_INCLUDE"]))
    eigen = next((p for p in places if (p / "Eigen/Core").exists()), None)
    if eigen is None:
        raise RuntimeError(
            "no headers of Eigen (pip install cmeel-eigen, or set EIGEN3_INCLUDE)"
        )
    include = prefixes()[0] / "include"
    command = [
        "g++",
        "-std=c++17",
        "-O3",
        "-march=native",
        "-DNDEBUG",
        "-shared",
        "-fPIC",
    ]
    command += ["-fvisibility=hidden", "-Wl,-Bsymbolic", "-w", str(source)]
    command += [f"-D{name}={value}" for name, value in BOOST.items()]
    command += [f"-I{include}", f"-I{eigen}", *extra]
    texts = source.read_bytes() + SOURCE.read_bytes()
    key = hashlib.sha256(" ".join(command).encode() + texts).hexdigest()[:16]
    target = Path(tempfile.gettempdir()) / f"jaxid-pinocchio-loop-{key}.so"
    if not target.exists():
        partial = target.with_suffix(f".{os.getpid()}")
        try:
            done = subprocess.run(
                [*command, "-o", str(partial)], capture_output=True, text=True
            )
        except OSError as problem:
            raise RuntimeError(f"no g++: {problem}") from problem
        if done.returncode:
            first = next(
                (x for x in done.stderr.splitlines() if "error" in x), "no message"
            )
            raise RuntimeError(f"g++ says: {first[:200]}")
        partial.replace(target)
    return target


class Loop:
    """Pinocchio in C++ over rows of samples, with results in mapped memory."""

    def __init__(self, robot, bodies, q, qd, qdd, built=None):
        if not all(robot.revolute):
            raise ValueError("the loop in C++ knows only joints that turn")
        self.library = ctypes.CDLL(str(built or build()))
        self.library.arm_new.restype = ctypes.c_void_p
        joints = robot.joints
        rows = np.concatenate(
            [bodies.mass[:, None], bodies.centre, bodies.inertia.reshape(joints, 9)],
            axis=1,
        )
        parent = np.array(robot.parent, np.int32)
        arrays = [
            np.ascontiguousarray(x, float) for x in (robot.rotation, robot.offset)
        ]
        arrays += [np.ascontiguousarray(robot.axis, float), np.ascontiguousarray(rows)]
        self.arm = ctypes.c_void_p(
            self.library.arm_new(joints, *(_address(x) for x in [parent, *arrays]))
        )
        self.inputs = [np.ascontiguousarray(x, float) for x in (q, qd, qdd)]
        self.columns = np.zeros((len(q), 10 * joints, joints))
        self.forces = np.zeros((len(q), joints))

    def regressors(self):
        """Return the regressors [samples, joints, columns], in Pinocchio's columns."""
        self._run(self.library.arm_regressors, self.columns)
        return self.columns.swapaxes(1, 2)

    def torques(self):
        """Return the generalised forces [samples, joints]."""
        self._run(self.library.arm_torques, self.forces)
        return self.forces

    def _run(self, function, out):
        samples = ctypes.c_long(len(out))
        function(self.arm, samples, *(_address(x) for x in self.inputs), _address(out))


def generated(robot, bodies):
    """Return the C code that CasADi makes of Pinocchio's rnea: the function `peer`.

    Raises:
        RuntimeError: If it cannot be built, with the reason.
    """
    spec = importlib.util.find_spec("casadi")
    if spec is None or spec.origin is None:
        raise RuntimeError("no CasADi (pip install --no-deps casadi)")
    wheel = Path(spec.origin).parent
    links = [f"-I{wheel / 'include'}", f"-L{wheel}", "-lcasadi", f"-Wl,-rpath,{wheel}"]
    # It runs once: compiling it with -O3 takes minutes.
    built = build(GENERATOR, *links, "-O1")
    nothing = np.zeros((1, robot.joints))
    loop = Loop(robot, bodies, nothing, nothing, nothing, built)
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        try:
            # CasADi takes the name of a file, without a folder.
            os.chdir(folder)
            loop.library.arm_generate(loop.arm, b"peer.c")
        finally:
            os.chdir(here)
        return Path(folder, "peer.c").read_text()


def _address(x):
    return ctypes.c_void_p(x.ctypes.data)
