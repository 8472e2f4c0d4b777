"""The work behind the commands, without their faces: nothing here parses options or prints.

``records`` says what the JSON documents hold that the commands print, key by key, as types; the
same as a JSON Schema is what ``records.load_schema`` returns.
"""

from __future__ import annotations
