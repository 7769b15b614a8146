"""An orientation: gyro, accelerometer and magnetometer in, attitude with its covariance out (Kuevor, B20; Brommer)."""
