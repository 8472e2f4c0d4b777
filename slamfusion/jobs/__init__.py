"""The work behind the commands, without their faces: nothing here parses options or prints.

Each job is a plain function with typed arguments that returns a frozen record: ``map_log`` and
``run_log`` make maps of a log, ``fuse`` and ``align`` work on maps, ``evaluate`` and ``trajectory``
measure, ``simulate`` and ``graph`` do what they are called. A second function of each module writes
what the first returned, all files of it or none, and returns the JSON document of the command.
Errors are those of ``slamfusion.errors``; progress is told to a callback.

``records`` says what the JSON documents hold that the commands print, key by key, as types; the
same as a JSON Schema is what ``records.load_schema`` returns.
"""

from __future__ import annotations
