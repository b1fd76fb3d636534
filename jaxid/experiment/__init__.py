"""The user's TOML file, decoded into the objects that it describes."""

from .experiment import (
    Experiment as Experiment,
    load_experiment as load_experiment,
    parse_experiment as parse_experiment,
)
from .experiment_variants import variants as variants
from .template import write_template as write_template
