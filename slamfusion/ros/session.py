"""What nodes that were started together say once for all of them."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

# A folder for as long as the nodes run; ``slamfusion.sh`` makes one. Without it each speaks for
# itself.
SESSION_VARIABLE = "SLAMFUSION_SESSION"


def is_first_to_say(text: str) -> bool:
    """Return whether no node of this session has said the same; whoever asks is taken to say it."""
    folder = os.environ.get(SESSION_VARIABLE)
    if not folder:
        return True
    said = Path(folder) / f"said-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    try:
        said.touch(exist_ok=False)
    except FileExistsError:
        return False
    except OSError:  # the folder is gone, or full: rather twice than never
        return True
    return True
