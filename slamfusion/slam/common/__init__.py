"""Shared parts of the SLAMs: ``Mapper`` protocol, scan matching, tiled maps, states, runs."""
