"""The documentation: pages for Sphinx, and ``docs.generate``, which writes what they repeat."""
