r"""Joints that follow others, as in parallelograms, on belts and in closed chains.

A follower has no coordinate of its own: it moves by $q_f = k q_l + q_0$ with the joint
that leads it, or by the loops of the robot, whose points coincide.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Indices, as_finite_array, given
from jaxid.errors import InputError

MAX_FINGER_SHARE = 0.05
"""Share of the moving mass above which a joint moves more than a finger."""


class Follower(eqx.Module):
    """Joint that follows another one by `factor * q + offset`, and moves a body.

    Args:
        name: Name of the joint.
        revolute: Whether it turns; a prismatic joint slides.
        leader: Index of the joint that it follows, among those that move alone; None if
            loops move it.
        factor: Ratio of its speed to that of its leader [1, m/rad or rad/m].
        offset: Its coordinate where that of its leader is zero, or where the robot's
            description closes the loops [rad or m].
        position_min: Lower end of its range, if loops move it [rad or m].
        position_max: Upper end of its range, if loops move it [rad or m].
        velocity: Its largest speed, if loops move it [rad/s or m/s].

    Raises:
        InputError: If the factor is zero, or a number is not finite.
    """

    name: str = eqx.field(static=True)
    _: dataclasses.KW_ONLY
    revolute: bool = eqx.field(static=True)
    leader: Any = eqx.field(static=True)
    factor: float = eqx.field(static=True, converter=float, default=1.0)
    offset: float = eqx.field(static=True, converter=float, default=0.0)
    position_min: float = eqx.field(static=True, converter=float, default=-math.inf)
    position_max: float = eqx.field(static=True, converter=float, default=math.inf)
    velocity: float = eqx.field(static=True, converter=float, default=math.inf)

    def __check_init__(self):
        if not 0.0 < abs(self.factor) < math.inf or not math.isfinite(self.offset):
            raise InputError(
                f"joint `{self.name}` needs a finite `factor` other than 0 and a "
                f"finite `offset`, but has {self.factor:g} and {self.offset:g}."
            )


Followers = tuple[Follower, ...]
"""Followers of a robot, in the order of their bodies: last those that loops move."""


class Loop(eqx.Module):
    """Closed loop of bodies: a point of one body always coincides with one of another.

    Args:
        name: Name of the loop.
        bodies: Indices of the two bodies; -1 for the ground.
        points: The point in the frame of each body [m].

    Raises:
        InputError: If the bodies are the same, or a point is none.
    """

    name: str = eqx.field(static=True)
    _: dataclasses.KW_ONLY
    bodies: tuple[int, int] = eqx.field(static=True)
    points: Float[AnyArray, "*geometry 2 3"] = eqx.field(converter=given)

    def __post_init__(self):
        first_body, second_body = self.bodies
        self.points = as_finite_array(
            f"`points` of loop `{self.name}`", self.points, (2, 3)
        )
        if first_body == second_body:
            raise InputError(
                f"loop `{self.name}` must join two bodies, but both are {first_body}."
            )


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


def chain_to_ground(parent: Indices, body: int) -> Indices:
    """Return a body and those that carry it; -1, the ground, comes last."""
    chain = [body]
    while chain[-1] >= 0:
        chain.append(parent[chain[-1]])
    return tuple(chain)


def bodies_in_loop(parent: Indices, bodies: tuple[int, int]) -> set[int]:
    """Return the bodies between two bodies, which carry only one of them."""
    first_chain, second_chain = (chain_to_ground(parent, body) for body in bodies)
    return set(first_chain) ^ set(second_chain)


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


def loaded_followers(
    tree: Any, tip_chain: Sequence[Any], loop_joints: Sequence[Any] = ()
) -> list[Any]:
    """Return the joints of a `UrdfTree` that follow others and move parts of the arm.

    Where they move, a finger hardly changes the forces of an arm, but a link does, and
    so does a part of a closed loop.

    Args:
        tree: Tree in which all joints that mimic others are held.
        tip_chain: Elements of the joints between base and end-effector, if it was
            asked for.
        loop_joints: Elements of the joints in closed loops.

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
        leads_to_tip = leads_to_tip or joint in loop_joints
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


def resolved_followers(
    tree: Any, joints: Sequence[Any], moved_joints: Sequence[Any]
) -> Followers:
    """Return how the last joints of a `UrdfTree` follow others, or loops."""
    for joint in joints:
        if joint not in tree.joints:
            raise tree.error(
                joint,
                "moves with a joint of the robot, but on a link that `tip` leaves out: "
                "choose another `tip`, or remove its `<mimic>`",
            )
    followers = []
    # In the order of their bodies.
    for joint in tree.joints:
        relation_of_joint: dict[str, Any] = {}
        if joint in joints:
            leader, factor, offset, _ = relation(tree, joint)
            relation_of_joint["leader"] = tree.joints.index(leader)
            relation_of_joint["factor"] = factor
            relation_of_joint["offset"] = offset
        elif joint in moved_joints:
            low, high = tree.range(joint)
            relation_of_joint["leader"] = None
            relation_of_joint["position_min"] = low
            relation_of_joint["position_max"] = high
            relation_of_joint["velocity"] = tree.limit(joint, "velocity", math.inf)
        if relation_of_joint:
            turns = joint.get("type") != "prismatic"
            name = joint.get("name")
            followers.append(Follower(name, revolute=turns, **relation_of_joint))
    return tuple(followers)


def joints_of_loops(
    tree: Any, loops: Sequence[Any], tip_chain: Sequence[Any]
) -> list[Any]:
    """Return the moving joints in the loops of a `UrdfTree`.

    If an end-effector was asked for, they are those of loops that hold a moving link on
    the way to it.
    """
    joints = []
    for loop in loops:
        chains = []
        for link in loop.links:
            joints_above = tree.joints_above(link)
            chains.append([x for x in joints_above if x.get("type") != "fixed"])
        first_chain, second_chain = chains
        nearest_joints = (*first_chain[:1], *second_chain[:1])
        if not tip_chain or any(joint in tip_chain for joint in nearest_joints):
            joints += [x for x in first_chain if x not in second_chain]
            joints += [x for x in second_chain if x not in first_chain]
    return joints


def loops_of_bodies(tree: Any, loops: Sequence[Any]) -> Iterator[Loop]:
    """Yield the loops between different bodies of a `UrdfTree`."""
    for loop in loops:
        carriers = [tree.carriers.get(link) for link in loop.links]
        if None in carriers or carriers[0].body == carriers[1].body:
            continue
        points = [
            carrier.position + points @ carrier.rotation.T
            for carrier, points in zip(carriers, loop.points, strict=True)
        ]
        bodies = (carriers[0].body, carriers[1].body)
        for number, pair in enumerate(zip(*points, strict=True), 1):
            name = loop.name if number == 1 else f"{loop.name} {number}"
            yield Loop(name, bodies=bodies, points=np.array(pair))
