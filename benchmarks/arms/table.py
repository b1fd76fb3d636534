"""The tables, the picture and the JSON of the benchmark."""

import datetime
import itertools
import json

import numpy as np
from arm import HERE

RESULTS = HERE / "results.json"
PICTURE = HERE / "errors.png"
PAGE = HERE / "README.md"
MARK = "<!-- results -->"
"""Line of the page below which everything is written by `run.py --write`."""
RIVALS = "<!-- better rivals -->"
"""Line of the page before and after the written list of better rivals."""
OURS = {"jaxid": "as it is", "jaxid choose": "as `choose` picks"}
CLOSE = 1.01
"""Ratio of errors that counts as equal."""
COVERAGE = "coverage"
DASH = "–"  # noqa: RUF001
"""What was not measured, or does not exist."""

MIN_NUMBER = 1e-3
"""Number below which 0 is shown."""

COLUMNS = {
    "torques": (
        "torque error [%]",
        "worst joint [%]",
        "position after 0.1 s; 0.5 s [mrad or mm]",
        "definite poses [%]",
        "possible bodies [%]",
    ),
    "servos": (
        "free-running error [mrad]",
        "worst joint [mrad]",
        "position after 0.1 s; 0.5 s [mrad]",
    ),
    "geometry": ("position error [mm]", "worst session [mm]", "attitude error [°]"),
}
"""Columns of each kind of robots; those of cost follow."""
COSTS = ("CPU s, first; again", "MB", "lines")


def number(value, digits=2):
    """Return a number with so many significant digits; a dash for none."""
    if value is None or np.isnan(value):
        return DASH
    if not np.isfinite(value):
        return "diverges"
    if value < MIN_NUMBER:
        return "0"
    if value >= 100:
        return f"{value:.0f}"
    return f"{value:#.{digits}g}".rstrip(".")


def scaled(values, scale, digits=2):
    """Return numbers in another unit, side by side."""
    return "; ".join(number(scale * x, digits) for x in values) or DASH


def percent(share, digits=0):
    """Return a share in percent; a dash for none."""
    return DASH if share is None else f"{100 * share:.{digits}f}"


def cells(row):
    """Return the figures of one method in the columns of its kind."""
    if row["kind"] == "torques":
        return [
            number(100 * row["error"], 3),
            number(100 * row["worst"], 3),
            scaled(row["simulations"], 1e3),
            percent(row["definite"]),
            percent(row["plausible"]),
        ]
    errors = [number(1e3 * row["error"], 3), number(1e3 * row["worst"], 3)]
    if row["kind"] == "servos":
        return [*errors, scaled(row["simulations"], 1e3)]
    angle = row["angle"]
    return [*errors, number(None if angle is None else np.rad2deg(angle))]


def line(set_name, method_name, row):
    """Return the figures of one pair in one line."""
    if "reason" in row:
        return f"{set_name}, {method_name}: {row['reason']}"
    if method_name == COVERAGE:
        return f"{set_name}, {method_name}: {row}"
    return (
        f"{set_name}, {method_name}: {', '.join(cells(row))}, "
        f"{scaled(row['seconds'], 1.0)} CPU s"
    )


def text(results, lines):
    """Return a table for each robot, the best method first, and that of coverage."""
    parts = []
    for set_name, rows in results.items():
        rows = {name: row for name, row in rows.items() if name != COVERAGE}
        measured = {name: row for name, row in rows.items() if "reason" not in row}
        if not measured:
            continue
        kind = next(iter(measured.values()))["kind"]
        heads = ["method", *COLUMNS[kind], *COSTS]
        table = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        for name in sorted(measured, key=lambda x: measured[x]["error"]):
            row = measured[name]
            costs = [
                scaled(row["seconds"], 1.0),
                number(row["megabytes"], 3),
                str(lines[kind].get(name, DASH)),
            ]
            table.append(f"| {' | '.join([name, *cells(row), *costs])} |")
        reasons = [f"* {x}: {rows[x]['reason']}" for x in rows if x not in measured]
        parts.append("\n".join([f"### {set_name}", "", *table]))
        if reasons:
            parts.append("\n".join(reasons))
    return "\n\n".join([*parts, *coverage_text(results)])


