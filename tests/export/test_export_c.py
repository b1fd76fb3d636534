"""The C code against NumPy on the same model, against itself, and its own promises."""

import itertools
import re
import shutil
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from compiled_model import CompiledModel
from export_samples import fit_of, motion, possible

import jaxid as jid
from jaxid.errors import InputError
from jaxid.export import exported_function, torque_program
from jaxid.program.sample_methods import in_numpy

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="no C compiler (gcc)"
)
STRICT = ["-Wall", "-Wextra", "-pedantic", "-Werror", "-O1"]


def tree():
    """Revolute and prismatic joints about skew axes, bodies with no symmetry."""
    rng = np.random.default_rng(5)
    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(4)]
    robot = jid.Robot(
        "tree",
        parent=(-1, 0, 1, 1),
        revolute=(True, False, True, True),
        axis=rng.normal(size=(4, 3)),
        rotation=[t * np.sign(np.linalg.det(t)) for t in turns],
        offset=rng.normal(size=(4, 3)),
        gravity=(1.0, 2.0, -9.0),
    )
    terms = (
        jid.RigidBodies(),
        jid.terms.LinearSpring(0.3),
        jid.terms.AsymmetricCoulombFriction(),
    )
    return jid.Model(robot, terms)


def railed():
    """A rail and two joints, without products of inertia."""
    terms = (
        jid.RigidBodies(principal_axes=True),
        jid.CoulombFriction(),
        jid.RotorInertia(),
    )
    robot = jid.Robot(
        "rail",
        revolute=(False, True, True),
        axis=[(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)],
        rotation=np.tile(np.eye(3), (3, 1, 1)),
        offset=[(0.0, 0.0, 0.5), (0.0, 0.0, 0.3), (0.2, 0.0, 0.0)],
    )
    return jid.Model(robot, terms)


def coupled():
    robot = jid.robots.planar_arm(3, 0.4).replace(
        drives=jid.Drives(3, reduction=[[9, 0, 0], [0, 9, 0], [0, 5, 9]])
    )
    return jid.Model(robot, (*jid.Model(robot).terms, jid.terms.CoupledDrives()))


@pytest.fixture(scope="module", params=[tree, railed, coupled])
def fit(request):
    model = request.param()
    return fit_of(model, possible(model))


@pytest.fixture(scope="module")
def compiled(fit):
    return CompiledModel(fit, flags=["-O0"])


def close(values, expected, tolerance=1e-12):
    np.testing.assert_allclose(
        values, expected, rtol=0, atol=tolerance * np.abs(expected).max()
    )


def _torque_of_masses(compiled, q, qd, qdd, *s):
    """Return M qdd + h (Eq. 38)."""
    mass_matrix = compiled.mass_matrix(q).reshape(*q.shape, -1)
    return np.einsum("nij,nj->ni", mass_matrix, qdd) + compiled.bias(q, qd, *s)


def test_all_forms_agree_with_numpy(fit, compiled):
    base, model = fit.base, fit.base.model
    m = motion(model.robot.joints, 300)
    expected, p = fit.predict(m), fit.standard_parameters
    state, p_b = (m.q, m.qd, m.qdd), np.tile(np.asarray(fit.parameters), (300, 1))
    for torques in (
        compiled.torque(*state),
        compiled.torque_of_parameters(*state, p_b),
        _torque_of_masses(compiled, *state),
    ):
        close(torques, expected)
    close(compiled.regressor(*state), in_numpy(base, base.columns, *state))
    close(compiled.mass_matrix(m.q), in_numpy(model, model.inertia, m.q, shared=(p,)))

    def bias(p, qd):
        return in_numpy(model, model.bias, m.q, qd, shared=(p,))

    still, rigid = np.zeros_like(m.q), p.copy()
    h, g = bias(p, m.qd), bias(p, still)
    close(compiled.bias(m.q, m.qd), h)
    close(compiled.gravity(m.q), g)
    rigid[model.robot.joints * model.terms[0].body_parameters :] = 0.0
    friction = h - bias(rigid, m.qd) - (g - bias(rigid, still))
    error = np.abs(compiled.friction(m.q, m.qd) - friction).max()
    assert error <= 1e-11 * np.abs(h).max()
    assert compiled.messages == ""


def test_operations_of_the_factored_form_are_pinned():
    model = jid.Model(jid.robots.panda(), (jid.RigidBodies(),))
    p = np.random.default_rng(0).uniform(0.1, 1.0, model.size)
    counts = torque_program(fit_of(model, p)).counts
    assert (counts.multiplications, counts.additions) == (309, 286)
    assert counts.functions == 12


class CubicFriction(jid.terms.AbstractTerm):
    def parameters(self, robot):
        return tuple((f"fq{i + 1}", "N m s³") for i in range(robot.joints))

    def columns(self, robot, q, qd, qdd):
        return jnp.diag(qd**3)


@pytest.fixture(scope="module")
def small():
    terms = (jid.RigidBodies(), jid.terms.StribeckFriction(), CubicFriction())
    robot = jid.robots.planar_arm(2, 0.4).replace(name="j*/ int x; /* j*\\ int x; /*")
    model = jid.Model(robot, terms)
    return fit_of(model, possible(model))


