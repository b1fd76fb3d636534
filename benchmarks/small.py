"""Small batches: NumPy at once, or compiled XLA? The threshold `FEW` in `jaxid.dynamics.machine`.

    python benchmarks/small.py [--quick] [--json FILE]

The cost of a call of the regressor for N = 1 to 16 384 samples by both machines, the number of
samples from which a compiled function is faster, and the number of calls that pay for compiling it.
"""

import argparse

import timing
from timing import Row, hand_over, interleaved


def measure(sizes, turns):
    from peers import compiled, motion

    import jaxid as jid
    from jaxid.dynamics import machine
    from jaxid.program import evaluate

    model = jid.Model(jid.robots.panda())
    n = model.robot.joints
    shapes = ((n,),) * 3
    made = machine.machines(model, model.columns, *shapes)
    found = {}
    for samples in sizes:
        arrays = [x.T.copy() for x in motion(n, samples)]
        xla, compiling = timing.elapsed(lambda x=arrays: compiled(made.compiled, *x))
        numpy = lambda x=arrays: evaluate(made.program, *x)  # noqa: E731
        times = interleaved({"NumPy": numpy, "XLA": xla}, turns)
        found[samples] = (times["NumPy"].median * 1e6, times["XLA"].median * 1e6, compiling)
    return found, machine.FEW


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few sizes")
    parser.add_argument("--json", help="where to write the rows")
    options = parser.parse_args()
    timing.pin_to(2)
    sizes = (1, 64) if options.quick else (1, 16, 256, 1024, 4096, 16384)
    found, few = measure(sizes, 5 if options.quick else 9)
    crossing = next((s for s, (numpy, xla, _) in found.items() if xla < numpy), None)
    for samples, (numpy, xla, compiling) in found.items():
        saved = numpy - xla
        pays = f"{compiling * 1e6 / saved:.0f} calls pay for it" if saved > 0 else "never pays"
        costs = f"NumPy {numpy:.0f} us, XLA {xla:.0f} us, compile {compiling:.1f} s"
        print(f"N = {samples}: {costs}, {pays}")
    rows = [
        Row(
            "8",
            "cost of one call by batch: NumPy / compiled XLA",
            f"Panda, 91 columns, dense, two cores; `FEW` = {few}; compiled XLA first wins at "
            f"N = {crossing} of those measured",
            "-",
            "; ".join(f"N = {s}: {a:.0f} / {b:.0f} us" for s, (a, b, _) in found.items()),
        )
    ]
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
