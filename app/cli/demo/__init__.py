"""`isodyn demo`: a building, walks, maps and positions end to end, over HTTP alone."""

from app.cli.demo.command import demo

__all__ = ["demo"]
