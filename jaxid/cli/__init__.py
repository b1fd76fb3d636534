"""Command line of jaxid."""

from jaxid.cli.main import app as app
from jaxid.cli.main import main as main
