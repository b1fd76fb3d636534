"""Experiment files: what they become, and how each mistake is refused in a sentence."""

import dataclasses
import json
import re
import tomllib
import typing

import equinox as eqx
import numpy as np
import pytest

import jaxid as jid
from jaxid import units
from jaxid.errors import InputError
from jaxid.excitation.criteria import CRITERIA
from jaxid.experiment.decoder import keys_of, table_of
from jaxid.experiment.experiment import TABLES, load_experiment
from jaxid.experiment.setup_tables import KINDS
from jaxid.experiment.template import write_template
from jaxid.experiment_file import KEYS
from jaxid.experiment_values import decode_table
from jaxid.identification.uncertainty import UNCERTAINTIES
from jaxid.io import union_members
from jaxid.measurement.columns import Columns, with_lerobot_calibration
from jaxid.measurement.filters import FILTERS
from jaxid.trajectory.controllers import CONTROLLERS
from jaxid.workflow import log_loading
from jaxid.workflow.log_loading import load_log, load_logs, read_log

WEIGHTS = jid.estimators.MaximumForces()
ARM = """\
[robot]
builtin = "planar_arm"
"""
RECORDING = """
[recording]
angles = "q{}"
forces = "tau{}"
time = "t"
"""
URDF = """\
<robot name="rail and arm">
  <link name="base"/><link name="cart"/><link name="arm"/><link name="tool"/>
  <joint name="rail" type="prismatic">
    <parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-1.5" upper="1.5" velocity="2" effort="3000"/>
  </joint>
  <joint name="shoulder" type="revolute">
    <parent link="cart"/><child link="arm"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
    <limit lower="-2.1" upper="2.2" velocity="3.5" effort="120"/>
  </joint>
  <joint name="flange" type="fixed">
    <parent link="arm"/><child link="tool"/><origin xyz="0 0 0.5"/>
  </joint>
</robot>
"""

ARM_OF_SHAPES = """\
<robot name="arm">
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/>
  <joint name="turn" type="continuous">
    <parent link="base"/><child link="a"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
  </joint>
  <joint name="lift" type="continuous">
    <parent link="a"/><child link="b"/><origin rpy="-1.5707963267948966 0 0"/>
    <axis xyz="0 0 1"/>
  </joint>
  <joint name="bend" type="continuous">
    <parent link="b"/><child link="c"/><origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>
  </joint>
</robot>
"""
SHAPES = """
[robot]
urdf = "shapes.urdf"

[collision]
distance = 0.05
fit = false
floor = -0.1

[[collision.capsules]]
name = "column"
body = "ground"
start = [0, 0, 0]
end = [0, 0, 0.3]
radius = 0.1

[[collision.capsules]]
name = "hand"
body = "bend"
start = [0.4, 0, 0]
radius = 0.08

[[collision.boxes]]
name = "table"
centre = [0.5, 0, 0]
size = [0.4, 1, 0.1]
rotation = [0, 0, 90]
"""


@pytest.fixture
def load(tmp_path):
    """Loads an experiment file with this text."""

    def load(text):
        (tmp_path / "shapes.urdf").write_text(ARM_OF_SHAPES)
        path = tmp_path / "experiment.toml"
        path.write_text(text, encoding="utf-8")
        return load_experiment(path)

    return load


def test_a_key_that_is_gone_is_unknown(load):
    with pytest.raises(
        InputError, match=r"`model\.coulomb\.dead_zone` is not a known key"
    ):
        load(f"{ARM}[model.coulomb]\ndead_zone = 0.1\n")


def read(experiment, log):
    """The recording of a log, as the experiment file says."""
    return read_log(experiment.setup, log, experiment.columns)


def test_defaults_are_said(load):
    experiment = load(ARM)
    assert len(experiment.setup.model.terms) == 5
    assert experiment.setup.filter == jid.ZeroPhaseButterworth(10.0)
    assert experiment.setup.decimation == jid.Subsample(1)
    assert experiment.setup.min_speed is None
    assert experiment.columns is None
    assert experiment.setup.estimator.weights == jid.estimators.MaximumForces()
    cutoffs = [x.cutoff for x in experiment.setup.filter_candidates]
    assert cutoffs == [10.0, 2.0, 3.5, 5.0]


def test_limits_replace_those_of_the_robot_and_nan_keeps_them(load):
    known = jid.robots.tx90l_on_rail()
    text = """
[robot]
builtin = "tx90l_on_rail"
[limits]
angle_unit = "deg"
velocity = [2.0, 180, nan, nan, nan, nan, inf]
force = [1000, nan, nan, nan, nan, nan, nan]
"""
    robot = load(text).setup.robot
    velocity = np.array(known.limits.velocity)
    velocity[[0, 1, 6]] = 2.0, np.pi, np.inf
    np.testing.assert_allclose(robot.limits.velocity, velocity, rtol=1e-15)
    np.testing.assert_array_equal(robot.limits.force[1:], known.limits.force[1:])
    assert robot.limits.force[0] == 1000.0
    assert "velocity" not in robot.limits.assumed


