"""The live page: what the fusion node hears and makes, drawn in a browser while it happens.

``protocol`` says who may talk to the server and what goes over the wire beside the scene of
``slamfusion.viewer``, ``server`` answers browsers. ``static`` is what the front end has beside the
viewer's: the socket, time and commands. Nothing here knows ROS.
"""
