"""Write the generated parts of README and pages: ``python -m docs.generate``.

A generated part of a page stands between two comments, one that names it and one that ends it. Its
text comes from the code: settings, commands, nodes, the JSON schema, recorded benchmarks.
"""
