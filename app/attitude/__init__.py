<<<<<<< HEAD
"""An orientation: gyro, accelerometer and magnetometer in, attitude with its covariance out (Kuevor, B20; Brommer)."""
=======
"""Orientation of a device, and the magnetic field it takes its heading from."""
>>>>>>> dis