def test_drives_replace_those_of_the_robot(load):
    text = '[robot]\nbuiltin = "tx40"\n[drives]\nmax_torques = [1, 2, 3, 4, 5, 6]\n'
    text += 'angle_unit = "deg"\nzero = [0, -90, 90, 0, 0, 0]\n'
    drives, known = load(text).setup.robot.drives, jid.robots.tx40().drives
    np.testing.assert_array_equal(drives.reduction, known.reduction)
    np.testing.assert_allclose(drives.zero, known.zero, rtol=1e-15)
    np.testing.assert_array_equal(drives.max_torques, [1, 2, 3, 4, 5, 6])


@pytest.mark.parametrize("name", ["planar_arm", "tx40"])
def test_a_setup_of_a_robot_has_the_model_of_a_file_without_the_table_model(load, name):
    robot = getattr(jid.robots, name)()
    of_file = load(f'[robot]\nbuiltin = "{name}"\n').setup
    setup = jid.Setup(robot)
    assert setup.model.parameter_names == of_file.model.parameter_names
    assert any(isinstance(term, jid.ConstantOffset) for term in setup.model.terms)
    motion = jid.Motion(*np.random.default_rng(0).normal(size=(3, 5, robot.joints)))
    np.testing.assert_array_equal(
        setup.model.regressor(motion), of_file.model.regressor(motion)
    )


def test_a_tool_at_the_end_effector_or_on_a_body(load):
    inertia = "inertia = { xx = 0.02, yy = 0.03, zz = 0.04, xy = 0.001 }\n"
    text = ARM + "[robot.tool]\nmass = 2\ncentre_of_mass = [0.1, 0, 0]\n" + inertia
    tool = load(text).setup.robot.tool
    np.testing.assert_allclose(tool.centre_of_mass, [1.1, 0, 0])
    np.testing.assert_allclose(tool.inertia[0], [0.02, 0.001, 0])
    tool = load(text + 'body = "joint1"\n').setup.robot.tool
    assert tool.body == 0
    np.testing.assert_allclose(tool.centre_of_mass, [0.1, 0, 0])


def test_the_model(load):
    text = """
[model]
principal_axes = true
rotor_inertia = false
viscous = false
springs = true
[model.coulomb]
epsilon = [0.1, 0.2]
asymmetric = true
"""
    model = load(ARM + text).setup.model
    assert "D1" not in model.parameter_names
    others = " ".join(n for n in model.parameter_names if n.startswith(("f", "I", "k")))
    assert others == "fcp1 fcp2 fcn1 fcn2 ks1 ks2"
    dry = model.terms[1]
    np.testing.assert_array_equal(dry.transition.epsilon, [0.1, 0.2])
    coupled = "[drives]\nmatrix = [[10, 0], [20, 20]]\n"
    hard = load(ARM + coupled + "[model.coulomb]\nhard = true\n").setup.model
    assert isinstance(hard.terms[2].transition, jid.terms.HardSign)
    assert "Iam2" in hard.parameter_names


ESTIMATORS = {
    'kind = "least_squares"': jid.estimators.LeastSquares(),
    'kind = "least_squares"\nridge = "cross_validated"': jid.estimators.LeastSquares(
        jid.estimators.CrossValidated()
    ),
    "ridge = 0.02": jid.WeightedLeastSquares(WEIGHTS, jid.estimators.Ridge(0.02)),
    'kind = "huber"': jid.estimators.IterativelyReweighted(
        jid.estimators.Huber(), WEIGHTS
    ),
    'kind = "tukey"\nridge = 0.1': jid.estimators.IterativelyReweighted(
        jid.estimators.Tukey(), WEIGHTS, jid.estimators.Ridge(0.1)
    ),
    'kind = "consistent"\npull = 2': jid.PhysicallyConsistent(
        WEIGHTS, pull=jid.consistency.EntropicPull(strength=2.0)
    ),
    "": jid.PhysicallyConsistent(WEIGHTS, pull=jid.consistency.EntropicPull()),
    "pull = 0": jid.PhysicallyConsistent(WEIGHTS),
}


@pytest.mark.parametrize("text", ESTIMATORS)
def test_estimators(load, text):
    estimation = load(f"{ARM}[estimator]\n{text}\n").setup
    assert estimation.estimator == ESTIMATORS[text]


