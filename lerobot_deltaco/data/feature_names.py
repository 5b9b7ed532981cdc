"""Names of the features of the benchmark's datasets, and of their dimensions."""

STATE_NAMES = [
    *("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"),
    *("end_effector_x", "end_effector_y", "end_effector_z", "gripper_open"),
]
ACTION_NAMES = ["delta_x", "delta_y", "delta_z", "gripper"]
# Outside `observation.`, so that no policy takes them for an input.
PRIVILEGED = ("benchmark.task_id", "benchmark.target_object", "benchmark.target_container", "benchmark.seed")
# LeRobot adds these to the features of every dataset.
DEFAULT_FEATURES = {
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    **{
        name: {"dtype": "int64", "shape": [1], "names": None}
        for name in ("frame_index", "episode_index", "index", "task_index")
    },
}
