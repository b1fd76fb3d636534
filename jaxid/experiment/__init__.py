"""The user's TOML file, decoded into the objects that it describes."""

from .changes_of_models import changed_text as changed_text
from .experiment import (
    Experiment as Experiment,
    load_experiment as load_experiment,
    parse_experiment as parse_experiment,
)
from .model_choice import choose_model as choose_model
from .report_comparison import compare_reports as compare_reports
from .template import write_template as write_template
