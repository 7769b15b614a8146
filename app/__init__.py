"""Isodyn: magnetic maps of buildings. Walk in, position out. See README.md and docs/architecture.md."""

__version__ = "0.1.0"
