"""The ROS 2 nodes: thin faces over the core, and the only place that imports rclpy.

Every node: ``base`` is what all share, ``parameters`` declares a node's parameters from the
configuration, ``messages`` turns ROS messages into values and back, ``frames`` sends and follows
transforms, ``qos`` has the qualities of service. ``player_node``; ``producer_node`` with its
``scan_input``; ``fusion_node`` with ``fusion_inputs`` (which maps), ``input_health`` (whether each
is well), ``fused_frames``, ``fusion_services``, ``live_page``.
``live_client`` asks a fusion node from outside. Nothing is imported here: a program without ROS may
name this package.
"""
