"""How often the shipped policy succeeds after its camera has moved, with and without its own correction.

    python benchmarks/moved_camera.py

The camera of the benchmark is turned on the spot, rolled, or displaced while it looks at the same point, in
several directions. The demonstrations are those of the checkpoint, by the camera as it was.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gym_deltaco.scene_config import SceneConfig
from gym_deltaco.sim import simulation
from gym_deltaco.sim.workspace import CAMERA
from lerobot_deltaco.evaluation.checkpoints import load_policy
from lerobot_deltaco.evaluation.evaluate import evaluate
from lerobot_deltaco.evaluation.records import EvaluationPlan
from lerobot_deltaco.policies.scene.proposals import Background

# Shift of the picture's middle, px of an image that is 256 wide; roll, degrees; displacement, m
MOTIONS = {
    "not moved": (0.0, 0.0, 0.0),
    "shifted by 10 px": (10.0, 0.0, 0.0),
    "shifted by 37 px": (37.0, 0.0, 0.0),
    "turned by 2 degrees": (0.0, 2.0, 0.0),
    "shifted by 10 px, turned by 2 degrees": (10.0, 2.0, 0.0),
    "displaced by 1 cm": (0.0, 0.0, 0.01),
}
DIRECTIONS = 4
camera_matrices, undo_motion = simulation.camera_matrices, Background.undo_motion


def rotation(axis: int, angle: float) -> NDArray[np.float64]:
    """Returns a rotation about an axis by an angle in radians, as a matrix (4, 4)."""
    first, second = (n for n in range(3) if n != axis)
    matrix = np.eye(4)
    matrix[[first, second], [first, second]] = math.cos(angle)
    matrix[first, second], matrix[second, first] = -math.sin(angle), math.sin(angle)
    return matrix


def move_camera(shift: float, roll: float, displacement: float, direction: float) -> None:
    """Moves the benchmark's camera in a direction, radians. See `MOTIONS`."""
    pan = math.atan(shift / 256 * 2 * math.tan(math.radians(CAMERA.fov / 2)))
    turn = rotation(1, pan * math.cos(direction)) @ rotation(0, pan * math.sin(direction))
    turn = turn @ rotation(2, math.radians(roll) * math.copysign(1, math.cos(3 * direction + 1)))
    around = math.degrees(displacement / CAMERA.distance)
    yaw = CAMERA.yaw + around * math.cos(direction) / math.cos(math.radians(CAMERA.pitch))
    moved = replace(CAMERA, yaw=yaw, pitch=CAMERA.pitch + around * math.sin(direction))

    def matrices(camera: simulation.Camera) -> tuple[list[float], list[float]]:
        if camera != CAMERA:
            return camera_matrices(camera)
        view, projection = camera_matrices(moved)
        view = turn @ np.array(view).reshape(4, 4).T
        return view.T.flatten().tolist(), projection

    simulation.camera_matrices = matrices


def main() -> None:
    """Prints the rates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", type=Path, default=Path("checkpoints/pick_place"))
    parser.add_argument("--tasks", default="scenario_a_test")
    parser.add_argument("--demo-root", type=Path, help="demonstrations, in place of the checkpoint's own")
    parser.add_argument("--objects", default="all")
    parser.add_argument("--image-size", type=int, default=48)
    parser.add_argument("--motions", nargs="+", default=list(MOTIONS), choices=MOTIONS)
    parser.add_argument("--seed", type=int, default=9600)
    arguments = parser.parse_args()
    demonstrations = (
        [f"--demo_repo_id=local/{arguments.demo_root.name}", f"--demo_root={arguments.demo_root}"]
        if arguments.demo_root
        else []
    )
    loaded = load_policy(arguments.policy, demonstrations)
    scene = SceneConfig(objects=arguments.objects, image_size=arguments.image_size)
    plan = EvaluationPlan(tasks=arguments.tasks, trials=1, seed=arguments.seed, scene=scene)
    for name in arguments.motions:
        for is_corrected in (True, False):
            Background.undo_motion = undo_motion if is_corrected else lambda _, images, __: images
            outcomes, grasps = [], []
            for n in range(DIRECTIONS):
                move_camera(*MOTIONS[name], direction=2 * math.pi * (n + 0.5) / DIRECTIONS)
                rows = evaluate(loaded, replace(plan, seed=plan.seed + n))
                outcomes += rows["success"].tolist()
                grasps += rows["right_object"].tolist()
            sys.stdout.write(
                f"{name:38} {'corrected' if is_corrected else 'as seen':10} "
                f"{100 * np.mean(outcomes):5.1f} % of {len(outcomes)}, the right object grasped in "
                f"{100 * np.mean(grasps):5.1f} %\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
