"""The command line: `jaxid …`."""

from .process import main as main
