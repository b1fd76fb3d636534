"""Whole designs on a small arm: limits for all times, better than random, stopped and resumed."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxid.excitation.information import information

from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints import AbstractConstraint, Clearance, Finding
from jaxid.excitation.criteria import ConditionNumber, DOptimal
from jaxid.excitation.design import design_excitation, minimise
from jaxid.excitation.problem import ExcitationProblem
from jaxid.excitation.search import Search
from jaxid.robot.collision import GROUND, Capsule, CollisionModel
from jaxid.trajectory.files import load_trajectory
from jaxid.trajectory.fourier import FourierBasis

EFFORT = {"starts": 3, "generations": 2, "polish": 1}
SETTINGS = {"harmonics": 3, "omega": 1.1, "samples": 200, **EFFORT}


class LowTip(AbstractConstraint):
    """The sum of the angles stays below a bound; an angle is no multiple of another."""

    bound: float

    def __call__(self, robot, motion):
        return (jnp.sum(motion.q, axis=-1, keepdims=True) - self.bound) / 1.0

    def entries(self, robot):
        return (Finding("tilt of the tip", 1.0, "rad"),)


@pytest.fixture(scope="module")
def problem(base):
    return ExcitationProblem(base, FourierBasis(3, 1.1), samples=200)


@pytest.fixture(scope="module")
def plan(problem):
    return minimise(problem, key=jax.random.key(3), **EFFORT)


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


def test_a_stopped_design_gives_its_best_and_resumes_to_the_same_motion(problem, plan, tmp_path):
    seen = []

    def stop(progress):
        seen.append(progress)
        if len(seen) == 9:
            raise KeyboardInterrupt

    file = tmp_path / "design.state"
    arguments = {"key": jax.random.key(3), "state": file, **EFFORT}
    stopped = minimise(problem, progress=stop, **arguments)
    assert stopped.interrupted
    assert excess(stopped) <= 0.0
    assert seen[0].fraction < seen[-1].fraction < 1.0
    assert seen[-1].best <= seen[0].best
    resumed = minimise(problem, resume=True, **arguments)
    assert not resumed.interrupted
    expected = plan.trajectory.coefficients
    np.testing.assert_array_equal(resumed.trajectory.coefficients, expected)
    with pytest.raises(ValueError, match="other settings"):
        minimise(problem, resume=True, **{**arguments, "key": jax.random.key(4)})
    file.write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="no saved state"):
        minimise(problem, resume=True, **arguments)


def test_every_step_keeps_or_improves_the_best_motion(problem, plan):
    """Guaranteed for any rounding: the best motion so far is only replaced by a better one."""
    seen = []
    minimise(problem, key=jax.random.key(3), progress=seen.append, **EFFORT)
    values = [one.best for one in seen]
    assert all(after <= before for before, after in itertools.pairwise(values))
    assert seen[-1].fraction == 1.0
    d = DOptimal()
    assert d.value(plan.information) < 0.9 * d.value(plan.reference)


def test_the_problems_functions_are_those_of_the_motion(pendulum):
    """`value`, `inequalities` and `violation` run under `jit` and agree with the exact ones."""
    basis = FourierBasis(3, 1.1)
    problem = ExcitationProblem(pendulum, basis, constraints=(LowTip(0.5),), samples=200)
    x = problem.random(jax.random.key(0))
    value = jax.jit(problem.value)
    assert float(value(x)) == pytest.approx(problem.exact_value(x), abs=1e-9)
    motion = problem.trajectory(x).motion(basis.times(200))
    information_ = information(pendulum, motion, 1.0 / problem.noise)
    assert float(value(x)) == pytest.approx(np.log(DOptimal().value(information_)), abs=1e-9)
    slope = jax.jit(jax.grad(problem.value))(x)
    direction = np.linspace(-1.0, 1.0, problem.size)
    quotient = (value(x + 1e-6 * direction) - value(x - 1e-6 * direction)) / 2e-6
    assert float(slope @ direction) == pytest.approx(float(quotient), rel=1e-5)
    violation = jax.jit(problem.violation)
    q = problem.trajectory(x).motion(np.linspace(0.0, basis.duration, 20_000)).q
    use = problem.limits.use(problem.limits.coefficients(np.asarray(x)))
    expected = max(float(np.max(q)) - 0.5, use.max() - 1.0)
    assert float(violation(x)) == pytest.approx(expected, abs=1e-5)
    inequalities = jax.jit(problem.inequalities)
    for factor in (0.05, 1.0, 3.0):
        broken = float(jnp.max(inequalities(factor * x)))
        assert broken == pytest.approx(float(violation(factor * x)), rel=0.05, abs=0.05)


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
    expected = alone + prior
    size = 1e-12 * np.abs(expected).max()
    np.testing.assert_allclose(after.information.weighted, expected, rtol=1e-9, atol=size)
    with pytest.raises(ValueError, match="`prior`"):
        design_excitation(pendulum, prior=prior, criterion=ConditionNumber(), **SETTINGS)
    with pytest.raises(ValueError, match="`prior`"):
        design_excitation(pendulum, prior=np.eye(2), **SETTINGS)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"starts": 0}, "`starts`"),
        ({"polish": -1}, "`polish`"),
        ({"generations": -1}, "`generations`"),
        ({"noise": np.array([1.0, -1.0])}, "`noise`"),
    ],
)
def test_refuses_what_makes_no_sense(base, argument, message):
    with pytest.raises(ValueError, match=message):
        design_excitation(base, **{**SETTINGS, **argument})


def test_a_constraint_sees_each_sample_by_itself(arm):
    motion = Motion(*np.random.default_rng(0).standard_normal((3, 5, 2)))
    whole = LowTip(0.3)(arm, motion)
    np.testing.assert_allclose(whole[2], LowTip(0.3)(arm, motion[2]))


def test_a_state_belongs_to_the_pairs_that_are_watched(pendulum, tmp_path):
    """They are no arrays, and decide all the same."""
    shapes = (
        Capsule("hand", 0, start=(0.2, 0, 0), end=(1.0, 0, 0), radius=0.05),
        Capsule("post", GROUND, start=(2.0, 0, 0), end=(2.0, 0, 1.0), radius=0.05),
        Capsule("far", GROUND, start=(9.0, 0, 0), end=(9.0, 0, 1.0), radius=0.05),
    )
    models = [
        CollisionModel(pendulum.model.robot, shapes, (), (("hand", x),))
        for x in ("post", "far", "far")
    ]
    post, far, again = (
        Search(
            ExcitationProblem(
                pendulum, FourierBasis(1, 1.1), constraints=(Clearance(m, distance=0.02),)
            ),
            jax.random.key(0),
            1,
            0,
            0,
        )
        for m in models
    )
    post.save(tmp_path / "state")
    with pytest.raises(ValueError, match="other settings"):
        far.resume(tmp_path / "state")
    far.save(tmp_path / "state")
    again.resume(tmp_path / "state")
