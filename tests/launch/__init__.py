"""Tests of ``launch_scripts/``: what starts the nodes, and the files beside it."""
