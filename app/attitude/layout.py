"""Where everything is in the arrays of the filter, and the constants of its logic that no option tells."""

from numpy import pi

ANGLE, BIAS, VELOCITY, FIELD, IRON, SIZE = 0, 3, 6, 9, 12, 15
"""Blocks of three of the error and of its covariance; the mean starts at BIAS."""

T, T_GYRO, T_FORCE, T_MAG = 0, 1, 2, 3
LAST_GYRO, LAST_FORCE, MEAN_GYRO, MEAN_FORCE, MEAN_RESIDUAL = 4, 7, 10, 13, 16
STILL_S, DISTURBANCE, FORCE_REJECTED_S, MAG_REJECTED_S, NORTH_SET, GRAVITY = 19, 20, 21, 22, 23, 24
SUM_WEIGHT, SUM_POWER, SUM_FIELD, SUM_IRON, SUM_R, SUM_END = 25, 26, 27, 30, 33, 42
NORTH, DECLINATION, DECLINATION_RAD2, MENDING_S, KEPT = 42, 43, 44, 45, 46
"""What is kept between samples besides mean and covariance: times, last and smoothed readings, how long rejected."""

REST_MEAN_S, REST_CORRELATION_S, REST_SPEED_M_S = 0.5, 1.0, 0.02
"""Readings at rest: how they are smoothed, how long an error of the rate lasts, and the speed of what lies still."""
RELEVELLED_RAD, LOST_RAD2 = 0.2, 0.1
"""Tilt after it was set from the accelerometer, and the variance at which small angles are given up."""
NORTH_SET_S, UNKNOWN_YAW_RAD2 = 0.3, pi * pi / 3.0
"""How long readings are averaged to set north, and the variance of an angle of which nothing is known."""
RESIDUAL_MEAN_S = 0.3
BLAME_S, BLAME_SPREAD, BLAME_UT, BLAME_SHARE, LEAST_SPREAD, BLAMED_UT, MEND_S = 3.0, 0.2, 3.0, 0.7, 0.005, 1.5, 10.0
"""Hard iron is blamed for what it explains: seconds looked back on, the rotation and the scatter (uT) needed to judge,

the share of the scatter it must explain, what keeps the sums invertible, how well it is then known (uT), and how long
the learned field is doubted after that."""
