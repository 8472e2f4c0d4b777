"""Work as tasks: in this process, in several of this machine, or on the workers of a Dask cluster.

``open_scheduler`` gives a ``Scheduler``; who has many like things to do hands it tasks, plain
functions of modules with plain values, and asks for their results. What a task gives does not
depend on where it ran, as long as devices and drivers are the same. Dask is imported where a
cluster is asked for, and nowhere else.
"""

from __future__ import annotations

from slamfusion.fleet.scheduler import InProcess, Scheduler, Task, open_scheduler

__all__ = ["InProcess", "Scheduler", "Task", "open_scheduler"]
