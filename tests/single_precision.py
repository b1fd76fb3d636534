"""What entry points give, or say, where JAX runs in float32 (0) or in float64 (1).

python tests/single_precision.py 0|1 FOLDER: as JSON in FOLDER/found.json.
"""

import dataclasses
import json
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

HERE = Path(__file__).parent
DOUBLE = sys.argv[1] == "1"
FOLDER = Path(sys.argv[2])
sys.path.insert(0, str(HERE / "identification"))
# Whatever the environment says.
jax.config.update("jax_enable_x64", DOUBLE)

from virtual import observations, standard_parameters

import jaxid as jid
from jaxid.validation.torque_errors import validate

URDF = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="50" velocity="3"/></joint>
<joint name="k" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
<origin xyz="0.4 0 0" rpy="1.5707963267948966 0 0"/>
<limit lower="-2" upper="2" effort="20" velocity="3"/></joint></robot>"""
FOLDER.mkdir()
(FOLDER / "arm.urdf").write_text(URDF)
TERMS = (
    jid.RigidBodies(),
    jid.ViscousFriction(),
    jid.CoulombFriction(),
    jid.ConstantOffset(),
)
robot = jid.load_urdf(FOLDER / "arm.urdf")
model = jid.Model(robot, TERMS)
p = standard_parameters(model)
cold, warm = (
    dataclasses.replace(
        observations(model, q, noise=0.1, samples=300, seed=k, noise_seed=k), name=name
    )
    for k, (name, q) in enumerate((("cold", p), ("warm", 1.1 * p)))
)
base = jid.base_parameters(model)
key = jax.random.key(0)


def plain():
    return jid.identify(base, cold)


def dynamics():
    """Methods of a model on float32 arrays, whose results have this precision too."""
    motion = jid.Motion(
        *(jnp.asarray(x[:9], jnp.float32) for x in jax.tree.leaves(cold.motion))
    )
    single = jnp.asarray(p, jnp.float32)
    found = (
        model.regressor(motion),
        model.inverse_dynamics(single, motion),
        model.mass_matrix(single, motion.q),
        model.potential_energy(single, motion.q),
    )
    assert DOUBLE or {x.dtype for x in found} == {np.dtype(np.float32)}
    return np.concatenate([np.ravel(x) for x in found])


def rounded():
    """Of arrays in float32, which are the same numbers in float64."""
    single = [np.float32(x) for x in (*jax.tree.leaves(cold.motion), cold.forces)]
    *motion, forces = [x.astype(float) for x in single] if DOUBLE else single
    o = cold.replace(motion=jid.Motion(*motion), forces=forces)
    return jid.identify(base, o).parameters


def runs():
    return [jid.identify(base, o) for o in (cold, warm)]


def consistent():
    return jid.identify(base, cold, jid.PhysicallyConsistent())


def numbers_of(path):
    """All numbers of a text but those in its comments."""
    text = re.sub(
        r"/\*.*?\*/|//.*|<!--.*?-->|<\?.*?\?>", "", path.read_text(), flags=re.DOTALL
    )
    return [float(x) for x in re.findall(r"-?\d+\.\d+(?:e[-+]?\d+)?", text)]


def loaded():
    plain().save(FOLDER / "arm.json")
    return jid.load_fit(FOLDER / "arm.json").parameters


def angles_along_path():
    path = jid.trajectories.iso9283_path(
        [0.3, 0.1, 0.4], 0.2, np.diag([1.0, -1.0, -1.0])
    )
    return jid.trajectories.joint_path(jid.robots.tx40(), path).coefficients[-1]


def written_motion():
    a = np.array([[0.1, 0.2], [0.3, -0.1]])
    coefficients = np.column_stack([[0.3, 0.1], a, a[::-1]])
    series = jid.trajectories.FourierBasis(2, 1.1).trajectory(coefficients)
    jid.trajectories.save_trajectory(series, FOLDER / "motion.json")
    found = jid.trajectories.load_trajectory(FOLDER / "motion.json")
    return found.motion(np.linspace(0.0, 1.0, 5)).qdd


def batch():
    motion = jid.Motion(*(x[None] for x in jax.tree.leaves(cold.motion)))
    return jid.identify_batch(base, motion, cold.forces[None]).parameters


def designed():
    return jid.design_excitation(
        base,
        harmonics=2,
        omega=1.0,
        starts=2,
        generations=0,
        samples=50,
        key=key,
    ).trajectory.coefficients


CASES = {
    "dynamics": dynamics,
    "load_urdf": lambda: jax.tree.leaves(jid.load_urdf(FOLDER / "arm.urdf").rotation)[
        0
    ],
    "base_parameters": lambda: jid.base_parameters(model).kappa,
    "identify": lambda: plain().parameters,
    "standard deviations": lambda: plain().standard_deviations,
    "identify float32 arrays": rounded,
    "Huber": lambda: (
        jid.identify(base, cold, jid.estimators.IterativelyReweighted()).parameters
    ),
    "PhysicallyConsistent": lambda: consistent().parameters,
    "identify_batch": batch,
    "bootstrap": lambda: jid.uncertainty.bootstrap(
        jid.RegressionProblem(base, [cold]).blocks, np.ones(2), 20, key
    ),
    "identify_states": lambda: jid.identify_states(runs()).parameters,
    "update": lambda: jid.combine_fits(*runs()).parameters,
    "compare": lambda: jid.compare(plain(), jid.identify(base, warm)).difference,
    "validate": lambda: [e.relative for e in validate(plain(), [warm]).errors],
    "predict": lambda: plain().predict(cold.motion),
    "design_excitation": designed,
    "save and load": loaded,
    "trajectory": written_motion,
    "export_c": lambda: numbers_of(jid.export_c(plain(), FOLDER / "c")),
    "export_urdf": lambda: numbers_of(
        jid.export_urdf(consistent(), FOLDER / "arm.urdf", FOLDER / "new.urdf")
    ),
    "export_mjcf": lambda: numbers_of(
        jid.export_mjcf(consistent(), FOLDER / "new.xml")
    ),
    "pinocchio_parameters": lambda: jid.export.pinocchio_parameters(consistent()),
    "joint_path": angles_along_path,
}
REFUSED = (
    "identify_batch",
    "bootstrap",
    "design_excitation",
)
"""Cases that compute in JAX, which must not do so in float32."""
if __name__ == "__main__":
    found = {}
    for name, case in CASES.items():
        if DOUBLE and name in REFUSED:
            continue
        try:
            found[name] = np.asarray(case(), np.float64).ravel().tolist()
        except Exception as error:
            found[name] = f"{type(error).__name__}: {error}"
    (FOLDER / "found.json").write_text(json.dumps(found))
