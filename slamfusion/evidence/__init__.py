"""What the scans of a drive say of its paths, without a ground truth.

``beams`` chooses the hits that all paths are scored on, and ``predictive`` scores each path by how
well what was seen at other times predicts them. ``displacement`` finds where a path draws walls
twice, ``parting`` where two paths part, ``conditions`` what the robot suffers. ``fused_path`` makes
one path of several, ``refined_path`` aligns all scans along it, on the walls of ``patches``, and
``refinement`` takes that path unless the scans contradict it. ``drawn_map`` draws the map along a
path, and ``recommendation`` gives the one answer: which map and path, and what to check.
"""
