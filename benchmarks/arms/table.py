"""The table, the picture and the JSON of the benchmark."""

import datetime
import json

import numpy as np
from arm import HERE

RESULTS = HERE / "results.json"
PICTURE = HERE / "errors.png"
PAGE = HERE / "README.md"
MARK = "<!-- results -->"
"""Line of the page below which everything is written by `run.py --write`."""


def number(value, digits=2):
    """Return a number with so many significant digits; a dash for none."""
    if value is None or not np.isfinite(value):
        return "–" if value is None or np.isnan(value) else "diverges"  # noqa: RUF001
    if value >= 100:
        return f"{value:.0f}"
    return f"{value:#.{digits}g}".rstrip(".")


def line(set_name, method_name, pair):
    """Return the figures of one pair in one line."""
    if "reason" in pair:
        return f"{set_name}, {method_name}: {pair['reason']}"
    return (
        f"{set_name}, {method_name}: {100 * pair['torque']:.2f} %, "
        f"{pair['seconds'][0]:.1f} and {pair['seconds'][1]:.1f} CPU s"
    )


def text(results, lines):
    """Return a table for each robot, the best method first."""
    parts = []
    for set_name, pairs in results.items():
        measured = {name: pair for name, pair in pairs.items() if "reason" not in pair}
        order = sorted(measured, key=lambda name: measured[name]["torque"])
        rows = [
            "| method | torque error [%] | worst joint [%] | position after 0.1 s; "
            "0.5 s [mrad or mm] | definite poses [%] | possible bodies [%] | "
            "CPU s, first; again | MB | lines |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        for name in order:
            rows.append(_row(name, measured[name], lines.get(name, 0)))
        failed = [name for name in pairs if name not in measured]
        reasons = [f"* {name}: {pairs[name]['reason']}" for name in failed]
        parts.append(
            "\n".join(
                [f"### {set_name}", "", *rows, *([""] if failed else []), *reasons]
            )
        )
    return "\n\n".join(parts)


def _row(name, pair, lines):
    simulations = "; ".join(number(1e3 * x) for x in pair["simulations"])
    plausible = pair["plausible"]
    share = None if plausible is None else 100 * plausible
    seconds = "; ".join(number(x) for x in pair["seconds"])
    cells = [
        name,
        number(100 * pair["torque"], 3),
        number(100 * max(pair["joints"]), 3),
        simulations,
        f"{100 * pair['definite']:.0f}",
        "–" if share is None else f"{share:.0f}",  # noqa: RUF001
        seconds,
        f"{pair['megabytes']:.0f}",
        str(lines),
    ]
    return f"| {' | '.join(cells)} |"


def picture(results):
    """Draw the torque error of each method on each robot."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = list(dict.fromkeys(name for pairs in results.values() for name in pairs))
    figure, axes = pyplot.subplots(figsize=(9, 0.6 * len(results) + 2.2))
    rows = np.arange(len(results))
    markers = "osD^vPX*<>h"
    for k, name in enumerate(names):
        values = [
            100 * pairs.get(name, {}).get("torque", np.nan)
            for pairs in results.values()
        ]
        is_ours = name.startswith("jaxid")
        axes.plot(
            values,
            rows + 0.04 * (k - len(names) / 2),
            markers[k % len(markers)],
            color=pyplot.cm.Blues(0.5 + 0.1 * (k % 5)) if is_ours else None,
            label=name,
        )
    axes.set_xscale("log")
    axes.set_yticks(rows, list(results))
    axes.invert_yaxis()
    axes.set_xlabel("torque error on unseen motion: RMS over RMS [%]")
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.savefig(PICTURE, dpi=150, bbox_inches="tight")


def write(results, lines):
    """Write the page, the picture and the JSON; pairs that were not run stay."""
    date = datetime.date.today().isoformat()
    if RESULTS.exists():
        earlier = json.loads(RESULTS.read_text(encoding="utf-8"))["results"]
        names = dict.fromkeys([*earlier, *results])
        results = {x: earlier.get(x, {}) | results.get(x, {}) for x in names}
    content = {"date": date, "results": results, "lines": lines}
    RESULTS.write_text(json.dumps(content, indent=1), encoding="utf-8")
    picture(results)
    head = PAGE.read_text(encoding="utf-8").split(MARK)[0]
    page = f"{head}{MARK}\n\nMeasured on {date}.\n\n{text(results, lines)}\n"
    PAGE.write_text(page, encoding="utf-8")
