"""What users give by mistake, and what `jaxid` says: a table of every bad input.

    python benchmarks/bad_input.py [--quick] [--json FILE]

A planar arm of two joints behind gears, a log of 6 s at 200 Hz with noise, and one mistake at a
time in log, experiment file, URDF or command. What cannot be used must end with exit code 2 and one
sentence that has the words in the table; what can be used although something is wrong must be named
(exit code 0, the words stand in the output). Wrong are other exit codes, tracebacks, sentences
without those words, and files or folders that stay behind after exit code 2. All run in this
process, one after the other; the time is that of the command.
"""

import argparse
import contextlib
import io
import os
import re
import sys
import tempfile
import time
from pathlib import Path

import timing
from timing import Row, hand_over

EXPERIMENT = """\
[robot]
builtin = "planar_arm"
[limits]
angle_unit = "deg"
position_min = [-150, -150]
position_max = [150, 150]
velocity = [400, 400]
force = [80, 30]
[drives]
gear_ratios = [100, -80]
[recording]
angles = "q{}"
forces = "tau{}"
time = "t"
[filter]
kind = "butterworth"
cutoff = 10
[rows]
every = 4
"""
JOINT = (
    '<joint name="{0}" type="{3}"><parent link="{1}"/><child link="{2}"/>'
    '<axis xyz="0 1 0"/>{4}</joint>'
)
INSPECT = ("inspect", "e.toml", "x.csv")
IMPOSSIBLE = "no motion was found that keeps all limits: the force of joint `j` exceeds"
UNKNOWN = "j turns \u2013 \u2013 \u2013"
DIAGNOSED, REFUSED = 0, 2


def log():
    """Header and rows of a good log."""
    import numpy as np

    import jaxid as jid

    model = jid.Model(jid.robots.planar_arm(2))
    t = 0.005 * np.arange(1200)
    w = 1.3 * np.arange(1, 5)[:, None]
    a, b = np.random.default_rng(1).uniform(-0.25, 0.25, (2, 4, 2))
    s, c = np.sin(w * t), np.cos(w * t)
    parts = s.T @ a + c.T @ b, (w * c).T @ a - (w * s).T @ b, -(w**2 * s).T @ a - (w**2 * c).T @ b
    sizes = {"m": 2.0, "mx": 1.0, "A": 0.2, "B": 0.6, "C": 0.6, "fv": 0.4, "fc": 1.0}
    p = [sizes.get(name.rstrip("0123456789"), 0.0) for name in model.parameter_names]
    forces = np.asarray(model.inverse_dynamics(np.array(p), jid.Motion(*parts)))
    forces = forces + np.random.default_rng(2).normal(0.0, 0.02, forces.shape)
    return np.column_stack([t, parts[0], forces])


def text(rows, header="t,q1,q2,tau1,tau2"):
    """A log as a file."""
    return "\n".join([header, *(",".join(f"{x:.9g}" for x in row) for row in rows)]) + "\n"


def changed(rows, **columns):
    """A log some of whose columns are others."""
    import numpy as np

    out = np.array(rows)
    for name, value in columns.items():
        out[:, ("t", "q1", "q2", "tau1", "tau2").index(name)] = value
    return text(out)


