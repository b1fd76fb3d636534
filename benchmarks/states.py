"""Several runs of one virtual robot: cold and warm, payload, gains, delay, update.

Everything is simulated; noise on the forces has a standard deviation of 1 % of each
joint's largest force, half of its variance white and half with a memory of 50 ms.
Motions are `random_fourier_series` (5 harmonics, limits kept) that run through two
periods, 500 samples in a second; filter: zero-phase Butterworth at 10 Hz, every 20th
row; weights: the largest forces; model right unless a row says otherwise. Intervals and
tests are those of the package at 95 %.

Cold and warm (Sec. 6): the paper's arm on its rail with seven parameters per body (44
base parameters), ground frequency 0.8 rad/s, the same motion cold and warm. The truth
has the paper's numbers where it gives some: p_B(1) = 273.40 kg and p_B(2) = 1.68 kg m
in both states; of the axes 1 and 2, viscous friction of 248.41 -> 90.19 N s/m and 41.26
-> 25.65 N m s, Coulomb friction of 312.50 -> 233.00 N and 18.24 -> 15.07 N m. Bodies
are random clouds of points with the CAD's masses; the axes 3 to 7 have 2 % (viscous, at
1 rad/s) and 4 % (Coulomb) of their largest torques and warm up like axis 2. Each draw
has new noise.

Payload, gains, delay, update: the built-in Panda with the example's bodies, ten
parameters each, and friction and offsets; period 8 s. The tool has 3 kg, its centre 13
cm from the last frame; friction is 20 % larger with it. Gains are drawn within 20 % of
1. Forces are late by 10 ms.

    python benchmarks/states.py            # all tables
    python benchmarks/states.py payload    # some of them: cold, payload, delay
    python benchmarks/states.py --quick    # one draw of each
"""

import dataclasses

import jax
import numpy as np
import timing
from scipy import signal

import jaxid as jid

SAMPLE_TIME, MEMORY, NOISE = 0.002, 0.05, 0.01
LEVEL = 0.95
CAD = (273.4, 16.93, 14.35, 7.50, 6.42, 0.569, 0.031)
"""Masses of the bodies [kg]; the first is the difference to the paper's p_B(1)."""
VISCOUS, COULOMB = ((248.41, 90.19), (41.26, 25.65)), ((312.50, 233.00), (18.24, 15.07))
DELAY = 0.01
CENTRAL_UNITS = {"m": "kg", "x": "m", "y": "m", "z": "m"}
CENTRAL_UNITS |= dict.fromkeys(("A_c", "B_c", "C_c", "D_c", "E_c", "F_c"), "kg m²")
"""Units of mass, centre of mass, and moments about it."""
TOOL = jid.Tool(
    6,
    mass=3.0,
    centre_of_mass=(0.02, -0.03, 0.12),
    inertia=[[0.012, 0.001, 0.0], [0.001, 0.015, -0.0005], [0.0, -0.0005, 0.008]],
)

jax.config.update("jax_enable_x64", True)


class Rig:
    """Robot that repeats one motion: forces are computed once, noise is drawn anew."""

    def __init__(self, model: jid.Model, omega: float, seed: int, late: float = 0.0):
        self.robot = model.robot
        trajectory = jid.trajectories.random_fourier_series(
            self.robot, omega=omega, seed=seed
        )
        t = np.arange(0.0, 4 * np.pi / omega, SAMPLE_TIME)
        self.motion, self.late = trajectory.motion(t), trajectory.motion(t - late)
        self.model = model

    def forces(self, p: np.ndarray) -> np.ndarray:
        """Return the forces of the motion, without noise."""
        return np.asarray(self.model.inverse_dynamics(p, self.late))

    def observe(self, forces: np.ndarray, seed: int, gains=1.0, name: str = "run"):
        """Return rows of a recording."""
        return self.rows(self.record(forces, seed, gains, name))

    def record(self, forces: np.ndarray, seed: int, gains=1.0, name: str = "run"):
        """Return a recording with noise of its own."""
        random = np.random.default_rng(seed)
        white, drive = random.standard_normal((2, *forces.shape))
        kept = np.exp(-SAMPLE_TIME / MEMORY)
        first = kept * random.standard_normal((1, forces.shape[1]))
        coloured, _ = signal.lfilter(
            [np.sqrt(1 - kept**2)], [1, -kept], drive, axis=0, zi=first
        )
        size = NOISE * np.asarray(self.robot.max_forces) / np.sqrt(2.0)
        measured = (forces + size * (white + coloured)) / gains
        return jid.Recording.of(
            self.motion.q, measured, sample_time=SAMPLE_TIME, name=name
        )

    def rows(self, recording: jid.Recording) -> jid.Observations:
        """Return the filtered recording."""
        return jid.observe(
            recording, self.robot, jid.ZeroPhaseButterworth(10.0), jid.Subsample(20)
        )


