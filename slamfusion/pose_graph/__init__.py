"""Pose graphs in the plane: least squares over relative measurements, false closures left out.

``PoseGraph`` is the value, ``optimize`` finds its poses, and ``read_g2o`` / ``write_g2o`` take them
in and out of files. Sparse normal equations are built for all edges at once in NumPy and factorised
by SciPy's SuperLU.
"""
