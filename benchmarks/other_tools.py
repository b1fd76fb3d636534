"""The log of the UR10 identified by FIGAROH and by jaxid, for the guide on both.

    python benchmarks/other_tools.py [--quick] [--json FILE]

Each way is the one that its own documentation shows. FIGAROH 1.0: low-pass filter of
angles, velocities and torques, differences, regressor with friction, rotors and
offsets, QR, least squares. jaxid: `jid.Setup` with its defaults. Both are fitted to the
first 60 % of the log with the same cut-off frequency, and predict the rest. FIGAROH's
own filter helper is not used: version 1.0.2 passes a quarter of the stated cut-off
frequency to SciPy.
"""

import time
from types import SimpleNamespace

import numpy as np
import timing
from timing import DATA, Row, hand_over

LOG = DATA / "ur10" / "exciting_measured.csv"
CUTOFF = 4.0
"""Cut-off frequency [Hz]."""
SHARE = 0.6
"""Share of the log that is used for the fit."""


def relative_error(predicted, measured):
    """Return the RMS error over the RMS torque, of all joints together."""
    return np.linalg.norm(predicted - measured) / np.linalg.norm(measured)


def by_jaxid(jid):
    """Return the errors on both parts of the log."""
    setup = jid.Setup(jid.robots.ur10(), filter=jid.ZeroPhaseButterworth(CUTOFF))
    columns = jid.Columns(angles="q{}", velocities="dq{}", forces="tau{}", time="t")
    report = jid.identify_logs(setup, [LOG], columns, held_out=1.0 - SHARE)
    parts = (*report.identification, *report.verification)
    return [
        relative_error(part.predicted[part.counted], part.measured[part.counted])
        for part in parts
    ]


def by_figaroh(robot):
    """Return the errors on both parts of the log."""
    from figaroh.tools.qrdecomposition import QRDecomposer
    from figaroh.tools.regressor import build_regressor_basic
    from pinocchio_loop import Bodies, pinocchio_model
    from scipy.signal import butter, filtfilt

    log = np.genfromtxt(LOG, delimiter=",", names=True)
    n, step = robot.joints, np.median(np.diff(log["t"]))
    weights = butter(4, 2.0 * CUTOFF * step)
    q, qd, forces = (
        filtfilt(*weights, np.stack([log[f"{name}{k + 1}"] for k in range(n)]))
        for name in ("q", "dq", "tau")
    )
    qdd = np.gradient(qd, step, axis=1)
    model = pinocchio_model(robot, Bodies(n))
    figaroh_robot = SimpleNamespace(model=model, data=model.createData())
    config = {
        "has_friction": True,
        "has_actuator_inertia": True,
        "has_joint_offset": True,
        "act_idxv": list(range(n)),
    }
    regressor = build_regressor_basic(figaroh_robot, q.T, qd.T, qdd.T, config)
    regressor = regressor.reshape(n, -1, regressor.shape[1])
    end = int(SHARE * forces.shape[1])
    fitted = regressor[:, :end].reshape(-1, regressor.shape[2])
    columns = np.flatnonzero((fitted**2).sum(axis=0) >= 1e-6)
    names = [f"p{k}" for k in columns]
    decomposer = QRDecomposer(tolerance=1e-8)
    *_, estimates = decomposer.double_decomposition(
        forces[:, :end].ravel(), fitted[:, columns], names
    )
    independent = columns[decomposer.base_indices]
    predicted = regressor[..., independent] @ estimates
    return [
        relative_error(predicted[:, :end], forces[:, :end]),
        relative_error(predicted[:, end:], forces[:, end:]),
        len(independent),
    ]


def main():
    """Print the rows."""
    given = timing.parser(__doc__, "the same").parse_args()
    what = "UR10, fitted to 60 % of the log: error there, on the rest; seconds"
    recipe = f"benchmarks/other_tools.py: RMS error over RMS torque below {CUTOFF:g} Hz"
    if not LOG.exists():
        rows = [Row("other tools", what, recipe, "-", "no log: skipped")]
        hand_over(rows, given.json)
        return
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxid as jid

    rows = []
    start = time.process_time()
    fitted, rest = by_jaxid(jid)
    seconds = time.process_time() - start
    said = f"{fitted:.1%}, {rest:.1%}; {seconds:.0f} s of the CPU with compiling"
    rows.append(Row("other tools", f"{what}: jaxid", recipe, "-", said))
    absent = timing.missing("figaroh") or timing.missing("pinocchio")
    if absent is None:
        start = time.process_time()
        fitted, rest, size = by_figaroh(jid.robots.ur10())
        seconds = time.process_time() - start
        said = f"{fitted:.1%}, {rest:.1%}; {seconds:.0f} s of the CPU; {size} columns"
    else:
        said = absent
    rows.append(Row("other tools", f"{what}: FIGAROH", recipe, "-", said))
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
