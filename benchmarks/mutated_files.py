"""Damaged and hostile files of every reader: results, refusals, and anything else.

    python benchmarks/mutated_files.py [--quick] [--json FILE] [--kind npz]
        [--number 17] [--show] [--each 16]

Files: `file_samples.py`. Each is damaged `--each` times by a random number generator
with the kind's name and the number as its seed: bits, bytes and words changed, removed
and doubled, numbers replaced, lines and elements doubled, dropped and exchanged, sizes
overwritten. Some are written to be hostile: empty, a folder, nested without end, small
files that declare or expand to gigabytes. `--kind` and `--number` repeat one of them.

Each file is read in a process of its own kind, which takes one file after the other.
Right is a result, or an `InputError` or `OSError` whose text is one sentence of at most
`LONGEST_SENTENCE` characters that names a file. Counted apart: other exceptions, ends
of the process, more than `MAX_SECONDS`, and more than `MAX_MEMORY` of resident memory,
the package's own included (about 400 MB). Values that change without a word count as
right: most formats have no checksums.
"""

import argparse
import collections
import concurrent.futures
import contextlib
import io
import json
import os
import random
import re
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from pathlib import Path

import timing
from file_samples import SAMPLES
from timing import Row, hand_over

MAX_SECONDS = 20.0
"""Longest processor time for one file [s]."""
MAX_WAIT = 200.0
"""Longest time for one file while other programs run, too [s]."""
MAX_MEMORY = 1e9
"""Largest resident memory [byte]."""
LONGEST_SENTENCE = 1000
"""Characters of the longest sentence: it may list 40 columns."""
FAULTS = ("exception", "end of the process", "hang", "memory", "sentence")

WORDS = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e-320", b"9" * 30),
    *(b"9" * 5000, b"true", b"null", b"\xc3\xa9", b"\xff\xfe", b"\0", b"{", b"["),
    *(b'"', b"\x1b[31m", b"\r\n\r\n", b"&a;", b"<", b"..", b"word", b"1e6", b"\n"),
    b"0x10",
    b"x" * 100_000,
)
SIZES = (0, 1, 0x7F, 0xFF, 0x7FFF_FFFF, 0xFFFF_FFFF, 2**40, 2**63 - 1, 2**64 - 1)


# Damage at random


def flipped(data, chance):
    """Change single bits."""
    for _ in range(chance.choice((1, 4, 50))):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


def cut_off(data, chance):
    """Remove the end."""
    del data[chance.randrange(len(data)) :]


def cut_out(data, chance):
    """Remove a part."""
    place = chance.randrange(len(data))
    del data[place : place + chance.choice((1, 7, 64, 1000))]


def doubled(data, chance):
    """Repeat a part."""
    place = chance.randrange(len(data))
    data[place:place] = data[place : place + chance.choice((1, 7, 64, 1000))]


def exchanged(data, chance):
    """Exchange two parts."""
    length = chance.choice((1, 4, 16, 200))
    a = chance.randrange(max(1, len(data) - length))
    b = chance.randrange(max(1, len(data) - length))
    part = data[a : a + length]
    data[a : a + length] = data[b : b + length]
    data[b : b + length] = part


def overwritten_size(data, chance):
    """Write a number of four or eight bytes where another may stand."""
    length = chance.choice((4, 8))
    number = chance.choice(SIZES) & (2 ** (8 * length) - 1)
    size = number.to_bytes(length, chance.choice(("little", "big")))
    place = chance.randrange(max(1, min(len(data), 2048) - length))
    if chance.random() < 0.3:
        place = max(0, len(data) - length - place)
    data[place : place + length] = size


def overwritten(data, chance):
    """Fill a part with one byte."""
    place = chance.randrange(len(data))
    length = min(chance.choice((4, 64, 1000)), len(data) - place)
    data[place : place + length] = bytes([chance.choice((0, 255))]) * length


def replaced_token(data, chance):
    """Replace a number or name."""
    tokens = [*re.finditer(rb"[\w.+-]+", bytes(data))]
    if tokens:
        start, end = chance.choice(tokens).span()
        data[start:end] = chance.choice(WORDS)


def exchanged_tokens(data, chance):
    """Exchange two numbers or names."""
    tokens = [*re.finditer(rb"[\w.+-]+", bytes(data))]
    if len(tokens) > 1:
        a, b = sorted(chance.sample(tokens, 2), key=lambda token: token.start())
        data[b.start() : b.end()] = a[0]
        data[a.start() : a.end()] = b[0]


