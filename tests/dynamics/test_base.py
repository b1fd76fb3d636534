"""Base parameters: published counts, Eq. 24, the laws they obey, reported doubts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trees import mixed_tree, random_tree

from jaxid.dynamics.base import BaseParameters, Identifiability, base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.rank import random_regressor
from jaxid.dynamics.terms import (
    ConstantOffset,
    CoulombFriction,
    CoupledDrives,
    RigidBodies,
    RotorInertia,
    ViscousFriction,
)
from jaxid.robot import library
from jaxid.robot.robot import Robot

DRIVES = (ViscousFriction(), CoulombFriction(), RotorInertia())
SEVEN, TEN = RigidBodies(principal_axes=True), RigidBodies()


def paper_robot(elbow: float = 0.05) -> Robot:
    robot = library.tx90l_on_rail()
    offset = np.array(robot.offset)
    offset[3, 2] = elbow
    return robot.replace(offset=offset)


@functools.cache
def paper(bodies: RigidBodies) -> BaseParameters:
    return base_parameters(Model(paper_robot(), (bodies, *DRIVES)))


def random_motion(joints: int, seed: int, samples: int = 30) -> Motion:
    return Motion(*np.random.default_rng(seed).uniform(-3.0, 3.0, (3, samples, joints)))


COUNTS = [
    (paper_robot, (SEVEN, *DRIVES), 70, 44),
    (paper_robot, (SEVEN, *DRIVES[:2]), 63, 40),
    (paper_robot, (SEVEN,), 49, 26),
    (paper_robot, (TEN, *DRIVES), 91, 57),
    (paper_robot, (TEN,), 70, 39),
    (library.ur10, (TEN, *DRIVES, ConstantOffset()), 84, 58),
    (library.tx40, (TEN, *DRIVES, ConstantOffset(), CoupledDrives()), 87, 61),
    (library.panda, (TEN,), 70, 43),
    (library.iiwa14, (TEN,), 70, 43),
    (library.planar_arm, (TEN,), 20, 6),
]


@pytest.mark.parametrize(("robot", "terms", "standard", "base"), COUNTS)
def test_published_counts(robot, terms, standard, base):
    found = base_parameters(Model(robot(), terms))
    assert (found.model.size, found.size) == (standard, base)
    assert found.notes == ()


def test_how_clearly_the_papers_columns_are_told_apart():
    base = paper(SEVEN)
    assert (base.units[0], *base.units[26:28]) == ("kg", "N s/m", "N m s")
    assert base.smallest_independent > 0.01
    assert base.largest_dependent < 1e-12


def test_with_all_ten_parameters_the_rail_carries_all_masses():
    masses = "m1 + m2 + m3 + m4 + m5 + m6 + m7"
    assert paper(TEN).expressions[0] == f"{masses} + Ia1"


@pytest.mark.parametrize("bodies", [SEVEN, TEN])
def test_the_same_columns_for_every_seed(bodies):
    first = paper(bodies)
    for seed in range(1, 6):
        other = base_parameters(first.model, seed=seed)
        assert other.indices == first.indices
        np.testing.assert_allclose(other.kappa, first.kappa, atol=1e-11 * 20)


@pytest.mark.parametrize("elbow", [1e-3, 1e-5])
@pytest.mark.parametrize(("bodies", "size"), [(SEVEN, 44), (TEN, 57)])
def test_a_nearly_degenerate_elbow_is_told_apart(elbow, bodies, size):
    base = base_parameters(Model(paper_robot(elbow), (bodies, *DRIVES)))
    assert base.size == size
    assert base.indices == paper(bodies).indices
    assert not any("disagree" in note for note in base.notes)
    assert base.largest_dependent < 1e-9


def test_doubts_are_reported():
    base = base_parameters(Model(paper_robot(1e-7), (SEVEN, *DRIVES)))
    assert any("disagree" in note for note in base.notes)
    barely = base_parameters(Model(paper_robot(1e-5), (SEVEN, *DRIVES)))
    assert len(barely.notes) == 1
    assert "`m4` is barely" in barely.notes[0]


def test_rounded_quarter_turns_count_as_exact_and_others_are_reported():
    def arm(quarter):
        turn = np.array([[1, 0, 0], [0, np.cos(quarter), -np.sin(quarter)],
                         [0, np.sin(quarter), np.cos(quarter)]])  # fmt: skip
        return Robot(
            "arm",
            revolute=(True,) * 4,
            axis=[(0, 0, 1)] * 4,
            rotation=[np.eye(3), turn, np.eye(3), turn.T],
            offset=[(0, 0, 0), (0.1, 0, 0.3), (0.5, 0, 0), (0.02, 0.4, 0)],
        )

    exact = base_parameters(Model(arm(np.pi / 2), (TEN, *DRIVES)))
    assert base_parameters(Model(arm(1.5708), (TEN, *DRIVES))).indices == exact.indices
    rounded = base_parameters(Model(arm(1.571), (TEN, *DRIVES)))
    assert exact.notes == ()
    assert rounded.size > exact.size
    assert any("1.571" in note for note in rounded.notes)


MODELS = {
    "paper": lambda: paper(SEVEN).model,
    "tree": lambda: Model(mixed_tree().robot(), (TEN, *DRIVES, ConstantOffset())),
    "coupled": lambda: Model(library.tx40(), (TEN, *DRIVES, CoupledDrives())),
    **{
        f"random{s}": lambda s=s: Model(random_tree(s, 5).robot(), (TEN, *DRIVES))
        for s in (1, 4)
    },
}


@pytest.mark.parametrize("name", MODELS)
def test_base_parameters_give_the_forces_and_mass_matrix_of_the_standard_ones(name):
    base = base_parameters(MODELS[name]())
    motion = random_motion(base.model.robot.joints, seed=77)
    full = np.asarray(base.model.regressor(motion))
    together = np.zeros((base.size, base.model.size))
    together[:, base.indices] = np.eye(base.size)
    together[:, base.dependent] = base.kappa
    again = np.asarray(base.regressor(motion)) @ together
    columns = np.abs(full).max(axis=(0, 1))
    assert (
        np.abs(again - full).max(axis=(0, 1)) <= 1e-12 * np.maximum(columns, 1.0)
    ).all()
    p = np.random.default_rng(3).normal(size=base.model.size)
    p_base = base.from_standard(p)
    forces = base.model.inverse_dynamics(jnp.asarray(p), motion)
    scale = float(jnp.abs(forces).max()) * float(
        1.0 + np.abs(base.kappa).max(initial=0.0)
    )
    np.testing.assert_allclose(
        base.inverse_dynamics(p_base, motion), forces, atol=1e-12 * scale
    )
    M = base.model.mass_matrix(jnp.asarray(p), motion.q)
    np.testing.assert_allclose(
        base.mass_matrix(p_base, motion.q), M, atol=1e-12 * scale
    )


def test_standard_parameters_and_back():
    base = base_parameters(MODELS["paper"]())
    x = np.random.default_rng(0).normal(size=(3, base.size))
    np.testing.assert_array_equal(base.from_standard(base.to_standard(x)), x)


@pytest.mark.parametrize("seed", range(6))
def test_the_rank_agrees_with_lapack_on_random_trees(seed):
    bodies = SEVEN if seed % 2 else TEN
    model = Model(
        random_tree(seed, 2 + seed % 4).robot(), (bodies, *DRIVES, ConstantOffset())
    )
    found = base_parameters(model, seed=seed)
    assert found.notes == ()
    W, _ = random_regressor(model, seed + 100)
    norms = np.linalg.norm(W, axis=0)
    live = norms > 1e-12 * norms.max()
    assert np.linalg.matrix_rank(W[:, live] / norms[live], tol=1e-9) == found.size


@pytest.mark.parametrize("make", ["paper", "tree", "coupled"])
def test_millimetres_choose_the_same_columns(make):
    """A unit of mass needs no such test: what is known of a robot here holds none."""
    model = MODELS[make]()
    robot = model.robot
    in_mm = robot.replace(offset=1e3 * robot.offset, gravity=1e3 * robot.gravity)
    metres = base_parameters(model)
    millimetres = base_parameters(Model(in_mm, model.terms))
    assert millimetres.indices == metres.indices
    assert millimetres.identifiability == metres.identifiability
    assert millimetres.notes == ()
    np.testing.assert_allclose(
        millimetres.smallest_independent, metres.smallest_independent, rtol=0.2
    )
    powers = {"kg": 0, "kg m": 1, "kg m²": 2, "N m": 2, "N": 1, "N m s": 2, "N s/m": 0}
    length = np.array([powers[u] for u in model.parameter_units])
    factor = 1e3 ** (
        length[list(metres.indices)][:, None] - length[list(metres.dependent)]
    )
    np.testing.assert_allclose(
        millimetres.kappa / factor, metres.kappa, rtol=1e-7, atol=1e-9
    )


def test_identifiability_of_a_planar_arm():
    # Only the moment about z and the first moments in the plane matter; a link's mass
    # acts on the joint before it as a part of that link's parameters.
    base = base_parameters(Model(library.planar_arm(2), (TEN,)))
    verdict = dict(zip(base.model.parameter_names, base.identifiability, strict=True))
    alone = {n for n, v in verdict.items() if v is Identifiability.ALONE}
    combined = {n for n, v in verdict.items() if v is Identifiability.COMBINED}
    assert alone == {"my1", "mx2", "my2", "C2"}
    assert combined == {"mx1", "C1", "m2"}


def test_rank_decisions_do_not_depend_on_jaxs_precision():
    double = paper(SEVEN)
    with jax.enable_x64(False):
        single = base_parameters(double.model)
        expressions = single.expressions
    assert single.indices == double.indices
    np.testing.assert_array_equal(single.kappa, double.kappa)
    assert expressions == double.expressions


def test_frames_do_not_matter_with_all_ten_parameters():
    # The forearm's frame at the wrist instead of the elbow: other parameters, as many
    # of them; with seven per body the number changes from 44 to 43.
    robot = paper_robot()
    offset = np.array(robot.offset)
    offset[4, 2], offset[5, 2] = offset[5, 2], 0.0
    at_wrist = robot.replace(offset=offset)
    if not np.allclose(robot.rotation[4] @ (0, 0, 0.55), (0, 0, 0.55)):
        offset[4] = robot.rotation[4] @ (0, 0, 0.55)
        at_wrist = robot.replace(offset=offset)
    assert base_parameters(Model(at_wrist, (TEN, *DRIVES))).size == 57
    assert base_parameters(Model(at_wrist, (SEVEN, *DRIVES))).size == 43
