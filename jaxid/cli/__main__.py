"""Runs the command line as `python -m jaxid.cli`."""

from jaxid.cli.commands import main

main()
