"""The command line: `jaxid …`."""

from .app import main as main
