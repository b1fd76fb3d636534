"""A small robot with rail and pendulum, fitted to a virtual log; errors of any arm."""

import dataclasses

import numpy as np
import pytest

import jaxid as jid
from jaxid.report.result_files import write_report
from jaxid.simulation.friction_and_ripple import SmoothFriction
from jaxid.simulation.virtual import Sensors, random_bodies
from jaxid.validation.judgement import Report
from jaxid.validation.torque_errors import TorqueErrors


@pytest.fixture(scope="session")
def errors_of():
    """Return a function that makes torque errors of an arm."""

    def errors_of(joints, rows=200, *, name="log", seed=0):
        random = np.random.default_rng(seed)
        measured = 10.0 * random.standard_normal((rows, joints))
        errors = random.standard_normal((rows, joints))
        return TorqueErrors(
            name=name,
            time=np.arange(rows) * 0.01,
            measured=measured,
            predicted=measured + errors,
            counted=np.ones((rows, joints), bool),
            max_forces=np.full(joints, 50.0),
            speeds=np.where(random.random((rows, joints)) < 0.8, 1.0, 0.0),
            unexplained=errors,
            positions=np.zeros((rows, joints)),
        )

    return errors_of


@pytest.fixture(scope="session")
def validated():
    """A fit of the cart with its validation on two recordings."""
    robot = jid.Robot(
        "cart",
        revolute=(False, True),
        axis=[(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)],
        rotation=np.tile(np.eye(3), (2, 1, 1)),
        offset=np.zeros((2, 3)),
        joint_names=("rail", "swing_$1_$"),
        limits=jid.Limits(2, velocity=[1.0, 3.0], force=[200.0, 30.0]),
        tip_offset=(0.0, 0.0, 0.4),
    )
    virtual = jid.VirtualRobot(
        robot=robot,
        terms=(jid.RigidBodies(),),
        values=random_bodies(
            robot, np.array([8.0, 2.0]), np.random.default_rng(0)
        ).ravel(),
        friction=SmoothFriction(np.array([3.0, 0.2]), np.array([5.0, 0.4])),
        sensors=Sensors(
            encoder_step=1e-6,
            white_noise=np.array([0.5, 0.05]),
            coloured_noise=np.zeros(2),
            memory=0.1,
        ),
    )
    observations = []
    for seed, name in ((1, "first/run"), (2, "second")):
        motion = jid.trajectories.random_fourier_series(robot, omega=1.5, seed=seed)
        log = virtual.measure(
            motion, duration=4.0, sample_time=0.005, seed=seed, name=name
        )
        observations.append(jid.observe(log, robot, jid.ZeroPhaseButterworth(10.0)))
    base = jid.base_parameters(virtual.model)
    fit = jid.identify(base, observations[0], jid.estimators.LeastSquares())
    return fit, jid.validate(fit, observations)


@pytest.fixture(scope="session")
def fit(validated):
    return validated[0]


@pytest.fixture(scope="session")
def validation(validated):
    return validated[1]


@pytest.fixture(scope="session")
def changed(fit):
    """The comparison with the same robot, warm: a third of the rail's friction."""
    p = np.array(fit.parameters)
    p[fit.base.names.index("fv1")] /= 3.0
    return jid.compare(
        fit, dataclasses.replace(fit, parameters=p, recordings=("warm",))
    )


@pytest.fixture(scope="session")
def consistent():
    """Return a fit of possible bodies, where the bound of friction at zero decides."""
    robot = jid.robots.planar_arm(2, 0.4)
    model = jid.Model(robot, (jid.RigidBodies(), jid.ViscousFriction()))
    t = np.arange(0.0, 6.0, 0.01)
    motion = jid.trajectories.random_fourier_series(robot, omega=1.5, seed=0).motion(t)
    p = np.zeros(model.size)
    p[[0, 1, 6, 5, 10, 11, 16, 15]] = [2.0, 0.4, 0.11, 0.11, 1.0, 0.2, 0.06, 0.06]
    p[-2:] = [0.3, -0.3]
    forces = np.array(model.inverse_dynamics(p, motion))
    forces += np.random.default_rng(0).normal(0.0, 0.05, forces.shape)
    log = jid.Recording.of(np.asarray(motion.q), forces, time=t)
    o = jid.observe(log, robot, jid.ZeroPhaseButterworth(10.0))
    estimator = jid.PhysicallyConsistent(jid.estimators.ResidualVariances(0))
    return jid.identify(jid.base_parameters(model), o, estimator)


@pytest.fixture(scope="session")
def written(validated, tmp_path_factory):
    """Return a folder with a report."""
    fit, validation = validated
    folder = tmp_path_factory.mktemp("new") / "report"
    report = Report(
        fit,
        validation.errors[:1],
        validation.errors[1:],
        validation.definiteness,
        {"experiment": "cart.toml", "experiment_text": "[robot]\nurdf = 'a<b'\n"},
        ("a note <script>alert('&\"')</script>",),
        ("the log looks odd",),
    )
    write_report(folder, report, "png")
    return folder
