r"""Joints that follow others, as in parallelograms and on belts.

A follower has no coordinate of its own: it moves by $q_f = k q_l + q_0$ with the joint
that leads it. The coordinates of all joints are $\Gamma q + q_0$, where $q$ are those
of the joints that move alone, which come first. Forces of all joints become those of
the coordinates by $\Gamma^T$.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Indices, ManyJoints, Matrix, namespace
from jaxid.errors import InputError

MAX_FINGER_SHARE = 0.05
"""Share of the moving mass above which a joint moves more than a finger."""


class Follower(eqx.Module):
    """Joint that follows another one by `factor * q + offset`, and moves a body.

    Args:
        name: Name of the joint.
        revolute: Whether it turns; a prismatic joint slides.
        leader: Index of the joint that it follows, among those that move alone.
        factor: Ratio of its speed to that of its leader [1, m/rad or rad/m].
        offset: Its coordinate where that of its leader is zero [rad or m].

    Raises:
        InputError: If the factor is zero, or a number is not finite.
    """

    name: str = eqx.field(static=True)
    _: dataclasses.KW_ONLY
    revolute: bool = eqx.field(static=True)
    leader: int = eqx.field(static=True)
    factor: float = eqx.field(static=True, converter=float)
    offset: float = eqx.field(static=True, converter=float, default=0.0)

    def __check_init__(self):
        if not 0.0 < abs(self.factor) < math.inf or not math.isfinite(self.offset):
            raise InputError(
                f"joint `{self.name}` needs a finite `factor` other than 0 and a "
                f"finite `offset`, but has {self.factor:g} and {self.offset:g}."
            )


Followers = tuple[Follower, ...]
"""Followers of a robot, in the order of their bodies."""


def all_coordinates(followers: Followers, q: ManyJoints) -> AnyArray:
    """Return the coordinates of all joints from those of the joints that move alone."""
    return _joined(q, [f.factor * q[..., f.leader] + f.offset for f in followers])


def all_rates(followers: Followers, qd: ManyJoints) -> AnyArray:
    """Return the velocities or accelerations of all joints in the same way."""
    return _joined(qd, [f.factor * qd[..., f.leader] for f in followers])


def _joined(values: AnyArray, follower_values: list):
    """Append the values of followers along the last axis."""
    if not follower_values:
        return values
    xp = namespace(values)
    return xp.concatenate([values, xp.stack(follower_values, axis=-1)], axis=-1)


def speed_ratios(followers: Followers, joints: int) -> Matrix:
    r"""Return $\Gamma$: speeds of all joints (rows) by those of the coordinates."""
    ratios = np.eye(joints + len(followers), joints)
    for row, follower in enumerate(followers, joints):
        ratios[row, follower.leader] = follower.factor
    return ratios


def on_coordinates(followers: Followers, rows: Any) -> Any:
    r"""Return $\Gamma^T$ times rows of all joints, such as their forces."""
    if not followers:
        return rows
    ratios = speed_ratios(followers, len(rows) - len(followers))
    return jnp.tensordot(jnp.asarray(ratios.T, rows.dtype), rows, 1)


def order_from_ground(parent: Indices, followers: int) -> Indices:
    """Return the bodies in an order in which each comes after the one that carries it.

    Otherwise they keep the order of their numbers. Circles of parents are left out.
    """
    order = [-1]
    # Only a follower's body may carry one with a smaller number, once on each way.
    for body in [*range(len(parent))] * (followers + 1):
        if body not in order and parent[body] in order:
            order.append(body)
    return tuple(order[1:])


class Relation(NamedTuple):
    """How a joint of a file follows another one, through all between them.

    Attributes:
        leader: Element of the joint that follows no other; None if there is none that
            can move.
        factor: Ratio of the follower's speed to that of the leader.
        offset: Coordinate of the follower where that of the leader is zero.
        is_linear: Whether that is the relation everywhere, not only near zero.
    """

    leader: Any
    factor: float
    offset: float
    is_linear: bool


def relation(tree: Any, joint: Any) -> Relation:
    """Return how a joint of a `UrdfTree` follows another one, or itself."""
    factor = 1.0
    offset = 0.0
    is_linear = True
    chain = []
    while joint is not None and joint not in chain and joint.get("type") != "fixed":
        chain.append(joint)
        mimic = joint.find("mimic")
        if mimic is None:
            return Relation(joint, factor, offset, is_linear)
        offset += factor * float(tree.numbers(mimic, "offset", (0.0,))[0])
        factor *= float(tree.numbers(mimic, "multiplier", (1.0,))[0])
        is_linear = is_linear and mimic.get("nonlinear") is None
        joint = tree.named_joints.get(mimic.get("joint"))
    # A constraint without a joint, with one that cannot move, or a circle of mimics.
    return Relation(None, factor, offset, is_linear)


def loaded_followers(tree: Any, tip_chain: Sequence[Any]) -> list[Any]:
    """Return the joints of a `UrdfTree` that follow others and move parts of the arm.

    Where they move, a finger hardly changes the forces of an arm, but a link does.

    Args:
        tree: Tree in which all joints that mimic others are held.
        tip_chain: Elements of the joints between base and end-effector, if it was
            asked for.

    Raises:
        InputError: If such a joint follows one that is not in the tree, or does not
            follow it linearly.
    """
    total = sum(tree.mass(link) for link in tree.moving_links)
    followers = []
    for joint in tree.named_joints.values():
        leader, factor, _, is_linear = relation(tree, joint)
        is_near = joint in tree.mimics or leader in tree.joints
        if leader in (None, joint) or factor == 0.0 or not is_near:
            continue
        branch = list(tree.branch(joint))
        mass = sum(tree.mass(x.find("child").get("link")) for x in branch)
        carries_chain = any(x in tree.joints for x in branch)
        leads_to_tip = joint in tip_chain and leader in tree.joints
        if not (carries_chain or leads_to_tip or mass > MAX_FINGER_SHARE * total):
            continue
        fault = ""
        if leader not in tree.joints:
            fault = "which `base` or `tip` leaves out: remove them"
        elif not is_linear:
            fault = "by a polynomial: keep only two coefficients of `polycoef`"
        if fault:
            raise tree.error(
                joint,
                f"carries {mass:.3g} of {total:.3g} kg and follows joint "
                f"`{leader.get('name')}`, {fault}, make the joint fixed if it stands "
                "still in the logs, or remove the constraint (`<mimic>`, "
                "`<equality>`) if the logs have its own angle and force",
            )
        followers.append(joint)
    return followers


def resolved_followers(tree: Any, joints: Sequence[Any]) -> Followers:
    """Return how the last joints of a `UrdfTree`, which are these, follow others."""
    for joint in joints:
        if joint not in tree.joints:
            raise tree.error(
                joint,
                "moves with a joint of the robot, but on a link that `tip` leaves out: "
                "choose another `tip`, or remove its `<mimic>`",
            )
    followers = []
    for joint in tree.joints[-len(joints) :]:
        leader, factor, offset, _ = relation(tree, joint)
        follower = Follower(
            joint.get("name"),
            revolute=joint.get("type") != "prismatic",
            leader=tree.joints.index(leader),
            factor=factor,
            offset=offset,
        )
        followers.append(follower)
    return tuple(followers)
