"""Runs the command line as `python -m jaxid`."""

from jaxid.cli.commands import main

main()
