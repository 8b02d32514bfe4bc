"""Grasp pose from arrays that are already in memory, with noise stated and biases of the sensor left out."""

from __future__ import annotations

import numpy as np

from factorgrasp import solve
from factorgrasp.problems import GraspNoise, GraspPose, GraspSettings
from factorgrasp.recordings import ImuStream, PoseStream
from factorgrasp.simulation import make_scenario
from factorgrasp.simulation.grasp import RobotSensing

# Stand-ins for your own arrays. Times in s on each side's own clock; NaN rows and missing stamps are gaps.
simulated = make_scenario("cehajic2015", seed=1, duration=30.0, robot=RobotSensing("pose", 500.0, 5e-5, 5e-5))
robot_time, position, quaternion_wxyz = (
    simulated.robot.t,
    simulated.robot.position,
    simulated.robot.rotation_wxyz,
)
imu_time, angular_velocity, specific_force = (
    simulated.hand.t,
    simulated.hand.angular_velocity,
    simulated.hand.specific_force,
)

problem = GraspPose(
    robot=PoseStream(robot_time, position, quaternion_wxyz),
    hand=ImuStream(imu_time, angular_velocity, specific_force),
    noise=GraspNoise(
        gyro_density=9e-4, accelerometer_density=2e-3
    ),  # rad/s/sqrt(Hz), m/s^2/sqrt(Hz), from the data sheet
    settings=GraspSettings(time_offset=False),  # both sides were stamped by one clock
    gravity=(0.0, 0.0, -9.80665),
)
estimate = solve(problem)

if not estimate.status.ok:
    raise SystemExit(estimate.message)
sd = np.sqrt(np.diag(estimate.covariance))
print("p_r_h [mm]", np.round(1e3 * estimate.translation, 2), "sd", np.round(1e3 * sd[3:], 2))
print("truth [mm]", np.round(1e3 * simulated.truth.translation, 2))
