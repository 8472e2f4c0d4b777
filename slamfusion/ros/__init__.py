"""The ROS 2 nodes: thin faces over the core, and the only place that imports rclpy.

``messages`` turns ROS messages into values and back, ``parameters`` declares a node's parameters
from the configuration, ``frames`` sends and follows transforms, ``worker`` takes the work out of
the callbacks, ``base`` is what every node shares. Nothing is imported here: a program without ROS
may name this package.
"""
