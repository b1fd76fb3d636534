"""Fuzzes the readers, model files included; every error must be a sentence for the user.

    python benchmarks/fuzz.py [--quick] [--minutes 8] [--target csv …] [--out FOLDER]

Each target writes the fuzzer's bytes into a file and reads it as a user would. Right is a result in
which every number is finite, or an error that `jaxid.experiment.failures` takes for one of the
user's; anything else, warnings of NumPy included, is a crash, kept once for each line that raised
it, with its input. With `atheris` (pip install atheris) the fuzzer is guided by the coverage of
`jaxid`; without it, and with `--quick`, good files are only mutated at random. One process for
each target, one after the other. The table: executions, CPU time, distinct crashes.
"""

import argparse
import contextlib
import copy
import importlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from pathlib import Path

import timing

os.environ["JAX_PLATFORMS"] = "cpu"
TARGETS = ("urdf", "toml", "csv", "npz", "npy", "json", "run", "model")
LONGEST = 4096
URDF = """<robot name="r"><link name="a"/><link name="b"><inertial>
<origin xyz="0 0 .1" rpy="0 0 0"/>
<mass value="2"/><inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial></link>
<link name="c"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/>
<origin xyz="0 0 .3" rpy="0 1.5708 0"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="50" velocity="3"/></joint>
<joint name="k" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="1 0 0"/>
<limit upper="1" effort="5" velocity="1"/></joint></robot>"""
TOML = """[robot]
builtin = "planar_arm"
gravity = [0, 0, -9.81]
[robot.tool]
mass = 0.5
centre_of_mass = [0, 0, 0.1]
inertia = { xx = 0.01, yy = 0.01, zz = 0.01, xy = 0, xz = 0, yz = 0 }
[limits]
force = [80, 20]
velocity = [180, 180]
angle_unit = "deg"
[drives]
gear_ratios = [100, -50]
max_torques = [1, 1]
zero = [0, 0]
rotor_inertia = [1e-4, 1e-4]
[model]
viscous = true
springs = true
[model.coulomb]
epsilon = [0.01, 0.02]
[recording]
angles = ["q1", "q2"]
forces = "i{}"
force_unit = "A"
torque_constants = [1.0, 2.0]
time = "t"
time_unit = "ms"
start = 1.0
force_delay = 0.001
[filter]
kind = "butterworth"
cutoff = [5, 10]
[rows]
factors = [5, 2]
slow = [0.01, 0.01]
[estimator]
kind = "weighted"
ridge = 0.1
[excitation]
harmonics = 3
omega = 0.5
"""
DH = """[robot]
convention = "standard"
[[robot.dh]]
alpha = 90
a = 0.1
d = 0.2
theta = 0
[[robot.dh]]
alpha = 0
a = 0.5
d = 0
theta = 45
slides = true
[collision]
distance = 0.01
[[collision.boxes]]
name = "table"
centre = [1, 1, 0]
size = [1, 1, 0.1]
[[collision.capsules]]
name = "arm"
body = "joint2"
start = [0, 0, 0]
end = [0, 0, 1]
radius = 0.1
[filter]
kind = "paper"
"""
WORDS = (
    *("nan", "inf", "-inf", "1e999", "-0", "1e-320", "9" * 30, "0x1p3", "true", "null", "é", "\0"),
    *(
        "\r\n",
        "\n\n",
        ",,",
        ";",
        "\t",
        '"',
        "''",
        "[[",
        "]]",
        "{",
        "}",
        "=",
        "#",
        "<",
        "/>",
        "&lt;",
    ),
    *("<!DOCTYPE r>", "<!ENTITY a 'b'>", "floating", "planar", "fixed", "continuous", "mimic"),
    *("axis", "limit", "robot", "joint", "link", "convention", "modified", "periodic", "deg"),
    *("robot.urdf", "../../etc/passwd", "/dev/zero", "1970-01-01T00:00:00", "q{}", "{}", "{0}"),
    *("kind", "version", "1e30", "1e308", "18446744073709551616", "1_000", "\ufeff", "PK\x03\x04"),
)


VALUES = (
    *(None, True, 0, -1, 1.5, 2**70, -(2**63), 1e308, float("nan"), float("inf")),
    *("", "x", "é\0", "jaxid.robot.robot.Robot", "os.system", [], {}, [[]], [1, "a"], {"a": None}),
)
"""What stands in JSON where something else stood."""