def paper_truth(base: jid.BaseParameters) -> tuple[np.ndarray, np.ndarray]:
    """Return standard parameters of the cold and the warm arm."""
    model, robot = base.model, base.model.robot
    names = list(model.parameter_names)
    random = np.random.default_rng(0)
    cold = np.zeros(model.size)
    bodies = jid.simulation.random_bodies(robot, np.array(CAD), random)
    for i, body in enumerate(bodies):
        for name, value in zip(
            ("m", "mx", "my", "mz", "A", "B", "C"), body[:7], strict=True
        ):
            cold[names.index(f"{name}{i + 1}")] = value
    largest = np.asarray(robot.max_forces)
    for j in range(7):
        cold[names.index(f"Ia{j + 1}")] = (20.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05)[j]
        cold[names.index(f"fv{j + 1}")] = VISCOUS[j][0] if j < 2 else 0.02 * largest[j]
        cold[names.index(f"fc{j + 1}")] = COULOMB[j][0] if j < 2 else 0.04 * largest[j]
    for name, k, wanted in (("m1", 0, 273.40), ("mx2", 1, 1.68)):
        cold[names.index(name)] += wanted - float(
            np.asarray(base.from_standard(cold))[k]
        )
    warm = cold.copy()
    for j in range(7):
        for kind, numbers in (("fv", VISCOUS), ("fc", COULOMB)):
            before, after = numbers[min(j, 1)]
            warm[names.index(f"{kind}{j + 1}")] *= after / before
    return cold, warm


def cold_and_warm(draws: int) -> list[str]:
    """Return the tables of cold and warm friction (Fig. 7)."""
    terms = (
        jid.RigidBodies(principal_axes=True),
        jid.ViscousFriction(),
        jid.CoulombFriction(),
        jid.RotorInertia(),
    )
    base = jid.base_parameters(jid.Model(jid.robots.tx90l_on_rail(), terms))
    truth = paper_truth(base)
    rig = Rig(base.model, omega=0.8, seed=1)
    clean = [rig.forces(p) for p in truth]
    cold_p, warm_p = (np.asarray(base.from_standard(p)) for p in truth)
    verdicts, nothing, inside, states, shared, widths = [], [], [], [], [], []
    table: list[str] = []
    for seed in range(draws):
        cold, again, warm = (
            jid.identify(base, rig.observe(clean[state], 100 * seed + k), name=name)
            for k, (state, name) in enumerate(((0, "cold"), (0, "again"), (1, "warm")))
        )
        found = jid.compare(cold, warm)
        verdicts.append(found.verdicts)
        nothing.append((jid.compare(cold, again).verdicts, _groups(cold, again)))
        inside.append(np.abs(found.difference - (warm_p - cold_p)) <= found.half_widths)
        both = jid.identify_states([cold, warm])
        tested = both.compare("cold", "warm")
        states.append((tested.verdicts, both.sharing[1]))
        shared.append(_groups(cold, warm))
        apart = cold.standard_deviations[list(both.shared)]
        widths.append(
            np.median(both.fit("cold").standard_deviations[list(both.shared)] / apart)
        )
        if not seed:
            table = _paper_table(base, found, cold_p, warm_p)
    kinds = np.array(found.kinds)
    # States share the parameters that store energy; friction and offsets do not.
    stored = np.isin(np.arange(base.size), both.shared)
    changed = is_verdict("CHANGED", verdicts)
    perhaps = is_verdict("PERHAPS", verdicts)
    of_equals = [row for row, _ in nothing]
    certain = is_verdict("CHANGED", of_equals)
    false = ~is_verdict("UNCHANGED", of_equals)
    of_states = is_verdict("CHANGED", [row for row, _ in states])
    lines = [
        *table,
        "",
        "| kind | parameters | changed | perhaps | intervals that hold the truth |",
    ]
    lines.append("|---|---|---|---|---|")
    for kind in dict.fromkeys(kinds):
        own = kinds == kind
        lines.append(
            f"| {kind} ({'un' if stored[own].all() else ''}changed) | {own.sum()} "
            f"| {_percent(changed[:, own])} | {_percent(perhaps[:, own])} "
            f"| {_percent(np.array(inside)[:, own])} |"
        )
    return [
        *lines,
        "",
        f"| of {draws} draws | share |",
        "|---|---|",
        "| warm: any inertia called changed (allowed 5 %) | "
        f"{_any(changed[:, stored])} |",
        "| warm: all 14 friction parameters called changed | "
        f"{_all(changed[:, ~stored])} |",
        "| warm: friction groups called changed, inertia groups not | "
        f"{np.mean(shared):.0%} |",
        "| nothing changed: outside their own 95 % interval, of all | "
        f"{_percent(false)} |",
        f"| nothing changed: any called changed (allowed 5 %) | {_any(certain)} |",
        f"| nothing changed: any group called changed (allowed 5 %) "
        f"| {np.mean([g for _, g in nothing]):.0%} |",
        "| joint fit of both states: all 14 friction parameters called changed "
        f"| {_all(of_states)} |",
        "| joint fit: sharing of inertia rejected at 5 % "
        f"| {np.mean([p < 1 - LEVEL for _, p in states]):.0%} |",
        "| joint fit: standard deviations of inertia, of those of one run (median) "
        f"| {np.median(widths):.2f} |",
    ]