def logs(good):
    """Mistakes in a log: name, file, exit code, words."""
    import numpy as np

    t, q1, q2, tau1, tau2 = good.T
    lines = text(good).splitlines()

    def cell(row, value):
        return "\n".join([*lines[:row], value, *lines[row + 1 :]])

    stands = np.repeat(good[:1], len(good), axis=0)
    stands[:, 0] = t
    gap = np.delete(good, slice(300, 400), axis=0)
    slow = good[::40]
    cut = np.clip(tau1, np.quantile(tau1, 0.05), np.quantile(tau1, 0.95))
    seven = np.column_stack([t, *[q1] * 7, *[tau1] * 7])
    head = ",".join(["t", *(f"q{k}" for k in range(1, 8)), *(f"tau{k}" for k in range(1, 8))])
    wrapped = (q1 + 0.6 + np.pi) % (2 * np.pi) - np.pi
    wrapped = np.where(np.arange(len(t)) > 600, wrapped - 2 * np.pi, wrapped)
    spike = np.array(good)
    spike[501, 1] += 0.5
    quoted = [f"{line},moving" for line in lines]
    quoted[100], quoted[900] = f'{lines[100]},"start', f'{lines[900]},end"'

    def held(column, first, last, value=None):
        out = np.array(good)
        out[first:last, column] = out[first, column] if value is None else value
        return text(out)

    return [
        (
            "a column is missing",
            text(good, "t,q1,q2,tau1,current"),
            2,
            "`forces` in `x.csv` have 1",
        ),
        ("forces of two joints swapped", changed(good, tau1=tau2, tau2=tau1), 0, "exchanged"),
        ("angles of two joints swapped", changed(good, q1=q2, q2=q1), 0, "exchanged"),
        (
            "degrees taken for radians",
            changed(good, q1=np.rad2deg(q1), q2=np.rad2deg(q2)),
            0,
            "angle_unit",
        ),
        ("milliseconds taken for seconds", changed(good, t=1e3 * t), 2, "check `time_unit`"),
        (
            "motor side taken for joint side",
            changed(good, q1=100 * q1, q2=-80 * q2, tau1=tau1 / 100, tau2=-tau2 / 80),
            0,
            "side",
        ),
        ("sign of one joint's force", changed(good, tau2=-tau2), 0, "sign of the force of joint"),
        ("sign of one joint's angle", changed(good, q2=-q2), 0, "sign of the angle of joint"),
        ("a channel that is constant", changed(good, tau2=3.0), 0, "are 3 throughout"),
        ("a channel that is dead", changed(good, tau2=0.0), 0, "are zero throughout"),
        ("not a number", cell(7, "0.03,nan,0,0,0"), 2, "`q1` of `x.csv`, line 8"),
        ("infinity", cell(7, "0.03,inf,0,0,0"), 2, "`q1` of `x.csv`, line 8"),
        ("an empty cell", cell(7, "0.03,,0,0,0"), 2, "`q1` of `x.csv`, line 8, is empty"),
        ("a word for a number", cell(7, "0.03,off,0,0,0"), 2, "line 8, is `off`, no number"),
        ("a number beyond 1e30", cell(7, "0.03,1e31,0,0,0"), 2, "which nothing measures"),
        ("lines of different length", cell(7, "0.03,0,0,0,0,0"), 2, "repair or remove"),
        ("duplicate time stamps", cell(8, lines[7]), 0, "repeat the time stamp"),
        ("time that runs backwards", text(good[::-1]), 2, "runs backwards"),
        ("time that stands still", changed(good, t=1.0), 2, "stands still"),
        ("a gap", text(gap), 0, "1 gap in time"),
        ("clipped forces", changed(good, tau1=cut), 0, "drive or a sensor is at its limit"),
        ("too low a sampling rate", text(slow), 2, "half of the sampling rate of 5 Hz"),
        ("standstill only", text(stands), 0, "cannot be told from this log"),
        ("encoder wrap-around", changed(good, q1=wrapped), 0, "undo the wrapping"),
        ("the log of another robot", text(seven, head), 2, "names 7 of the columns"),
        ("a header and no rows", lines[0] + "\n", 2, "but no rows"),
        ("an empty file", "", 2, "but is empty"),
        ("text in UTF-16", text(good).encode("utf-16"), 2, "save it again in UTF-8"),
        ("bytes that are no text", bytes(range(256)) * 9, 2, "`x.csv`"),
        ("a delay of 40 ms", text(_late(good)), 0, "force_delay"),
        ("a force that is held", held(4, 600, None), 0, "stay at 5.68 from 3 s to 5.995 s"),
        ("an angle that is held", held(2, 600, None), 0, "stays at 0.382 from 3 s to 5.995 s"),
        ("a force that drops out", held(3, 400, 600, 0.0), 0, "stay at 0 from 2 s to 2.995 s"),
        ("a spike", text(spike), 0, "`joint1` jumps by 0.497 and back at 2.505 s"),
        ("a quotation over many rows", "\n".join(quoted), 2, "line 101 of `x.csv` opens a quo"),
        ("carriage returns alone", "\r".join(lines), 2, "carriage returns alone"),
        (
            "one number in two columns",
            "\n".join([f"{lines[0]},q01", *(f"{line},0" for line in lines[1:])]),
            2,
            "`q1` and `q01`, which both are number 1",
        ),
    ]