def test_filters_and_rows(load):
    text = "cutoff = 20\norder = 2\nforce_cutoff = inf\nmargin = 0.1"
    found = load(f'{ARM}[filter]\nkind = "butterworth"\n{text}').setup.filter
    assert found == jid.ZeroPhaseButterworth(20.0, 2, np.inf, 0.1)
    found = load(f'{ARM}[filter]\nkind = "paper"\nvelocity = 900').setup.filter
    assert found == jid.filters.PaperFilter(900.0, 100.0)
    experiment = load(ARM + "[rows]\nstep = 50\nmin_speed = [0.1, 2]\n")
    assert experiment.setup.decimation == jid.Subsample(50)
    np.testing.assert_array_equal(experiment.setup.min_speed, [0.1, 2.0])


def test_estimators_of_files(load, tmp_path):
    inertia = (
        "<inertial><mass value='{}'/><inertia ixx='{}' ixy='0' ixz='0' iyy='6' "
        "iyz='0' izz='6'/>"
    )
    heavy = URDF
    for link, mass in (("cart", 5), ("arm", 7)):
        own = f"<link name='{link}'>{inertia.format(mass, mass)}</inertial></link>"
        heavy = heavy.replace(f'<link name="{link}"/>', own)
    (tmp_path / "arm.urdf").write_text(heavy)
    robot = '[robot]\nurdf = "arm.urdf"\n[model]\nprincipal_axes = true\n'
    robot += "[estimator]\n"
    claims = load(robot).setup.robot_file.claims()
    assert [claims[k] for k in ("m1", "m2", "A2", "C2")] == [5.0, 7.0, 7.0, 6.0]
    bounds = """kind = "consistent"
mass_min = 0.5
total_mass = 12
"""
    consistent = load(robot + bounds).setup.estimator
    assert consistent.pull.bodies[1, 0] == 7.0
    assert consistent.bounds.total_mass == 12.0
    np.testing.assert_array_equal(consistent.bounds.mass_min, [0.5, 0.5])


BODIES = '[estimator]\nkind = "consistent"\n'
COLUMNS = ARM + RECORDING
RAIL = '[robot]\nbuiltin = "tx90l_on_rail"\n' + RECORDING
BUTTERWORTH = ARM + "[filter]\nkind = 'butterworth'\n"
TOOL = ARM + "[robot.tool]\nmass = 1\ncentre_of_mass = [0, 0, 0]\n"
REFUSALS = [
    ("robot = 3", "`robot`"),
    ("[robt]\nurdf = 'a'", "`robt`.*did you mean `robot`"),
    ("", "`[robot]`"),
    (ARM + 'urdf = "a"', "`urdf` and `builtin`"),
    ('[robot]\nbuiltin = "tx9"', "`robot.builtin`"),
    ('[robot]\nbuiltin = "panda"\ntip = "x"', "`tip` belongs to `urdf`"),
    ('[robot]\nurdf = "no.urdf"', "`urdf`: `.*no.urdf`"),
    (ARM + "gravity = [0, 0, 'g']", "`robot.gravity[2]`"),
    (ARM + "xyzzy = 1", "`robot.xyzzy`.*`[robot]` has urdf"),
    (ARM + 'name = "a\\u001b[31m"', "`robot.name`.*control character"),
    (TOOL + "body = 'hand'", "`body`.*joint1, joint2"),
    (TOOL + "inertia = {xx = 1, yy = 1, zz = 9}", "`inertia`"),
    (ARM + "[limits]\nvelocity = [1, 2, 3]", "`limits`: `velocity`"),
    (ARM + "[limits]\nposition_max = [150, 150]", "`joint1`.*`angle_unit"),
    (ARM + "[limits]\nforce = [1e-300, 20]", "`force`"),
    (
        ARM + "[drives]\ngear_ratios = [1, 1]\nmatrix = [[1, 0], [0, 1]]",
        "`gear_ratios` or `matrix`",
    ),
    (ARM + "[drives]\ngear_ratios = [nan, 1]", "`drives.gear_ratios[0]`"),
    (ARM + "[drives]\nmatrix = [[1, 0], [0]]", "`matrix`"),
    (ARM + "[model]\ncoulomb = 'hard'", "`model.coulomb`"),
    (ARM + "[model.coulomb]\nasymmetric = true\nstribeck = 1", "`coulomb.stribeck`"),
    (ARM + "[recording]\nangles = 'q{}'", "`recording.forces`"),
    (COLUMNS + "angle_unit = 'degree'", "`degree`"),
    (COLUMNS + "angle_unit = [0.01, 0.01, 0.01]", "`angle_unit`"),
    (COLUMNS + "angle_unit = [0.01, true]", "`recording.angle_unit[1]`"),
    (COLUMNS + "force_unit = '%'", "`rated_forces`"),
    (COLUMNS + "angle_signs = [1, 2]", "`angle_signs`"),
    (
        RAIL + "angle_unit = 'deg'",
        '`angle_unit` of joint `rail` is "deg", but the joint slides',
    ),
    (
        RAIL + "force_unit = 'N'",
        '`force_unit` of joint `joint1` is "N", but the joint turns',
    ),
    (BUTTERWORTH + "cutoff = []", "`filter.cutoff`"),
    (ARM + "[filter]\nkind = 'paper'\ncutoff = 3", "`filter.cutoff`.*velocity"),
    (ARM + "[estimator]\nweights = 'maximum_forces'", "`weights = .*`joint1`"),
    (
        ARM + "[estimator]\nkind = 'least_squares'\nweights = 'residual_variances'",
        "`estimator.weights`: belongs to `kind",
    ),
    (
        ARM + "[estimator]\nkind = 'huber'\npull = 2.0",
        '`estimator.pull`: belongs to `kind = "consistent"',
    ),
    (ARM + "[estimator]\nkind = 'instrumental'", "`estimator.kind` must be"),
    (ARM + BODIES + "radius = [[1, 1, 1], [1, 1]]", "`estimator.radius`"),
    (ARM + "[estimator]\nridge = 'cv'", "`estimator.ridge`"),
    ("[robot\n", "TOML"),
    (ARM + "x = " + 3000 * "[", "TOML"),
    (
        SHAPES.replace('body = "bend"', 'body = "wrist"'),
        "`collision`: `body`.*turn, lift",
    ),
    (SHAPES.replace("floor = -0.1", 'pairs = [["hand", "chair"]]'), "`chair`"),
]