def coverage_text(results):
    """Return the table of intervals, if it was measured."""
    rows = []
    for set_name, pairs in results.items():
        row = pairs.get(COVERAGE)
        if row is None or "reason" in row or row["logs"] < 2:
            continue
        shares = [row.get(x, [None, None]) for x in ("truth", "pairs")]
        values = [percent(x, 1) for pair in shares for x in pair]
        predicted = percent(row.get("predicted"), 1)
        count = f"{row['logs']}; {row['parameters']}"
        rows.append(f"| {' | '.join([set_name, count, *values, predicted])} |")
    if not rows:
        return []
    heads = (
        "robot",
        "logs; parameters",
        "truth in the interval [%]",
        "in the naive one [%]",
        "two logs agree [%]",
        "by naive intervals [%]",
        "predicted by `jid.agreement` of the others [%]",
    )
    head = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    return ["\n".join(["### 95 % intervals of one log", "", *head, *rows])]


def better_rivals(results):
    """Return a line for each robot on which a rival is better by more than 1 %."""
    lines = []
    for set_name, relative in relative_errors(results).items():
        for name, words in OURS.items():
            if relative.get(name, 0.0) > CLOSE:
                best = next(x for x, ratio in relative.items() if ratio == 1.0)
                excess = 100 * (relative[name] - 1)
                lines.append(
                    f"* {set_name}: **{best}**; this package {words} has an error that "
                    f"is {excess:.0f} % larger."
                )
    if not lines:
        return "No rival is better by more than 1 % on any of these robots."
    return "\n".join(["Rivals that are better by more than 1 %:", "", *lines])


def relative_errors(results):
    """Return the error of each method over that of the best rival, by robot."""
    relative = {}
    for set_name, rows in results.items():
        errors = {x: row["error"] for x, row in rows.items() if "error" in row}
        rivals = [errors[x] for x in errors if not x.startswith("jaxid")]
        if rivals:
            best = min(rivals)
            relative[set_name] = {name: x / best for name, x in errors.items()}
    return relative


def picture(results):
    """Draw the errors over those of the best rival, for each robot."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    relative = relative_errors(results)
    names = list(dict.fromkeys(name for errors in relative.values() for name in errors))
    # Other estimators of this package stand in the tables alone.
    names = [x for x in names if x in OURS or not x.startswith("jaxid")]
    names.sort(key=lambda name: name in OURS)
    figure, axes = pyplot.subplots(figsize=(8, 0.32 * len(relative) + 1.2))
    rows = np.arange(len(relative))
    markers = dict(zip(OURS, "oD", strict=True))
    others = itertools.cycle("s^vPX*<>hp")
    colours = itertools.cycle(pyplot.cm.tab10.colors[1:])
    for name in names:
        values = [errors.get(name, np.nan) for errors in relative.values()]
        is_ours = name in markers
        axes.plot(
            values,
            rows,
            markers[name] if is_ours else next(others),
            color="tab:blue" if is_ours else next(colours),
            markerfacecolor="none" if name == "jaxid choose" else None,
            alpha=1.0 if is_ours else 0.6,
            label=name,
            linestyle="none",
        )
    axes.axvline(1.0, color="0.7", linewidth=0.8, zorder=0)
    axes.set_xscale("log")
    ticks = (0.3, 0.5, 0.7, 1, 2, 5, 10, 30)
    axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
    axes.minorticks_off()
    axes.set_yticks(rows, list(relative))
    axes.invert_yaxis()
    axes.set_xlabel("error on unseen motion over that of the best rival")
    axes.grid(axis="y", alpha=0.2)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.savefig(PICTURE, dpi=150, bbox_inches="tight")


def write(results, lines):
    """Write the page, the picture and the JSON; pairs that were not run stay."""
    import jaxid

    date = datetime.date.today().isoformat()
    if RESULTS.exists():
        earlier = json.loads(RESULTS.read_text(encoding="utf-8"))["results"]
        names = dict.fromkeys([*earlier, *results])
        results = {x: earlier.get(x, {}) | results.get(x, {}) for x in names}
    content = {
        "date": date,
        "version": jaxid.__version__,
        "results": results,
        "lines": lines,
    }
    RESULTS.write_text(json.dumps(content, indent=1), encoding="utf-8")
    picture(results)
    head = PAGE.read_text(encoding="utf-8").split(MARK)[0]
    before, _, after = head.split(RIVALS)
    head = RIVALS.join([before, f"\n{better_rivals(results)}\n", after])
    page = f"{head}{MARK}\n\nMeasured on {date}.\n\n{text(results, lines)}\n"
    PAGE.write_text(page, encoding="utf-8")
