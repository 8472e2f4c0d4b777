"""Graph SLAM: scans on submaps, loop closures, and a pose graph that makes them agree.

``slam`` is the method. Who owns what::

    GraphSlam
      Localizer             where a scan lies on the local map; whether tracking failed
      LocalMap              the submaps, which one is active, the map components they are in
        Submap              a likelihood field in the frame of its anchor node
      MapGraph              nodes (scans), their poses, constraints and weights; when it is solved
      LoopClosure           pending closures, what was searched when, the node of a failure
        Relocalization      of a kidnapped robot: what was searched, hypotheses and their hits
      ClosureSearch         a scan in one submap: near, in a window, anywhere (keeps nothing)
      DrivenPath            every scan's pose relative to the node before it
      NodeMap               the drawn map

``Localizer`` reads ``LocalMap``. ``LoopClosure`` reads ``LocalMap`` and ``MapGraph``, adds closures
to the graph and, when a robot is relocalized, joins components and moves their poses.
"""
