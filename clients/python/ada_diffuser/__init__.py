"""Python side of Ada-Diffuser: client, environments, data collection, evaluation."""

__version__ = "0.1.0"
