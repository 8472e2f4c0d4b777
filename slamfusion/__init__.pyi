# The public names of the library, each with the module that it is defined in.
# ruff: noqa: I001  (it would write an import a name)

from slamfusion.version import __version__ as __version__
from slamfusion.align.records import Alignment as Alignment, FusionResult as FusionResult
from slamfusion.align.starts import StartPose as StartPose
from slamfusion.compute import ComputeDevice as ComputeDevice, open_device as open_device
from slamfusion.config import RunConfig as RunConfig
from slamfusion.errors import (
    AlignmentError as AlignmentError,
    ConfigError as ConfigError,
    DeviceError as DeviceError,
    GraphError as GraphError,
    GridError as GridError,
    LogError as LogError,
    MapFileError as MapFileError,
    MemoryBudgetError as MemoryBudgetError,
    ScanError as ScanError,
    SimulationError as SimulationError,
    SlamFusionError as SlamFusionError,
    StartError as StartError,
    TrajectoryError as TrajectoryError,
)
from slamfusion.geometry import Pose2 as Pose2
from slamfusion.grid import (
    FREE as FREE,
    OCCUPIED as OCCUPIED,
    UNKNOWN as UNKNOWN,
    OccupancyGrid as OccupancyGrid,
)
from slamfusion.io import (
    AtomicFiles as AtomicFiles,
    load_map as load_map,
    open_log as open_log,
    read_trajectory as read_trajectory,
    save_map as save_map,
)
from slamfusion.jobs.align import align_maps as align_maps
from slamfusion.jobs.cases import CaseFile as CaseFile, place_files as place_files
from slamfusion.jobs.compare import (
    ComparedResults as ComparedResults,
    compare_results as compare_results,
    write_comparison_plot as write_comparison_plot,
)
from slamfusion.evaluation.measured import (
    Measures as Measures,
    measure_trajectory as measure_trajectory,
)
from slamfusion.jobs.evaluate import (
    evaluate_maps as evaluate_maps,
    measure_distances as measure_distances,
    write_evaluation as write_evaluation,
)
from slamfusion.jobs.fuse import (
    FusedMaps as FusedMaps,
    fuse_maps as fuse_maps,
    save_fused_maps as save_fused_maps,
)
from slamfusion.jobs.fuse_documents import Evaluation as Evaluation
from slamfusion.jobs.graph import (
    OptimizedGraph as OptimizedGraph,
    optimize_graph as optimize_graph,
    save_optimized_graph as save_optimized_graph,
)
from slamfusion.jobs.inputs import LogFiles as LogFiles
from slamfusion.jobs.judge import (
    JudgedPaths as JudgedPaths,
    judge_paths as judge_paths,
    write_judgement as write_judgement,
)
from slamfusion.jobs.map_log import (
    MappedLog as MappedLog,
    map_log as map_log,
    save_mapped_log as save_mapped_log,
)
from slamfusion.jobs.records import load_schema as load_schema
from slamfusion.jobs.results import (
    SavedResults as SavedResults,
    read_results as read_results,
    write_results_file as write_results_file,
)
from slamfusion.jobs.run import run_log as run_log
from slamfusion.jobs.run_files import LogRun as LogRun, save_run as save_run
from slamfusion.jobs.simulate import (
    SimulatedDrive as SimulatedDrive,
    save_simulated_drive as save_simulated_drive,
    simulate_course as simulate_course,
)
from slamfusion.jobs.trajectory import (
    MeasuredTrajectory as MeasuredTrajectory,
    measure_trajectories as measure_trajectories,
    write_trajectories as write_trajectories,
)
from slamfusion.scan import LaserScan as LaserScan
from slamfusion.slam.registry import load_config as load_config
from slamfusion.trajectory import Trajectory as Trajectory