def inserted_word(data, chance):
    """Insert a word anywhere."""
    place = chance.randrange(len(data) + 1)
    data[place:place] = chance.choice(WORDS)


def changed_lines(data, chance):
    """Drop, double or move a line, or an element of XML or JSON."""
    pieces = [*re.finditer(rb"[^\n>}]*[\n>}]|[^\n>}]+", bytes(data))]
    start, end = chance.choice(pieces).span()
    piece = data[start:end]
    kind = chance.choice(("drop", "double", "move"))
    if kind != "double":
        del data[start:end]
    if kind != "drop":
        place = chance.choice(pieces).start()
        data[place:place] = piece


BINARY = (
    flipped,
    cut_off,
    cut_out,
    doubled,
    exchanged,
    overwritten,
    overwritten_size,
    overwritten_size,
)
TEXT = (
    flipped,
    cut_off,
    cut_out,
    doubled,
    inserted_word,
    replaced_token,
    replaced_token,
    exchanged_tokens,
    changed_lines,
    changed_lines,
)


def damage(path, is_text, chance):
    """Damage a file by one to three random changes."""
    data = bytearray(path.read_bytes())
    for _ in range(chance.choice((1, 1, 2, 3))):
        if data:
            chance.choice(TEXT if is_text else BINARY)(data, chance)
    path.write_bytes(data)


# Hostile files


def empty(path):
    """Write an empty file."""
    path.write_bytes(b"")


def folder_in_its_place(path):
    """Put a folder in place of the file."""
    path.unlink()
    path.mkdir()


def other_format(path):
    """Write a file of another format."""
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 4)


def nested(opening, closing, repeats=100_000):
    """Return a function that writes opening and closing brackets."""
    return lambda path: path.write_bytes(opening * repeats + closing * repeats)


def wide_table(path):
    """Write a table of very many columns."""
    names = ",".join(f"q{k}" for k in range(200_000))
    path.write_text(f"{names}\n{names.replace('q', '')}\n", encoding="utf-8")


def one_line(path):
    """Write a line of nine megabytes."""
    path.write_bytes(b"0.5" * 3_000_000)


def many_short_lines(path):
    """Write more lines than a table of such a size has."""
    path.write_bytes(path.read_bytes() + b"\n" * 9_000_000)


def many_quotes(path):
    """Write quotation marks alone below the header."""
    path.write_bytes(path.read_bytes() + b'"\n' * 1_000_000)


