"""The version of the package, for every module below the package's own."""

__version__ = "0.1.0"