def _late(good, samples=8):
    import numpy as np

    return np.column_stack([good[:-samples, :1], good[samples:, 1:3], good[:-samples, 3:]])


def files():
    """Mistakes in an experiment file: name, what is replaced by what, words."""
    return [
        ("a misspelt key", "cutoff", "cuttoff", "did you mean `cutoff`?"),
        ("a misspelt table", "[recording]", "[recordings]", "did you mean `recording`?"),
        (
            "an unknown unit",
            'time = "t"',
            'time = "t"\nangle_unit = "degrees"',
            "did you mean `deg`?",
        ),
        ("a unit of something else", 'time = "t"', 'time = "t"\nangle_unit = "A"', "measure"),
        ("a list of the wrong length", "[80, 30]", "[80, 30, 9]", "one value for each of the 2"),
        ("a text for a number", "cutoff = 10", 'cutoff = "10"', "must be a number"),
        ("a negative limit", "[80, 30]", "[-80, 30]", "`force`"),
        ("limits that contradict", "[150, 150]", "[-160, 150]", "limits"),
        ("currents without constants", '"t"', '"t"\nforce_unit = "A"', "`torque_constants`"),
        ("a gear ratio of zero", "[100, -80]", "[0, -80]", "drives"),
        ("both of time and sample time", '"t"', '"t"\nsample_time = 0.1', "not both"),
        ("one column for two channels", '"tau{}"', '"q{}"', "is used for `angles` and `forces`"),
        ("an unknown robot", '"planar_arm"', '"panada"', "none of the robots"),
        ("a URDF that is not there", 'builtin = "planar_arm"', 'urdf = "x/arm.urdf"', "no file"),
        ("no TOML", "[robot]", "[robot", "is no TOML"),
        ("an order beyond all", "cutoff = 10", "cutoff = 10\norder = 3000", "20 at most"),
        ("a cut-off of nearly zero", "cutoff = 10", "cutoff = 1e-12", "`cutoff` of 1e-12 Hz is"),
        (
            "an infinite period",
            'kind = "butterworth"\ncutoff = 10',
            'kind = "periodic"\nharmonics = 5\nperiod = inf',
            "`period`",
        ),
        ("seconds taken for milliseconds", '"t"', '"t"\ntime_unit = "ms"', "check `time_unit`"),
        ("a filter above half the rate", "cutoff = 10", "cutoff = 120", "sampling rate of 200 Hz"),
    ]