def seeds(target):
    """Good files to begin with."""
    import io

    import numpy as np

    t = 0.01 * np.arange(30)
    q = np.sin(np.outer(t, [1.0, 2.0]))
    table = np.column_stack([t, q, 3 * q])
    if target == "urdf":
        return [URDF.encode()]
    if target == "toml":
        return [TOML.encode(), DH.encode(), b'[robot]\nurdf = "arm.urdf"\n']
    if target == "csv":
        lines = [",".join(f"{x:.4g}" for x in row) for row in table]
        head = "t,q1,q2,tau1,tau2"
        text = "\n".join([head, *lines])
        german = text.replace(",", ";").replace(".", ",")
        return [text.encode(), german.encode(), text.replace(",", " ").encode()]
    if target == "npz":
        buffer = io.BytesIO()
        np.savez(buffer, t=t, q=q, tau=3 * q)
        return [buffer.getvalue()]
    if target == "npy":
        buffers = io.BytesIO(), io.BytesIO()
        for buffer, order in zip(buffers, "CF", strict=True):
            np.save(buffer, np.asarray(q, order=order))
        return [buffer.getvalue() for buffer in buffers]
    if target == "run":
        with np.load(written(target)[0]) as arrays:
            return [str(arrays["head"]).encode()]
    return [path.read_bytes() for path in written(target)]


def written(target):
    """Files that the package has written itself."""
    import numpy as np

    import jaxid as jid
    from jaxid.identification.runs.update import save_run

    folder = Path(tempfile.mkdtemp(prefix="jaxid-fuzz-"))
    arm = base()
    series = jid.random_fourier_series(arm.model.robot, omega=0.8, harmonics=2, seed=0)
    if target == "json":
        jid.save_trajectory(series, folder / "t.json")
        jid.save_trajectory(jid.RestToRest(series, 2), folder / "r.json")
        names = ("name", "expression", "unit")
        rows = [{**dict.fromkeys(names, "x"), "estimate": 1.0, "degrees_of_freedom": 5.0}]
        result = {"schema": "jaxid-result/1", "base_parameters": rows, "fit": {"covariance": [[1]]}}
        (folder / "result.json").write_text(json.dumps(result))
        return sorted(folder.iterdir())
    motion = series.motion(0.01 * np.arange(300))
    forces = arm.model.inverse_dynamics(np.ones(arm.model.size), motion)
    log = jid.Recording.of(motion.q, forces, sample_time=0.01)
    rows = jid.Rows.of(arm, [jid.observe(log, arm.model.robot, jid.ZeroPhaseButterworth(10.0))])
    fit = jid.fit_rows(rows, jid.LeastSquares())
    if target == "model":
        return [fit.save(folder / "arm.json")]
    save_run(folder / "run.npz", jid.Run.of_rows(rows, fit))
    return [folder / "run.npz"]


def base():
    """What runs are of."""
    import jaxid as jid

    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2), (jid.RigidBodies(),)))


