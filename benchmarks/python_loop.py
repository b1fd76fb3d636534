"""Dense regressor and a million samples, against a Python loop over Pinocchio.

    XLA_FLAGS=--xla_cpu_max_isa=AVX2 python benchmarks/python_loop.py [--quick]

Panda with friction and rotors, float64, arrays of NumPy, two cores. The loop stores
each regressor of bodies, 70 columns of ours 91, into a new array; both run in turn. The
regressor is judged by CPU time, `identify` by time. Memory is the growth of the
resident set from before `Observations.of`, compiling included.
"""

import statistics
import time

import timing
from timing import Row, hand_over

SIZES = (2048, 8192)


def elapsed(run):
    """Return time and CPU time of a call [s]."""
    start, cpu_start = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - start, time.process_time() - cpu_start


def ratios(ours, theirs, turns):
    """Return how many times longer theirs takes: by time, and by CPU time."""
    ours()
    pairs = [(elapsed(ours), elapsed(theirs)) for _ in range(turns)]
    return [statistics.median(b[k] / a[k] for a, b in pairs) for k in (0, 1)]


def main():
    """Print the rows."""
    options = timing.parser(__doc__, "fewer samples").parse_args()
    timing.pin_to(2)
    absent = timing.missing("pinocchio")
    if absent is not None:
        hand_over([Row("loop", "Pinocchio", "-", "-", absent)], options.json)
        return
    import numpy as np
    import pinocchio as pin
    from streaming import Peak, in_pinocchio, virtual_log

    import jaxid as jid

    model = jid.Model(jid.robots.panda())
    peer = in_pinocchio(model.robot)
    data = peer.createData()
    columns = 10 * model.robot.joints

    def loop(motion):
        arrays = motion.q, motion.qd, motion.qdd
        result = np.empty((len(motion.q), model.robot.joints, columns))
        for k, sample in enumerate(zip(*arrays, strict=True)):
            result[k] = pin.computeJointTorqueRegressor(peer, data, *sample)

    rows = []
    recipe = "Panda, 91 parameters, the loop has 70; medians of turns"
    for samples in SIZES:
        motion = jid.Motion(
            *np.random.default_rng(0).uniform(-1.0, 1.0, (3, samples, 7))
        )
        by_time, by_cpu = ratios(
            lambda x=motion: model.regressor(x), lambda x=motion: loop(x), 7
        )
        said = f"{by_time:.1f}x by time, {by_cpu:.1f}x by CPU time"
        what = f"dense regressor of {samples} samples against the loop"
        rows.append(Row("loop", what, recipe, ">= 1.7x", said, by_cpu >= 1.7))

    samples = 100_000 if options.quick else 1_000_000
    base = jid.base_parameters(model)
    motion, forces = virtual_log(base, samples)

    def identify():
        arrays = motion.q, motion.qd, motion.qdd, forces
        jid.identify(base, jid.Observations.of(*arrays, sample_time=1e-3))

    with Peak() as peak:
        first = elapsed(identify)
    part = motion[: samples // 20]
    by_time, by_cpu = ratios(identify, lambda: loop(part), 3)
    share, cpu_share = (1 / (20 * x) for x in (by_time, by_cpu))
    said = (
        f"{share:.2f} of the loop's time, {cpu_share:.2f} of its CPU time on two cores "
        f"together; {peak.megabytes:.0f} MB with compiling, first call {first[1]:.1f} "
        "CPU s"
    )
    what = f"{samples} samples through `Observations.of` and `identify`"
    holds = share <= 0.3 and peak.megabytes <= 250
    rows.append(Row("loop", what, recipe, "<= 0.3, <= 250 MB", said, holds))
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
