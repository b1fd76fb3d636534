"""Effect of gross outliers and noisy encoders on estimates, by estimator.

    python benchmarks/robustness.py [--quick] [--json FILE]

The arm, its truth and the motions are those of `coverage.py`: seven axes with offsets, 20 s.

Outliers: 5 % of the samples of every force are gross (a dropped or corrupted value: of random sign,
as large as the largest force of the joint); the others bear white noise of 1 % of the largest
forces. One kind stands alone, the other comes in bursts of ten samples (10 ms). Angles
are low-passed at 15 Hz; forces and columns are not, because a filter spreads an outlier over its
rows; every 5th sample is a row. The statistic: root mean square, over parameters and draws, of the
error in units of the standard deviations that weighted least squares have without outliers, and the
largest ratio of one parameter's; beside it the same estimators without any outlier, which shows
what their caution costs, and the share of 95 % intervals that hold the truth.

Noisy encoders: a log at 1 kHz with white noise on the angles and a filter with far too high a
cut-off (zero phase, for forces and columns too); white noise of 1 % on the forces; every 4th sample
is a row. The statistic: the mean of the errors over the draws in units of one fit's scatter (the
bias), root mean square and largest over the parameters, of weighted least squares and of
instrumental variables with the commanded motion; beside it the RMS error of one fit. The friction's
tanh has an epsilon of 0.1 rad/s here: no instrument takes away what noise does to the mean of a
sharper one. For the same reason another row leaves Coulomb friction out of the arm.
"""

import math

import coverage
import timing
from timing import Row, hand_over

SHARE, EVERY_OUTLIER, EVERY_NOISY = 0.05, 5, 4
SEED = 2026
BURST = 10
ENCODERS = ((1.4e-5, 60.0), (1e-4, 60.0))
"""Standard deviation of the angles [rad] (the first: 17 bits), and cut-off of the filter [Hz]."""


def arm(coulomb=True, epsilon=None):
    """Return base parameters and truth of the arm of `coverage.py`, with another friction."""
    import numpy as np

    import jaxid as jid

    base = coverage.seven_axes()
    p = dict(zip(base.model.parameter_names, coverage.truth(base), strict=True))
    terms = []
    for term in base.model.terms:
        dry = isinstance(term, jid.CoulombFriction)
        if dry and not coulomb:
            continue
        terms.append(jid.CoulombFriction(jid.terms.Tanh(epsilon)) if dry and epsilon else term)
    base = jid.base_parameters(jid.Model(base.model.robot, tuple(terms)))
    return base, np.array([p[name] for name in base.model.parameter_names])


def simulated(base, p, seed):
    """Return time, exact angles and exact forces of a motion that nothing was tuned on."""
    import numpy as np

    import jaxid as jid

    motion = jid.random_fourier_series(base.model.robot, omega=0.2 * math.pi, seed=seed)
    t = np.arange(round(coverage.DURATION * coverage.RATE)) / coverage.RATE
    m = motion.motion(t)
    forces = np.asarray(base.model.inverse_dynamics(p, m))
    return motion, t, np.asarray(m.q), forces


def gross(random, shape, burst):
    """Draw the gross samples: 5 % of every joint's, alone or in bursts."""
    import numpy as np

    starts = random.random(shape) < SHARE / burst
    hit = starts.copy()
    for k in range(1, burst):
        hit[k:] |= starts[:-k]
    return hit & np.ones(shape, bool)