def reader(target, folder):
    """What reads a file of bytes, and refuses results that are not finite."""
    import numpy as np

    import jaxid as jid
    from jaxid.experiment.experiment import load_experiment
    from jaxid.identification.model_file import checksum_of
    from jaxid.measurement.parts import estimated_rows, open_parts
    from jaxid.report.compared_files import read_estimates

    def finite(*arrays):
        if not all(np.isfinite(np.asarray(x)).all() for x in arrays):
            raise AssertionError("a result is not finite")

    def urdf(path):
        robot = jid.load_urdf(path)
        finite(robot.rotation, robot.offset, robot.axis, jid.urdf_parameters(path))

    def toml(path):
        load_experiment(path)

    def csv(path):
        estimated_rows(path)
        named = jid.Columns("q{}", "tau{}", time="t")
        placed = jid.Columns((1, 2), (3, 4), time=0)
        for columns in (named, placed):
            try:
                log = jid.read_recording(path, columns)
            except ValueError as error:
                refuse_bug(error)
            else:
                finite(log.time, log.angles, log.forces)
        parts = open_parts(path)
        if parts.rows:
            parts.part(0, parts.rows)

    def npz(path):
        log = jid.read_recording(path, jid.Columns("q", "tau", time="t"))
        finite(log.time, log.angles, log.forces)

    def text(path):
        for read in (jid.load_trajectory, read_estimates):
            try:
                read(path)
            except ValueError as error:
                refuse_bug(error)

    def npy(path):
        """An array in an archive whose sums are right: read as a whole, and mapped."""
        data = path.read_bytes()
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("q.npy", data)
            archive.writestr("tau.npy", seeds("npy")[0])
        columns = jid.Columns("q", "tau", sample_time=0.01)
        try:
            log = jid.read_recording(path, columns)
        except ValueError as error:
            refuse_bug(error)
        else:
            finite(log.time, log.angles, log.forces)
        parts = open_parts(path)
        if parts.rows:
            parts.part(0, min(parts.rows, 100)).array("angles", "q")

    arm = base() if target == "run" else None
    whole = {}
    if target == "run":
        with np.load(written(target)[0]) as arrays:
            whole = dict(arrays)

    def run(path):
        """A file whose arrays are whole, with another head."""
        head = path.read_bytes().decode("utf-8", "replace")
        np.savez(path, **{**whole, "head": np.array(head)})
        jid.load_run(path, arm)

    def model(path):
        """A model file whose checksum fits its content, where it is JSON at all."""
        text = path.read_bytes().decode("utf-8", "replace")
        with contextlib.suppress(ValueError, RecursionError):
            document = json.loads(text)
            if isinstance(document, dict) and "model" in document:
                document["checksum"] = checksum_of(document["model"])
                text = json.dumps(document)
        path.write_text(text, encoding="utf-8", errors="replace")
        finite(jid.load(path).parameters)

    readers = {"urdf": urdf, "toml": toml, "csv": csv, "npz": npz, "npy": npy}
    readers |= {"json": text, "run": run, "model": model}
    suffix = {"run": "npz", "npy": "npz", "model": "json"}.get(target, target)
    path = folder / f"log.{suffix}"
    (folder / "arm.urdf").write_text(URDF)

    def read(data):
        path.write_bytes(data)
        readers[target](path)

    return read


def refuse_bug(error):
    from jaxid.experiment.failures import is_for_the_user

    if not is_for_the_user(error):
        raise error


class Watch:
    """Counts executions, and keeps one input of each kind of crash."""

    def __init__(self, target, read, out, minutes):
        self.target, self.read, self.out, self.minutes = target, read, out, minutes
        self.executions, self.began, self.crashes, self.slowest = 0, time.process_time(), {}, 0.0
        self.out.mkdir(parents=True, exist_ok=True)

    def take(self, data):
        """Reads one input."""
        began = time.process_time()
        try:
            self.read(data)
        except Exception as error:
            from jaxid.experiment.failures import is_for_the_user

            if not is_for_the_user(error):
                self.keep(error, data)
        self.executions += 1
        took = time.process_time() - began
        if took > self.slowest:
            self.slowest = took
            (self.out / f"{self.target}-slowest").write_bytes(data)
        if self.executions % 100 == 0:
            self.tell()
            if time.process_time() - self.began > 60 * self.minutes:
                # The fuzzer has no way to be told that it is enough.
                os._exit(0)

    def keep(self, error, data):
        """One input of each place in the package."""
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if f"{os.sep}jaxid{os.sep}" in f.filename]
        last = own[-1] if own else frames[-1]
        name = f"{Path(last.filename).name}:{last.lineno}:{type(error).__name__}"
        if name not in self.crashes:
            self.crashes[name] = str(error)[:300]
            (self.out / f"{self.target}-{name.replace(':', '-')}").write_bytes(data)
            self.tell()

    def tell(self):
        """Where it stands."""
        found = {
            "target": self.target,
            "executions": self.executions,
            "seconds": time.process_time() - self.began,
            "slowest": self.slowest,
            "crashes": self.crashes,
        }
        (self.out / f"{self.target}.json").write_text(json.dumps(found, indent=1))


