"""Whole designs on a small arm: limits at all times, better than random, resumed."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.excitation.compiled_search import CompiledSearch
from jaxid.excitation.constraints import AbstractConstraint, Finding
from jaxid.excitation.criteria import ConditionNumber, DOptimal, information
from jaxid.excitation.design import design_excitation, minimise
from jaxid.excitation.design_result import DesignStatus
from jaxid.excitation.problem import ExcitationProblem
from jaxid.report.excitation_page import motion_verdict
from jaxid.result_table import Status
from jaxid.trajectory.fourier import FourierBasis

EFFORT = {"starts": 6, "generations": 1}
BASIS = FourierBasis(2, 1.1)


class LowTip(AbstractConstraint):
    """The sum of the angles stays below a bound; an angle is no multiple of another."""

    bound: float

    def __call__(self, robot, motion):
        return (jnp.sum(motion.q, axis=-1, keepdims=True) - self.bound) / 1.0

    def entries(self, robot):
        return (Finding("tilt of the tip", 1.0, "rad"),)


@pytest.fixture(scope="module")
def designed(free):
    """A design and its progress."""
    seen = []
    return minimise(free, key=jax.random.key(3), progress=seen.append, **EFFORT), seen


@pytest.fixture(scope="module")
def plan(designed):
    return designed[0]


@pytest.fixture(scope="module")
def impossible(pendulum):
    """The range begins at -2: standing still there is nearest to the constraint."""
    return ExcitationProblem(pendulum, BASIS, constraints=(LowTip(-2.5),), samples=200)


def test_keeps_limits_uses_them_and_beats_random_motions(designed, excess):
    plan, seen = designed
    assert plan.feasible
    assert excess(plan) <= 0.0
    assert plan.use.max() > 0.99
    d = {c.name: c for c in plan.criteria}[DOptimal.name]
    assert d.after < 0.9 * d.before
    assert plan.undetermined == ()
    # Guaranteed for any rounding: the best motion so far is only replaced by a better
    # one.
    assert all(after.best <= before.best for before, after in itertools.pairwise(seen))
    assert seen[-1].fraction == 1.0
    assert "use of the limits" in str(plan)


def test_expected_deviations_are_those_of_repeated_experiments(plan):
    base, times = plan.base, plan.trajectory.measured_times(plan.samples)
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
    assert [x.parts for x in blind.undetermined] == [(0,)]
    assert blind.open_share == np.inf
    assert blind.gains[0] == 0.0
    np.testing.assert_allclose(
        blind.mean_gain, np.exp(np.mean(np.log(blind.gains[1:])))
    )
    assert plan.mean_gain > 1.2


def test_a_motion_worse_than_a_random_one_is_not_praised(plan):
    def verdict_at(scale):
        weighted = scale * plan.reference.weighted
        information = dataclasses.replace(plan.information, weighted=weighted)
        return motion_verdict(dataclasses.replace(plan, information=information), [])

    assert verdict_at(1.1).status is Status.GOOD
    assert verdict_at(0.25).status is Status.DOUBTFUL
    assert "2 times worse" in verdict_at(0.25).text
    # Deviations that on a random motion make forces above the noise.
    assert verdict_at(1e-6).status is Status.BAD


def test_a_stopped_design_gives_its_best_and_another_goes_on_with_it(free, excess):
    seen = []

    def stop(progress):
        seen.append(progress)
        if len(seen) == 40:
            raise KeyboardInterrupt

    arguments = {"key": jax.random.key(3), "starts": 2, "generations": 0}
    stopped = minimise(free, progress=stop, **arguments)
    assert stopped.interrupted
    assert excess(stopped) <= 0.0
    best = stopped.criterion.value(stopped.information)
    assert stopped.history[-1] == pytest.approx(best)
    assert seen[-1].best <= seen[0].best
    # From other random motions: what was found is not lost.
    arguments["key"] = jax.random.key(4)
    resumed = minimise(free, begin=stopped.trajectory, seconds=1.0, **arguments)
    assert not resumed.interrupted
    assert resumed.history[0] <= best * (1 + 1e-9)
    assert excess(resumed) <= 0.0
    with pytest.raises(ValueError, match="begin"):
        minimise(
            free, begin=FourierBasis(4, 1.1).trajectory(np.zeros((2, 9))), **arguments
        )


def test_a_design_says_how_it_ended(designed):
    found, seen = designed
    assert found.status in (DesignStatus.CONVERGED, DesignStatus.IMPROVING)
    assert 2 < len(found.history) <= len(seen)
    assert seen[0].fraction == 0.0
    assert seen[-1].best == found.history[-1]
    assert (np.diff(found.history) <= 0).all()
    assert found.history[-1] == pytest.approx(found.criterion.value(found.information))


def test_another_solver_is_put_around_a_problem(free):
    """Steepest descent from each start; what leaves the limits is brought back."""

    def descend(problem, starts):
        slope = jax.jit(jax.vmap(jax.grad(problem.value)))
        x = starts
        for _ in range(10):
            x = x - 0.05 * slope(x)
        return x

    found = minimise(free, descend, starts=4, key=jax.random.key(3))
    assert found.status is DesignStatus.GIVEN
    assert found.feasible
    assert found.use.max() <= 1.0 + 1e-9
    before, after = found.history
    assert after < before
    assert after == pytest.approx(found.criterion.value(found.information))


@pytest.mark.parametrize("bound", [np.inf, 0.4])
def test_the_compiled_search_finds_what_the_search_in_numpy_finds(
    free, plan, pendulum, bound
):
    arguments = {"starts": 6, "key": jax.random.key(3)}
    problem = free
    if np.isfinite(bound):
        problem = ExcitationProblem(pendulum, BASIS, constraints=(LowTip(bound),))
        plan = minimise(problem, generations=1, **arguments)
    compiled = minimise(problem, CompiledSearch(generations=1), **arguments)
    assert plan.feasible
    assert compiled.feasible
    assert compiled.history[-1] == pytest.approx(plan.history[-1], rel=0.02)
    if np.isfinite(bound):
        assert compiled.findings[0].value > -0.02, "the constraint binds"


def test_the_whole_search_is_one_program_for_a_gpu(free):
    search = CompiledSearch(generations=1)
    program = search.program(free, 2, np.random.default_rng(0))
    starts = free.limits.random(jax.random.key(3), 2)
    traced = jax.jit(program).trace(starts)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert "stablehlo.while" in text
    assert "cusolver" in text, "its linear systems are solved on the device"
    assert "callback" not in text


def test_a_gpu_is_used_where_there_is_one(free, monkeypatch):
    """Progress, a limited time, and motions to go on with, as without a GPU."""
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    seen = []
    arguments = {"key": jax.random.key(3), "starts": 2, "generations": 0}
    plan = minimise(free, progress=seen.append, seconds=4.0, **arguments)
    assert plan.feasible
    assert all(after.best <= before.best for before, after in itertools.pairwise(seen))
    assert plan.history[-1] == pytest.approx(plan.criterion.value(plan.information))


def test_the_problems_functions_are_those_of_the_motion(impossible, pendulum):
    """`value`, `inequalities` and `violation` run in `jit`, and match exact ones."""
    x = impossible.random(jax.random.key(0))
    value = jax.jit(impossible.value)
    motion = impossible.trajectory(x).motion(BASIS.times(200))
    found = information(pendulum, motion, 1.0 / impossible.noise)
    assert float(value(x)) == pytest.approx(np.log(DOptimal().value(found)), abs=1e-9)
    slope = jax.jit(jax.grad(impossible.value))(x)
    direction = np.linspace(-1.0, 1.0, impossible.size)
    quotient = (value(x + 1e-6 * direction) - value(x - 1e-6 * direction)) / 2e-6
    assert float(slope @ direction) == pytest.approx(float(quotient), rel=1e-5)
    violation, inequalities = (
        jax.jit(impossible.violation),
        jax.jit(impossible.inequalities),
    )
    q = impossible.trajectory(x).motion(np.linspace(0.0, BASIS.duration, 20_000)).q
    use = impossible.limits.use(impossible.limits.coefficients(np.asarray(x)))
    expected = max(float(np.max(q)) + 2.5, use.max() - 1.0)
    assert float(violation(x)) == pytest.approx(expected, abs=1e-5)
    for factor in (0.05, 1.0, 3.0):
        broken = float(jnp.max(inequalities(factor * x)))
        assert broken == pytest.approx(float(violation(factor * x)), rel=0.05, abs=0.05)


def test_an_impossible_constraint_is_diagnosed(impossible, monkeypatch):
    # The last stage alone finds the least excess of so simple a problem.
    for stages in ("SCHEDULE", "CONSTRAINED_SCHEDULE"):
        monkeypatch.setattr(f"jaxid.excitation.search.{stages}", ())
    effort = {"starts": 2, "generations": 0}
    with pytest.raises(
        ValueError, match=r"tilt of the tip exceeds its limit by 0\.[5-9]"
    ):
        minimise(impossible, **effort)

    def stop(progress):
        raise KeyboardInterrupt

    with pytest.raises(
        KeyboardInterrupt, match=r"stopped before a motion kept all limits: tilt"
    ):
        minimise(impossible, progress=stop, **effort)


def test_earlier_information_is_added(pendulum):
    prior = np.diag(np.linspace(1.0, 1e4, pendulum.size))
    alone, after = (ExcitationProblem(pendulum, BASIS, prior=p) for p in (None, prior))
    x = np.linspace(-0.5, 0.5, after.size)
    expected = alone.information(x).weighted + prior
    np.testing.assert_allclose(
        after.information(x).weighted, expected, rtol=1e-9, atol=1e-6
    )
    value = after.criterion.value(after.information(x))
    assert float(np.exp(after.value(x))) == pytest.approx(value)
    with pytest.raises(ValueError, match="`prior`"):
        design_excitation(pendulum, prior=prior, criterion=ConditionNumber())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("starts", 0),
        ("generations", -1),
        ("noise", np.array([-1.0])),
        ("prior", np.eye(2)),
    ],
)
def test_refuses_what_makes_no_sense(pendulum, name, value):
    with pytest.raises(ValueError, match=f"`{name}`"):
        design_excitation(pendulum, **{name: value})
