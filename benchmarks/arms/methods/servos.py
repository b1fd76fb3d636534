"""Methods for servo joints: this package, and rivals that simulate in MuJoCo."""

import contextlib

import numpy as np
from arm import ServoResult

JOINT = """\
<mujoco><option timestep="{step}" gravity="0 0 0" integrator="implicitfast"/>
<worldbody><body><inertial pos="0 0 0" mass="1e-3" diaginertia="1e-9 1e-9 1e-9"/>
<joint name="q" armature="0.01" solimpfriction="0.9999 0.9999 0.001"/></body>
</worldbody><actuator><position name="servo" joint="q" kp="1"/>
<general name="load" joint="q" gainprm="0"/></actuator>
<sensor><jointpos name="q" joint="q"/></sensor></mujoco>"""
"""Joint with its servo; parameters are relative to the gain of the servo."""
# Start, lower and upper end of each unknown: inertia [s²], damping [s], dry friction
# and bias [rad], compliance under the bodies' weight [rad/(N m)], delay [s].
UNKNOWNS = {
    "inertia": (0.004, 1e-7, 1.0),
    "damping": (0.05, 1e-3, 5.0),
    "friction": (0.01, 0.0, 1.0),
    "bias": (0.0, -1.0, 1.0),
    "compliance": (0.02, 0.0, 1.0),
    "delay": (0.01, 0.0, 0.3),
}
MAX_STEP = 0.01
"""Longest time step [s]."""
FAILED_COST = 1.0
"""Cost of unknowns that cannot be simulated [rad²]."""
EVALUATIONS = 250
"""Simulations of CMA-ES for each joint."""


def jaxid(arm):
    """`jid.identify_rollout` with the bodies of the robot's file."""
    import jaxid as jid

    fit = jid.identify_rollout(arm.logs, arm.bodies, stiffness=arm.stiffness)

    def positions(logs):
        return [x.T for x in fit.validate(logs).simulated]

    return ServoResult(positions)


def copied_command(arm):
    """No model: the joint stands where it is sent."""
    return ServoResult(lambda logs: [log.forces for log in logs])


def motions(arm, logs):
    """Return time, positions, commands and weight torques of each part of logs."""
    import jaxid as jid

    parts = []
    for log in logs:
        for start, stop in log.segments:
            q = np.asarray(log.angles)[start:stop]
            still = jid.Motion(q, np.zeros_like(q), np.zeros_like(q))
            bodies = arm.bodies
            weights = bodies.model.inverse_dynamics(bodies.parameters, still)
            time = log.sample_time * np.arange(len(q))
            parts.append((time, q, log.forces[start:stop], np.asarray(weights)))
    return parts


def first_speeds(time, q, samples=5):
    """Return the speeds at the start, from a parabola through the first samples."""
    return np.polyfit(time[:samples], q[:samples], 2)[1]


def apply(spec, parameter):
    """Write one unknown into a model."""
    value = float(parameter.value[0])
    joint = spec.joint("q")
    if parameter.name == "inertia":
        joint.armature = value
    elif parameter.name == "damping":
        joint.damping = np.array([value, 0.0, 0.0])
    elif parameter.name == "friction":
        joint.frictionloss = value
    elif parameter.name == "bias":
        spec.actuator("servo").biasprm[0] = value
    elif parameter.name == "compliance":
        spec.actuator("load").gainprm[0] = -value


def in_mujoco(arm, search):
    """Identify joint by joint; `search` finds the unknowns that explain residuals.

    The weight torques are those of the measured poses, also in predictions.
    """
    import mujoco
    from mujoco import sysid

    # Otherwise MuJoCo writes its warnings into a file in the working folder.
    mujoco.set_mju_user_warning(print)
    step = min(MAX_STEP, arm.logs[0].sample_time)
    spec = mujoco.MjSpec.from_string(JOINT.format(step=step))
    model = spec.compile()
    found = {}
    for j in arm.joints:
        parameters = sysid.ParameterDict()
        for name, (start, lower, upper) in UNKNOWNS.items():
            write = None if name == "delay" else apply
            parameters.add(sysid.Parameter(name, start, lower, upper, False, write))
        sequences = []
        for k, (time, q, commands, weights) in enumerate(motions(arm, arm.logs)):
            controls = np.stack([commands[:, j], weights[:, j]], axis=1)
            speed = first_speeds(time, q)[[j]]
            start = sysid.create_initial_state(model, q[0, [j]], speed, np.zeros(0))
            control = sysid.TimeSeries(time, controls)
            sensor = sysid.TimeSeries.from_names(time, q[:, [j]], model)
            sequences.append(
                sysid.ModelSequences(
                    f"log {k}", spec, f"log {k}", start, control, sensor
                )
            )
        transform = sysid.SignalTransform()
        transform.delay("*", parameters["delay"])
        residual = sysid.build_residual_fn(
            models_sequences=sequences, modify_residual=transform.apply
        )
        found[j] = search(parameters, residual)
        for name, parameter in found[j].parameters.items():
            if name != "delay":
                apply(spec, parameter)
        found[j] = (spec.compile(), found[j]["delay"].value[0])

    def positions(logs):
        paths = []
        for time, q, commands, weights in motions(arm, logs):
            path = q.copy()
            for j, (joint, delay) in found.items():
                controls = np.stack([commands[:, j], weights[:, j]], axis=1)
                start = (q[0, j], first_speeds(time, q)[j])
                path[:, j] = simulate(joint, time, controls, start, delay)
            paths.append(path)
        return paths

    return ServoResult(positions)


def simulate(model, time, controls, start, delay):
    """Return the positions of a joint, which are as late as the delay says."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start
    times = np.arange(0.0, time[-1] + model.opt.timestep, model.opt.timestep)
    inputs = np.stack([np.interp(times, time, x) for x in controls.T], axis=1)
    path = np.zeros(len(times))
    for k, control in enumerate(inputs):
        path[k] = data.qpos[0]
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    return np.interp(time - delay, times, path)


def mujoco_sysid(arm):
    """The toolbox of MuJoCo with its defaults, but scaled by the derivatives."""
    from mujoco import sysid

    def search(parameters, residual):
        with contextlib.redirect_stdout(None):
            return sysid.optimize(parameters, residual, verbose=False, x_scale="jac")[0]

    return in_mujoco(arm, search)


def evolution(arm):
    """CMA-ES (`cma`) on the residuals of the same simulations."""
    import cma

    def search(parameters, residual):
        lower, upper = parameters.get_bounds()
        start = parameters.as_vector()
        scale = np.maximum(start, 0.01)

        def cost(z):
            x = np.clip(start + scale * np.asarray(z), lower, upper)
            try:
                errors = np.concatenate(residual(x, parameters)[0])
            except ValueError:  # some delays give equal times
                return FAILED_COST
            return float(np.mean(errors**2))

        options = {"seed": 1, "verbose": -9, "maxfevals": EVALUATIONS}
        best = cma.fmin2(cost, np.zeros(len(start)), 0.5, options)[0]
        parameters.update_from_vector(np.clip(start + scale * best, lower, upper))
        return parameters

    return in_mujoco(arm, search)


KIND = "servos"
METHODS = {
    "copied command": copied_command,
    "mujoco.sysid": mujoco_sysid,
    "CMA-ES": evolution,
    "jaxid": jaxid,
}
