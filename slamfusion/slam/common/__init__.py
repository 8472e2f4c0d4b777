"""What the SLAMs share: the ``Mapper`` protocol, scan matching, tiled maps, states, and runs.

``mapper`` is the protocol and its records, ``tracking`` follows the robot from scan to scan with
``matcher``'s search, ``tile_map`` keeps cells on the device, ``state`` writes and reads states, and
``runner`` feeds a log to a mapper.
"""