def mutated(data, chance):
    """A file with some of its bytes changed, doubled, lost, or replaced by a word."""
    out = bytearray(data)
    for _ in range(chance.randint(1, 6)):
        a = chance.randrange(len(out) + 1)
        b = min(len(out), a + chance.choice((0, 1, 1, 3, 8, 40)))
        kind = chance.randrange(4)
        if kind == 0:
            out[a:b] = chance.choice(WORDS).encode()
        elif kind == 1:
            out[a:b] = chance.randbytes(b - a)
        elif kind == 2:
            out[a:a] = out[a:b]
        else:
            del out[a:b]
    return bytes(out)


def grafted(data, chance):
    """JSON with some of its values replaced by others, so that it stays JSON."""
    try:
        tree = [json.loads(data)]
    except (ValueError, RecursionError):
        return mutated(data, chance)
    for _ in range(chance.randint(1, 3)):
        place = tree
        while True:
            key = chance.choice(list(place) if isinstance(place, dict) else range(len(place)))
            if not (isinstance(place[key], dict | list) and place[key]) or chance.random() < 0.1:
                break
            place = place[key]
        other = copy.deepcopy(chance.choice((*VALUES, place[key])))
        if isinstance(place, dict) and chance.random() < 0.2:
            place[chance.choice(WORDS)] = place.pop(key)
        elif isinstance(place, list) and chance.random() < 0.2:
            place.insert(key, other)
        else:
            place[key] = other
        if not tree:
            break
    return json.dumps(tree[0] if tree else None).encode("utf-8", "replace")


def child(target, minutes, out, guided):
    """One target in this process."""
    if guided:
        import atheris

        with atheris.instrument_imports(include=["jaxid"]):
            importlib.import_module("jaxid.experiment.experiment")
    import jax

    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("error", RuntimeWarning)
    folder = Path(tempfile.mkdtemp(prefix="jaxid-fuzz-"))
    good = seeds(target)
    read = reader(target, folder)
    change = grafted if target in ("json", "model") else mutated
    for one in good:
        read(one)
    watch = Watch(target, read, out, minutes)
    if not guided:
        chance = random.Random(1)
        while True:
            watch.take(change(chance.choice(good), chance))
    corpus, words = folder / "corpus", folder / "words"
    corpus.mkdir()
    for k, one in enumerate(good):
        (corpus / str(k)).write_bytes(one)
    quoted = ("".join(f"\\x{b:02x}" for b in word.encode()) for word in WORDS)
    words.write_text("".join(f'"{word}"\n' for word in quoted))
    longest = max(LONGEST, *(2 * len(one) for one in good))
    limits = ["-use_value_profile=1", f"-max_len={longest}", "-timeout=600"]

    def by_chance(data, room, seed):
        chance = random.Random(seed)
        if chance.random() < 0.5:
            return atheris.Mutate(data, room)
        return change(data, chance)[:room]

    atheris.Setup(
        [sys.argv[0], *limits, "-rss_limit_mb=6000", "-verbosity=0", f"-dict={words}", str(corpus)],
        watch.take,
        custom_mutator=by_chance,
    )
    atheris.Fuzz()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--target", nargs="*", default=TARGETS)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "jaxid-fuzz")
    parser.add_argument("--child")
    parser.add_argument("--random", action="store_true", help="without coverage")
    given = parser.parse_args()
    minutes = 0.03 if given.quick else given.minutes
    guided = not (given.quick or given.random or timing.missing("atheris"))
    if given.child:
        child(given.child, minutes, given.out, guided)
        return
    print("| reader | executions | CPU time [min] | slowest [s] | crashes |\n|---|---|---|---|---|")
    for target in given.target:
        (given.out / f"{target}.json").unlink(missing_ok=True)
        command = [sys.executable, __file__, "--child", target, "--minutes", str(minutes)]
        command += ["--out", str(given.out)] + ([] if guided else ["--random"])
        done = subprocess.run(command, capture_output=True, text=True)
        file = given.out / f"{target}.json"
        if done.returncode or not file.exists():
            print(f"{target} ended with {done.returncode}:\n{done.stderr[-3000:]}", file=sys.stderr)
        if not file.exists():
            continue
        found = json.loads(file.read_text())
        print(
            f"| {target} | {found['executions']} | {found['seconds'] / 60:.1f} "
            f"| {found['slowest']:.2f} | {len(found['crashes'])} |",
            flush=True,
        )
        for name, said in found["crashes"].items():
            print(f"  {name}: {said}", file=sys.stderr)


if __name__ == "__main__":
    main()
