"""The live page: what the fusion node hears and makes, drawn in a browser while it happens.

``protocol`` says what goes over the wire beside the scene of ``slamfusion.viewer``, ``server``
answers browsers and ``feed`` takes what the node has without keeping it waiting. ``static`` is what
the front end has beside the viewer's: the socket, time and commands. Nothing here knows ROS.
"""
