"""Maps over each other in a browser: what the live page, ``show`` and reports have in common.

``scene`` keeps the newest state of everything, ``messages`` finds what of a map has changed and
says it in words and bytes. ``static`` draws it, in plain modules without a build step; ``front``
hands them out, one by one or as a single script.
"""