def outlier_rows(draws):
    """Measure errors of estimators with and without outliers."""
    import numpy as np

    import jaxid as jid

    base, p = arm()
    robot, truth = base.model.robot, np.asarray(base.from_standard(p))
    _, *log = simulated(base, p, SEED)
    t, q, exact = (x[::EVERY_OUTLIER] for x in log)
    largest = np.asarray(robot.max_forces)
    filtering = jid.ZeroPhaseButterworth(15.0, force_cutoff=math.inf)
    estimators = {
        "WLS": jid.WeightedLeastSquares(),
        "Huber": jid.estimators.IterativelyReweighted(jid.estimators.Huber()),
        "Tukey": jid.estimators.IterativelyReweighted(jid.estimators.Tukey()),
    }
    kinds = (("none", 0), ("alone", 1), ("in bursts", BURST))
    errors = {(name, kind): [] for name in estimators for kind, _ in kinds}
    held = {key: [] for key in errors}
    for draw in range(draws):
        random = np.random.default_rng((SEED, draw))
        noise = coverage.NOISE * largest * random.standard_normal(exact.shape)
        for kind, burst in kinds:
            forces = exact + noise
            if burst:
                hit = gross(random, exact.shape, burst)
                size = largest * random.choice([-1.0, 1.0], exact.shape)
                forces = np.where(hit, size, forces)
            log = jid.Recording.of(q, forces, time=t)
            o = jid.observe(log, robot, filtering, jid.Subsample(1))
            for name, estimator in estimators.items():
                fit = jid.identify(base, o, estimator)
                low, high = fit.intervals().T
                errors[name, kind].append(np.asarray(fit.parameters) - truth)
                held[name, kind].append(np.mean((low <= truth) & (truth <= high)))
    rms = {key: np.sqrt(np.mean(np.square(e), axis=0)) for key, e in errors.items()}
    size = rms["WLS", "none"]
    found = []
    for kind, _ in kinds:
        whole = {n: np.sqrt(np.mean((rms[n, kind] / size) ** 2)) for n in estimators}
        said = "; ".join(
            f"{n} {whole[n]:.2f} (worst parameter {np.max(rms[n, kind] / size):.2f}; "
            f"{100 * np.mean(held[n, kind]):.0f} % of intervals hold)"
            for n in estimators
        )
        better = min(whole["WLS"] / whole[n] for n in ("Huber", "Tukey"))
        found.append(
            Row(
                f"outliers {kind}",
                f"RMS parameter error, outliers {kind}, of that of WLS without outliers",
                f"trajectory {SEED}, {draws} draws (keys {SEED}, 0 to {draws - 1}), "
                f"{100 * SHARE:g} % of samples as large as the largest force, "
                f"{coverage.RATE / EVERY_OUTLIER:g} Hz rows",
                "shown",
                said,
                bool(better > 1.0) if kind != "none" else True,
            )
        )
        print(found[-1].what, found[-1].measured, flush=True)
    return found


def encoder_rows(draws):
    """Measure the bias that noisy angles bring."""
    import numpy as np

    import jaxid as jid

    found = []
    for label, base, p in (
        ("epsilon 0.1 rad/s", *arm(epsilon=0.1)),
        ("no dry friction", *arm(coulomb=False)),
    ):
        robot, truth = base.model.robot, np.asarray(base.from_standard(p))
        motion, t, q, exact = simulated(base, p, SEED)
        largest = np.asarray(robot.max_forces)
        for noise, cutoff in ENCODERS:
            estimators = {
                "WLS": jid.WeightedLeastSquares(),
                "IV": jid.estimators.InstrumentalVariables((motion,)),
            }
            errors = {name: [] for name in estimators}
            for draw in range(draws):
                random = np.random.default_rng((SEED, draw))
                measured = q + noise * random.standard_normal(q.shape)
                forces = exact + coverage.NOISE * largest * random.standard_normal(q.shape)
                log = jid.Recording.of(measured, forces, time=t)
                filtering = jid.ZeroPhaseButterworth(cutoff)
                o = jid.observe(log, robot, filtering, jid.Subsample(EVERY_NOISY))
                rows = jid.RegressionProblem(base, [o])
                for name, estimator in estimators.items():
                    estimate = estimator(rows)
                    errors[name].append(np.asarray(estimate.parameters) - truth)
            said, bias = [], {}
            for name, e in errors.items():
                e = np.array(e)
                # The mean of many draws of one motion, beyond its own scatter, is bias.
                shift, scatter = e.mean(axis=0), e.std(axis=0, ddof=1)
                bias[name] = np.abs(shift) / scatter
                size = np.sqrt(np.mean(e**2, axis=0)) / np.std(errors["WLS"], axis=0, ddof=1)
                said.append(
                    f"{name} {np.sqrt(np.mean(bias[name] ** 2)):.2f} (worst "
                    f"{bias[name].max():.2f}; RMS error {np.sqrt(np.mean(size**2)):.2f} in WLS's "
                    "scatter)"
                )
            chance = 1 / math.sqrt(draws)
            found.append(
                Row(
                    f"encoders {noise:g} rad, {label}",
                    f"bias in standard deviations of one fit, {label}",
                    f"trajectory {SEED}, {draws} draws, angles with white noise of {noise:g} rad "
                    f"at 1 kHz, {cutoff:g} Hz zero phase, {coverage.RATE / EVERY_NOISY:g} Hz rows; "
                    f"without bias chance gives {chance:.2f}",
                    "shown",
                    "; ".join(said),
                    bool(np.mean(bias["IV"] ** 2) < np.mean(bias["WLS"] ** 2)),
                )
            )
            print(found[-1].what, found[-1].measured, flush=True)
    return found


def main():
    """Measure outliers and encoders on one core."""
    options = timing.parser(__doc__, "one draw, and two of encoders").parse_args()
    timing.pin_to(1)
    rows = outlier_rows(1 if options.quick else 20) + encoder_rows(2 if options.quick else 24)
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
