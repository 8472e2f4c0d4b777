# The public names of the package, each with the module that it is defined in.
# ruff: noqa: I001  (it would write an import a name)

from slamfusion.config.core import (
    INTEGER_MAX as INTEGER_MAX,
    PUBLISHED as PUBLISHED,
    YAW_MOST_RAD as YAW_MOST_RAD,
    Checked as Checked,
    ConfigOption as ConfigOption,
    FieldInfo as FieldInfo,
    checked_value as checked_value,
    config_fields as config_fields,
    field_infos as field_infos,
    from_mapping as from_mapping,
    option as option,
    shown_value as shown_value,
    with_values as with_values,
)
from slamfusion.config.fusion import (
    SMALLEST as SMALLEST,
    AlignConfig as AlignConfig,
    EvaluateConfig as EvaluateConfig,
    FusionConfig as FusionConfig,
    FusionMode as FusionMode,
    LiveConfig as LiveConfig,
    NormalizeConfig as NormalizeConfig,
    VoteConfig as VoteConfig,
    VoteMode as VoteMode,
)
from slamfusion.config.ros import (
    FusionNodeConfig as FusionNodeConfig,
    PlayerNodeConfig as PlayerNodeConfig,
    ProducerNodeConfig as ProducerNodeConfig,
    ScanNodeConfig as ScanNodeConfig,
)
from slamfusion.config.run import (
    PICTURE_FORMS as PICTURE_FORMS,
    START_FORM as START_FORM,
    START_M as START_M,
    START_RAD as START_RAD,
    CellModelsConfig as CellModelsConfig,
    DeviceConfig as DeviceConfig,
    ExperimentConfig as ExperimentConfig,
    FailuresConfig as FailuresConfig,
    GraphOptimizerConfig as GraphOptimizerConfig,
    GroundObstacleConfig as GroundObstacleConfig,
    LaserMounting as LaserMounting,
    LogConfig as LogConfig,
    MapFileConfig as MapFileConfig,
    OccupancyEstimatorConfig as OccupancyEstimatorConfig,
    ReportConfig as ReportConfig,
    RunConfig as RunConfig,
    SideBySideConfig as SideBySideConfig,
    SimulateConfig as SimulateConfig,
    TrajectoryConfig as TrajectoryConfig,
    checked_start as checked_start,
    checked_starts as checked_starts,
)
from slamfusion.config.sim import (
    COURSES as COURSES,
    ActionConfig as ActionConfig,
    DrawnPlace as DrawnPlace,
    DriveConfig as DriveConfig,
    LidarConfig as LidarConfig,
    ObstacleConfig as ObstacleConfig,
    PersonConfig as PersonConfig,
    PlaceName as PlaceName,
    WorldConfig as WorldConfig,
)
from slamfusion.config.slam import (
    GMAPPING_PROFILES as GMAPPING_PROFILES,
    CellModel as CellModel,
    GmappingConfig as GmappingConfig,
    GraphConfig as GraphConfig,
    MatcherConfig as MatcherConfig,
    OccupancyEstimator as OccupancyEstimator,
    TinySlamConfig as TinySlamConfig,
)
