# The modules that are loaded on first use.

from slamfusion.experiments import page as page
from slamfusion.experiments import real_logs as real_logs
from slamfusion.experiments import runs as runs
from slamfusion.experiments import tinyslam as tinyslam
from slamfusion.experiments import trials as trials
