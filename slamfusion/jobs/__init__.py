"""The work behind the commands: plain functions that return records; none parses or prints.

A second function of each module writes the files of the first, all or none, and returns the JSON
document of the command.
"""

from __future__ import annotations
