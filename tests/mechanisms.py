"""Mechanisms with closed loops as MJCF files, and what MuJoCo says about their trees.

MuJoCo's own equality constraints are soft. So its inverse dynamics of the tree without
them are projected on the motors, with its own Jacobians of the points that coincide.
"""

from typing import NamedTuple

import mujoco
import numpy as np

FIVE_BAR = """
<body name="a1" pos="-.1 0 0"><joint name="a1" axis="0 -1 0"/>{a1}
  <body name="a2" pos=".25 0 0"><joint name="a2" axis="0 -1 0"/>{a2}
    <site name="e1" pos=".3 0 0"/></body></body>
<body name="b1" pos=".1 0 0"><joint name="b1" axis="0 -1 0"/>{b1}
  <body name="b2" pos=".25 0 0"><joint name="b2" axis="0 -1 0"/>{b2}
    <site name="e2" pos=".3 0 0"/></body></body>
"""
PALLETISER = """
<body name="t" pos="0 0 .4"><joint name="t" axis="0 0 1"/>{t}
  <body name="u" pos=".15 0 0"><joint name="u" axis="0 -1 0"/>{u}
    <body name="f" pos=".8 0 0"><joint name="f" axis="0 -1 0"/>{f}
      <site name="e1" pos="-.2 0 0"/></body></body>
  <body name="c" pos=".15 0 0"><joint name="c" axis="0 -1 0"/>{c}
    <body name="r" pos="-.2 0 0"><joint name="r" axis="0 -1 0"/>{r}
      <site name="e2" pos=".8 0 0"/></body></body></body>
"""
# A crank whose rod pushes a slide, in a plane that no axis is normal to.
SLIDER = """
<body name="base" euler=".4 .3 .2"><body name="crank"><joint name="crank" axis="0 0 1"/>
  {crank}<body name="rod" pos=".2 0 0"><joint name="rod" axis="0 0 1"/>{rod}
    <site name="e1" pos=".5 0 0"/></body></body>
  <body name="slide" pos=".4 .05 0"><joint name="slide" type="slide" axis="1 0 0"/>
    {slide}<site name="e2" pos="0 0 0"/></body></body>
"""

# Three arms that carry a plate; rods turn about two axes at their elbows.
DELTA_ARM = """
<body name="arm{k}" euler="0 0 {angle}"><body name="upper{k}" pos=".2 0 0">
  <joint name="arm{k}" axis="0 1 0"/>{{upper{k}}}
  <body name="rod{k}" pos=".25 0 0"><joint name="bend{k}" axis="0 1 0"/>
    <joint name="swing{k}" axis="0 0 1"/>{{rod{k}}}
    <site name="e{first}" pos=".5 0 0"/></body></body></body>
"""
DELTA_PLATE = """
<body name="plate"><joint name="x" type="slide" axis="1 0 0"/>
  <joint name="y" type="slide" axis="0 1 0"/>
  <joint name="z" type="slide" axis="0 0 1"/>{plate}
  <site name="e2" pos=".06 0 0"/>
  <site name="e4" pos="-.03 .0519615242 0"/><site name="e6" pos="-.03 -.0519615242 0"/>
</body>
"""


class Mechanism(NamedTuple):
    """Bodies, motors, a pose in which the loop nearly closes, spread of motions."""

    bodies: str
    names: tuple[str, ...]
    motors: tuple[str, ...]
    pose: dict[str, float]
    spread: float

    @property
    def text(self):
        """MJCF file."""
        return mjcf(self, self.pose)

    def tree(self):
        """Model of MuJoCo without the constraint."""
        text = self.text.replace("<connect", "<connect active='false'")
        return mujoco.MjModel.from_xml_string(text)


