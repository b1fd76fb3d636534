"""Machines of ten kinds, as MuJoCo models: the true one, and the file a user has.

The file has the true geometry, and masses, centres and inertias that are wrong by up to
30 %, as drawings are. Limits and friction follow from a machine's own gravity and
inertia, so that a hobby arm and a crane are treated alike.
"""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np


class Link(NamedTuple):
    """Link of a machine, with the joint that moves it.

    Attributes:
        parent: Index of the link that carries it; -1 is the base.
        kind: "hinge" or "slide".
        place: Position of its frame in that of its parent [m].
        axis: Axis of its joint.
        mass: Mass [kg].
        reach: Vector from the joint to the far end [m].
        span: Half of the range of the joint [rad or m].
    """

    parent: int
    kind: str
    place: tuple[float, float, float]
    axis: tuple[float, float, float]
    mass: float
    reach: tuple[float, float, float]
    span: float


X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
OBLIQUE = (0.6, 0.0, 0.8)

MACHINES = {
    "palletiser": [
        Link(-1, "hinge", (0, 0, 0.4), Z, 60.0, (0.2, 0, 0.3), 2.5),
        Link(0, "hinge", (0.2, 0, 0.3), Y, 40.0, (0, 0, 0.8), 1.0),
        Link(1, "hinge", (0, 0, 0.8), Y, 25.0, (0.9, 0, 0), 1.2),
        Link(2, "hinge", (0.9, 0, 0), Z, 6.0, (0.05, 0.02, -0.2), 3.0),
    ],
    "lightweight": [
        Link(-1, "hinge", (0, 0, 0.16), Z, 4.0, (0, 0, 0.2), 2.9),
        Link(0, "hinge", (0, 0, 0.2), Y, 4.0, (0, 0, 0.2), 2.0),
        Link(1, "hinge", (0, 0, 0.2), Z, 3.0, (0, 0, 0.2), 2.9),
        Link(2, "hinge", (0, 0, 0.2), (0, -1, 0), 2.7, (0, 0, 0.2), 2.0),
        Link(3, "hinge", (0, 0, 0.2), Z, 1.7, (0, 0, 0.2), 2.9),
        Link(4, "hinge", (0, 0, 0.2), Y, 1.8, (0, 0, 0.08), 2.0),
        Link(5, "hinge", (0, 0, 0.08), Z, 0.5, (0.03, 0.02, 0.1), 3.0),
    ],
    "gantry": [
        Link(-1, "slide", (0, 0, 1.5), X, 120.0, (0.2, 0, 0), 0.8),
        Link(0, "slide", (0, 0, 0), Y, 50.0, (0, 0.2, 0.1), 0.5),
        Link(1, "slide", (0, 0, 0), Z, 20.0, (0, 0, -0.4), 0.3),
        Link(2, "hinge", (0, 0, -0.4), Z, 4.0, (0.05, 0, -0.15), 3.0),
        Link(3, "hinge", (0, 0, -0.15), Y, 2.0, (0.02, 0.01, -0.15), 2.0),
    ],
    "two arms": [
        Link(-1, "hinge", (0, 0, 0.8), Z, 12.0, (0, 0, 0.3), 1.5),
        Link(0, "hinge", (0, 0.25, 0.3), Y, 3.0, (0, 0.1, -0.3), 1.8),
        Link(1, "hinge", (0, 0.1, -0.3), X, 2.0, (0, 0.05, -0.3), 1.4),
        Link(2, "hinge", (0, 0.05, -0.3), Y, 1.0, (0.2, 0, 0), 1.8),
        Link(0, "hinge", (0, -0.25, 0.3), Y, 3.0, (0, -0.1, -0.3), 1.8),
        Link(4, "hinge", (0, -0.1, -0.3), X, 2.0, (0, -0.05, -0.3), 1.4),
    ],
    "oblique": [
        Link(-1, "hinge", (0, 0, 0.3), OBLIQUE, 8.0, (0.3, 0.1, 0.2), 1.8),
        Link(0, "hinge", (0.3, 0.1, 0.2), Y, 5.0, (0.2, 0, 0.3), 1.8),
        Link(1, "hinge", (0.2, 0, 0.3), OBLIQUE, 3.0, (0.25, 0.1, 0), 2.0),
        Link(2, "hinge", (0.25, 0.1, 0), X, 1.5, (0.1, 0, 0.15), 2.5),
        Link(3, "hinge", (0.1, 0, 0.15), Y, 0.8, (0.12, 0.02, 0), 2.5),
    ],
    "hobby": [
        Link(-1, "hinge", (0, 0, 0.05), Z, 0.12, (0, 0, 0.05), 1.9),
        Link(0, "hinge", (0, 0, 0.05), Y, 0.1, (0, 0, 0.115), 1.6),
        Link(1, "hinge", (0, 0, 0.115), Y, 0.09, (0.135, 0, 0), 1.6),
        Link(2, "hinge", (0.135, 0, 0), Y, 0.06, (0.06, 0, 0), 1.6),
        Link(3, "hinge", (0.06, 0, 0), X, 0.05, (0.05, 0.03, 0.02), 2.6),
    ],
    "wall": [
        Link(-1, "hinge", (0.2, 0, 0), X, 25.0, (0.1, 0.1, 0), 2.9),
        Link(0, "hinge", (0.1, 0.1, 0), Y, 15.0, (0.5, 0, 0), 1.8),
        Link(1, "hinge", (0.5, 0, 0), Y, 8.0, (0, 0, -0.4), 1.8),
        Link(2, "hinge", (0, 0, -0.4), Z, 3.0, (0, 0, -0.2), 2.9),
        Link(3, "hinge", (0, 0, -0.2), Y, 2.0, (0, 0, -0.1), 1.8),
        Link(4, "hinge", (0, 0, -0.1), Z, 0.6, (0.03, 0.01, -0.1), 3.0),
    ],
    "scara on a rail": [
        Link(-1, "slide", (0, 0, 1.2), X, 30.0, (0.2, 0, 0), 0.7),
        Link(0, "hinge", (0.1, 0, 0), Z, 10.0, (0.35, 0, 0), 2.2),
        Link(1, "hinge", (0.35, 0, 0), Z, 6.0, (0.3, 0, 0), 2.4),
        Link(2, "slide", (0.3, 0, 0), Z, 1.5, (0, 0, -0.25), 0.15),
        Link(3, "hinge", (0, 0, -0.25), Z, 0.6, (0.03, 0.01, -0.05), 3.0),
    ],
    "tree": [
        Link(-1, "hinge", (0, 0, 0.5), OBLIQUE, 9.0, (0.2, -0.1, 0.3), 1.6),
        Link(0, "hinge", (0.2, -0.1, 0.3), (0, 0.8, 0.6), 4.0, (0.3, 0, 0.1), 1.8),
        Link(1, "slide", (0.3, 0, 0.1), X, 2.0, (0.25, 0, 0), 0.2),
        Link(0, "hinge", (-0.2, 0.1, 0.3), Y, 3.0, (-0.3, 0, 0.1), 1.8),
        Link(3, "hinge", (-0.3, 0, 0.1), Z, 1.5, (0, 0.2, 0.05), 2.0),
    ],
    "crane": [
        Link(-1, "hinge", (0, 0, 2.0), Z, 9000.0, (0.5, 0, 1.0), 2.5),
        Link(0, "hinge", (0.5, 0, 1.0), Y, 12000.0, (10.0, 0, 0), 0.6),
        Link(1, "slide", (3.0, 0, 0), X, 6000.0, (9.0, 0, 0.2), 3.0),
        Link(2, "hinge", (9.0, 0, 0.2), Y, 1500.0, (3.0, 0, 0), 1.0),
    ],
}
SETTING_KINDS = "palletiser", "lightweight", "gantry", "two arms", "oblique"
"""Machines on which limits were set; the others show the rates."""