def is_verdict(name: str, draws) -> np.ndarray:
    """Return which verdicts have this name [draws, parameters]."""
    return np.array([[verdict.name == name for verdict in row] for row in draws])


def _groups(first: jid.Fit, second: jid.Fit) -> bool:
    """Return whether any group (equal states) or just friction (warm) changed."""
    found = {g["name"]: g["changed"] for g in jid.compare(first, second).groups}
    if second.name == "again":
        return any(found.values())
    return all(changed == ("friction" in name) for name, changed in found.items())


def _paper_table(
    base: jid.BaseParameters, found, cold: np.ndarray, warm: np.ndarray
) -> list[str]:
    lines = [
        "| parameter | cold: truth | estimate | warm: truth | estimate | difference | "
        "verdict |",
        "|---|---|---|---|---|---|---|",
    ]
    halves = [e.uncertainty.half_widths(LEVEL) for e in (found.first, found.second)]
    for k in [0, 1, *(base.names.index(n) for n in ("fv1", "fv2", "fc1", "fc2"))]:
        a, b = (
            f"{e.parameters[k]:.3f} ± {h[k]:.3f}"
            for e, h in zip((found.first, found.second), halves, strict=True)
        )
        lines.append(
            f"| p_B({k + 1}), {base.names[k]} [{base.units[k]}] | {cold[k]:.2f} | {a} "
            f"| {warm[k]:.2f} | {b} "
            f"| {found.difference[k]:+.3f} ± {found.half_widths[k]:.3f} "
            f"| {found.verdicts[k].value} |"
        )
    return lines


def _percent(values: np.ndarray) -> str:
    return f"{100 * np.mean(values):.1f} %"


def _any(values: np.ndarray) -> str:
    return f"{np.mean(values.any(axis=1)):.0%}"


def _all(values: np.ndarray) -> str:
    return f"{np.mean(values.all(axis=1)):.0%}"


def panda() -> tuple[jid.BaseParameters, np.ndarray, np.ndarray]:
    """Return base parameters, and standard parameters without and with the tool."""
    virtual = jid.simulation.virtual_panda(0)
    plain = np.array(virtual.parameters)
    loaded = plain.copy()
    names = virtual.model.parameter_names
    loaded[names.index("m7") : names.index("m7") + 10] += np.asarray(TOOL.parameters)
    friction = [k for k, name in enumerate(names) if name.startswith(("fv", "fc"))]
    loaded[friction] *= 1.2
    return jid.base_parameters(virtual.model), plain, loaded


def central_values(tool: jid.Tool) -> np.ndarray:
    """Return mass, centre of mass, and moments about it."""
    central = dataclasses.replace(tool, centre_of_mass=(0.0, 0.0, 0.0))
    moments = np.asarray(central.parameters)[4:]
    return np.concatenate([[tool.mass], tool.centre_of_mass, moments])


