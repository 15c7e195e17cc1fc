"""The cell in space: kinematics, motions, and the step test as it is planned."""
