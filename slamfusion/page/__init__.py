"""The live page: what the fusion node hears and makes, drawn in a browser while it happens.

``protocol`` says what goes over the wire, ``tiles`` finds what of a map has changed, ``scene``
keeps the newest state of everything, ``server`` answers browsers and ``feed`` takes what the node
has without keeping it waiting. ``static`` is the front end, plain modules. Nothing here knows ROS.
"""