@pytest.mark.parametrize(("text", "expected"), REFUSALS, ids=range(len(REFUSALS)))
def test_mistakes_are_one_sentence_with_file_and_key(load, text, expected):
    pattern = re.escape(expected).replace(r"\.\*", ".*")
    with pytest.raises(InputError, match=pattern) as caught:
        load(text)
    message = str(caught.value)
    assert message.startswith("experiment.toml: ")
    assert "\n" not in message
    assert message.endswith((".", "?"))
    assert not message.endswith("..")


def test_columns_by_the_names_of_the_joints(load):
    table = (
        '[recording]\nangles = "/js.position.{name}"\nforces = "tau{}"\nunwrap = true\n'
    )
    experiment = load(ARM + table)
    names = experiment.setup.robot.joint_names
    assert experiment.columns.angles == tuple(f"/js.position.{name}" for name in names)
    assert experiment.columns.forces == "tau{}"
    assert experiment.columns.unwrap


def test_logs_that_do_not_fit_the_file(load, tmp_path):
    log = tmp_path / "run.csv"
    rows = "\n".join(f"{0.01 * i},{i},{i},{i},1,1,1" for i in range(100))
    log.write_text("t,q1,q2,q3,tau1,tau2,tau3\n" + rows)
    names = r"`run.csv`, which has `t`, `q1`, .* `tau3`\."
    missing = rf"the table `\[recording\]` is missing: .* {names}"
    with pytest.raises(ValueError, match=missing):
        load(ARM).require_columns([log])
    with pytest.raises(
        ValueError, match=r"`recording.angles` names 3 of the columns of `run.csv`, but"
    ):
        read(load(ARM + RECORDING), log)
    short = RECORDING.replace('"q{}"', '["q1", "q2"]').replace(
        '"tau{}"', '["tau1", "tau2"]'
    )
    with pytest.raises(ValueError, match=r"`run` has 0 samples from 5 s"):
        read(load(ARM + short + "start = 5\n"), log)
    parts = load(ARM + short + "start = 0.2\n")
    assert read(parts, log).angles[[0, -1], 0].tolist() == [20, 99]


def test_bad_rows_outside_start_and_stop_of_long_logs(load, tmp_path, monkeypatch):
    monkeypatch.setattr(log_loading, "LONG_LOG_ROWS", 300)
    keys = RECORDING.replace('"q{}"', '["q1", "q2"]')
    keys = keys.replace('"tau{}"', '["tau1", "tau2"]') + "start = 0.5\nstop = 3.5\n"
    experiment = load(ARM + keys)
    t = np.arange(400) / 100
    rows = np.stack([t, np.sin(3 * t), np.cos(2 * t), np.cos(t), np.sin(t)], 1)
    lines = [",".join(f"{x:.6f}" for x in row) for row in rows]
    lines[3] = "driver not ready"
    lines[20] = lines[20].replace(",", ",nan,", 1).rpartition(",")[0]
    lines[399] = "3.99,1"
    path = tmp_path / "run.csv"
    path.write_text("t,q1,q2,tau1,tau2\n" + "\n".join(lines))
    log = load_log(experiment.setup, path, experiment.columns)
    assert "read as a whole" in log.observations.notes[-1]
    assert log.diagnosis.log.samples == 300
    np.testing.assert_allclose(log.diagnosis.log.angles, rows[50:350, 1:3], atol=1e-6)


