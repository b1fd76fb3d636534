"""Arms simulated by MuJoCo under closed-loop control, whose truth is known."""

import re

import numpy as np
from arm import Arm

LOG = """\
[robot]
urdf = "machine.xml"
[recording]
time = "t"
angles = "q{}"
forces = "tau{}"
"""
BAND = 15.0
"""Cut-off frequency [Hz]."""


def machine_and_logs(name, folder, machine_name, kind, change=None):
    """Record a machine three times; `change` turns its file into that of the user."""
    from judgement.machines import machine
    from judgement.recordings import KINDS, record

    truth = machine(machine_name)
    text = truth.file if change is None else change(truth.file)
    logs = [folder / f"log{seed}.csv" for seed in range(3)]
    if not logs[-1].exists():
        (folder / "machine.xml").write_text(text, encoding="utf-8")
        for seed, path in enumerate(logs):
            write_log(path, record(truth, KINDS[kind], seed))
    # With another geometry, there are no true parameters.
    known = truth if name != "wrong_geometry" else None
    return Arm(name, BAND, LOG, logs[:1], LOG, logs[1:], folder, known)


def write_log(path, log):
    """Write a log as CSV."""
    joints = log.angles.shape[1]
    names = [f"{x}{j + 1}" for x in ("q", "tau") for j in range(joints)]
    table = np.column_stack([log.time, log.angles, log.forces])
    header = ",".join(["t", *names])
    np.savetxt(path, table, "%.9g", ",", header=header, comments="")


def closed_loop(folder):
    """Seven-axis light arm under a servo, encoders of 17 bits, 0.3 % noise.

    Dry friction sticks; one log of 12 s to identify from, two unseen. The user's file
    has masses and inertias that are wrong by up to 30 %.
    """
    return machine_and_logs("closed_loop", folder, "lightweight", "plain")


def presliding(folder):
    """Six-axis wall arm that goes from point to point and rests in between.

    Dry friction sticks, and creeps before it breaks loose.
    """
    return machine_and_logs("presliding", folder, "wall", "pauses")


def wrong_geometry(folder):
    """Five-axis arm with oblique axes, whose file has links that are 5 mm too long."""

    def change(text):
        return re.sub(
            r'pos="([-\d.e]+) ', lambda x: f'pos="{float(x[1]) + 0.005} ', text
        )

    return machine_and_logs("wrong_geometry", folder, "oblique", "plain", change)


def placeholder(folder):
    """Six-axis wall arm, whose file gives 1 kg and 0.01 kg m² to each body."""

    def change(text):
        inertial = '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
        return re.sub(r"<inertial [^>]*/>", inertial, text)

    return machine_and_logs("placeholder", folder, "wall", "plain", change)


def elastic(folder):
    """Four-axis palletiser whose gears are springs: 10 to 20 Hz, behind each motor.

    The log has the motors' angles and torques, as industrial robots give them.
    """
    from judgement.machines import machine

    truth = machine("palletiser")
    logs = [folder / f"log{seed}.csv" for seed in range(3)]
    if not logs[-1].exists():
        (folder / "machine.xml").write_text(truth.file, encoding="utf-8")
        for seed, path in enumerate(logs):
            write_log(path, record_with_springs(truth, seed))
    return Arm("elastic", BAND, LOG, logs[:1], LOG, logs[1:], folder, truth)


def record_with_springs(truth, seed):
    """Record a machine whose motors drive its links through springs."""
    import mujoco
    from judgement.recordings import KINDS, SAMPLE_TIME, STEPS, Log, reference

    joint = re.compile(
        r'<joint name="(\w+)" type="(\w+)" axis="([^"]*)" armature="([^"]*)"[^>]*/>'
    )
    text = joint.sub(
        r'<joint name="\1" type="\2" axis="\3" armature="\4"/>'
        r'<joint name="\1_spring" type="\2" axis="\3"/>',
        truth.true_file,
    )
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = SAMPLE_TIME / STEPS
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mujoco.MjData(model)
    motors = np.arange(0, model.nv, 2)
    springs = motors + 1
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    inertias = np.diag(matrix)[motors]
    rates = 2 * np.pi * np.random.default_rng(9).uniform(10, 20, len(motors))
    model.jnt_stiffness[springs] = inertias * rates**2
    model.dof_damping[springs] = 0.1 * inertias * rates
    model.dof_damping[motors] = truth.viscous
    model.dof_frictionloss[motors] = truth.coulomb
    time, q_ref, v_ref, _ = reference(truth, KINDS["plain"], seed)
    data.qpos[motors] = q_ref[0]
    servo_rate = 2 * np.pi * 4.0
    samples = len(time) // STEPS
    angles = np.zeros((samples, len(motors)))
    forces = np.zeros_like(angles)
    for k in range(samples):
        row = k * STEPS
        angles[k] = data.qpos[motors]
        error = q_ref[row] - angles[k]
        error_rate = v_ref[row] - data.qvel[motors]
        # The servo holds the arm against gravity, as a controller's integral does.
        force = inertias * (servo_rate**2 * error + 1.4 * servo_rate * error_rate)
        force += data.qfrc_bias[motors]
        data.qfrc_applied[motors] = force
        forces[k] = force
        for _ in range(STEPS):
            mujoco.mj_step(model, data)
    # A force is held during a sample: the mean around a sample belongs to its angles.
    forces = 0.5 * forces + 0.5 * np.vstack([forces[:1], forces[:-1]])
    grid = 2 * np.pi / 2**17
    noise = np.random.default_rng(seed + 1000).normal(size=forces.shape)
    forces += 0.003 * truth.max_forces * noise
    seen = np.round(angles / grid) * grid
    return Log(time[::STEPS][:samples], seen, forces, q_ref[::STEPS][:samples])


KIND = "torques"
SETS = {
    "closed_loop": closed_loop,
    "elastic": elastic,
    "presliding": presliding,
    "wrong_geometry": wrong_geometry,
    "placeholder": placeholder,
}
