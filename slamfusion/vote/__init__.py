"""Let aligned maps decide the cells of one map.

``tiles`` weighs the maps by how well their walls agree and decides a tile; memory, stores and the
live fusion all call it. ``walls`` prepares what a map shows there.
"""
