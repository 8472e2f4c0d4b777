"""The experiments of the papers: each is a script that adds rows to one table of results.

``runs`` does each run once and keeps it; ``page`` makes the tables, tests, sentences and the plot
of the rows. The scripts are ``tinyslam`` ([H16]), ``trials`` ([F16], failures) and ``real_logs``.
"""