@pytest.mark.parametrize(
    ("rate", "samples", "cures"),
    [
        (50, 400, ("lower it", "only logs faster than 60 Hz")),
        (100, 12, ("record longer",)),
        (100, 5, ("at least 10 are needed",)),
    ],
)
def test_the_one_log_of_five_that_is_too_slow_or_too_short(
    load, tmp_path, rate, samples, cures
):
    keys = RECORDING.replace('"q{}"', '["q1", "q2"]')
    keys = keys.replace('"tau{}"', '["tau1", "tau2"]')
    experiment = load(ARM + keys + "[filter]\nkind = 'butterworth'\ncutoff = 30\n")
    paths = []
    for k in range(5):
        count, frequency = (samples, rate) if k == 3 else (400, 100)
        t = np.arange(count) / frequency
        rows = np.stack([t, np.sin(3 * t), np.cos(2 * t), np.cos(t), np.sin(t)], 1)
        lines = [",".join(f"{x:.6f}" for x in row) for row in rows]
        paths.append(tmp_path / f"run{k}.csv")
        paths[k].write_text("t,q1,q2,tau1,tau2\n" + "\n".join(lines))
    with pytest.raises(InputError) as caught:
        load_logs(experiment.setup, paths, experiment.columns)
    message = str(caught.value)
    assert "`run3`" in message or "`run3.csv`" in message, message
    assert not any(f"run{k}`" in message for k in (0, 1, 2, 4))
    assert all(cure in message for cure in cures), message


def test_the_file_states_scales_of_each_joint(tmp_path):
    """Angles from -100 to 100 of each joint's range, forces in parts of rated ones."""
    path = tmp_path / "experiment.toml"
    keys = "angle_unit = [0.011, 0.012]\nangle_offsets = [0.2, 0.1]\n"
    keys += 'force_unit = "%"\nrated_forces = [80, 20]\n'
    path.write_text(COLUMNS + keys, encoding="utf-8")
    columns = load_experiment(path).columns
    values = np.array([[-100.0, 100.0]])
    found = columns.to_si({"angles": values, "forces": values})
    angles, forces = found["angles"], found["forces"]
    np.testing.assert_allclose(angles, [[-0.9, 1.3]])
    np.testing.assert_allclose(forces, [[-80.0, 20.0]])


SO_ARM = {
    "shoulder_pan": {"id": 1, "range_min": 754, "range_max": 3230},
    "shoulder_lift": {"id": 2, "range_min": 871, "range_max": 3271},
    "gripper": {"id": 3, "range_min": 1903, "range_max": 3135},
}
FURTHER_KEYS = {"drive_mode": 0, "homing_offset": -1024}


def lerobot_values(counts, motor, is_gripper=False):
    """Return what LeRobot writes for counts of a motor, and their angles [rad]."""
    share = (counts - motor["range_min"]) / (motor["range_max"] - motor["range_min"])
    middle = 0.5 * (motor["range_max"] + motor["range_min"])
    values = 100 * share if is_gripper else 200 * share - 100
    return values, 2 * np.pi / 4096 * (counts - middle)


@pytest.mark.parametrize("names", [("a", "b", "c"), ("shoulder_lift", "gripper")])
def test_calibration_files_of_lerobot_scale_each_joint(tmp_path, names):
    """Motors by the names of the joints, else by their numbers."""
    motors = {name: motor | FURTHER_KEYS for name, motor in reversed(SO_ARM.items())}
    path = tmp_path / "arm.json"
    path.write_text(json.dumps(motors))
    arguments = {"angles": "q{}", "forces": "tau{}", "sample_time": 0.1}
    arguments["angle_offsets"] = [0.3] * len(names)
    columns = Columns(**with_lerobot_calibration(arguments, path, names))
    counts = np.linspace(1000.0, 3000.0, 5)
    motor_names = [name if name in SO_ARM else None for name in names]
    if None in motor_names:
        motor_names = [*SO_ARM]
    pairs = [lerobot_values(counts, SO_ARM[n], n == "gripper") for n in motor_names]
    values, angles = np.transpose(pairs, (1, 2, 0))
    found = columns.to_si({"angles": values, "velocities": values})
    scaled_angles, velocities = found["angles"], found["velocities"]
    np.testing.assert_allclose(scaled_angles, angles + 0.3, atol=1e-12)
    np.testing.assert_allclose(np.diff(velocities, axis=0), np.diff(angles, axis=0))


