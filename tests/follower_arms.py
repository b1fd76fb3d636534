"""Arms of four links on joints of which some follow others, as URDF files.

What Pinocchio and the tests know of them is written a second time, by hand: `relations`
gives the coordinate of a follower as (leader, factor, offset).
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

RELATIONS = {
    "parallelogram": {"j3": ("j2", -1.0, 0.0)},
    "belt": {"j3": ("j2", 1.0, 0.0)},
    "half the speed": {"j4": ("j2", 0.5, 0.3)},
    "follower of a follower": {"j3": ("j2", -1.5, 0.2), "j4": ("j2", -3.0, 0.5)},
    "slide on a turning joint": {"j3": ("j1", 0.15, 0.1)},
    "side branch": {"j4": ("j2", -1.0, 0.4)},
    "on the ground": {"j4": ("j1", 0.7, -0.2)},
    "before its leader": {"j1": ("j3", 0.8, 0.1)},
}
MIMICS = {"follower of a follower": {"j4": ("j3", 2.0, 0.1)}}
"""Elements of the file where they are other than the relations."""
PARENTS = {"side branch": {4: 1}, "on the ground": {4: 0}}
JOINT = """<joint name="j{i}" type="{kind}">
 <parent link="l{parent}"/><child link="l{i}"/><origin xyz="{xyz}" rpy="{rpy}"/>
 <axis xyz="{axis}"/><limit lower="-3" upper="3" velocity="2" effort="50"/>
 <dynamics damping="0.5" friction="0.25"/>{mimic}</joint>"""


class FollowerArm(NamedTuple):
    """File of an arm, and its joints as Pinocchio knows them without relations."""

    text: str
    relations: dict[str, tuple[str, float, float]]
    tree: pin.Model

    @property
    def names(self):
        """Names of all joints: those that move alone, then the followers."""
        names = [f"j{i}" for i in range(1, 5)]
        return sorted(names, key=lambda name: name in self.relations)

    @property
    def ratios(self):
        """Speeds of Pinocchio's joints by those of the coordinates, and offsets."""
        joints = 4 - len(self.relations)
        ratios, offsets = np.zeros((4, joints)), np.zeros(4)
        for name in self.names:
            leader, factor, offset = self.relations.get(name, (name, 1.0, 0.0))
            row = self.tree.idx_vs[self.tree.getJointId(name)]
            ratios[row, self.names.index(leader)] = factor
            offsets[row] = offset
        return ratios, offsets

    def tree_motion(self, motion):
        """Motions of all joints in Pinocchio's order."""
        ratios, offsets = self.ratios
        q, qd, qdd = (np.asarray(x) @ ratios.T for x in motion)
        return q + offsets, qd, qdd


def follower_arm(case):
    """Return an arm by its name."""
    random = np.random.default_rng(list(RELATIONS).index(case))
    relations = RELATIONS[case]
    mimics = relations | MIMICS.get(case, {})
    links, joints = ['<link name="l0"/>'], []
    for i in range(1, 5):
        mimic = ""
        if f"j{i}" in mimics:
            leader, factor, offset = mimics[f"j{i}"]
            mimic = f'<mimic joint="{leader}" multiplier="{factor}" offset="{offset}"/>'
        slides = case == "slide on a turning joint" and i == 3
        joints.append(
            JOINT.format(
                i=i,
                parent=PARENTS.get(case, {}).get(i, i - 1),
                kind="prismatic" if slides else "revolute",
                xyz=_numbers(random.uniform(-0.3, 0.3, 3)),
                rpy=_numbers(random.uniform(-1.0, 1.0, 3)),
                axis="0 1 0"
                if case == "parallelogram"
                else _numbers(random.normal(size=3)),
                mimic=mimic,
            )
        )
        points = random.normal(0.0, 0.2, (6, 3))
        centre = points.mean(axis=0)
        square = (points - centre).T @ (points - centre)
        tensor = np.trace(square) * np.eye(3) - square
        links.append(
            f'<link name="l{i}"><inertial><origin xyz="{_numbers(centre)}"/>'
            f'<mass value="{random.uniform(1.0, 4.0)}"/>'
            f'<inertia ixx="{tensor[0, 0]}" iyy="{tensor[1, 1]}" izz="{tensor[2, 2]}" '
            f'ixy="{tensor[0, 1]}" ixz="{tensor[0, 2]}" iyz="{tensor[1, 2]}"/>'
            "</inertial></link>"
        )
    text = f'<robot name="arm">{"".join(links + joints)}</robot>'
    return FollowerArm(text, relations, pin.buildModelFromXML(text))


def _numbers(values):
    return " ".join(map(repr, np.asarray(values).tolist()))
