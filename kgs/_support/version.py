"""The version of kgs."""

__version__ = "0.1.0"
