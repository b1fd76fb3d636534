"""Bodies of the robot's file as a prior: intervals, residuals and errors with bad ones.

    python benchmarks/judgement/priors.py [--quick] [--json FILE] [--machine wall]
        [--kind plain] [--draws 20]

MuJoCo records the machines (`machines.py`, `recordings.py`): each draw has a motion,
noise and disturbances of its own, 12 s. The estimator is the default one, with the
user's file (bodies up to 30 % wrong), with placeholders, with the bodies of other links
in reverse order, and with every second body a placeholder. Logs with smooth friction
are identified with the speed of transition that they have, so that the model is right.
The machines that served to set the estimator's constants are left out.

Statistics: share of intervals (95 %) that hold the truth, of parameters that a fit
determines within half their size; increase of the weighted residuals by bounds and
prior; error on another motion over that of least squares; CPU seconds of the fit.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import timing
from timing import Row

SETTING_KINDS = "palletiser", "lightweight", "gantry", "two arms"
"""Machines on which the share of the logs' bodies and the strengths were set."""
UNSEEN_SEED = 100


class Case:
    """Machine with its true parameters, and the files that its user may have."""

    def __init__(self, name, kind, folder):
        import machines
        import numpy as np

        import jaxid as jid

        self.kind = kind
        self.machine = machine = machines.machine(name)
        for stem, text in (("file", machine.file), ("true", machine.true_file)):
            (folder / f"{stem}.xml").write_text(text)
        self.file = jid.workflow.RobotFile(folder / "file.xml")
        robot = self.file.load()
        terms = jid.Setup(robot).model.terms
        if kind == "smooth friction":
            transition = jid.terms.Tanh(0.02 * machine.max_speeds)
            dry = jid.CoulombFriction(transition)
            terms = [dry if isinstance(x, jid.CoulombFriction) else x for x in terms]
        self.setup = jid.Setup(jid.Model(robot, tuple(terms)), robot_file=self.file)
        true_file = jid.workflow.RobotFile(folder / "true.xml")
        claims = true_file.claims()
        for j in range(robot.joints):
            claims[f"fv{j + 1}"] = machine.viscous[j]
            claims[f"fc{j + 1}"] = machine.coulomb[j]
        names = self.setup.model.parameter_names
        truth = np.array([claims.get(name, 0.0) for name in names])
        self.truth = np.asarray(self.setup.base.from_standard(truth))

    def observe(self, seed):
        """Record the machine and filter the log."""
        import recordings

        import jaxid as jid

        log = recordings.record(self.machine, recordings.KINDS[self.kind], seed)
        recording = jid.Recording.of(log.angles, log.forces, time=log.time)
        return self.setup.observe(recording)

    def priors(self):
        """Return the bodies of files by what is wrong with them; None for no file."""
        import numpy as np

        def all_alike(mass, moment):
            body = np.zeros(10)
            body[0] = mass
            body[4:7] = moment
            return np.tile(body, (len(bodies), 1))

        bodies = self.file.bodies()
        every_second = bodies.copy()
        every_second[1::2] = all_alike(1e-3, 1e-6)[1::2]
        return {
            "no file": None,
            "30 % wrong": bodies,
            "1 g, 1e-6 kg m²": all_alike(1e-3, 1e-6),
            "1 kg, 1 kg m²": all_alike(1.0, 1.0),
            "1 kg, 1e-3 kg m²": all_alike(1.0, 1e-3),
            "other links": bodies[::-1].copy(),
            "every second 1 g": every_second,
        }


def results(case, seed, unseen):
    """Yield the name of each prior with its statistics for one draw."""
    import numpy as np

    import jaxid as jid

    base = case.setup.base
    rows = jid.RegressionProblem(base, case.observe(seed))
    free = jid.identify(base, rows, jid.WeightedLeastSquares())
    sizes = np.abs(np.asarray(free.parameters))
    is_determined = free.standard_deviations < 0.5 * sizes
    for direction in free.undetermined:
        is_determined[list(direction.parts)] = False

    def unseen_error(fit):
        squares = unseen.residual_squares(np.asarray(fit.parameters))
        return np.sqrt(np.asarray(fit.weights) ** 2 @ squares)

    def coverage(fit):
        low, high = fit.intervals().T
        holds = (low <= case.truth) & (case.truth <= high)
        return np.mean(holds[is_determined])

    yield "least squares", (coverage(free), 0.0, 1.0, 0.0, "")
    for name, bodies in case.priors().items():
        pull = jid.consistency.EntropicPull(bodies)
        estimator = jid.PhysicallyConsistent(pull=pull)
        start = time.process_time()
        fit = jid.identify(base, rows, estimator)
        seconds = time.process_time() - start
        pull = fit.consistency.pull
        is_dropped = bodies is not None and pull.bodies is None
        strength = "dropped" if is_dropped else f"{pull.strength or 1.0:g}"
        yield (
            name,
            (
                coverage(fit),
                fit.consistency.residual_increase,
                unseen_error(fit) / unseen_error(free),
                seconds,
                strength,
            ),
        )


def main():
    """Print the statistics of each machine, and those of all."""
    parser: argparse.ArgumentParser = timing.parser(__doc__, "one draw of one machine")
    parser.add_argument("--machine", nargs="*")
    parser.add_argument("--kind", default="smooth friction")
    parser.add_argument("--draws", type=int, default=20)
    options = parser.parse_args()
    timing.pin_to(1)
    from collections import Counter

    import machines
    import numpy as np

    import jaxid as jid

    names = options.machine or [x for x in machines.MACHINES if x not in SETTING_KINDS]
    names = ["hobby"] if options.quick else names
    table = {}
    for machine_name in names:
        case = Case(machine_name, options.kind, Path(tempfile.mkdtemp()))
        unseen = jid.RegressionProblem(
            case.setup.base, case.observe(UNSEEN_SEED)
        ).factors
        for seed in range(1 if options.quick else options.draws):
            for prior, numbers in results(case, seed, unseen):
                table.setdefault((machine_name, prior), []).append(numbers)
    priors = list(dict.fromkeys(prior for _, prior in table))
    rows = []
    for prior in priors:
        draws = [
            x for (_, name), draws in table.items() if name == prior for x in draws
        ]
        for machine_name in (*names, "all"):
            each = draws if machine_name == "all" else table[machine_name, prior]
            cover, increase, error, seconds = np.array([x[:4] for x in each]).T
            print(
                f"{prior:18} {machine_name:16} intervals hold {100 * cover.mean():.1f} "
                f"%, residuals +{100 * np.median(increase):.2f} % (at most "
                f"{100 * increase.max():.2f}), unseen error x{np.median(error):.3f} "
                f"(at most {error.max():.3f}), {seconds.mean():.2f} s, "
                f"{dict(Counter(x[4] for x in each))}"
            )
        cover, increase, *_ = np.array([x[:4] for x in draws]).T
        rows.append(
            Row(
                "judgement/priors",
                f"intervals that hold the truth, and residuals: {prior}",
                f"{len(draws)} logs",
                "93 to 97 %; at most 2 % larger",
                f"{100 * cover.mean():.1f} %; {100 * increase.max():.2f} %",
                bool(cover.mean() >= 0.93 and increase.max() <= 0.02),
            )
        )
    timing.hand_over(rows, options.json)


if __name__ == "__main__":
    main()
