"""The experiments of the papers; each adds rows to one table of results.

``runs`` runs and keeps trials, ``page`` makes tables, tests and plots of the rows. Experiments:
``tinyslam`` ([H16]), ``trials`` ([F16], failures) and ``real_logs``.
"""