@dataclasses.dataclass(frozen=True)
class Machine:
    """Machine to record, and the file that its user has.

    Attributes:
        name: Name.
        model: MuJoCo model of the true machine, without friction.
        file: Text of the MJCF file that the user has.
        true_file: Text of the MJCF file of the true machine.
        max_forces: Largest forces of the drives [N m or N].
        max_speeds: Largest speeds [rad/s or m/s].
        viscous: Viscous friction [N m s/rad or N s/m].
        coulomb: Dry friction [N m or N].
    """

    name: str
    model: mujoco.MjModel
    file: str
    true_file: str
    max_forces: np.ndarray
    max_speeds: np.ndarray
    viscous: np.ndarray
    coulomb: np.ndarray


def machine(name):
    """Return one of the machines."""
    links = MACHINES[name]
    rng = np.random.default_rng(list(MACHINES).index(name))
    bodies = [_body(link, rng) for link in links]
    rotors = np.zeros(len(links))
    model = _model(links, bodies, rotors, None)
    spans = np.array([x.span for x in links])
    max_speeds = 1.6 * spans
    rotors = rng.uniform(0.1, 0.4, len(links)) * _inertias(model)
    max_forces = 1.3 * _forces(_model(links, bodies, rotors, None), max_speeds)
    share = rng.uniform(0.03, 0.08, (2, len(links)))
    drawn = [_wrong(body, rng) for body in bodies]
    return Machine(
        name,
        _model(links, bodies, rotors, None),
        _text(links, drawn, np.zeros(len(links)), max_forces),
        _text(links, bodies, rotors, max_forces),
        max_forces,
        max_speeds,
        share[0] * max_forces / max_speeds,
        share[1] * max_forces,
    )