@pytest.mark.parametrize("double", [True, False])
def test_the_file_compiles_without_warnings_and_checks_itself(small, tmp_path, double):
    source = jid.export_c(small, tmp_path, name="my_arm", double=double)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["my_arm.c", "my_arm.h"]

    def check(*language):
        command = ["gcc", *language, *STRICT, "-DMY_ARM_SELF_TEST", str(source), "-lm"]
        subprocess.run([*command, "-o", str(tmp_path / "check")], check=True)
        done = subprocess.run(
            [str(tmp_path / "check")], capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout

    for language in (("-std=c99",), ("-x", "c++", "-std=c++11")):
        code, output = check(*language)
        assert code == 0, output
        assert "this build is right" in output
    text = re.sub(
        r"(_torque_expected.*\n    \{)", r"\g<1>9", source.read_text("ascii"), count=1
    )
    source.write_text(text, "ascii")
    code, output = check("-std=c99")
    assert code == 1
    assert "WRONG" in output
    compiled, m = CompiledModel(small, double=double, flags=["-O1"]), motion(2, 50)
    close(
        compiled.torque(m.q, m.qd, m.qdd), small.predict(m), 1e-12 if double else 1e-5
    )
    with pytest.raises(InputError, match="7 axes"):
        jid.export_c(small, tmp_path, name="7 axes")


def test_the_header_says_what_it_is(small, tmp_path):
    header = jid.export_c(small, tmp_path).with_suffix(".h").read_text("ascii")
    for text in (
        small.checksum,
        "Model of 2026-01-31",
        "first, second",
        "0  joint1: turns, q in rad, tau in N m",
        "void arm_torque(const double *q, const double *qd, const double *qdd, double "
        "*tau);",
        "#define ARM_JOINTS 2",
    ):
        assert text in header
    assert header.splitlines()[0].count("*/") == 0
    source = (tmp_path / "arm.c").read_text("ascii")
    functions = source[
        source.index("void arm_torque") : source.index("#ifdef ARM_SELF_TEST")
    ]
    assert not re.search(r"\b(if|while|goto|switch)\b", functions)


def test_numbers_that_are_not_finite_give_nan(compiled, fit):
    n = fit.base.model.robot.joints
    for bad in (np.nan, np.inf, 1e30):
        q = np.zeros((1, n))
        q[0, 2] = bad
        torques = compiled.torque(q, np.zeros((1, n)), np.zeros((1, n)))
        assert np.isnan(torques).any()


@pytest.mark.parametrize("double", [True, False])
def test_friction_with_memory_follows_the_path_in_c_as_in_numpy(tmp_path, double):
    law = jid.terms.Presliding(length=np.array([3e-2, 0.1]))
    dry = (jid.CoulombFriction(law), jid.terms.SquareRootFriction(law))
    model = jid.Model(jid.robots.planar_arm(2, 0.4), (jid.RigidBodies(), *dry))
    fit = fit_of(model, possible(model))
    t = np.linspace(0.0, 6.0, 400)[:, None]
    q = np.sin(t * [1.1, 2.3]) * np.minimum(t, 3.0)  # ends with a slow part
    q[200:260] = q[200]
    m = jid.Motion(q, np.gradient(q, 0.015, axis=0), np.cos(3 * t) * [2.0, 1.0])
    expected = fit.predict(m)
    compiled = CompiledModel(fit, double=double, flags=["-O1"])
    s = [np.tanh(m.qd[:1] / 0.01)]
    for before, now in itertools.pairwise(q):
        s.append(compiled.advance(before[None], now[None], s[-1]))
    s, p = np.concatenate(s), np.tile(np.asarray(fit.parameters), (len(q), 1))
    tolerance = 1e-12 if double else 2e-4
    for torques in (
        compiled.torque(q, m.qd, m.qdd, s),
        compiled.torque_of_parameters(q, m.qd, m.qdd, p, s),
        _torque_of_masses(compiled, q, m.qd, m.qdd, s),
        compiled.bias(q, m.qd, s)
        + compiled.torque(q, m.qd, m.qdd, s)
        - compiled.torque(q, m.qd, 0 * q, s),
    ):
        close(torques, expected, tolerance)
    # At rest dry friction holds what the path has left.
    held = compiled.torque(q, 0 * q, 0 * q, s) - compiled.gravity(q)
    levels = [fit.base.names.index(f"fc{j}") for j in (1, 2)]
    close(held, np.asarray(fit.parameters)[levels] * s, max(tolerance, 1e-3))
    source = jid.export_c(fit, tmp_path, double=double)
    assert "arm_advance(q_before, q, s, s)" in (tmp_path / "arm.h").read_text()
    command = ["gcc", "-std=c99", *STRICT, "-DARM_SELF_TEST", str(source), "-lm"]
    subprocess.run([*command, "-o", str(tmp_path / "check")], check=True)
    subprocess.run([str(tmp_path / "check")], check=True, capture_output=True)
    if double:
        out = exported_function(fit).call(q, m.qd, m.qdd, s)
        close(out, expected)
