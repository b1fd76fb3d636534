"""Digits of least squares on NIST's linear reference problems, beside NumPy's `lstsq`.

    python benchmarks/nist.py [--quick] [--json FILE]

Data and certified values: the Statistical Reference Datasets, linear regression; the tests check
both by exact arithmetic. The observation matrix is built in float64 as it is (no centring), and
solved by the path that identification takes (triangular factor of a joint's rows, columns scaled to
length one, singular values). The statistic is the least of all estimates of a problem: minus the
decimal logarithm of its relative error, 15 at most, in the order of the rows of the data and the
worst of ten random orders. `lstsq` is called twice, with NumPy's own limit for singular values and
with `rcond=0`.
"""

import argparse
import sys

import timing
from timing import Row, hand_over

sys.path.insert(0, str(timing.REPOSITORY / "tests" / "identification"))
ORDERS = 10


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    given = parser.parse_args()
    timing.pin_to(1)
    import numpy as np
    from strd import PROBLEMS

    from jaxid.identification.factors import Factors, JointFactor
    from jaxid.identification.solutions import Complete, Decomposition

    def ours(X, y):
        size = X.shape[1]
        joint = JointFactor(tuple(range(size)), np.zeros((0, size + 1)), 0)
        joint = joint.joined(np.column_stack([X, y]))
        found = Decomposition.of(*Factors((joint,), size).weighted(np.ones(1)))
        return found.solve(Complete().inverse(found.values)), found.values[0] / found.values[-1]

    def digits(found, known):
        error = np.abs(found - known) / np.abs(known)
        return float(-np.log10(max(error.max(), 1e-15)))

    print("| problem | condition, scaled | ours | worst order | lstsq | lstsq, rcond=0 |")
    print("|---|---|---|---|---|---|")
    rows = []
    for name, problem in PROBLEMS.items():
        X = np.array([[float(x) for x in column] for column in problem.columns]).T
        y = np.array([float(one) for one in problem.response])
        known = np.array(problem.certified)
        found, condition = ours(X, y)
        random = np.random.default_rng(0)
        orders = [random.permutation(len(y)) for _ in range(2 if given.quick else ORDERS)]
        worst = min(digits(ours(X[o], y[o])[0], known) for o in orders)
        theirs = [digits(np.linalg.lstsq(X, y, rcond=r)[0], known) for r in (None, 0.0)]
        own = digits(found, known)
        shown = " | ".join(f"{d:.1f}" for d in (own, worst, *theirs))
        print(f"| {name} | {condition:.1e} | {shown} |")
        rows.append(
            Row(
                name,
                f"NIST StRD {name}",
                "least digits of all estimates: ours; NumPy's lstsq; lstsq with rcond=0",
                "digits reported",
                f"{own:.1f}; {theirs[0]:.1f}; {theirs[1]:.1f}",
            )
        )
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
