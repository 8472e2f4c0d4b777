# The public names of the package, each with the module that it is defined in.

from slamfusion.io.carmen import write_carmen as write_carmen
from slamfusion.io.files import AtomicFiles as AtomicFiles
from slamfusion.io.files import available_memory as available_memory
from slamfusion.io.files import check_memory as check_memory
from slamfusion.io.files import write_atomic as write_atomic
from slamfusion.io.log import LogScan as LogScan
from slamfusion.io.log import ScanLog as ScanLog
from slamfusion.io.log import Skips as Skips
from slamfusion.io.logs import open_log as open_log
from slamfusion.io.map_server import load_map as load_map
from slamfusion.io.map_server import save_map as save_map
from slamfusion.io.trajectories import read_trajectory as read_trajectory
from slamfusion.io.trajectories import write_tum as write_tum
