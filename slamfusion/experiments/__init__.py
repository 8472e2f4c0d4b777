"""The experiments of the papers; each adds rows to one table of results."""
