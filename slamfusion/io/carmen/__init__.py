"""CARMEN logs, read as a stream of scans and written.

``messages`` says what a line means; ``survey`` is a first pass over the file, for what lines cannot
say alone; ``log`` reads with both, and ``writer`` writes.
"""

from slamfusion.io.carmen.log import CarmenLog
from slamfusion.io.carmen.messages import CARMEN_WORDS, write_carmen

__all__ = ["CARMEN_WORDS", "CarmenLog", "write_carmen"]