def _body(link, rng):
    """Return mass, centre and inertia about the centre of a link."""
    reach = np.array(link.reach)
    length = np.linalg.norm(reach)
    centre = 0.45 * reach + 0.08 * length * rng.uniform(-1, 1, 3)
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    radii = length * rng.uniform(0.12, 0.35, 3)
    # Solid ellipsoid: second moments of mass along its axes.
    second = axes @ np.diag(link.mass * radii**2 / 5) @ axes.T
    return link.mass, centre, np.trace(second) * np.eye(3) - second


def _wrong(body, rng):
    """Return a body as drawings tell it."""
    mass, centre, inertia = body
    factor = rng.uniform(0.7, 1.3)
    size = np.linalg.norm(centre)
    centre = centre + 0.3 * size * rng.uniform(-1, 1, 3) / np.sqrt(3)
    return factor * mass, centre, factor * rng.uniform(0.7, 1.3) * inertia


def _text(links, bodies, rotors, max_forces):
    """Return the MJCF of a machine."""
    children = {k: [] for k in range(-1, len(links))}
    for k, link in enumerate(links):
        children[link.parent].append(k)

    def vector(values):
        return " ".join(f"{x:.9g}" for x in values)

    def element(k):
        link = links[k]
        mass, centre, J = bodies[k]
        moments = vector((J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]))
        forces = ""
        if max_forces is not None:
            f = max_forces[k]
            forces = f'actuatorfrcrange="{-f:.6g} {f:.6g}"'
        return (
            f'<body name="body{k + 1}" pos="{vector(link.place)}">'
            f'<inertial pos="{vector(centre)}" mass="{mass:.9g}" '
            f'fullinertia="{moments}"/>'
            f'<joint name="joint{k + 1}" type="{link.kind}" '
            f'axis="{vector(link.axis)}" armature="{rotors[k]:.9g}" '
            f'range="{-link.span:.9g} {link.span:.9g}" {forces}/>'
            + "".join(map(element, children[k]))
            + "</body>"
        )

    return (
        '<mujoco><compiler angle="radian" boundinertia="0"/>'
        "<worldbody>" + "".join(map(element, children[-1])) + "</worldbody></mujoco>"
    )


def _model(links, bodies, rotors, max_forces):
    model = mujoco.MjModel.from_xml_string(_text(links, bodies, rotors, max_forces))
    # Ranges are the reference's, not stops.
    model.jnt_limited[:] = 0
    return model


def _poses(model):
    """Yield random poses in the ranges."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        yield rng.uniform(model.jnt_range[:, 0], model.jnt_range[:, 1])


def _inertias(model):
    """Return typical inertias of the joints."""
    data = mujoco.MjData(model)
    diagonals = []
    for pose in _poses(model):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        diagonals.append(np.diag(matrix))
    return np.median(diagonals, axis=0)


def _forces(model, max_speeds):
    """Return large forces of random motions within the limits of speed."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    forces = []
    for pose in _poses(model):
        data.qpos[:] = pose
        data.qvel[:] = max_speeds * rng.uniform(-1, 1, model.nv)
        data.qacc[:] = 4.5 * max_speeds * rng.uniform(-1, 1, model.nv)
        mujoco.mj_inverse(model, data)
        forces.append(np.abs(data.qfrc_inverse))
    return np.quantile(forces, 0.95, axis=0)