def mjcf(mechanism, pose, motors=None):
    """MJCF file of a mechanism with another pose or other motors."""
    random = np.random.default_rng(len(mechanism.names))
    inertials = {}
    for name in mechanism.names:
        points = random.normal(0.1, 0.15, (8, 3))
        centre = points.mean(axis=0)
        square = (points - centre).T @ (points - centre)
        tensor = np.trace(square) * np.eye(3) - square
        entries = tensor[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
        inertials[name] = (
            f'<inertial pos="{numbers(centre)}" mass="{random.uniform(1, 5)}" '
            f'fullinertia="{numbers(entries)}"/>'
        )
    bodies = mechanism.bodies.format(**inertials)
    names = mechanism.motors if motors is None else motors
    actuators = "".join(f'<motor joint="{x}" ctrlrange="-80 80"/>' for x in names)
    pins = "".join(
        f'<connect name="pin{k or ""}" site1="e{2 * k + 1}" site2="e{2 * k + 2}"/>'
        for k in range(bodies.count("<site") // 2)
    )
    text = (
        '<mujoco model="mechanism"><compiler angle="radian"/>'
        f"<worldbody>{bodies}</worldbody>"
        f"<equality>{pins}</equality><actuator>{actuators}</actuator>"
    )
    model = mujoco.MjModel.from_xml_string(text + "</mujoco>")
    order = [model.joint(k).name for k in range(model.njnt)]
    key = numbers([pose[name] for name in order])
    return f'{text}<keyframe><key qpos="{key}"/></keyframe></mujoco>'


def numbers(values):
    """Numbers of an attribute."""
    return " ".join(map(repr, np.asarray(values, float).tolist()))


class Projection(NamedTuple):
    """Speeds of all joints by those of the motors, and their accelerations."""

    ratios: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


def projection(model, data, q, motors, qd, qdd):
    """Motion of MuJoCo's tree in a closed pose, by its Jacobians of the points."""
    joints = model.nv
    others = [k for k in range(joints) if k not in motors]
    data.qpos[:] = q
    data.qvel[:] = 0.0
    mujoco.mj_forward(model, data)
    slopes = difference(model, data, mujoco.mj_jacSite)
    ratios = np.zeros((joints, len(motors)))
    ratios[motors] = np.eye(len(motors))
    inverse = np.linalg.pinv(slopes[:, others], rcond=1e-9)
    ratios[others] = -inverse @ slopes[:, motors]
    rates = ratios @ qd
    data.qvel[:] = rates
    mujoco.mj_forward(model, data)

    def jacobian_rates(model, data, jacobian, turn, site):
        point = data.site_xpos[site]
        mujoco.mj_jacDot(model, data, jacobian, turn, point, model.site_bodyid[site])

    slope_rates = difference(model, data, jacobian_rates)
    accelerations = ratios @ qdd
    accelerations[others] -= inverse @ slope_rates @ rates
    return Projection(ratios, rates, accelerations)


def difference(model, data, jacobian_of):
    """Differences of the Jacobians of the points of each pair."""
    jacobians = np.zeros((model.nsite, 3, model.nv))
    for number, jacobian in enumerate(jacobians, 1):
        jacobian_of(model, data, jacobian, None, model.site(f"e{number}").id)
    return (jacobians[1::2] - jacobians[::2]).reshape(-1, model.nv)


MECHANISMS = {
    "five-bar": Mechanism(
        FIVE_BAR,
        ("a1", "a2", "b1", "b2"),
        ("a1", "b1"),
        {"a1": 2.2, "a2": -1.634, "b1": 0.9, "b2": 1.651},
        0.25,
    ),
    "palletiser": Mechanism(
        PALLETISER,
        ("t", "u", "f", "c", "r"),
        ("t", "u", "c"),
        {"t": 0.0, "u": 1.4, "f": -1.3, "c": 0.1, "r": 1.3},
        0.25,
    ),
    "slider": Mechanism(
        SLIDER,
        ("crank", "rod", "slide"),
        ("crank",),
        {"crank": 0.9, "rod": -1.1164, "slide": 0.2129},
        0.6,
    ),
}
DELTA = Mechanism(
    "".join(
        DELTA_ARM.format(k=k, angle=2 * np.pi / 3 * k, first=2 * k + 1)
        for k in range(3)
    )
    + DELTA_PLATE,
    (*(f"{kind}{k}" for k in range(3) for kind in ("upper", "rod")), "plate"),
    ("arm0", "arm1", "arm2"),
    {
        **dict.fromkeys(("arm0", "arm1", "arm2"), 0.3),
        **dict.fromkeys(("bend0", "bend1", "bend2"), 2.13),
        **dict.fromkeys(("swing0", "swing1", "swing2", "x", "y"), 0.0),
        "z": -0.4003,
    },
    0.25,
)
"""A mechanism of more loops, for the benchmark: nothing was set on it."""
