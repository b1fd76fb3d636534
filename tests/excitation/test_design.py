"""Whole designs on a small arm: limits for all times, better than random, stopped and resumed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints.clearance import Clearance
from jaxid.excitation.constraints.constraint import AbstractConstraint, Entry
from jaxid.excitation.criteria import ConditionNumber, DOptimal
from jaxid.excitation.design import design_excitation
from jaxid.excitation.information import information
from jaxid.excitation.state import fingerprint
from jaxid.robot.collision import GROUND, Capsule, CollisionModel
from jaxid.trajectory.files import load_trajectory

SETTINGS = {
    "harmonics": 3,
    "omega": 1.1,
    "starts": 3,
    "generations": 2,
    "polish": 1,
    "samples": 200,
}


class LowTip(AbstractConstraint):
    """The sum of the angles stays below a bound; an angle is no multiple of another."""

    bound: float

    def __call__(self, robot, motion):
        return (jnp.sum(motion.q, axis=-1, keepdims=True) - self.bound) / 1.0

    def entries(self, robot):
        return (Entry("tilt of the tip", 1.0, "rad"),)


@pytest.fixture(scope="module")
def plan(base):
    return design_excitation(base, key=jax.random.key(3), **SETTINGS)


def excess(plan):
    motion = plan.trajectory.motion(np.linspace(0.0, float(plan.trajectory.duration), 8000))
    own = plan.base.model.robot.limits
    return max(
        float(np.max(np.asarray(motion.q) - own.position_max)),
        float(np.max(own.position_min - np.asarray(motion.q))),
        float(np.max(np.abs(motion.qd) - own.velocity)),
        float(np.max(np.abs(motion.qdd) - own.acceleration)),
    )


def test_keeps_limits_uses_them_and_beats_random_motions(plan):
    assert plan.feasible
    assert excess(plan) <= 0.0
    assert plan.use.max() > 0.99
    d = {c.name: c for c in plan.criteria}[DOptimal.name]
    assert d.after < d.before
    assert plan.undetermined == ()


def test_expected_deviations_are_those_of_repeated_experiments(plan):
    base, times = plan.base, plan.limits.basis.times(plan.samples)
    theta = np.asarray(base.regressor(plan.trajectory.motion(times)))
    weighted = (theta / plan.noise[:, None]).reshape(-1, base.size)
    noise = np.random.default_rng(0).standard_normal((len(weighted), 2000))
    errors = np.linalg.lstsq(weighted, noise, rcond=None)[0]
    np.testing.assert_allclose(errors.std(axis=1), plan.standard_deviations, rtol=0.1)


def test_the_mean_gain_leaves_out_what_stays_open(plan):
    seen = np.diag([0.0] + [1.0] * (plan.base.size - 1))
    weighted = seen @ plan.information.weighted @ seen
    blind = dataclasses.replace(
        plan, information=dataclasses.replace(plan.information, weighted=weighted)
    )
    assert blind.undetermined == plan.base.names[:1]
    assert blind.gains[0] == 0.0
    np.testing.assert_allclose(blind.mean_gain, np.exp(np.mean(np.log(blind.gains[1:]))))
    assert plan.mean_gain > 1.2


def test_writes_a_table_and_itself(plan, tmp_path):
    plan.to_csv(tmp_path / "motion.csv")
    table = np.loadtxt(tmp_path / "motion.csv", delimiter=",", skiprows=1)
    assert table.shape == (201, 7)
    plan.save(tmp_path / "motion.json")
    again = load_trajectory(tmp_path / "motion.json")
    np.testing.assert_array_equal(again.coefficients, plan.trajectory.coefficients)


def test_a_stopped_design_gives_its_best_and_resumes_to_the_same_motion(base, plan, tmp_path):
    seen = []

    def stop(progress):
        seen.append(progress)
        if len(seen) == 9:
            raise KeyboardInterrupt

    file = tmp_path / "design.npz"
    arguments = {"key": jax.random.key(3), "state": file, **SETTINGS}
    stopped = design_excitation(base, progress=stop, **arguments)
    assert stopped.interrupted
    assert excess(stopped) <= 0.0
    assert seen[0].share < seen[-1].share < 1.0
    assert seen[-1].best <= seen[0].best
    resumed = design_excitation(base, resume=True, **arguments)
    assert not resumed.interrupted
    np.testing.assert_array_equal(resumed.numbers, plan.numbers)
    with pytest.raises(ValueError, match="other settings"):
        design_excitation(base, resume=True, **{**arguments, "samples": 100})
    file.write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="no saved state"):
        design_excitation(base, resume=True, **arguments)


def test_generations_never_make_a_motion_worse(base, plan):
    calm = design_excitation(base, key=jax.random.key(3), **{**SETTINGS, "generations": 0})
    d = DOptimal()
    assert d.value(plan.information) <= d.value(calm.information)
    assert d.value(plan.information) < 0.9 * d.value(plan.reference)


def test_constraints_are_kept_where_they_bind(pendulum):
    bound = -0.7
    kept = design_excitation(pendulum, constraints=(LowTip(bound),), **SETTINGS)
    q = kept.trajectory.motion(np.linspace(0.0, float(kept.trajectory.duration), 8000)).q
    assert bound - 0.05 < float(np.max(q)) <= bound
    assert excess(kept) <= 0.0


def test_an_impossible_constraint_is_diagnosed(pendulum):
    # The range begins at -2: standing still there is as near as it gets.
    with pytest.raises(ValueError, match=r"tilt of the tip exceeds its limit by 0\.[5-9]"):
        design_excitation(pendulum, constraints=(LowTip(-2.5),), **SETTINGS)

    def stop(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"stopped before a motion kept all limits: tilt"):
        design_excitation(pendulum, constraints=(LowTip(-2.5),), progress=stop, **SETTINGS)


def test_what_is_known_already_is_not_measured_again(pendulum):
    prior = np.diag(np.linspace(1.0, 1e4, pendulum.size))
    after = design_excitation(pendulum, prior=prior, **{**SETTINGS, "polish": 0})
    motion = after.trajectory.motion(after.limits.basis.times(after.samples))
    alone = information(pendulum, motion, 1.0 / after.noise).weighted
    np.testing.assert_allclose(after.information.weighted, alone + prior, rtol=1e-9)
    with pytest.raises(ValueError, match="in units of the noise"):
        design_excitation(pendulum, prior=prior, criterion=ConditionNumber(), **SETTINGS)
    with pytest.raises(ValueError, match="`prior` must be a matrix"):
        design_excitation(pendulum, prior=np.eye(2), **SETTINGS)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"starts": 0}, "`starts` must be at least 1"),
        ({"polish": -1}, "`polish` must be at least 0"),
        ({"generations": -1}, "`generations` must be at least 0"),
        ({"noise": np.array([1.0, -1.0])}, "`noise` must hold one positive"),
    ],
)
def test_refuses_what_makes_no_sense(base, argument, message):
    with pytest.raises(ValueError, match=message):
        design_excitation(base, **{**SETTINGS, **argument})


def test_a_constraint_sees_each_sample_by_itself(arm):
    motion = Motion(*np.random.default_rng(0).standard_normal((3, 5, 2)))
    whole = LowTip(0.3)(arm, motion)
    np.testing.assert_allclose(whole[2], LowTip(0.3)(arm, motion[2]))


def test_a_state_belongs_to_the_pairs_that_are_watched(pendulum):
    """They are no arrays, and decide all the same."""
    robot = pendulum.model.robot
    shapes = (
        Capsule("hand", 0, start=(0.2, 0, 0), end=(1.0, 0, 0), radius=0.05),
        Capsule("post", GROUND, start=(2.0, 0, 0), end=(2.0, 0, 1.0), radius=0.05),
        Capsule("far", GROUND, start=(9.0, 0, 0), end=(9.0, 0, 1.0), radius=0.05),
    )
    models = [CollisionModel(robot, shapes, (), (("hand", x),)) for x in ("post", "far", "far")]
    post, far, again = (fingerprint(Clearance(m, distance=0.02)) for m in models)
    assert post != far
    assert far == again