def test_an_experiment_names_a_calibration_file_of_lerobot(tmp_path):
    path = tmp_path / "experiment.toml"
    key = 'lerobot_calibration = "arm.json"\n'
    for keys, content, expected in (
        (key, json.dumps(SO_ARM), None),
        (key + 'angle_unit = "%"\n', json.dumps(SO_ARM), None),
        (key + 'angle_unit = "rad"\n', json.dumps(SO_ARM), 'write "%"'),
        (key + 'angle_unit = "deg"\n', json.dumps(SO_ARM), "leave the calibration out"),
        (key, "{", "`arm.json` must be a calibration file"),
        (key, "[1, 2]", "`arm.json` must be a calibration file"),
        (key, '{"a": {"id": 1}, "b": {"id": 2}}', "range_max"),
        (key, json.dumps({"a": SO_ARM["gripper"]}), "each of the 2 joints"),
        (key.replace("arm", "other"), "", "`other.json` must be"),
    ):
        path.write_text(COLUMNS + keys, encoding="utf-8")
        (tmp_path / "arm.json").write_text(content)
        if expected is None:
            columns = load_experiment(path).columns
            values = np.full((1, 2), 100.0)
            angles = columns.to_si({"angles": values})["angles"]
            half_ranges = np.pi / 4096 * np.array([2476, 2400])
            np.testing.assert_allclose(angles[0], half_ranges)
        else:
            with pytest.raises(InputError, match=re.escape(expected)):
                load_experiment(path)


