# The modules that are loaded on first use.

from slamfusion.jobs import align as align
from slamfusion.jobs import compare as compare
from slamfusion.jobs import doctor as doctor
from slamfusion.jobs import evaluate as evaluate
from slamfusion.jobs import fuse as fuse
from slamfusion.jobs import fuse_documents as fuse_documents
from slamfusion.jobs import graph as graph
from slamfusion.jobs import info as info
from slamfusion.jobs import judge as judge
from slamfusion.jobs import map_log as map_log
from slamfusion.jobs import results as results
from slamfusion.jobs import run as run
from slamfusion.jobs import run_files as run_files
from slamfusion.jobs import run_many as run_many
from slamfusion.jobs import simulate as simulate
from slamfusion.jobs import trajectory as trajectory