def entities(path):
    """Write entities of XML that expand to gigabytes."""
    lines = ['<!ENTITY a0 "aaaaaaaaaa">']
    for k in range(1, 12):
        lines.append(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">')
    root = re.search(r"<(robot|mujoco|COLLADA)", path.read_text(encoding="utf-8"))
    name = root[1] if root else "mujocoinclude"
    path.write_text(
        f"<!DOCTYPE {name} [{''.join(lines)}]><{name} name='&a11;'>&a11;</{name}>",
        encoding="utf-8",
    )


def nested_bodies(path):
    """Write bodies of MJCF within each other."""
    text = "<body>" * 20_000 + "</body>" * 20_000
    path.write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")


def included_by_itself(path):
    """Write a part of MJCF that includes itself."""
    path.write_text(f'<mujocoinclude><include file="{path.name}"/></mujocoinclude>')


def long_chain(path):
    """Write a URDF with thousands of links."""
    number = 4000
    parts = [f'<link name="l{k}"/>' for k in range(number + 1)]
    for k in range(number):
        ends = f'<parent link="l{k}"/><child link="l{k + 1}"/>'
        parts.append(f'<joint name="j{k}" type="fixed">{ends}</joint>')
    path.write_text(f"<robot name='r'>{''.join(parts)}</robot>")


def declared_triangles(path):
    """Declare more triangles than a file of STL can hold."""
    data = bytearray(path.read_bytes())
    data[80:84] = struct.pack("<I", 0xFFFF_FFFF)
    path.write_bytes(data)


def npy_header(shape, kind="<f8"):
    """Return the beginning of an array of NumPy."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    text = text.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def npz_bomb(header, megabytes=0):
    """Return a function that writes an NPZ file with arrays of zeros."""

    def write(path):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in ("time", "q", "dq", "tau"):
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    file.write(header)
                    for _ in range(megabytes):
                        file.write(bytes(2**20))

    return write


def mat_bomb(path):
    """Write a MAT file whose arrays of zeros expand to two gigabytes."""
    import numpy as np
    from scipy.io import savemat

    array = np.zeros((20_000_000, 3))
    log = {"time": array[:, 0], "q": array, "dq": array, "tau": array}
    savemat(path, {"log": log}, do_compression=True)


def mat_4_sizes(path):
    """Declare an array of 24 GB in a MAT file of version 4."""
    data = bytearray(path.read_bytes())
    data[4:12] = struct.pack("<II", 1_000_000_000, 3)
    path.write_bytes(data)


def hdf5_bomb(is_written):
    """Return a function that writes large arrays in HDF5: declared, or with zeros."""

    def write(path):
        import h5py
        import numpy as np

        rows = 20_000_000
        block = np.zeros((1_000_000, 3))
        path.unlink()
        with h5py.File(path, "w") as file:
            for name in ("q", "dq", "tau", "time"):
                shape = (rows,) if name == "time" else (rows, 3)
                options = {"compression": "gzip", "chunks": (1_000_000, *shape[1:])}
                array = file.create_dataset(name, shape, "f8", **options)
                for start in range(0, rows if is_written else 0, 1_000_000):
                    array[start : start + 1_000_000] = (
                        block[:, 0] if name == "time" else block
                    )

    return write


def parquet_bomb(path):
    """Write a Parquet file of 100 million equal rows."""
    import numpy as np
    import polars as pl

    zeros = np.zeros(2_000_000)
    names = ("time", *(f"{s}{j}" for s in ("q", "dq", "tau") for j in (1, 2, 3)))
    frame = pl.DataFrame(dict.fromkeys(names, zeros)).lazy()
    pl.concat([frame] * 15).sink_parquet(path, row_group_size=2_000_000)


def parquet_lists(path):
    """Write a LeRobot data set with a very long list in one cell."""
    import polars as pl

    number = 5_000_000
    frame = {
        "observation.state": [[0.0] * number, [0.0]],
        "action": [[0.0] * 3, [0.0]],
        "timestamp": [0.0, 0.1],
        "episode_index": [0, 0],
    }
    pl.DataFrame(frame).write_parquet(path)


def bag_bomb(path):
    """Write a chunk of a ROS 1 bag that declares two gigabytes."""
    import bz2

    data = bz2.compress(bytes(2**26))
    content = path.read_bytes()
    size_place = content.find(b"size=", content.find(b"compression=bz2") - 60) + 5
    place = content.find(b"BZh")
    length = struct.unpack("<I", content[place - 4 : place])[0]
    changed = bytearray(content)
    changed[size_place : size_place + 4] = struct.pack("<I", 2**31)
    changed[place : place + length] = data[:length].ljust(length, b"\0")
    path.write_bytes(changed)


def mcap_bomb(path):
    """Write a chunk of MCAP that declares and expands to two gigabytes."""
    import zstandard

    size = 2**31
    squeezer = zstandard.ZstdCompressor().compressobj(size=size)
    data = b"".join(squeezer.compress(bytes(2**24)) for _ in range(128))
    data += squeezer.flush()
    chunk = struct.pack("<QQQI", 0, 10**18, size, 0)
    chunk += struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(data)) + data
    magic = b"\x89MCAP0\r\n"
    header = struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0)
    records = b"".join(
        struct.pack("<BQ", code, len(body)) + body
        for code, body in ((1, header), (6, chunk), (2, bytes(20)))
    )
    path.write_bytes(magic + records + magic)


def huge_shape(path):
    """Declare arrays of terabytes in a document."""
    text = path.read_text(encoding="utf-8")
    text = re.sub(r'"float64": \[', '"shape": [1000000000000], "float64": [', text)
    path.write_text(text, encoding="utf-8")


def without_rows(path):
    """Leave the header of a table alone."""
    path.write_bytes(path.read_bytes().partition(b"\n")[0])


COMMON = (empty, folder_in_its_place, other_format)
TABLES = (wide_table, one_line, many_short_lines, many_quotes, without_rows)
XML = (nested(b"<a>", b"</a>"), nested(b"<a>", b""), entities)
JSON = (nested(b"[", b"]"), nested(b'{"a":', b""), huge_shape)
TOML = (nested(b"a=[", b"]"), nested(b"[a.", b"]"), nested(b"a.", b"=1"))
HOSTILE = {
    "csv": TABLES,
    "csv, part by part": TABLES,
    "text with decimal commas": TABLES,
    "text with tabs": TABLES,
    "text with spaces": TABLES,
    "parquet": (parquet_bomb,),
    "parquet, part by part": (parquet_bomb,),
    "lerobot": (parquet_lists, parquet_bomb),
    "npz": (
        npz_bomb(npy_header((3_000_000_000,))),
        npz_bomb(npy_header((20_000_000, 3)), 458),
        npz_bomb(npy_header((10,), "|O")),
        npz_bomb(npy_header((-1, 3))),
        npz_bomb(npy_header("(" * 200 + ")" * 200)),
    ),
    "mat 4": (mat_4_sizes,),
    "mat 5": (mat_bomb,),
    "mat 7.3": (hdf5_bomb(False), hdf5_bomb(True)),
    "hdf5": (hdf5_bomb(False), hdf5_bomb(True)),
    "mcap": (mcap_bomb,),
    "ros 1, bz2": (bag_bomb,),
    "ros 2 metadata": (nested(b"[", b"]"), nested(b"- ", b"")),
    "urdf": (*XML, long_chain),
    "xacro": XML,
    "stl": (declared_triangles,),
    "obj": (one_line,),
    "dae": XML,
    "mjcf": (*XML, nested_bodies),
    "mjcf, part": (*XML, included_by_itself),
    "mjcf, mesh": (declared_triangles,),
    "experiment": TOML,
    "model": JSON,
    "trajectory": JSON,
}


def mutate(path, kind, is_text, number):
    """Write the file of a kind that has this number."""
    hostile = COMMON + HOSTILE.get(kind, ())
    if number < len(hostile):
        hostile[number](path)
    else:
        damage(path, is_text, random.Random(f"{kind} {number}"))


def number_of_files(kind, each):
    """Return how many files of a kind there are."""
    return len(COMMON) + len(HOSTILE.get(kind, ())) + each


# Reading, in a process of its own


def largest_memory():
    """Return the largest resident memory of this process [byte]."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(re.search(r"VmHWM:\s+(\d+)", status)[1])


def fault_of_sentence(text):
    """Return what is wrong with the text of an error; "" if nothing is."""
    if not text.isprintable():
        return "not printable"
    if len(text) > LONGEST_SENTENCE:
        return f"{len(text)} characters"
    if re.search(r"\\x[0-9a-f]{2}|b'|0x[0-9a-f]{6}|<[\w.]+ object", text):
        return "a dump"
    if not re.search(r"[.?]$", text) or re.search(r"\.\.$|\.:|: *\.", text):
        return "its end"
    if not re.search(r"\w\.[a-z0-9]{2,7}\b|`(log|[^`]*bag)`", text):
        return "no file"
    return ""


def read_one(sample, path):
    """Return the kind of result, and words about it."""
    import jaxid as jid

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            sample.read(path)
    except (jid.InputError, OSError) as error:
        text = str(error)
        if isinstance(error, OSError) and error.strerror:
            text = f"`{error.filename}`: {error.strerror}."
        fault = fault_of_sentence(text)
        return ("sentence", f"{fault}: {text}") if fault else ("refused", text)
    except BaseException as error:
        line = traceback.extract_tb(error.__traceback__)[-1]
        own = [
            x
            for x in traceback.extract_tb(error.__traceback__)
            if "jaxid/" in x.filename
        ]
        place = f"{Path(line.filename).name}:{line.lineno}"
        if own:
            place += f" ({Path(own[-1].filename).name}:{own[-1].lineno})"
        return "exception", f"{type(error).__name__} at {place}: {str(error)[:200]}"
    return "ok", ""


def make_files(sample, kind, place, numbers):
    """Write the files of a kind into one folder each, unless they are there."""
    original = place / "original"
    if not original.exists():
        original.mkdir(parents=True)
        sample.write(original)
    for number in numbers:
        copy = place / f"{number}"
        if not copy.exists():
            shutil.copytree(original, copy)
            mutate(copy / sample.target, kind, sample.is_text, number)


def work(kind, place, numbers):
    """Make files of a kind, and read them one by one; write a line before and after."""
    sample = SAMPLES[kind]
    # What makes hostile files needs memory itself.
    process = os.fork()
    if process == 0:
        make_files(sample, kind, place, numbers)
        os._exit(0)
    _, status = os.waitpid(process, 0)
    if status:
        raise SystemExit("the files could not be made")
    for number in numbers:
        print(json.dumps(["begin", "", 0]), flush=True)
        Path("/proc/self/clear_refs").write_text("5")
        with contextlib.redirect_stdout(io.StringIO()):
            result, words = read_one(sample, place / f"{number}")
        memory = largest_memory()
        if memory > MAX_MEMORY:
            result, words = "memory", f"{memory / 1e9:.2f} GB: {words}"
        print(json.dumps([result, words, memory]), flush=True)


class Worker:
    """A process that reads files of one kind."""

    def __init__(self, kind, place, numbers):
        command = [sys.executable, __file__, "--work", kind, "--place", str(place)]
        command += ["--numbers", *map(str, numbers)]
        environment = {**os.environ, "JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"}
        environment["PYTHONPATH"] = str(timing.REPOSITORY)
        self.log = Path(f"{place}.log")
        # Without a buffer, so that a line that waits can be seen.
        options = {"bufsize": 0, "stdout": subprocess.PIPE, "env": environment}
        options["cwd"] = place.parent  # MuJoCo writes a log
        with self.log.open("w") as log:
            self.process = subprocess.Popen(command, stderr=log, **options)

    def answer(self, seconds):
        """Return the next line of the process: a kind of result, words and memory."""
        end = time.monotonic() + MAX_WAIT
        max_time = self.processor_time() + seconds
        memory_file = Path(f"/proc/{self.process.pid}/statm")
        while time.monotonic() < end and self.processor_time() < max_time:
            ready, _, _ = select.select([self.process.stdout], [], [], 0.02)
            if ready:
                line = self.process.stdout.readline()
                return json.loads(line) if line else self.end()
            pages = memory_file.read_text().split()
            if pages and 4096 * int(pages[1]) > 3 * MAX_MEMORY:
                return ["memory", "more than 3 GB", 3 * MAX_MEMORY]
        return ["hang", f"more than {seconds:g} s", 0]

    def processor_time(self):
        """Return the processor time of the process so far [s]."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2]
        user_ticks, system_ticks = fields.split()[11:13]
        return (int(user_ticks) + int(system_ticks)) / os.sysconf("SC_CLK_TCK")

    def end(self):
        """Return how the process has ended."""
        code = self.process.wait()
        words = self.log.read_text(errors="replace")[-300:]
        return ["end of the process", f"{code}: {words}", 0]

    def read(self):
        """Return what becomes of the next file."""
        answer = self.answer(100.0)
        return self.answer(MAX_SECONDS) if answer[0] == "begin" else answer

    def close(self):
        """End the process."""
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


def read_kind(kind, place, numbers, show):
    """Read files of a kind; return (number, result, words, memory) of each."""
    results = []
    worker = None
    for place_of_number, number in enumerate(numbers):
        worker = worker or Worker(kind, place, numbers[place_of_number:])
        result = worker.read()
        results.append((number, *result))
        if show or result[0] in FAULTS:
            print(f"{kind} {number}: {' '.join(map(str, result[:2]))}", flush=True)
        if result[0] in ("end of the process", "hang") or result[2] > MAX_MEMORY:
            worker.close()
            worker = None
    if worker is not None:
        worker.close()
    return results


def rows_of(kind, results):
    """Return the row of a kind in the table of results."""
    counts = collections.Counter(result for _, result, *_ in results)
    largest = max(memory for *_, memory in results)
    parts = [f"{counts['ok']} read", f"{counts['refused']} refused"]
    parts += [f"{counts[fault]} {fault}" for fault in FAULTS if counts[fault]]
    said = f"{len(results)} files: {', '.join(parts)}; {largest / 1e6:.0f} MB"
    holds = not any(counts[fault] for fault in FAULTS)
    return Row("files", kind, "mutated_files.py", "0 faults", said, holds)


def main():
    """Read all files."""
    parser = timing.parser(__doc__, "three random files of each kind")
    parser.add_argument("--kind", action="append", help="only these kinds")
    parser.add_argument("--number", type=int, help="only the file of this number")
    parser.add_argument(
        "--each", type=int, default=16, help="random files of each kind"
    )
    parser.add_argument("--show", action="store_true", help="print every result")
    for name, kind in (("--work", str), ("--place", Path)):
        parser.add_argument(name, type=kind, help=argparse.SUPPRESS)
    parser.add_argument("--numbers", type=int, nargs="*", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options.work, options.place, options.numbers)
        return 0
    each = 3 if options.quick else options.each
    kinds = options.kind or list(SAMPLES)
    rows = []
    with (
        tempfile.TemporaryDirectory() as place,
        concurrent.futures.ThreadPoolExecutor(2) as pool,
    ):

        def read(kind):
            numbers = [*range(number_of_files(kind, each))]
            if options.number is not None:
                numbers = [options.number]
            return read_kind(
                kind, Path(place) / kind.replace(" ", "-"), numbers, options.show
            )

        for kind, results in zip(kinds, pool.map(read, kinds), strict=True):
            rows.append(rows_of(kind, results))
    hand_over(rows, options.json)
    return not all(row.holds for row in rows)


if __name__ == "__main__":
    raise SystemExit(main())
