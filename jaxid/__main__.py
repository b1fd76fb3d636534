"""Runs the command line as `python -m jaxid`."""

from jaxid.cli.main import main

main()
