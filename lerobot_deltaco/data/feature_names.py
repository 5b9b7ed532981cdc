"""What the numbers in the benchmark's datasets are called."""

STATE_NAMES = [
    *("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"),
    *("end_effector_x", "end_effector_y", "end_effector_z", "gripper_open"),
]
ACTION_NAMES = ["delta_x", "delta_y", "delta_z", "gripper"]
# Outside `observation.`, so that no policy takes them for an input.
PRIVILEGED = ("benchmark.task_id", "benchmark.target_object", "benchmark.target_container", "benchmark.seed")
