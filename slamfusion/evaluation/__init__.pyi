# The module that is loaded on first use.

from slamfusion.evaluation import measured as measured