def test_the_template_loads_as_it_is_and_keeps_what_the_urdf_says(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    text = write_template(tmp_path / "arm.urdf", folder=tmp_path)
    path = tmp_path / "experiment.toml"
    path.write_text(text, encoding="utf-8")
    experiment = load_experiment(path)
    robot, known = experiment.setup.robot, jid.load_urdf(tmp_path / "arm.urdf")
    for name in (
        "position_min",
        "position_max",
        "velocity",
        "acceleration",
        "jerk",
        "force",
    ):
        np.testing.assert_array_equal(
            getattr(robot.limits, name), getattr(known.limits, name)
        )
    assert robot.drives.is_direct
    assert experiment.setup.notes == ()
    assert experiment.columns.angle_unit == (units.M, units.RAD)
    assert experiment.columns.force_unit == (units.N, units.NM)
    assert "#   1 rail (slides)\n#   2 shoulder (turns)\n" in text
    assert max(len(line) for line in text.splitlines()) <= 100


def test_an_mjcf_file_gives_template_robot_and_nominal_values(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body name="link">'
        '<joint name="hinge" armature="0.1" frictionloss="2" stiffness="3" '
        'springref="90"/>'
        '<geom size="0.1" pos="0.2 0 0"/></body></worldbody></mujoco>'
    )
    text = write_template(
        tmp_path / "arm.xml", folder=tmp_path, base="world", tip="link"
    )
    (tmp_path / "experiment.toml").write_text(text, encoding="utf-8")
    experiment = load_experiment(tmp_path / "experiment.toml")
    assert 'mjcf = "arm.xml"' in text
    assert experiment.setup.robot.joint_names == ("hinge",)
    claims = experiment.setup.robot_file.claims()
    assert claims["m1"] == pytest.approx(4000 / 3 * np.pi * 1e-3)
    assert (claims["Ia1"], claims["fc1"], claims["ks1"]) == (0.1, 2.0, 3.0)
    assert claims["fo1"] == pytest.approx(-1.5 * np.pi)
    names = experiment.setup.model.parameter_names
    assert "ks1" in names
    assert "fo1" in names


def test_every_commented_key_of_the_template_is_a_known_one(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    text = write_template(tmp_path / "arm.urdf", folder=tmp_path)
    text = re.sub(
        r"^# (?=\[(robot.tool|load|sensor|collision)\])", "", text, flags=re.M
    )
    keys = dict.fromkeys(re.findall(r"^# (\w+) = ", text, flags=re.M))
    assert len(keys) > 25
    for key in set(keys) - {"kind", "coulomb"}:  # the second is a table as well
        # Kinds of filters share names of keys: only one of them can be active.
        others = re.sub(rf"^{key} = .*\n", "", text, flags=re.M)
        content = tomllib.loads(
            re.sub(rf"^# ({key} = )", r"\1", others, count=1, flags=re.M)
        )
        for name, table in content.items():
            decode_table(table, KEYS[name], name)


SIDES = (
    "angles_on_motor_side",
    "forces_on_motor_side",
    "joint_names",
    "wrench",
    "wrench_sign",
    "in_ground",
)
"""Arguments of a reading that `side`, `forces_side`, robot and `[sensor]` tell."""


def keys_by_table(name, functions):
    """The names of the arguments of functions, and of the functions of inner tables."""
    keys = [key for function in functions for key in keys_of(function).values()]
    found = {name: {key.name for key in keys}}
    for key in keys:
        hint = key.annotation
        options = [*union_members(hint), *typing.get_args(hint)[:1]]
        for function in filter(None, map(table_of, options)):
            found |= keys_by_table(f"{name}.{key.name}", [function])
    return found


def declared_keys(name, hints):
    """The names of the keys that a table declares, and of those of inner tables."""
    found = {name: set(hints)}
    for key, hint in hints.items():
        for option in hint if isinstance(hint, tuple | list) else [hint]:
            if isinstance(option, dict):
                found |= declared_keys(f"{name}.{key}", option)
    return found


def test_the_keys_that_are_known_before_jax_is_loaded_are_those_of_the_objects():
    expected = {}
    for name, functions in TABLES.items():
        expected |= keys_by_table(name, functions)
    expected["recording"] -= set(SIDES)
    expected["filter"] |= {"kind"}
    declared = {}
    for name, hints in KEYS.items():
        declared |= declared_keys(name, hints)
    assert declared == expected


def test_the_template_has_every_key_with_its_default(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    text = write_template(tmp_path / "arm.urdf", folder=tmp_path)
    parts = re.split(r"^(?:# )?\[([\w.]+)\]\n", text, flags=re.M)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    for name, functions in TABLES.items():
        content = sections[name]
        active = tomllib.loads(content)
        keys = [key for f in functions for key in keys_of(f).values()]
        for key in keys:
            # `urdf` stands in place of `mjcf`, and the robot or `[sensor]` tells these.
            if key.name == "mjcf" or (name == "recording" and key.name in SIDES):
                continue
            is_table = f"{name}.{key.name}" in sections
            assert is_table or re.search(rf"^(# )?{key.name} = ", content, flags=re.M)
            is_plain = isinstance(key.default, bool | int | float | str)
            if is_plain and key.name in active and name != "filter":
                assert active[key.name] == key.default


@pytest.mark.parametrize(
    ("table", "key", "family"),
    [
        ("filter", "kind", FILTERS),
        ("estimator", "kind", KINDS),
        ("estimator", "uncertainty", UNCERTAINTIES),
        ("excitation", "criterion", CRITERIA),
        ("excitation", "controller", CONTROLLERS),
    ],
)
def test_names_that_a_key_may_have_are_those_of_the_family(table, key, family):
    assert set(typing.get_args(KEYS[table][key])) == set(family)


TX40 = """\
[robot]
builtin = "tx40"
[recording]
angles = "Joint_{}"
forces = "Joint_{}"
forces_file = "motor_torque.csv"
sample_time = 2e-4
side = "motor"
[filter]
kind = "butterworth"
cutoff = 20
[rows]
step = 50
"""


def test_a_file_has_the_defaults_of_python(load):
    """Motors that move joints together, and forces in a file of their own."""
    experiment = load(TX40)
    terms = (
        jid.terms.RigidBodies(),
        jid.terms.ViscousFriction(),
        jid.terms.CoulombFriction(),
        jid.terms.RotorInertia(),
        jid.terms.ConstantOffset(),
        jid.terms.CoupledDrives(),
    )
    setup = jid.Setup(
        jid.Model(jid.robots.tx40(), terms),
        filter=jid.ZeroPhaseButterworth(20.0),
        decimation=jid.Subsample(50),
        reading=jid.workflow.LogReading(forces_file="motor_torque.csv"),
    )
    assert eqx.tree_equal(experiment.setup.model.terms, setup.model.terms)
    assert experiment.setup.model.parameter_names == setup.model.parameter_names
    settings = {field.name for field in dataclasses.fields(setup)} - {"unknowns", "_"}
    for name in settings:
        found, expected = (getattr(x, name) for x in (experiment.setup, setup))
        assert eqx.tree_equal(found, expected), name
    columns = jid.Columns(
        angles="Joint_{}",
        forces="Joint_{}",
        sample_time=2e-4,
        angles_on_motor_side=True,
        forces_on_motor_side=True,
        joint_names=jid.robots.tx40().joint_names,
    )
    assert experiment.columns == columns


def test_no_name_of_a_urdf_writes_into_the_template(tmp_path):
    folder = tmp_path / 'a"b\\c  # d'
    folder.mkdir()
    urdf = folder / "arm.urdf"
    text = URDF.replace("rail and arm", "x&#10;[limits]&#13;#").replace(
        "shoulder", "j  # k = 1"
    )
    urdf.write_text(text)
    found = tomllib.loads(write_template(urdf, tip="tool", folder=tmp_path))
    assert found["robot"] == {"urdf": 'a"b\\c  # d/arm.urdf', "tip": "tool"}
    plain = tmp_path / "arm.urdf"
    plain.write_text(URDF)
    assert found.keys() == tomllib.loads(write_template(plain, folder=tmp_path)).keys()
    for sign in ("&#10;gravity = [0, 0, 9.81]&#10;#", "&#x9b;31m", "&#x2028;"):
        urdf.write_text(URDF.replace("shoulder", f"j{sign}"))
        with pytest.raises(ValueError, match="name"):
            write_template(urdf, folder=tmp_path)
        urdf.write_text(URDF.replace('"tool"', f'"t{sign}"'))
        assert (
            found.keys() == tomllib.loads(write_template(urdf, folder=tmp_path)).keys()
        )


def test_shapes_come_from_the_file(load):
    experiment = load(SHAPES)
    model = experiment.surroundings.clearance.model
    assert model.pair_names == ("column and hand", "hand and table", "hand and floor")
    assert experiment.surroundings.clearance.distance == 0.05
    gaps = np.asarray(model.clearance(experiment.setup.robot, np.zeros(3)))
    # At zero the hand is at 0.9 m along x, at the height of the shoulder.
    assert gaps[2] == pytest.approx(0.3 + 0.1 - 0.08, abs=1e-5)
    assert gaps[0] == pytest.approx(0.9 - 0.18, abs=1e-5)
    named = SHAPES.replace("floor = -0.1", 'pairs = [["hand", "table"]]')
    assert load(named).surroundings.clearance.model.pair_names == ("hand and table",)
    # Without shapes the lines between the joints stand in.
    found = load(ARM).surroundings
    assert "thick capsules" in found.faults[0]


GEARED = """<robot name="arm"><link name="l0"/><link name="l1"/><link name="l2"/>
  <joint name="j1" type="revolute"><parent link="l0"/><child link="l1"/>
    <limit lower="-1" upper="1" effort="9" velocity="2"/></joint>
  <joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/>
    <limit lower="-1" upper="1" effort="9" velocity="2"/></joint>
  <transmission name="t"><joint name="j1"/><actuator name="m">
    <mechanicalReduction>50</mechanicalReduction></actuator></transmission></robot>"""


def test_the_template_proposes_the_gears_of_the_file(tmp_path):
    (tmp_path / "arm.urdf").write_text(GEARED)
    text = write_template(tmp_path / "arm.urdf", folder=tmp_path)
    path = tmp_path / "experiment.toml"
    path.write_text(text, encoding="utf-8")
    # As long as nobody says that the log is of the motors, nothing changes.
    assert load_experiment(path).setup.robot.drives.is_direct
    motor_text = text.replace('\nside = "joint"', '\nside = "motor"')
    path.write_text(motor_text, encoding="utf-8")
    with pytest.raises(InputError, match=r"`gear_ratios = .50.0, 1.0.` in `.drives.`"):
        load_experiment(path)
    active_text = re.sub(r"\ngear_ratios = .*", "", motor_text)
    proposal = "# gear_ratios = [50.0, 1.0]"
    assert proposal in active_text
    path.write_text(active_text.replace(proposal, proposal[2:]), encoding="utf-8")
    drives = load_experiment(path).setup.robot.drives
    assert np.diag(drives.reduction).tolist() == [50.0, 1.0]
    (tmp_path / "arm.urdf").write_text(GEARED.replace(">50<", ">1<"))
    assert proposal[:15] not in write_template(tmp_path / "arm.urdf", folder=tmp_path)


def test_another_tip_names_all_lists_and_the_command_that_writes_them(tmp_path):
    (tmp_path / "arm.urdf").write_text(GEARED)
    text = write_template(tmp_path / "arm.urdf", folder=tmp_path)
    path = tmp_path / "experiment.toml"
    shorter = text.replace('urdf = "arm.urdf"', 'urdf = "arm.urdf"\ntip = "l1"')
    path.write_text(re.sub(r"\n# tip = .*", "", shorter), encoding="utf-8")
    keys = "`limits.position_min`, `limits.pos.*`drives.gear_ratios` do not hold 1"
    cure = r"each joint .j1.: .*`jaxid init \S*arm.urdf --tip l1` prints"
    with pytest.raises(InputError, match=f"{keys} .*{cure}"):
        load_experiment(path)
    lists = write_template(tmp_path / "arm.urdf", tip="l1", folder=tmp_path)
    path.write_text(lists, encoding="utf-8")
    assert load_experiment(path).setup.robot.joints == 1


def test_a_cutoff_is_chosen_unless_it_is_given(load):
    setup = load(ARM + "[filter]\nkind = 'butterworth'\norder = 2\n").setup
    assert [x.cutoff for x in setup.filter_candidates] == [10.0, 2.0, 3.5, 5.0]
    assert {x.order for x in setup.filter_candidates} == {2}
    given = dataclasses.replace(setup, filter=jid.ZeroPhaseButterworth(3.0))
    assert given.filter_candidates == ()
    assert jid.Setup(setup.model, filter=setup.filter).filter_candidates == ()
    assert dataclasses.replace(setup, load_friction=True).filter_candidates
    assert load(ARM + "[filter]\nkind = 'paper'\n").setup.filter_candidates == ()


def test_signals_of_a_trunk_need_a_floating_base(tmp_path):
    path = tmp_path / "arm.toml"
    path.write_text(
        '[robot]\nbuiltin = "planar_arm"\n[recording]\nsample_time = 0.01\n'
        'angles = "q{}"\nforces = "tau{}"\ngyro = "gyro{}"\n'
    )
    with pytest.raises(InputError, match=r"`recording.gyro` .* `floating = true`"):
        load_experiment(path)
