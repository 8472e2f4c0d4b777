# The public names of the package, each with the module that it is defined in.

from slamfusion.slam.common.mapper import Health as Health
from slamfusion.slam.common.mapper import Mapper as Mapper
from slamfusion.slam.common.mapper import Step as Step
