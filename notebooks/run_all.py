"""Executes the notebooks, two at a time, and says how long each one takes.

    python notebooks/run_all.py                 # does everything still run? writes nothing
    python notebooks/run_all.py --write         # … and writes the .ipynb beside each .py
    python notebooks/run_all.py 03 05 --write   # some of them

The text of a notebook is its .py (py:percent); the .ipynb is made from it, outputs included. What
changes from run to run or from machine to machine is left out of it, and pictures are made small.
Needs the extra `notebooks`.
"""

import argparse
import base64
import io
import os
import re
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from PIL import Image

try:
    import resource
except ImportError:  # not on Windows
    resource = None

HERE = Path(__file__).resolve().parent
AT_ONCE = 2
LONGEST = 300
"""Seconds that a cell may take."""
COLOURS = 96
"""Colours of a picture: enough for lines and a scale of colours."""
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}


def notebook_of(source: Path) -> nbformat.NotebookNode:
    """The notebook that a .py says, without outputs, with names of its cells that stay."""
    notebook = jupytext.read(source)
    notebook.metadata = nbformat.from_dict({"kernelspec": KERNEL})
    for k, cell in enumerate(notebook.cells):
        cell.id = f"{source.stem}-{k}"
        cell.metadata = nbformat.from_dict({})
    return notebook


class Executed(NamedTuple):
    """What came of a notebook.

    Attributes:
        notebook: With its outputs.
        wall: How long it took [s].
        processor: Time of all cores that its kernel took [s]; NaN where nobody counts.
        error: What went wrong, or nothing.
    """

    notebook: nbformat.NotebookNode
    wall: float
    processor: float
    error: str


def processor_time() -> float:
    """Time of all cores that this process's ended children took [s]."""
    if resource is None:
        return float("nan")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def executed(source: Path) -> Executed:
    """Executes a notebook from top to bottom."""
    notebook, start, before = notebook_of(source), time.perf_counter(), processor_time()
    client = NotebookClient(
        notebook,
        timeout=LONGEST,
        kernel_name="python3",
        resources={"metadata": {"path": HERE}},
        startup_timeout=LONGEST,
        extra_arguments=["--IPKernelApp.log_level=ERROR"],
    )
    error = ""
    try:
        client.execute()
    except CellExecutionError as raised:
        error = str(raised)
    return Executed(
        notebook, time.perf_counter() - start, processor_time() - before, error
    )


def small(png: str) -> str:
    """A picture with few colours."""
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    kept = io.BytesIO()
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(kept, "PNG", optimize=True)
    return base64.b64encode(kept.getvalue()).decode()


def cleaned(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Without what differs from run to run."""
    notebook.metadata = nbformat.from_dict({"kernelspec": KERNEL})
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict({})
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                output["data"] = nbformat.from_dict(
                    {"image/png": small(data["image/png"])}
                )
            output["metadata"] = nbformat.from_dict({})
        if "outputs" in cell:
            cell.outputs = joined(cell.outputs)
    return notebook


def joined(outputs: list) -> list:
    """Lines that were printed one after the other as one output, however they arrived."""
    kept = []
    for output in outputs:
        if output.output_type == "stream":
            del output["metadata"]
            if kept and kept[-1].get("name") == output.name:
                kept[-1].text += output.text
                continue
        kept.append(output)
    return kept


def main() -> int:
    """Executes what is asked for; 1 if something fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "names", nargs="*", help="beginnings of names, such as 03; all if none"
    )
    parser.add_argument("--write", action="store_true", help="writes the .ipynb files")
    asked = parser.parse_args()
    sources = sorted(
        p
        for p in HERE.glob("[0-9][0-9]_*.py")
        if not asked.names or p.stem.startswith(tuple(asked.names))
    )
    # Two notebooks share the cores: threads of BLAS would be in each other's way.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    start, failed = time.perf_counter(), False
    with ProcessPoolExecutor(AT_ONCE) as pool:
        for source, done in zip(sources, pool.map(executed, sources), strict=True):
            print(
                f"{source.stem:24} {done.wall:6.1f} s, {done.processor:6.1f} s of the cores  "
                f"{'FAILED' if done.error else 'ok'}",
                flush=True,
            )
            if done.error:
                failed = True
                print(re.sub(r"\x1b\[[0-9;]*m", "", done.error), file=sys.stderr)
            elif asked.write:
                nbformat.write(cleaned(done.notebook), source.with_suffix(".ipynb"))
    print(f"{len(sources)} notebooks, {time.perf_counter() - start:.1f} s")
    return int(failed or not sources)


if __name__ == "__main__":
    sys.exit(main())
