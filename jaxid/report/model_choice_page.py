"""Page of a choice of models: table, error against size, forces of both models."""

from pathlib import Path

import numpy as np

from jaxid.identification.model_selection import (
    ModelChoice,
    Trial,
    relative_error,
)
from jaxid.io import write_text
from jaxid.result_table import Table, percent
from jaxid.robot.robot import Robot

from .figure import Figure
from .figure_elements import GREY, PREDICTION_COLOUR, Curve, Panel
from .page import Settings, provenance, render_page, tiles
from .torques import model_force_figure

FIRST_MODEL = "file as it is"
CHOSEN_MODEL = "chosen model"


def write_model_choice(
    file: Path, choice: ModelChoice, robot: Robot, settings: Settings
) -> None:
    """Write the page of a choice of models."""
    table = choice.summary()
    verdict, *remarks = choice.remarks
    error = percent(choice.promise)
    first_error = percent(relative_error(choice.first_predictions))
    sizes = f"{choice.path[0].size} → {choice.chosen.size}"
    numbers = tiles(
        (f"{error} %", "error of the chosen model (RMS over RMS)"),
        (
            f"{first_error} %",
            "error of the model as the file says",
        ),
        (sizes, "number of parameters: file as it is → chosen model"),
    )
    sections = [
        ("At a glance", [verdict, numbers, remarks]),
        ("Both models on one log", [force_figure(choice, robot)]),
        ("Error against number of parameters", [size_figure(choice)]),
        ("All models", [Table("", *table.columns, status=table.status)]),
        provenance(settings),
    ]
    write_text(file, render_page(f"{robot.name}: choice of a model", sections))


def size_figure(choice: ModelChoice) -> Figure:
    """Return the error on unseen parts of each model, against its size."""
    curves = [
        _trial_curve(choice.others, "other models", GREY, "points"),
        _trial_curve(choice.path, "path of the search", PREDICTION_COLOUR, "line"),
    ]
    panel = Panel(
        curves,
        x="number of parameters",
        y="error on unseen parts",
        unit="% of the forces",
        log="y",
    )
    title = f"Errors {choice.band} by size: {choice.chosen.name}"
    return Figure(title, [panel], height=4.0, width=7.6)


def _trial_curve(trials: list[Trial], name: str, colour: str, kind) -> Curve:
    """Return sizes and errors of models, with their names."""
    return Curve(
        np.array([float(trial.size) for trial in trials]),
        np.array([100.0 * trial.error for trial in trials]),
        name,
        colour,
        kind,
        marker=True,
        texts=[trial.name for trial in trials],
    )


def force_figure(choice: ModelChoice, robot: Robot) -> Figure:
    """Return forces of the first log, and errors of the first and the chosen model.

    Each part of the log is predicted by fits that have not seen it.
    """
    first_prediction = choice.first_predictions[0]
    prediction = choice.predictions[0]
    first_error = percent(relative_error([first_prediction]))
    error = percent(relative_error([prediction]))
    title = (
        f"{prediction.name}, each part predicted by a fit without it: {error} % by the "
        f"chosen model, {first_error} % by the file as it is"
    )
    predictions = {FIRST_MODEL: first_prediction, CHOSEN_MODEL: prediction}
    return model_force_figure(predictions, robot, title)
