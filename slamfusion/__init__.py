"""SLAMfusion: align the occupancy grids of several 2D SLAMs and let them vote cell by cell.

The library in a few lines::

    from slamfusion import fuse_maps, map_log, save_fused_maps

    made = map_log("drive.log", "graph")
    fused = fuse_maps([made.grid, "saved.yaml"])
    save_fused_maps(fused, "out/fused")

Every name below is loaded when it is first asked for: what is not used costs nothing. The work is
in ``slamfusion.jobs``, the settings in ``slamfusion.config``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from slamfusion.version import __version__

if TYPE_CHECKING:
    from slamfusion.align.records import Alignment, FusionResult
    from slamfusion.align.starts import StartPose
    from slamfusion.compute import ComputeDevice, open_device
    from slamfusion.config import RunConfig
    from slamfusion.errors import (
        AlignmentError,
        ConfigError,
        DeviceError,
        GraphError,
        GridError,
        LogError,
        MapFileError,
        MemoryBudgetError,
        ScanError,
        SimulationError,
        SlamFusionError,
        StartError,
        TrajectoryError,
    )
    from slamfusion.geometry import Pose2
    from slamfusion.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
    from slamfusion.io import AtomicFiles, load_map, open_log, read_trajectory, save_map
    from slamfusion.jobs.align import align_maps
    from slamfusion.jobs.cases import CaseFile, place_files
    from slamfusion.jobs.compare import (
        ComparedResults,
        compare_results,
        write_comparison_plot,
    )
    from slamfusion.jobs.evaluate import (
        evaluate_maps,
        measure_distances,
        write_evaluation,
    )
    from slamfusion.jobs.fuse import FusedMaps, fuse_maps, save_fused_maps
    from slamfusion.jobs.graph import OptimizedGraph, optimize_graph, save_optimized_graph
    from slamfusion.jobs.judge import JudgedPaths, judge_paths, write_judgement
    from slamfusion.jobs.map_log import MappedLog, map_log, save_mapped_log
    from slamfusion.jobs.records import Evaluation, load_schema
    from slamfusion.jobs.results import SavedResults, read_results, write_results_file
    from slamfusion.jobs.run import LogRun, run_log
    from slamfusion.jobs.run_files import SavedRun, save_run
    from slamfusion.jobs.simulate import SimulatedDrive, save_simulated_drive, simulate_course
    from slamfusion.jobs.trajectory import (
        CaseFiles,
        MeasuredTrajectory,
        Measures,
        TrajectoryFiles,
        measure_trajectories,
        measure_trajectory,
        measure_trajectory_file,
        write_trajectory,
    )
    from slamfusion.scan import LaserScan
    from slamfusion.slam.registry import load_config
    from slamfusion.trajectory import Trajectory

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "Alignment",
    "AlignmentError",
    "AtomicFiles",
    "CaseFile",
    "CaseFiles",
    "ComparedResults",
    "ComputeDevice",
    "ConfigError",
    "DeviceError",
    "Evaluation",
    "FusedMaps",
    "FusionResult",
    "GraphError",
    "GridError",
    "JudgedPaths",
    "LaserScan",
    "LogError",
    "LogRun",
    "MapFileError",
    "MappedLog",
    "MeasuredTrajectory",
    "Measures",
    "MemoryBudgetError",
    "OccupancyGrid",
    "OptimizedGraph",
    "Pose2",
    "RunConfig",
    "SavedResults",
    "SavedRun",
    "ScanError",
    "SimulatedDrive",
    "SimulationError",
    "SlamFusionError",
    "StartError",
    "StartPose",
    "Trajectory",
    "TrajectoryError",
    "TrajectoryFiles",
    "__version__",
    "align_maps",
    "compare_results",
    "evaluate_maps",
    "fuse_maps",
    "judge_paths",
    "load_config",
    "load_map",
    "load_schema",
    "map_log",
    "measure_distances",
    "measure_trajectories",
    "measure_trajectory",
    "measure_trajectory_file",
    "open_device",
    "open_log",
    "optimize_graph",
    "place_files",
    "read_results",
    "read_trajectory",
    "run_log",
    "save_fused_maps",
    "save_map",
    "save_mapped_log",
    "save_optimized_graph",
    "save_run",
    "save_simulated_drive",
    "simulate_course",
    "write_comparison_plot",
    "write_evaluation",
    "write_judgement",
    "write_results_file",
    "write_trajectory",
]

# Where each name is defined: as above, for the interpreter.
_MODULES: dict[str, tuple[str, ...]] = {
    "compute": ("ComputeDevice", "open_device"),
    "config": ("RunConfig",),
    "errors": (
        "AlignmentError",
        "ConfigError",
        "DeviceError",
        "GraphError",
        "GridError",
        "LogError",
        "MapFileError",
        "MemoryBudgetError",
        "ScanError",
        "SimulationError",
        "SlamFusionError",
        "StartError",
        "TrajectoryError",
    ),
    "align.records": ("Alignment", "FusionResult"),
    "align.starts": ("StartPose",),
    "geometry": ("Pose2",),
    "grid": ("FREE", "OCCUPIED", "UNKNOWN", "OccupancyGrid"),
    "io": ("AtomicFiles", "load_map", "open_log", "read_trajectory", "save_map"),
    "jobs.align": ("align_maps",),
    "jobs.cases": ("CaseFile", "place_files"),
    "jobs.compare": ("ComparedResults", "compare_results", "write_comparison_plot"),
    "jobs.evaluate": ("evaluate_maps", "measure_distances", "write_evaluation"),
    "jobs.fuse": ("FusedMaps", "fuse_maps", "save_fused_maps"),
    "jobs.graph": ("OptimizedGraph", "optimize_graph", "save_optimized_graph"),
    "jobs.judge": ("JudgedPaths", "judge_paths", "write_judgement"),
    "jobs.map_log": ("MappedLog", "map_log", "save_mapped_log"),
    "jobs.records": ("Evaluation", "load_schema"),
    "jobs.results": ("SavedResults", "read_results", "write_results_file"),
    "jobs.run": ("LogRun", "run_log"),
    "jobs.run_files": ("SavedRun", "save_run"),
    "jobs.simulate": ("SimulatedDrive", "save_simulated_drive", "simulate_course"),
    "jobs.trajectory": (
        "CaseFiles",
        "MeasuredTrajectory",
        "Measures",
        "TrajectoryFiles",
        "measure_trajectories",
        "measure_trajectory",
        "measure_trajectory_file",
        "write_trajectory",
    ),
    "scan": ("LaserScan",),
    "slam.registry": ("load_config",),
    "trajectory": ("Trajectory",),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load a public name when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        message = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(message)
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted({*globals(), *__all__})
