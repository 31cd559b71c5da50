"""`python -m ubl_graph` is the command `ubl-graph`."""

from ubl_graph.cli import main

main()