def robots():
    """Mistakes in a URDF: name, text, exit code, words."""
    links = "".join(f'<link name="{x}"/>' for x in "abc")

    def arm(*joints, body=links, head=""):
        return f'{head}<robot name="arm">{body}{"".join(joints)}</robot>'

    def joint(name, parent, child, kind="continuous", more=""):
        return JOINT.format(name, parent, child, kind, more)

    chain = joint("j", "a", "b"), joint("k", "b", "c")
    long = [joint(f"j{k}", f"l{k}", f"l{k + 1}") for k in range(60)]
    sixty = "".join(f'<link name="l{k}"/>' for k in range(61))
    absurd = (
        '<link name="a"/><link name="b"><inertial><mass value="-1e9"/><inertia ixx="-1" ixy="0" '
        'ixz="0" iyy="1e300" iyz="0" izz="0"/></inertial></link><link name="c"/>'
    )
    entity = '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    bomb = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]>'
    rounded = '<origin xyz="0 0 1" rpy="1.5708 0 0"/>'
    outside = links.replace(
        '<link name="c"/>',
        '<link name="c"><visual><geometry><mesh filename="../../../etc/passwd"/></geometry>'
        "</visual></link>",
    )
    return [
        ("a closed loop", arm(*chain, joint("m", "a", "c")), 2, "closed loops"),
        ("a loop without a root", arm(*chain, joint("m", "c", "a")), 2, "closed loop"),
        ("a floating base", arm(joint("j", "a", "b", "floating"), chain[1]), 2, "is floating"),
        (
            "a mimic joint",
            arm(chain[0], joint("k", "b", "c", more='<mimic joint="j"/>')),
            2,
            "mimics joint `j`",
        ),
        (
            "a zero axis",
            arm(chain[0].replace("0 1 0", "0 0 0"), chain[1]),
            2,
            "the zero vector as its axis",
        ),
        ("limits missing", arm(joint("j", "a", "b", "revolute"), chain[1]), 0, UNKNOWN),
        (
            "limits that contradict",
            arm(joint("j", "a", "b", "revolute", '<limit lower="1" upper="-1"/>'), chain[1]),
            2,
            "the lower end must be below",
        ),
        ("absurd inertias", arm(*chain, body=absurd), 0, "belongs to no body: its mass is -1e"),
        ("rounded angles", arm(joint("j", "a", "b", more=rounded), chain[1]), 0, "snapped"),
        ("two roots", arm(chain[0]), 2, "several root links"),
        ("a link that is not there", arm(joint("j", "a", "z")), 2, "does not define"),
        (
            "no moving joint",
            arm(joint("j", "a", "b", "fixed"), joint("k", "b", "c", "fixed")),
            2,
            "no moving joint",
        ),
        ("one joint", arm(chain[0], body=links[:32]), 0, "1 joint"),
        ("sixty joints", arm(*long, body=sixty), 0, "60 joints"),
        ("an entity that reads a file", arm(*chain, head=entity), 2, "DOCTYPE"),
        ("entities of entities", arm(*chain, head=bomb), 2, "DOCTYPE"),
        ("a path out of the folder", arm(*chain, body=outside), 0, "2 joints"),
        (
            "a xacro file",
            '<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:a/></robot>',
            2,
            "xacro",
        ),
        ("no XML", "robot", 2, "this is not XML"),
        ("no URDF", "<sdf/>", 2, "its root is `<sdf>`"),
    ]


def commands():
    """Mistakes on the command line: name, arguments, words."""
    identify = ("identify", "e.toml", "x.csv")
    return [
        ("verified by its own log", (*identify, "--verify", "x.csv"), "both to identify and to v"),
        ("`--verify` without a log", (*identify, "--verify"), "needs at least one log"),
        ("a split of 2", (*identify, "--split", "2"), "must lie between 0 and 1"),
        ("a log that is not there", ("inspect", "e.toml", "y.csv"), "is no file"),
        ("a log of another kind", ("inspect", "e.toml", "e.toml"), "must end in .csv"),
        ("a log given twice", (*identify, "./x.csv"), "is given twice"),
        ("a report onto a file", (*identify, "-o", "x.csv"), "is a file"),
        ("a report among other files", (*identify, "-o", "."), "no report"),
        ("a motion onto a log", ("excite", "e.toml", "-o", "x.csv"), "no motion"),
        ("a design that cannot be", ("excite", "weak.toml", "-o", "m.csv"), IMPOSSIBLE),
        (
            "a margin without parameters",
            ("excite", "margin.toml", "-o", "m.csv"),
            "`force_margin` needs par",
        ),
    ]