def payload(draws: int) -> list[str]:
    """Return tables of payloads (Fig. 8) and of drive gains by the same motions."""
    base, plain, loaded = panda()
    rigs = [Rig(base.model, omega=2 * np.pi / 8, seed=k + 1) for k in range(2)]
    clean = [rig.forces(p) for rig, p in zip(rigs, (plain, loaded), strict=True)]
    wanted = central_values(TOOL)
    masses, inside, estimates, distances, gains, holds = [], [], [], [], [], []
    for seed in range(draws):
        runs = [
            jid.identify(base, rig.observe(f, 10 * seed + k))
            for k, (rig, f) in enumerate(zip(rigs, clean, strict=True))
        ]
        found = jid.identify_payload(*runs)
        estimates.append(found.central)
        masses.append(found.mass / 3.0 - 1.0)
        half = found.uncertainty.half_widths(LEVEL)
        inside.append(np.abs(found.estimate - TOOL.parameters) <= half)
        distances.append(found.distance)
        _ = found.tool
        true = np.random.default_rng(seed).uniform(0.8, 1.2, 7)
        currents = [
            jid.identify(base, rig.observe(f, 10 * seed + k, true))
            for k, (rig, f) in enumerate(zip(rigs, clean, strict=True))
        ]
        drives = jid.identify_drive_gains(*currents, TOOL)
        gains.append(drives.gains / true - 1.0)
        holds.append(
            np.abs(drives.gains - true) <= drives.uncertainty.half_widths(LEVEL)
        )
    first, known = estimates[0]
    lines = [
        "| parameter | truth | estimate (95 %) | largest error of all draws |",
        "|---|---|---|---|",
    ]
    errors = np.abs(np.array([values for values, _ in estimates]) - wanted).max(axis=0)
    halves = known.half_widths(LEVEL)
    for k, (name, unit) in enumerate(CENTRAL_UNITS.items()):
        lines.append(
            f"| {name} [{unit}] | {wanted[k]:.4f} | {first[k]:.4f} ± {halves[k]:.4f} "
            f"| {errors[k]:.4f} |"
        )
    gains = np.array(gains)
    worst = " ".join(f"{100 * x:.2f}" for x in np.abs(gains).max(axis=0))
    return [
        *lines,
        "",
        f"| of {draws} draws | |",
        "|---|---|",
        "| mass: RMS error, largest | "
        f"{100 * np.sqrt(np.mean(np.square(masses))):.2f} %, "
        f"{100 * np.abs(masses).max():.2f} % |",
        "| intervals of the ten parameters that hold the truth | "
        f"{_percent(np.array(inside))} |",
        f"| estimates that belong to a body themselves; largest distance of the others "
        f"| {np.mean(np.array(distances) == 0):.0%}; {max(distances):.1f} standard "
        "deviations |",
        f"| drive gains: RMS error; largest of each joint [%] "
        f"| {100 * np.sqrt(np.mean(gains**2)):.2f} %; {worst} |",
        f"| intervals of the gains that hold the truth | {_percent(np.array(holds))} |",
    ]


def delay(draws: int) -> list[str]:
    """Return the table of delays and of runs that are added to earlier ones."""
    base, plain, _ = panda()
    rig = Rig(base.model, omega=2 * np.pi / 8, seed=1, late=DELAY)
    clean, truth = rig.forces(plain), np.asarray(base.from_standard(plain))
    found, inside, before, after, apart = [], [], [], [], []
    for seed in range(draws):
        recording = rig.record(clean, seed)
        late = rig.rows(recording)
        one = jid.estimate_delay(base.model, recording)
        low, high = one.interval(LEVEL)
        mended = rig.rows(jid.remove_delay(recording, one.seconds))
        fits = [jid.identify(base, o) for o in (late, mended)]
        found.append(one.seconds)
        inside.append(low <= DELAY <= high)
        for fit, kept in zip(fits, (before, after), strict=True):
            kept.append(
                np.median(np.abs(fit.parameters - truth) / fit.standard_deviations)
            )
        others = [rig.observe(clean, 1000 + 10 * seed + k) for k in range(3)]
        together = jid.identify(base, others).parameters
        earlier, *later = (jid.identify(base, o) for o in others)
        for run in later:
            earlier = jid.combine_fits(earlier, run)
        apart.append(
            np.linalg.norm(earlier.parameters - together) / np.linalg.norm(together)
        )
    errors = 1e6 * (np.array(found) - DELAY)
    return [
        f"| of {draws} draws | |",
        "|---|---|",
        f"| delay of {1e3 * DELAY:g} ms (sample time {1e3 * SAMPLE_TIME:g} ms): "
        f"mean error, RMS | {errors.mean():.1f} µs, "
        f"{np.sqrt(np.mean(errors**2)):.1f} µs |",
        f"| its 95 % intervals that hold the truth | {np.mean(inside):.0%} |",
        "| errors of the parameters in standard deviations (median), delay left in; "
        f"removed | {np.mean(before):.2f}; {np.mean(after):.2f} |",
        "| three runs, added one by one, against all at once: largest relative "
        f"difference | {max(apart):.0e} |",
    ]


STUDIES = {"cold": (cold_and_warm, 100), "payload": (payload, 30), "delay": (delay, 30)}


def main() -> None:
    """Print the tables."""
    parser = timing.parser(__doc__, "one draw of each")
    parser.add_argument("studies", nargs="*", default=list(STUDIES))
    options = parser.parse_args()
    for name in options.studies:
        study, draws = STUDIES[name]
        print("\n".join(study(1 if options.quick else draws)), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
