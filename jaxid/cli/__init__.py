"""The command line: what `jaxid …` does."""

from jaxid.cli.commands import app as app
from jaxid.cli.commands import main as main
