"""The one configuration tree: frozen dataclasses, all defaults here and nowhere else.

Every field carries its help text, unit, range and level (``public`` or ``expert``) as metadata.
The command line builds its options from them, the nodes their parameters, the documentation its
tables.
"""

from __future__ import annotations

from slamfusion.config.core import (
    INTEGER_MAX,
    PUBLISHED,
    Checked,
    FieldInfo,
    Profiled,
    checked_value,
    field_infos,
    from_mapping,
    option,
    split_list,
    to_mapping,
)
from slamfusion.config.experiments import (
    CellModelsConfig,
    ExperimentConfig,
    FailuresConfig,
    GroundObstacleConfig,
    OccupancyEstimatorConfig,
)
from slamfusion.config.fusion import (
    SMALLEST,
    AlignConfig,
    EvaluateConfig,
    FusionConfig,
    FusionMode,
    LiveConfig,
    NormalizeConfig,
    VoteConfig,
    VoteMode,
)
from slamfusion.config.graph import (
    GraphClosureConfig,
    GraphRelocalizationConfig,
    GraphTrackingConfig,
)
from slamfusion.config.ros import FusionNodeConfig, PlayerNodeConfig, ProducerNodeConfig
from slamfusion.config.run import (
    PICTURE_FORMS,
    DeviceConfig,
    LogConfig,
    MapFileConfig,
    ReportConfig,
    RunConfig,
    SideBySideConfig,
    TrajectoryConfig,
)
from slamfusion.config.sim import (
    ActionConfig,
    DrawnPlace,
    DriveConfig,
    LidarConfig,
    ObstacleConfig,
    PersonConfig,
    PlaceName,
    SimulateConfig,
    WorldConfig,
)
from slamfusion.config.slam import (
    GMAPPING_PROFILES,
    CellModel,
    GmappingConfig,
    GraphConfig,
    GraphOptimizerConfig,
    MatcherConfig,
    OccupancyEstimator,
    TinySlamConfig,
)
from slamfusion.config.start import (
    START_FORM,
    START_M,
    START_RAD,
    checked_start,
    checked_starts,
)

__all__ = [
    "GMAPPING_PROFILES",
    "INTEGER_MAX",
    "PICTURE_FORMS",
    "PUBLISHED",
    "SMALLEST",
    "START_FORM",
    "START_M",
    "START_RAD",
    "ActionConfig",
    "AlignConfig",
    "CellModel",
    "CellModelsConfig",
    "Checked",
    "DeviceConfig",
    "DrawnPlace",
    "DriveConfig",
    "EvaluateConfig",
    "ExperimentConfig",
    "FailuresConfig",
    "FieldInfo",
    "FusionConfig",
    "FusionMode",
    "FusionNodeConfig",
    "GmappingConfig",
    "GraphClosureConfig",
    "GraphConfig",
    "GraphOptimizerConfig",
    "GraphRelocalizationConfig",
    "GraphTrackingConfig",
    "GroundObstacleConfig",
    "LidarConfig",
    "LiveConfig",
    "LogConfig",
    "MapFileConfig",
    "MatcherConfig",
    "NormalizeConfig",
    "ObstacleConfig",
    "OccupancyEstimator",
    "OccupancyEstimatorConfig",
    "PersonConfig",
    "PlaceName",
    "PlayerNodeConfig",
    "ProducerNodeConfig",
    "Profiled",
    "ReportConfig",
    "RunConfig",
    "SideBySideConfig",
    "SimulateConfig",
    "TinySlamConfig",
    "TrajectoryConfig",
    "VoteConfig",
    "VoteMode",
    "WorldConfig",
    "checked_start",
    "checked_starts",
    "checked_value",
    "field_infos",
    "from_mapping",
    "option",
    "split_list",
    "to_mapping",
]