def run(args):
    """Exit code, what was said, and how long it took."""
    from jaxid import cli

    out, began = io.StringIO(), time.perf_counter()
    before, sys.argv = sys.argv, ["jaxid", *args]
    code = 1
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            cli.main()
    except SystemExit as stopped:
        code = stopped.code or 0
    except BaseException as error:
        out.write(f"Traceback: {error!r}")
    finally:
        sys.argv = before
    return code, " ".join(out.getvalue().split()), time.perf_counter() - began


def cases(good):
    """Name, files, arguments, exit code and words of every case."""
    for name, held, code, words in logs(good):
        yield name, {"x.csv": held}, INSPECT, code, words
    for name, old, new, words in files():
        changed_file = EXPERIMENT.replace(old, new)
        yield name, {"e.toml": changed_file, "x.csv": text(good)}, INSPECT, REFUSED, words
    for name, held, code, words in robots():
        toml = '[robot]\nurdf = "arm.urdf"\n'
        yield name, {"e.toml": toml, "arm.urdf": held}, ("inspect", "e.toml"), code, words
    inertial = '<inertial><origin xyz="1 0 0"/><mass value="100"/><inertia ixx="1" ixy="0" ixz="0" '
    inertial += 'iyy="1" iyz="0" izz="1"/></inertial>'
    limit = '<limit lower="-1" upper="1" velocity="2" effort="1"/>'
    arm = f'<robot name="arm"><link name="a"/><link name="b">{inertial}</link>'
    arm += f"{JOINT.format('j', 'a', 'b', 'revolute', limit)}</robot>"
    weak = '[robot]\nurdf = "arm.urdf"\n[excitation]\nharmonics = 2\nstarts = 1\npolish = 0\n'
    weak += "generations = 0\nsamples = 50\nforce_margin = 0.1\n"
    for name, args, words in commands():
        held = {"x.csv": text(good), "weak.toml": weak, "arm.urdf": arm}
        held["margin.toml"] = EXPERIMENT + "[excitation]\nforce_margin = 0.9\n"
        yield name, held, args, REFUSED, words


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json")
    given = parser.parse_args()
    timing.pin_to(1)
    os.environ["JAXID_CACHE_DIR"] = "off"
    os.environ["COLUMNS"] = "400"
    import jax

    jax.config.update("jax_enable_x64", True)
    good = log()
    print("| input | what is said | exit code | seconds | left behind | right |")
    print("|---|---|---|---|---|---|")
    tried, wrong, slowest, home = 0, [], 0.0, Path.cwd()
    for number, (name, held, args, expected, words) in enumerate(cases(good)):
        if given.quick and number % 6:
            continue
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            for file, content in {"e.toml": EXPERIMENT, **held}.items():
                data = content if isinstance(content, bytes) else content.encode()
                Path(file).write_bytes(data)
            before = sorted(Path().rglob("*"))
            code, said, seconds = run(args)
            left = len(set(Path().rglob("*")) - set(before))
            os.chdir(home)
        sentences = re.split(r"(?<=[.?]) (?=[a-z`A-Z!])| [!·] ", said)
        shown = next((s for s in sentences if words and words in s), said)[:200]
        right = code == expected and words in said and "Traceback" not in said
        right = right and not (code == REFUSED and left)
        tried, slowest = tried + 1, max(slowest, seconds)
        if not right:
            wrong.append(name)
        shown = shown.replace("|", "/")
        print(f"| {name} | {shown} | {code} | {seconds:.2f} | {left} | {right} |", flush=True)
    rows = [
        Row(
            "bad input",
            "bad inputs",
            "one mistake at a time in log, experiment file, URDF or command",
            "wrong answers: 0",
            f"{tried} tried, {len(wrong)} wrong {wrong or ''}; the slowest took {slowest:.1f} s",
            not wrong,
        )
    ]
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
