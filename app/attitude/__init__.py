"""Orientation of a device, and the magnetic field it takes its heading from."""
