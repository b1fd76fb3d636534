"""Held-out errors of estimators and friction models on two measured robots.

Data: the logs of the Stäubli TX40 and the Universal Robots UR10 in `../shared/data`,
prepared as the experiment files `tests/real_data/tx40.toml` (20 Hz, every 50th row) and
`ur10.toml` (4 Hz) say, divided in time: the first 60 % of the rows to identify with,
the rest to verify with.

Model: rigid bodies with ten parameters each, rotor inertias, viscous and Coulomb
friction (smooth sign, epsilon 0.01 rad/s), offsets, and on the TX40 the coupled wrist.
The row "epsilons" finds one epsilon for each joint, the row "Stribeck" has Stribeck's
law and finds its speeds too; each is the linear model where held-out blocks *of the
identification part* say that it does not pay (last column).

Statistics: "weighted" is the RMS error in percent of the largest forces, root mean
square of the joints: what weighted least squares minimise. "relative" is the norm of
all errors over the norm of all forces. "moving" is the weighted error of the rows of
the rest in which some joint moves: the TX40 stands still at the end. "of WLS" compares
with weighted least squares.

    python benchmarks/held_out.py            # both robots, all rows
    python benchmarks/held_out.py ur10       # one of them
    python benchmarks/held_out.py --quick    # the UR10, without the rows that search
"""

import jax
import numpy as np
import timing
from timing import DATA, EXPERIMENTS

import jaxid as jid

LOGS = {"tx40": "tx40/motor_position.csv", "ur10": "ur10/exciting_measured.csv"}
SHARE = 0.6
STILL = 0.02
"""Speed below which a joint counts as resting [rad/s]."""

jax.config.update("jax_enable_x64", True)


def stribeck(base: jid.BaseParameters) -> jid.BaseParameters:
    """Return the same model with Stribeck's law in place of Coulomb's."""
    terms = [
        jid.terms.StribeckFriction(transition=term.transition)
        if isinstance(term, jid.CoulombFriction)
        else term
        for term in base.model.terms
    ]
    return jid.base_parameters(jid.Model(base.model.robot, tuple(terms)))


def fits(base: jid.BaseParameters, train: jid.Observations, *, quick: bool):
    """Yield name, fit and remark of each row of the table."""
    wls = jid.identify(base, train, jid.WeightedLeastSquares())
    yield "WLS, largest forces", wls, ""
    yield "LS", jid.identify(base, train, jid.estimators.LeastSquares()), ""
    variances = jid.WeightedLeastSquares(jid.estimators.ResidualVariances())
    yield "WLS, residual variances", jid.identify(base, train, variances), ""
    for loss in (jid.estimators.Huber(), jid.estimators.Tukey()):
        robust = jid.identify(base, train, jid.estimators.IterativelyReweighted(loss))
        yield f"IRLS, {type(loss).__name__}", robust, ""
    for remark, pull in (("", None), ("entropic pull", jid.consistency.EntropicPull())):
        consistent = jid.identify(base, train, jid.PhysicallyConsistent(pull=pull))
        price = f"residual increase {consistent.consistency.residual_increase:.1%}"
        yield (
            "physically consistent",
            consistent,
            ", ".join(filter(None, (remark, price))),
        )
    if quick:
        return
    for name, other in (("epsilons", base), ("Stribeck", stribeck(base))):
        found = jid.identify_nonlinear_friction(other, train, linear=base)
        verdict = f"{-found.held_out.gain:+.0%} ± {found.held_out.gain_deviation:.0%}"
        pays = "pays" if found.held_out.pays else "does not pay"
        yield f"{name}, as found", found.fit, f"{pays}: {verdict}"
        if not found.held_out.pays:
            yield f"{name}, what is kept", found.better, "the linear model"


def table(name: str, *, quick: bool) -> list[str]:
    """Return the rows of one robot."""
    experiment = jid.experiment.load_experiment(EXPERIMENTS / f"{name}.toml")
    recording = jid.workflow.read_log(
        experiment.setup, DATA / LOGS[name], experiment.columns
    )
    train, test = experiment.setup.observe(recording).split(SHARE)
    lines = [
        f"| {name.upper()} | weighted, first 60 % | weighted, rest | of WLS | moving "
        "| of WLS "
        "| relative, rest | |",
        "|---|---|---|---|---|---|---|---|",
    ]
    moving = np.abs(np.asarray(test.reduced_motion.qd)).max(axis=1) > STILL
    reference = None
    for label, fit, remark in fits(experiment.setup.base, train, quick=quick):
        errors = jid.validate(fit, [train, test]).errors
        parts = (errors[0].errors, errors[1].errors, errors[1].errors[moving])
        largest = np.asarray(errors[0].max_forces)
        before, after, there = (
            float(np.sqrt(np.nanmean((e / largest) ** 2))) for e in parts
        )
        reference = (after, there) if reference is None else reference
        beside, there_beside = (
            x / y - 1 for x, y in zip((after, there), reference, strict=True)
        )
        lines.append(
            f"| {label} | {before:.2%} | {after:.2%} | {beside:+.1%} | {there:.2%} "
            f"| {there_beside:+.1%} | {errors[1].relative:.2%} | {remark} |".replace(
                "%", " %"
            )
        )
    return lines


def main() -> None:
    """Print the tables."""
    parser = timing.parser(__doc__, "the UR10, without the rows that search")
    parser.add_argument("robots", nargs="*", default=list(LOGS))
    options = parser.parse_args()
    if not DATA.is_dir():
        print("measured data (../shared/data beside the project) are not here: skipped")
        return
    for name in ("ur10",) if options.quick else options.robots:
        print("\n".join(table(name, quick=options.quick)), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
