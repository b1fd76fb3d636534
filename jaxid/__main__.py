"""Runs the command line as `python -m jaxid`."""

from jaxid.cli import main

main()
