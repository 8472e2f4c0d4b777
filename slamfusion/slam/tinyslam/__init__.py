"""tinySLAM [H16]: one map and a Monte-Carlo matcher."""
